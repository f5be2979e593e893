"""What Foxglove and Lichtblick are sent."""

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from imudrv.nav.attitude import turn
from imudrv.records import INCREMENTS, Records

foxglove = pytest.importorskip("foxglove")
decoder = pytest.importorskip("mcap_ros2.decoder")

from imudrv.viewer import POSE_TOPIC, Viewer, start_server  # noqa: E402


def turning(samples: int, rate_rad_s: float) -> Records:
    """A unit at rest that then turns about the vertical, its Y axis upwards."""
    increments = np.zeros(samples, INCREMENTS)
    increments["counter"] = np.arange(samples)
    increments["t_ns"] = 1_700_000_000_000_000_000 + np.arange(samples) * 1_000_000
    increments["interval_ns"] = 1_000_000
    increments["dv_b"] = [0.0, 9.8e-3, 0.0]
    increments["dtheta_b"][:, 1] = rate_rad_s * 1e-3
    increments["flags"] = 1
    return increments


def test_samples_and_the_attitude_are_published(tmp_path: Path) -> None:
    context = foxglove.Context()
    increments = turning(1000, np.pi / 2)
    with foxglove.open_mcap(tmp_path / "shown.mcap", context=context):
        viewer = Viewer(context)
        for piece in np.split(increments, 10):
            viewer.publish(piece)
    with (tmp_path / "shown.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        shown = [sample for *_, sample in reader.iter_decoded_messages(topics=["/imu50/samples"])]
        poses = [(c.message_encoding, m) for _, c, m in reader.iter_messages(topics=[POSE_TOPIC])]
    assert [sample.counter for sample in shown] == list(range(1000))
    assert all(sample.flags.valid for sample in shown)
    assert [sample.angular_rate.y for sample in shown] == pytest.approx([np.pi / 2] * 1000, rel=1e-6)
    assert len(poses) == 50, "50 a second"
    assert viewer.attitude is not None
    # Its Y axis still points upwards, and its X axis has turned by a quarter: from east to north.
    assert turn(viewer.attitude, (0.0, 1.0, 0.0)) == pytest.approx((0.0, 0.0, 1.0), abs=1e-9)
    assert turn(viewer.attitude, (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0), abs=1e-9)


def test_a_server_listens_on_the_loopback() -> None:
    server = start_server(0)
    try:
        assert server.port > 0
    finally:
        server.stop()
