import numpy as np
import pytest

from imudrv.nav.noise import fit_noise_model

LAGS = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
MODEL = np.stack([np.full(5, 20.0), LAGS**3], axis=1)


@pytest.mark.parametrize("parts", [(1e-8, 1e-12), (1e-8, 0.0), (0.0, 1e-12)])
def test_variances_that_follow_the_model_give_its_parts_back(parts: tuple[float, float]) -> None:
    variance = MODEL @ parts
    # nnls stops at its own tolerance, far above rounding; the parts span four decades
    assert fit_noise_model(variance, MODEL, 1.0 / variance) == pytest.approx(parts, rel=1e-9, abs=1e-20)


def test_no_part_is_negative() -> None:
    falling = 20.0 * np.array([5.0, 4.0, 3.0, 2.0, 1.0])  # a random walk would have to be negative
    white, walk = fit_noise_model(falling, MODEL, np.ones(5))
    # the best constant, where all weigh alike, is the mean
    assert white == pytest.approx(3.0)
    assert walk == 0.0
