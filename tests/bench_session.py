"""A small session of a simulated unit, and journals with forged lines."""

import json
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from calib.bench.entries import AcceptedStep, EmbeddedFile, from_json
from calib.bench.session import Session
from imudrv.calibration import write_calibration
from imudrv.files import settings_file
from imudrv.sim.scenario import NOMINAL
from imudrv.site import Site

DEGC = {"gyro": 35.0, "accelerometer_x": 36.0}
PROCEDURE = """
format: imu50-procedure
version: 1
name: two
poses: [{id: z-up, up: +Z, east: +X, turn_deg: 180}, {id: x-up, up: +X, east: +Y, turn_deg: 180}]
"""
SHORT = """
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
"""Three poses with the shortest alignment, for rehearsals."""
ACCEPTED = {
    "first_counter": 1000,
    "last_counter": 1899,
    "angle_deg": 180.0,
    "duration_s": 3.0,
    "peak_deg_per_s": 110.0,
    "axis_tilt_deg": 0.1,
    "rest_before_s": 30.0,
    "rest_after_s": 4.0,
    "level_sigma_deg": 0.001,
    "heading_sigma_deg": 0.05,
    "heading_deg": 1.0,
    "v_n": [0.0, 0.0, 0.0],
}
"""Fields of an accepted step as the first version journaled them, without its number of samples."""


def embedded(path: Path) -> EmbeddedFile:
    return EmbeddedFile.of(path, path.read_bytes())


def begin(
    folder: Path,
    profile: str = "imu50-rs422",
    unit: str = NOMINAL.serial_number,
    bench: str = "",
    operator: str = "",
) -> Session:
    """A session whose unit's files are beside it."""
    files = folder.parent
    write_calibration(files / "unit.yaml", NOMINAL.model_copy(update={"serial_number": unit}))
    settings_file.write(files / "site.yaml", Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0))
    (files / "bench.yaml").write_text(PROCEDURE)
    return Session.create(
        folder,
        procedure=embedded(files / "bench.yaml"),
        calibration=files / "unit.yaml",
        site=embedded(files / "site.yaml"),
        profile=profile,
        port="/dev/ttyUSB0",
        bench=EmbeddedFile.of("bench.yaml", f"{{format: imu50-bench, version: 1, bench: {bench}}}".encode())
        if bench
        else None,
        operator=operator,
    )


def accepted_step(step_id: str, recording: str, degc: dict[str, float], **more: object) -> AcceptedStep:
    fields = {"step_id": step_id, "attempt": 1, "recording": recording, "temperature_degc": degc}
    step = from_json({"event": "accepted", **ACCEPTED, **fields, **more})
    assert isinstance(step, AcceptedStep)
    return step


def accept(
    session: Session,
    recorded: Callable[..., Path],
    step_id: str,
    degc: dict[str, float] = DEGC,
    since: int = 900,
    **more: object,
) -> None:
    """Accept an attempt with its files; the recording begins at `since`, the attempt at 1000."""
    name = f"run-{step_id}-{session.next_attempt(step_id)}"
    recorded(session.folder / f"{name}.mcap", range(since, 2000))
    (session.folder / f"{name}.npz").write_bytes(name.encode() * 100)
    for suffix in ("mcap", "npz"):
        session.record_file(f"{name}.{suffix}")
    session.append(accepted_step(step_id, f"{name}.mcap", degc, **more))


def chained(lines: Sequence[dict[str, Any] | bytes]) -> bytes:
    """A journal with these lines, each with the right hashes; bytes are the text before the last hash."""
    before, journal = "", b""
    for line in lines:
        if isinstance(line, dict):
            content = {key: value for key, value in line.items() if key not in ("before", "sha256")}
            line = json.dumps({**content, "before": before})[:-1].encode()
        before = sha256(line).hexdigest()
        journal += line + f', "sha256": "{before}"}}\n'.encode()
    return journal
