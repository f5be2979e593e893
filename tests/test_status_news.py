import json
from pathlib import Path

from imudrv.calibration import write_calibration
from imudrv.hostclock import now_ns
from imudrv.service.loop import Service
from imudrv.service.settings import Settings
from imudrv.sim.scenario import NOMINAL


def test_the_status_has_news_at_the_next_turn_and_the_rate_is_still_over_a_whole_second(
    tmp_path: Path,
) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    settings = Settings(
        port=str(tmp_path / "nothing"),
        profile="imu50-rs422",
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
    )
    service = Service(settings, lambda _: None)
    try:
        now = now_ns() + 1_000_000_000
        service._poll(now)
        service._samples += 100
        service._event("something happened")
        service._poll(now + 100_000_000)
        status = json.loads(service._line)
        assert status["events"][-1].endswith("something happened")
        assert status["rate_hz"] == 0.0
        service._poll(now + 1_000_000_000)
        assert json.loads(service._line)["rate_hz"] == 100.0
    finally:
        service._open.close()
