"""Target: journals of sessions, as `calib verify` reads them."""

import contextlib
import functools
import hashlib
import json
import tempfile
from pathlib import Path
from typing import Any, Final

from numpy.random import Generator

from calib.bench.state import JOURNAL
from calib.bench.verify import verify
from calib.procedure import plan
from imudrv.errors import InputError

from .chain import CALIBRATION
from .properties import Cuts, Setup
from .random_input import mutated, pick
from .settings import changed
from .units import TEXTS

NUMBERS: Final = {
    **dict.fromkeys(("angle_deg", "duration_s", "peak_deg_per_s", "axis_tilt_deg", "rest_before_s"), 1.5),
    **dict.fromkeys(("rest_after_s", "level_sigma_deg", "heading_sigma_deg", "heading_deg"), 0.01),
}
DEGC: Final = {"gyro": 35.0, "accelerometer x": None}
SITE: Final = "{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}"


def embedded(name: str, text: str) -> dict[str, str]:
    """Return a file of the plan."""
    return {"name": name, "text": text, "sha256": hashlib.sha256(text.encode()).hexdigest()}


@functools.cache
def entries() -> str:
    """Return the entries of a good session, as JSON."""
    certificate = json.dumps(CALIBRATION)
    digest = hashlib.sha256(certificate.encode()).hexdigest()
    procedure = plan.shipped()[0]
    text = (Path(plan.__file__).parents[1] / "procedures" / f"{procedure}.yaml").read_text()
    step = {"step_id": "z-up", "attempt": 1}
    made: list[dict[str, Any]] = [
        {
            "event": "plan",
            "format": "imu50-session",
            "version": 1,
            "software": "1",
            "unit": "50-0017",
            "port": "/dev/ttyUSB0",
            "certificate": {"path": "/tmp/unit.yaml", "sha256": digest},
            "procedure": embedded(procedure, text),
            "site": embedded("site.yaml", SITE),
            "profile": embedded("imu50-rs422", TEXTS["imu50-rs422"]),
        },
        *(
            {"event": "file", "name": name, "bytes": len(certificate), "sha256_of_file": digest}
            for name in ("before.yaml", "working.yaml")
        ),
        {"event": "heard", "counter": 5, "restarted": False, "temperature_degc": DEGC},
        {"event": "entered", "phase": "place", **step, "counter": 900},
        {"event": "service", "text": "serving"},
        {"event": "rejected", **step, "counter": 1900, "reasons": ["moved"]},
        {"event": "restarted", **step, "counter": 1901, "reasons": ["moved"]},
        {
            "event": "accepted",
            **step,
            "first_counter": 1000,
            "last_counter": 1900,
            "samples": 901,
            **NUMBERS,
            "v_n": [0.0, 0.1, 0.2],
            "recording": "run-z-up-1.mcap",
            "temperature_degc": DEGC,
        },
        {"event": "redone", "step_id": "z-up", "counter": 2000},
        {"event": "skipped", "step_id": "x-up", "counter": 2001},
        {"event": "finished", "accepted": ["z-up"], "skipped": [], "removed": [], "counter": 2002},
        {"event": "aborted", "counter": 2003},
        {"event": "resumed", "left": ["run-z-up-2.mcap"]},
        {"event": "decision", "accepted": True},
        {"event": "end", "velocity_left_m_s": {"without": 0.1, "compensated": 0.01}},
    ]
    return json.dumps(made)


def make_journal(rng: Generator) -> tuple[Setup, bytes]:
    """Return a journal with a good chain of hashes whose values are changed, or a damaged one."""
    made = json.loads(entries())
    for _ in range(rng.integers(4)):
        made = changed(rng, made) if rng.integers(8) == 0 else made
        if isinstance(made, list) and made:
            at = int(rng.integers(len(made)))
            made[at] = changed(rng, made[at])
    lines, before = [], ""
    for entry in made if isinstance(made, list) else [made]:
        text = json.dumps({**entry, "before": before} if isinstance(entry, dict) else entry)[:-1]
        text = pick(rng, (text,) * 40 + ("[" * 200_000, '{"a": ' * 20_000, "", "{", '{"event": "plan"'))
        before = hashlib.sha256(text.encode()).hexdigest()
        lines.append(f'{text}, "sha256": "{before}"}}\n'.encode())
    data = b"".join(lines)
    return None, mutated(rng, data, [lines[0], b"\n", b"{}\n"] if lines else [b""]) if not rng.integers(
        3
    ) else data


def check_journal(_: Setup, data: bytes, __: Cuts) -> None:
    """Check that a session is verified, or its journal refused, and nothing is written."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / JOURNAL).write_bytes(data)
        for certificate in ("before.yaml", "working.yaml"):
            (folder / certificate).write_text(json.dumps(CALIBRATION))
        with contextlib.suppress(InputError):
            str(verify(folder))
        assert len(list(folder.iterdir())) == 3
