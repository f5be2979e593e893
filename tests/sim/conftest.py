from collections.abc import Callable
from typing import Any

import pytest

from imudrv.files.settings_file import parse
from imudrv.sim.scenario import Scenario

SITE = {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0, "gravity_m_s2": 9.79}


@pytest.fixture(scope="session")
def scenario() -> Callable[..., Scenario]:
    """Make a scenario from its motion and any other sections."""

    def make(*motion: dict[str, Any], **sections: Any) -> Scenario:
        document = {
            "format": "imu50-scenario",
            "version": 1,
            "seed": 7,
            "site": SITE,
            "motion": list(motion),
            **sections,
        }
        return parse(document, Scenario, "test")

    return make
