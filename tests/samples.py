"""Small files that several tests need: the shortest certificate and a short recording."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imudrv import profiles
from imudrv.records import INCREMENTS, PULSES, Arrival, Source
from imudrv.sinks.base import Batch
from imudrv.sinks.recorder import Recorder
from imudrv.wire.datagram import encode

CERTIFICATE = """\
format: imu50-calibration
version: 1
serial_number: "50-0017"
created: 2026-11-22T10:00:00Z
gyro:
  scale_arcsec_per_pulse: [0.5, 0.5, 0.5]
  bias_deg_per_h: [0.0, 0.0, 0.0]
  C_bg: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
accelerometer:
  scale_pulse_per_m_s: [2000.0, 2000.0, 2000.0]
  bias_ug: [0.0, 0.0, 0.0]
  C_ba: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
"""


def record(path: Path, samples: int) -> None:
    """Record samples, a status, an event and a change of the calibration."""
    profile = "imu50-rs422"
    recorder = Recorder(
        path,
        layout=profiles.load(profile).layout(),
        profile=profiles.content(profile),
        calibration=CERTIFICATE.encode(),
        source=Source.SIMULATOR,
        port="sim://x.yaml",
        unit="50-0017",
    )
    for n in range(samples):
        increments = np.zeros(1, INCREMENTS)
        increments["counter"], increments["interval_ns"] = n, 1_000_000
        increments["flags"] = 1
        recorder.arrived(Arrival(1000 + n, b"%044d" % n).block)
        recorder.publish(Batch(np.zeros(1, PULSES), increments, encode(increments, Source.SIMULATOR)))
    recorder.status(lambda: {"rate_hz": 1000.0})
    recorder.event(5000, "unplugged")
    recorder.calibration(6000, CERTIFICATE.replace("0.5, 0.5, 0.5", "0.6, 0.6, 0.6").encode())
    recorder.close()


def parse_json(text: str) -> Any:
    """JSON as DuckDB and spreadsheets read it: the keys of an object differ in more than their case."""

    def keyed(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
        names = [name.casefold() for name, _ in pairs]
        assert len(set(names)) == len(names), sorted(name for name, _ in pairs)
        return dict(pairs)

    return json.loads(text, object_pairs_hook=keyed)
