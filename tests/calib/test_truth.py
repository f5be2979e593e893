import numpy as np

from calib.lever_arms.gauge import LeverArms, convert
from calib.reports.text import as_text
from calib.reports.truth import calibration_comparison, comparison
from imudrv.sim.scenario import NOMINAL
from imudrv.units import MM

TRUE = LeverArms(np.array([[24.0, -11, -9], [-23, 29, -7], [-1, -18, 16]]) * MM, None, "centroid")


def test_a_common_shift_of_the_points_is_no_error() -> None:
    shown = as_text(comparison(convert(TRUE, "x"), TRUE, "truth.yaml"))

    assert "rms error of the nine components, from their centroid  0.0000 mm" in shown
    assert " u " not in shown  # there is no covariance


def test_errors_are_shown_beside_their_uncertainty() -> None:
    # 0.03 mm along Y of accelerometer x: 0.02 from the centroid, -0.01 of the other two
    off = TRUE.r_b + np.array([[0.0, 0.03, 0.0], [0, 0, 0], [0, 0, 0]]) * MM
    covariance = np.eye(9) * (0.01 * MM) ** 2  # 0.0141 of a difference

    shown = as_text(comparison(LeverArms(off, covariance, "given"), TRUE, "truth.yaml"))

    assert f"{np.sqrt((0.02**2 + 2 * 0.01**2) / 9.0):.4f} mm" in shown
    assert "largest error of a difference                          2.1 u" in shown
    assert "r_x - r_z, error" in shown
    assert shown.count("0.0300") == 2
    assert shown.count("0.0141") == 6


def test_a_session_of_the_noise_has_nothing_to_compare() -> None:
    shown = as_text(calibration_comparison(NOMINAL, NOMINAL, "the simulated unit"))

    assert "Nothing to compare: the session estimated no calibration." in shown
    assert "largest error" not in shown
