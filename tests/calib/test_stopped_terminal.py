"""Rehearsal at a terminal that accepts no output for a while, as after Ctrl-S or when ssh hangs."""

import json
import os
import pty
import subprocess
import sys
from pathlib import Path
from threading import Event, Thread
from typing import Any

import realtime

from calib.bench.state import JOURNAL
from calib.bench.verify import verify

PROCEDURE = """
format: imu50-procedure
version: 1
name: short
align_s: 30
rest_s: 4
poses:
  - {id: z-up, up: +Z, east: +X, turn_deg: 180}
  - {id: x-up, up: +X, east: +Y, turn_deg: 180}
  - {id: y-up, up: +Y, east: +Z, turn_deg: 180}
"""
SPEED = 25
CTRL_S, CTRL_Q = b"\x13", b"\x11"


class Terminal:
    """A terminal that accepts output only while it is read and not stopped by Ctrl-S."""

    def __init__(self) -> None:
        self._master, self.slave = pty.openpty()
        self.is_read = Event()
        self.is_read.set()
        self.text = b""
        Thread(target=self._read, daemon=True).start()

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def _read(self) -> None:
        while self.is_read.wait():
            try:
                self.text += os.read(self._master, 1 << 16)
            except OSError:
                return


def journal(folder: Path) -> list[dict[str, Any]]:
    path = folder / JOURNAL
    return [json.loads(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []


def test_a_terminal_that_accepts_no_output_for_a_whole_step_costs_no_data(tmp_path: Path) -> None:
    procedure, folder, terminal = tmp_path / "short.yaml", tmp_path / "session", Terminal()
    procedure.write_text(PROCEDURE)
    command = ["run", "--rehearse", "--speed", str(SPEED), "--procedure", str(procedure)]
    process = subprocess.Popen(
        [sys.executable, "-m", "calib", *command, "--session", str(folder)],
        stdin=terminal.slave,
        stdout=terminal.slave,
        stderr=terminal.slave,
        env={**os.environ, "TERM": "xterm-256color"},
    )

    def until(**fields: str) -> None:
        """Wait for a line of the journal."""

        def has_come() -> bool:
            assert process.poll() is None, terminal.text.decode(errors="replace")[-2000:]
            return any(fields.items() <= entry.items() for entry in journal(folder))

        realtime.until(has_come, str(fields))

    until(step_id="z-up", phase="rest")
    terminal.is_read.clear()
    until(step_id="x-up", event="accepted")
    terminal.is_read.set()
    until(step_id="y-up", phase="place")
    terminal.type(CTRL_S)
    until(step_id="y-up", event="accepted")
    terminal.type(CTRL_Q)
    code = process.wait(realtime.DEADLINE_S)

    assert code == 0, terminal.text.decode(errors="replace")[-2000:]
    accepted = [entry["step_id"] for entry in journal(folder) if entry["event"] == "accepted"]
    assert accepted == ["z-up", "x-up", "y-up", "verification"]
    assert not [entry for entry in journal(folder) if entry["event"] == "rejected"]
    verified = verify(folder)
    assert verified.faults == ()
    assert "the recordings give the certificate, digit for digit" in verified.notes
