from pathlib import Path

import can
import numpy as np
import pytest

from imudrv.profiles import load
from imudrv.records import EXTENDED, PULSES, Records
from imudrv.wire.encode import CanEncoder

SAMPLES = 200  # SqliteWriter loses messages when it is closed with more than 500
BEGIN_NS = 1_700_000_000_000_028_000


@pytest.fixture(scope="session")
def messages() -> Records:
    """Messages of a unit, 1 ms apart, and one of another device with 29 bits."""
    pulses = np.zeros(SAMPLES, PULSES)
    pulses["counter"] = 120_000 + np.arange(SAMPLES)
    pulses["arrival_ns"] = BEGIN_NS + 1_000_000 * np.arange(SAMPLES)
    pulses["gyro"] = np.random.default_rng(1).integers(-300, 300, (SAMPLES, 3))
    pulses["temperature_degc"] = 35.0
    messages = CanEncoder(load("imu50-can").layout()).encode(pulses)
    messages[7]["id"] = EXTENDED | 0x00000150
    return messages


@pytest.fixture(scope="session")
def can_logs(messages: Records, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The messages, an error frame and a remote frame after them, in each format that python-can writes."""
    folder = tmp_path_factory.mktemp("can")
    paths = {suffix: folder / f"unit{suffix}" for suffix in (".asc", ".blf", ".trc", ".csv", ".db")}
    end_s = float(messages["t_ns"][-1] * 1e-9)
    for suffix, path in paths.items():
        with can.Logger(path) as writer:
            for row in messages:
                writer.on_message_received(
                    can.Message(
                        float(row["t_ns"] * 1e-9),
                        int(row["id"]) & ~EXTENDED,
                        is_extended_id=bool(row["id"] & EXTENDED),
                        data=row["data"][: row["length"]].tobytes(),
                        channel=0,
                    )
                )
            if suffix != ".trc":  # its writer writes both as data
                writer.on_message_received(can.Message(end_s, is_error_frame=True, channel=0))
                writer.on_message_received(can.Message(end_s, 0x150, is_remote_frame=True, channel=0))
    return paths
