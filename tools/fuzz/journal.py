"""Target: the journal of a session."""

import contextlib
import json
import os
import tempfile
from functools import cache
from hashlib import sha256
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator

from calib.bench.entries import Decision, EmbeddedFile, ServiceMessage, SessionEnded, from_json
from calib.bench.resume import check_files, require_same
from calib.bench.session import Session
from calib.bench.state import JOURNAL, LOCK
from calib.bench.verify import verify
from imudrv import profiles
from imudrv.calibration import write_calibration
from imudrv.errors import InputError
from imudrv.records import INCREMENTS, PULSES, Arrival, Source
from imudrv.sim.scenario import NOMINAL
from imudrv.sinks.base import Batch
from imudrv.sinks.recorder import Recorder
from imudrv.wire.datagram import encode
from imudrv.wire.encode import StreamEncoder

from .properties import Cuts, Setup
from .random_input import mutated, pick
from .settings import WORDS, changed

PROFILE: Final = "imu50-rs422"
RECORDING: Final = "run-z-up-1.mcap"
DIGEST: Final = b"0" * 64
"""Placeholder for the SHA-256 of the recording, which depends on the time."""
ATTEMPT: Final = {"step_id": "z-up", "attempt": 1}
ACCEPTED: Final = {
    "event": "accepted",
    **ATTEMPT,
    "recording": RECORDING,
    "temperature_degc": {"gyro": 35.0},
    "v_n": [0.0, 0.0, 0.0],
    "first_counter": 10,
    "last_counter": 99,
    **dict.fromkeys(("angle_deg", "duration_s", "peak_deg_per_s", "axis_tilt_deg", "heading_deg"), 1.0),
    **dict.fromkeys(("rest_before_s", "rest_after_s", "level_sigma_deg", "heading_sigma_deg"), 1.0),
}
EVENTS: Final = (
    {"event": "entered", "phase": "place", **ATTEMPT, "counter": 7},
    {
        "event": "rejected",
        **ATTEMPT,
        "reasons": [{"key": "verbatim", "values": {"text": "moved"}}],
        "counter": 8,
    },
    {"event": "redone", **ATTEMPT, "counter": 9},
    {"event": "finished", "accepted": ["z-up"], "skipped": [], "reasons": [], "counter": 10},
)


@cache
def folder() -> Path:
    """Return the folder of a session with one step, which lasts as long as the process."""
    top = Path(_TOP.name)
    write_calibration(top / "unit.yaml", NOMINAL)
    procedure = resources.files("calib") / "procedures" / "three-rotations.yaml"
    session = Session.create(
        top / "session",
        procedure=EmbeddedFile.of("three-rotations", procedure.read_bytes()),
        calibration=top / "unit.yaml",
        site=EmbeddedFile.of("site.yaml", b"{latitude_deg: 28.2, longitude_deg: 113, height_m: 60.0}"),
        profile=PROFILE,
        port="/dev/ttyUSB0",
    )
    _record(session.folder / RECORDING)
    session.record_file(RECORDING)
    for event in (ACCEPTED, *EVENTS):
        session.append(from_json(event))
    for entry in (ServiceMessage("port lost"), Decision(True), SessionEnded(None)):
        session.append(entry)
    session.close()
    return session.folder


_TOP: Final = tempfile.TemporaryDirectory(prefix="fuzz-journal-")


def _record(path: Path) -> None:
    layout = profiles.load(PROFILE).layout()
    content, unit = profiles.content(PROFILE), NOMINAL.serial_number
    recorder = Recorder(
        path, layout=layout, profile=content, calibration=None, source=Source.SIMULATOR, port="", unit=unit
    )
    pulses, increments = np.zeros(100, PULSES), np.zeros(100, INCREMENTS)
    pulses["counter"] = increments["counter"] = np.arange(100)
    recorder.arrived(Arrival(1, StreamEncoder(layout).encode(pulses).tobytes()).block)
    recorder.publish(Batch(pulses, increments, encode(increments, Source.SIMULATOR)))
    recorder.close()


@cache
def _lines() -> list[bytes]:
    """Return the lines of the journal without hashes, times and the name of the folder."""
    journal, digest = (folder() / JOURNAL).read_bytes(), sha256((folder() / RECORDING).read_bytes())
    lines = []
    for line in journal.replace(digest.hexdigest().encode(), DIGEST).splitlines():
        document = json.loads(line)
        for key in ("at", "before", "sha256"):
            del document[key]
        if "certificate" in document:
            document["certificate"]["path"] = "/unit.yaml"
        lines.append(json.dumps(document).encode())
    return lines


def make_journal(rng: Generator) -> tuple[Setup, bytes]:
    """Return the lines of a journal, one of them changed, without their hashes."""
    lines = _lines().copy()
    at = int(rng.integers(len(lines)))
    if rng.integers(3):
        lines[at] = json.dumps(changed(rng, json.loads(lines[at]))).encode()
    else:
        lines[at] = mutated(rng, lines[at], WORDS)
    if rng.integers(8) == 0:
        lines.insert(int(rng.integers(len(lines))), pick(rng, lines))
    return None, b"\n".join(lines)


def check_journal(_: Setup, data: bytes, __: Cuts) -> None:
    """Check that a journal with right hashes is verified or refused, and resumed or refused."""
    with tempfile.TemporaryDirectory() as name:
        for path in folder().iterdir():
            if path.name not in (JOURNAL, LOCK):
                os.link(path, f"{name}/{path.name}")
        digest = sha256((folder() / RECORDING).read_bytes()).hexdigest().encode()
        Path(name, JOURNAL).write_bytes(_chained(data.replace(DIGEST, digest).split(b"\n")))
        verify(Path(name))
        with contextlib.suppress(InputError), contextlib.closing(Session.open(name)) as session:
            check_files(session)
            require_same(session)


def _chained(lines: list[bytes]) -> bytes:
    """Return the lines with the hashes that make them one journal."""
    before, journal = "", b""
    for line in lines:
        text = line.removesuffix(b"}") + f', "before": "{before}"'.encode()
        before = sha256(text).hexdigest()
        journal += text + f', "sha256": "{before}"}}\n'.encode()
    return journal
