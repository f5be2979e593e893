"""Export to sensor_msgs/Imu in an MCAP file for ROS 2."""

from math import isnan
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from imudrv.arrays import Array
from imudrv.calibration import Calibration
from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.files.model import Matrix3
from imudrv.recording.format import ORIGIN
from imudrv.recording.samples import Samples
from imudrv.records import Flag
from imudrv.sensor_calibration import Coefficient
from imudrv.units import ARCSEC, DEG_PER_SQRT_H, MM, NS, NS_PER_S, UG

_END_NS: Final = (1 << 31) * NS_PER_S
"""First time that a builtin_interfaces/Time cannot store: its seconds have 32 bits."""
TOPIC: Final = "/imu/data_raw"
_UNUSABLE: Final = [-1.0] + [0.0] * 8
"""A covariance that says that there is no such value."""

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


class Convention(NamedTuple):
    """Names that ROS 2 gives to frames and axes.

    Parameters
    ----------
    frame_id : str
        Name of the frame of the rates and forces.
    axes : {'flu', 'body'}
        ``flu``: X forward, Y left, Z up, as REP 103 asks for; ``body``: those of the unit, X right, Y front,
        Z up.
    """

    frame_id: str = "imu50"
    axes: str = "flu"


DEFAULT_CONVENTION: Final = Convention()
AXES: Final = {"flu": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), "body": np.eye(3)}
"""Rotation from body axes to each kind of axes."""


def export_ros2(samples: Samples, target: Path, convention: Convention) -> None:
    """Write increments as rates and specific forces, one message a sample.

    The first entry of a covariance is -1 where ROS 2 shall not use the value: of a sample that is not valid,
    and of a sensor that the unit lacks. Other covariances are those of the noise in the certificate, over the
    sample's interval, and 0 (not known) without it.

    Parameters
    ----------
    samples : Samples
        The increments.
    target : Path
        The file, ``.mcap``.
    convention : Convention
        Frame and axes.

    Raises
    ------
    InputError
        The package mcap-ros2-support is absent, the name has another suffix, a sample has no interval or a
        time that ROS 2 cannot store, or the file cannot be written.
    """
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        raise InputError(
            "--to ros2: expected the package mcap-ros2-support: pip install imu50[ros2]"
        ) from error
    if target.suffix != ".mcap":
        raise InputError(
            f"{target}: expected a name ending in .mcap, which ros2 bag and its readers ask for, got "
            f"{target.suffix or 'no suffix'}"
        )
    R = AXES[convention.axes]
    covariances = _Covariances(samples.calibration, R)
    with atomic_write(target) as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/Imu", _IMU_DEFINITION)
        writer.add_metadata(ORIGIN, dict(samples.origin))
        for increments in samples:
            t_ns = increments["t_ns"]
            if (increments["interval_ns"] <= 0).any() or (t_ns < 0).any() or (t_ns >= _END_NS).any():
                raise InputError(
                    f"{samples.path}: expected samples with an interval and a time from 1970 to 2038, got "
                    "others; choose another format"
                )
            interval_s = increments["interval_ns"][:, np.newaxis] * NS
            rates = _turned(R, increments["dtheta_b"] / interval_s).tolist()
            forces = _turned(R, increments["dv_b"] / interval_s).tolist()
            valid = (increments["flags"] & np.uint32(Flag.VALID)).tolist()
            intervals = increments["interval_ns"].tolist()
            for stamp_ns, interval_ns, is_valid, rate, force in zip(
                t_ns.tolist(), intervals, valid, rates, forces, strict=True
            ):
                of_rate, of_force = covariances.over(interval_ns)
                sec, nanosec = divmod(stamp_ns, NS_PER_S)
                message = {
                    "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": convention.frame_id},
                    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                    "orientation_covariance": _UNUSABLE,
                    "angular_velocity": dict(zip("xyz", rate, strict=True)),
                    "angular_velocity_covariance": _usable(of_rate, is_valid, rate),
                    "linear_acceleration": dict(zip("xyz", force, strict=True)),
                    "linear_acceleration_covariance": _usable(of_force, is_valid, force),
                }
                writer.write_message(TOPIC, schema, message, stamp_ns, stamp_ns)
        writer.finish()  # type: ignore[no-untyped-call]


def _turned(R: Array, vectors: Array) -> Array:
    """Return vectors in other axes; each component is one of the old ones, also where another is NaN."""
    axis = np.abs(R).argmax(axis=1)
    turned: Array = vectors[:, axis] * R[np.arange(3), axis]
    return turned


def _usable(covariance: list[float], is_valid: int, values: list[float]) -> list[float]:
    return covariance if is_valid and not all(map(isnan, values)) else _UNUSABLE


class _Covariances:
    """Covariances of rate and specific force over an interval, row by row; zeros: not known."""

    def __init__(self, calibration: Calibration | None, R: Array) -> None:
        self._known: dict[int, tuple[list[float], list[float]]] = {}
        self._calibration, self._R = calibration, R

    def over(self, interval_ns: int) -> tuple[list[float], list[float]]:
        if interval_ns not in self._known:
            self._known[interval_ns] = self._made(interval_ns * NS)
        return self._known[interval_ns]

    def _made(self, T: float) -> tuple[list[float], list[float]]:
        calibration = self._calibration
        if calibration is None or calibration.noise is None:
            return [0.0] * 9, [0.0] * 9
        gyro, accelerometer = calibration.noise.gyro, calibration.noise.accelerometer
        return (
            self._covariance(
                calibration.gyro.C_bg,
                _variance(gyro.angle_random_walk_deg_per_sqrt_h, DEG_PER_SQRT_H, T, 1)
                + _variance(gyro.quantisation_arcsec, ARCSEC, T, 2),
            ),
            self._covariance(
                calibration.accelerometer.C_ba,
                _variance(accelerometer.velocity_random_walk_ug_per_sqrt_hz, UG, T, 1)
                + _variance(accelerometer.quantisation_mm_per_s, MM, T, 2),
            ),
        )

    def _covariance(self, axes: Matrix3, variance: Array) -> list[float]:
        """Turn the variances along the sensing axes into a covariance."""
        C = self._R @ np.array(axes)
        rows: list[float] = (C @ np.diag(variance) @ C.T).ravel().tolist()
        return rows


def _variance(coefficient: Coefficient, unit: float, T: float, kind: int) -> Array:
    """Return the variance of a mean rate over T of an Allan coefficient; 0 for one that is not known.

    A random walk N (kind 1) has N^2 / T. Quantisation Q (kind 2) is white noise of the angle, so that a
    difference of two angles has 2 Q^2, and the rate 2 Q^2 / T^2.
    """
    return kind * (np.array(coefficient or (0.0, 0.0, 0.0)) * unit) ** 2 / T**kind
