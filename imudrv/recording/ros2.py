"""Export to sensor_msgs/Imu in an MCAP file for ROS 2."""

from math import isnan
from pathlib import Path
from typing import Any, Final

import numpy as np

from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.recording.format import ORIGIN
from imudrv.recording.reader import Recording
from imudrv.units import NS, NS_PER_S

_END_NS: Final = (1 << 31) * NS_PER_S
"""First time that a builtin_interfaces/Time cannot store: its seconds have 32 bits."""
TOPIC: Final = "/imu/data_raw"

_IMU_DEFINITION: Final = """\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""


def export_ros2(recording: Recording, target: Path) -> None:
    """Write the increments of a recording as rates and specific forces, one message a sample.

    Parameters
    ----------
    recording : Recording
        The recording.
    target : Path
        The file.

    Raises
    ------
    InputError
        The package mcap-ros2-support is absent, a sample has no interval or a time that ROS 2 cannot store,
        or the file cannot be written.
    """
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        raise InputError(
            "--to ros2: expected the package mcap-ros2-support: pip install imu50[ros2]"
        ) from error
    with atomic_write(target) as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/Imu", _IMU_DEFINITION)
        writer.add_metadata(ORIGIN, recording.origin)
        for increments in recording.increments():
            t_ns = increments["t_ns"]
            if (increments["interval_ns"] <= 0).any() or (t_ns < 0).any() or (t_ns >= _END_NS).any():
                raise InputError(
                    f"{recording.path}: expected samples with an interval and a time from 1970 to 2038, got "
                    "others; choose another format"
                )
            interval_s = increments["interval_ns"][:, np.newaxis] * NS
            rates = (increments["dtheta_b"] / interval_s).tolist()
            forces = (increments["dv_b"] / interval_s).tolist()
            for stamp_ns, rate, force in zip(t_ns.tolist(), rates, forces, strict=True):
                writer.write_message(TOPIC, schema, _imu_message(stamp_ns, rate, force), stamp_ns, stamp_ns)
        writer.finish()  # type: ignore[no-untyped-call]


def _imu_message(t_ns: int, rate: list[float], force: list[float]) -> dict[str, Any]:
    sec, nanosec = divmod(t_ns, NS_PER_S)
    return {
        "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "imu50"},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        "orientation_covariance": [-1.0] + [0.0] * 8,  # there is no orientation
        "angular_velocity": dict(zip("xyz", rate, strict=True)),
        "angular_velocity_covariance": _covariance(rate),
        "linear_acceleration": dict(zip("xyz", force, strict=True)),
        "linear_acceleration_covariance": _covariance(force),
    }


def _covariance(values: list[float]) -> list[float]:
    """Return a covariance that is not known: 0, or -1 first for a sensor that the unit lacks."""
    return [-1.0 if all(map(isnan, values)) else 0.0] + [0.0] * 8
