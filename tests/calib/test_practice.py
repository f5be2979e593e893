"""A rehearsal with a person at the keys: a real process on a real pty, a technician who makes mistakes."""

import json
import os
import pty
import select
import subprocess
import sys
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import pytest
from bench_session import SHORT
from realtime import DEADLINE_S

from calib.bench.run import RunOptions, run
from calib.bench.technician import MISTAKES, Mistake, mistakes_of
from calib.procedure.plan import load
from imudrv.errors import InputError
from imudrv.terminal import console


def key_for(line: str) -> bytes:
    """The key that a line asks for; the verification is left."""
    if "[y/n]" in line:
        return b"y"
    if "step 1 of 1:" in line:
        return b"q"
    return b"\n" if "PRESS ENTER" in line or "REJECTED" in line else b""


def practised(folder: Path, mistakes: str) -> tuple[int, str]:
    """Exit code and output of a rehearsal; the keys are those that the screen asks for."""
    (folder / "short.yaml").write_text(SHORT)
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "calib", "run", "--rehearse", "--keys", "--mistakes", mistakes]
    command += ["--speed", "20", "--procedure", "short.yaml", "--session", "s"]
    environment = {**os.environ, "TERM": "dumb", "XDG_CONFIG_HOME": str(folder)}
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdin=slave, stdout=slave, stderr=subprocess.STDOUT
    )
    os.close(slave)
    shown, answered, answer = "", 0, b""
    limit = Timer(DEADLINE_S, process.kill)
    limit.start()
    while True:
        if not select.select([master], [], [], 1.0)[0]:
            os.write(master, answer)  # keys pressed before a question is complete are no answer to it
            continue
        try:
            shown += os.read(master, 65536).decode(errors="replace")
        except OSError:  # the end, on a pty
            break
        for line in shown[answered:].splitlines(keepends=True):
            if line.endswith("\n") or "[y/n]" in line:  # a prompt has no end of line
                answered += len(line)
                if key := key_for(line):
                    answer = key
                    os.write(master, key)
    os.close(master)
    limit.cancel()
    return process.wait(timeout=DEADLINE_S), shown


def events(folder: Path, kind: str) -> list[dict[str, Any]]:
    lines = map(json.loads, (folder / "s" / "journal.jsonl").read_text().splitlines())
    return [line for line in lines if line["event"] == kind]


def test_a_mistake_is_made_once_rejected_read_and_made_good(tmp_path: Path) -> None:
    code, shown = practised(tmp_path, "wrong-way,moves,wrong-pose")

    assert code == 130, shown
    (rejected,) = events(tmp_path, "rejected")
    assert (rejected["step_id"], rejected["attempt"]) == ("z-up", 1)
    assert rejected["reasons"][0]["key"] == "wrong_direction"
    assert events(tmp_path, "restarted")[0]["step_id"] == "x-up"
    accepted = [(event["step_id"], event["attempt"]) for event in events(tmp_path, "accepted")]
    assert accepted[:3] == [("z-up", 2), ("x-up", 1), ("y-up", 1)]
    assert "last try: wrong direction" in shown
    assert events(tmp_path, "decision")[0]["accepted"]
    assert (tmp_path / "s" / "report.html").exists()
    assert shown.count("active certificate: ") == 2  # when it is accepted, and at the end
    assert "report: s/report.html" in shown


def test_mistakes_are_named_or_random_and_no_more_than_steps() -> None:
    procedure, rng = load("three-rotations"), np.random.default_rng(1)
    assert mistakes_of("slow,wrong-way", procedure, rng) == (
        Mistake("z-up", "slow"),
        Mistake("x-up", "wrong way"),
    )
    drawn = {mistake.kind for _ in range(100) for mistake in mistakes_of("random", procedure, rng)}
    assert drawn == set(MISTAKES)
    with pytest.raises(InputError, match=r"some of moves, wrong-way, .*got 'lazy'"):
        mistakes_of("lazy", procedure, rng)
    with pytest.raises(InputError, match="one a step, 3 at most, got 4"):
        mistakes_of("slow,slow,slow,slow", procedure, rng)


def test_practice_belongs_to_a_rehearsal(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--keys, --mistakes: expected with --rehearse"):
        run(RunOptions(tmp_path / "s", hands_free=True, mistakes="slow"), console())
