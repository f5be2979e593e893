"""Scenarios and frames that the tests send, and how what comes out is compared."""

from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from imudrv import profiles
from imudrv.files.tables import increment_columns
from imudrv.imu.sequence import SampleCounts
from imudrv.recording.reader import Recording
from imudrv.records import PULSES, Records
from imudrv.wire.encode import StreamEncoder

SERIAL: Final = "imu50-rs422"
LAYOUT: Final = profiles.load(SERIAL).layout()
FRAME: Final = LAYOUT.messages[0].length
RATE_HZ: Final = 1000


def profile_at(folder: Path, rate_hz: int) -> str:
    """Write the profile of a serial unit of another sample rate; return its path."""
    document = yaml.safe_load(profiles.load_file(SERIAL).content)
    path = folder / "unit-profile.yaml"
    path.write_text(yaml.safe_dump({**document, "name": f"imu50-{rate_hz}", "sample_rate_hz": rate_hz}))
    return str(path)


def write_scenario(
    folder: Path, duration_s: float, faults: dict[str, Any] | None = None, rate_hz: int = RATE_HZ
) -> int:
    """Write a rocking unit as ``scenario.yaml``; return its number of samples."""
    rock = {"duration_s": duration_s, "band_hz": [0.5, 3.0], "ramp_s": min(1.0, duration_s / 2.0)}
    document = {
        "format": "imu50-scenario",
        "version": 1,
        "seed": 11,
        "site": {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0},
        "motion": [{"rock": {**rock, "rate_rms_deg_per_s": [40.0, 40.0, 40.0]}}],
        "unit": {"noise": {"arw_deg_per_sqrt_h": 0.002, "vrw_m_s_per_sqrt_h": 0.003}},
        "faults": faults or {},
    }
    (folder / "scenario.yaml").write_text(yaml.safe_dump(document))
    return round(duration_s * rate_hz)


def encoded_frames(first: int, count: int) -> NDArray[np.uint8]:
    """Return frames of a slowly oscillating unit, shape (count, FRAME), numbered from `first`."""
    pulses = np.zeros(count, PULSES)
    pulses["counter"] = first + np.arange(count)
    pulses["gyro"] = np.rint(100.0 * np.sin(pulses["counter"] / 50.0))[:, None]
    pulses["accelerometer"] = [0, 0, 20]
    pulses["temperature_degc"] = 35.0
    return StreamEncoder(LAYOUT).encode(pulses)


def difference(increments: Records, npz: Path) -> str:
    """Name the column in which increments differ from the first rows of a file; empty: identical bits."""
    with np.load(npz) as columns:
        for name, column in increment_columns(increments).items():
            other = columns[name][: len(increments)]
            if column.shape != other.shape or column.tobytes() != other.tobytes():
                return f"{name} differs"
    return ""


def last_status(recording: Recording) -> tuple[SampleCounts, dict[str, Any]]:
    """Return the last status of a recording, and its sample counts."""
    *_, (_, status) = recording.statuses()
    return SampleCounts(
        **{name: status["samples"][name] for name in SampleCounts.__dataclass_fields__}
    ), status
