"""Samples as Foxglove and Lichtblick show them live: plots of each field, and the attitude of the unit.

It is a process of its own that receives what the driver sends, so that it costs the driver no more than one
output does.
"""

import time
from collections.abc import Iterable
from types import ModuleType
from typing import Any, Final

import numpy as np

from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.nav.attitude import product, quaternion_of_vector, unit
from imudrv.recording.samples_channel import NAME, TOPIC, SampleEncoder
from imudrv.records import MAX_TEMPERATURES, Records
from imudrv.units import NS, NS_PER_S

POSE_TOPIC: Final = "/imu50/pose"
PORT: Final = 8765
"""Port that Foxglove and Lichtblick try by default."""
_BACKLOG: Final = 1 << 14  # messages a client may be behind
_POSE_NS: Final = NS_PER_S // 50


class Viewer:
    """Publisher of samples and of the attitude that follows from them.

    The attitude begins level, by the specific force of the first samples, with X to the east. It is that of
    the gyros alone, for the eye: nothing corrects it.

    Parameters
    ----------
    context : foxglove.Context, optional
        Where to publish; by default to all servers of this process.

    Attributes
    ----------
    attitude : tuple of float or None
        Quaternion from body axes to level ones, scalar first; None before the first sample.

    Raises
    ------
    InputError
        The package foxglove-sdk is absent.
    """

    def __init__(self, context: Any = None) -> None:
        foxglove = _foxglove()
        self._encoder = SampleEncoder(())
        schema = foxglove.Schema(name=NAME, encoding="ros2msg", data=self._encoder.definition)
        self._samples = foxglove.Channel(TOPIC, schema=schema, message_encoding="cdr", context=context)
        self._pose = foxglove.channels.FrameTransformChannel(POSE_TOPIC, context=context)
        self._messages = foxglove.messages
        self.attitude: tuple[float, float, float, float] | None = None
        self._posed_ns = 0

    def publish(self, increments: Records) -> None:
        """Publish samples.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order.
        """
        if not len(increments):
            return
        rows = self._encoder.encode(increments, np.zeros((len(increments), MAX_TEMPERATURES)))
        for row, t_ns in zip(rows, increments["t_ns"].tolist(), strict=True):
            self._samples.log(row.tobytes(), log_time=max(t_ns, 0))
        for sample in increments[["dtheta_b", "dv_b", "t_ns"]]:
            self._turn(sample)

    def _turn(self, sample: np.void) -> None:
        x, y, z = np.nan_to_num(sample["dtheta_b"]).tolist()
        if self.attitude is None:
            self.attitude = _level(np.nan_to_num(sample["dv_b"]))
        self.attitude = unit(product(self.attitude, quaternion_of_vector((x, y, z))))
        t_ns = max(int(sample["t_ns"]), 0)
        if not 0 <= t_ns - self._posed_ns < _POSE_NS:
            self._posed_ns = t_ns
            w, x, y, z = self.attitude
            messages = self._messages
            self._pose.log(
                messages.FrameTransform(
                    timestamp=messages.Timestamp(t_ns // NS_PER_S, t_ns % NS_PER_S),
                    parent_frame_id="level",
                    child_frame_id="imu50",
                    translation=messages.Vector3(x=0.0, y=0.0, z=0.0),
                    rotation=messages.Quaternion(x=x, y=y, z=z, w=w),
                ),
                log_time=t_ns,
            )


def start_server(port: int = PORT) -> Any:
    """Start the server that Foxglove and Lichtblick connect to, on the loopback.

    Parameters
    ----------
    port : int
        0: any free one.

    Returns
    -------
    foxglove.WebSocketServer
        With its `port`, and `stop`.

    Raises
    ------
    InputError
        The package is absent, or the port is in use.
    """
    foxglove = _foxglove()
    try:
        return foxglove.start_server(name="imu50", port=port, message_backlog_size=_BACKLOG)
    except (OSError, RuntimeError) as error:
        raise InputError(f"--listen {port}: cannot be opened: {error}; choose another port") from error


def play(pieces: Iterable[Records], viewer: Viewer) -> None:
    """Publish recorded samples at the speed at which they were made."""
    begin_s, first_ns = time.monotonic(), None
    for increments in pieces:
        t_ns = int(increments["t_ns"][-1])
        first_ns = t_ns if first_ns is None else first_ns
        time.sleep(min(max(0.0, (t_ns - first_ns) * NS - (time.monotonic() - begin_s)), 1.0))
        viewer.publish(increments)


def _level(dv: Array) -> tuple[float, float, float, float]:
    """Return the shortest rotation that turns the specific force upwards."""
    size = float(np.linalg.norm(dv))
    if size == 0.0:
        return 1.0, 0.0, 0.0, 0.0
    x, y, z = (dv / size).tolist()
    if z < -1.0 + 1e-9:
        return 0.0, 1.0, 0.0, 0.0
    return unit((1.0 + z, y, -x, 0.0))


def _foxglove() -> ModuleType:
    try:
        import foxglove
        import foxglove.channels
        import foxglove.messages
    except ImportError as error:
        raise InputError("view: expected the package foxglove-sdk: pip install imu50[foxglove]") from error
    return foxglove
