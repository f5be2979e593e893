from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from size_effect import size_effect_rate

from calib.lever_arms.gauge import GAUGES, Gauge, LeverArms, convert
from calib.lever_arms.interchange import from_kalibr, from_psins, to_kalibr, to_psins
from imudrv.errors import InputError
from imudrv.units import MM

Array = NDArray[np.float64]
TO_DIFFERENCES = np.kron([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]], np.eye(3))
POINT = (0.01, -0.02, 0.03)


def arms(seed: int = 0) -> LeverArms:
    """Any three points with a covariance of rank 6, in gauge centroid."""
    rng = np.random.default_rng(seed)
    L = rng.normal(size=(9, 9)) * 0.01 * MM
    loose = LeverArms(rng.normal(size=(3, 3)) * 30.0 * MM, L @ L.T, "given")
    return convert(loose, "centroid")


def converted(given: LeverArms, to: Gauge) -> LeverArms:
    return convert(given, to, ("y", POINT) if to == "given" else None)


@pytest.mark.parametrize("to", GAUGES)
@pytest.mark.parametrize("back", GAUGES[:4])
def test_there_and_back_is_the_same(to: Gauge, back: Gauge) -> None:
    start = converted(arms(), back)
    there = converted(start, to)
    again = converted(there, back)
    np.testing.assert_allclose(again.r_b, start.r_b, atol=1e-16)  # rounding of 0.05 m
    assert again.covariance is not None
    assert start.covariance is not None
    np.testing.assert_allclose(again.covariance, start.covariance, atol=1e-22)  # of 1e-9 m^2
    assert again.gauge == back


@pytest.mark.parametrize("to", GAUGES)
def test_the_differences_and_their_covariance_are_the_same_in_every_gauge(to: Gauge) -> None:
    start, there = arms(), converted(arms(), to)
    np.testing.assert_allclose(
        TO_DIFFERENCES @ there.r_b.ravel(), TO_DIFFERENCES @ start.r_b.ravel(), atol=1e-16
    )
    assert there.covariance is not None
    assert start.covariance is not None
    np.testing.assert_allclose(
        TO_DIFFERENCES @ there.covariance @ TO_DIFFERENCES.T,
        TO_DIFFERENCES @ start.covariance @ TO_DIFFERENCES.T,
        atol=1e-22,
    )
    assert np.linalg.matrix_rank(there.covariance) == 6


def test_each_gauge_has_its_origin() -> None:
    np.testing.assert_allclose(arms().r_b.sum(axis=0), 0.0, atol=1e-16)
    for k, to in enumerate(GAUGES[1:4]):
        there = convert(arms(), to)
        assert there.r_b[k].tolist() == [0.0, 0.0, 0.0]
        assert there.covariance is not None
        # it is the origin: without error
        np.testing.assert_allclose(there.covariance[3 * k : 3 * k + 3], 0.0, atol=1e-25)
    np.testing.assert_allclose(converted(arms(), "given").r_b[1], POINT, atol=1e-17)


def test_the_map_of_the_covariance_is_that_of_the_points() -> None:
    # of many draws, with the covariance of each gauge
    rng, start = np.random.default_rng(5), arms()
    assert start.covariance is not None
    draws = rng.multivariate_normal(start.r_b.ravel(), start.covariance, 4000, method="eigh")
    moved = np.array([convert(LeverArms(d.reshape(3, 3), None, "centroid"), "z").r_b.ravel() for d in draws])
    expected = convert(start, "z").covariance
    assert expected is not None
    # 1 / sqrt(2000) = 2.2 % of the largest variance, four times
    np.testing.assert_allclose(np.cov(moved.T), expected, atol=0.09 * expected.max())


@pytest.mark.parametrize(
    ("to", "stated", "message"),
    [
        ("given", None, "expected the position of one sensing point, from a drawing, got none"),
        ("x", ("y", POINT), "gauge x: expected no known point, got one of accelerometer y"),
        ("given", ("w", POINT), "expected x, y or z and three finite numbers, got 'w'"),
        ("given", ("x", (0.0, np.nan, 0.0)), "three finite numbers"),
        ("given", ("x", (0.0, 0.0)), "three finite numbers"),
        ("centre", None, "expected one of centroid, x, y, z, given, got 'centre'"),
    ],
)
def test_a_gauge_that_makes_no_sense_is_refused(to: Any, stated: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        convert(arms(), to, stated)


def test_arms_without_covariance_stay_without() -> None:
    assert convert(LeverArms(np.eye(3), None, "given"), "y").covariance is None


def test_kalibr_has_x_as_origin_and_its_points_come_back() -> None:
    written = to_kalibr(arms())
    assert written["accelerometers"]["rx_i"] == [0.0, 0.0, 0.0]
    read = from_kalibr(written)
    assert read.gauge == "x"
    np.testing.assert_allclose(read.r_b, convert(arms(), "x").r_b, atol=1e-12)  # rounded so


def test_psins_points_come_back() -> None:
    read = from_psins(to_psins(arms()))
    assert read.gauge == "given"
    np.testing.assert_allclose(read.r_b, arms().r_b, atol=1e-12)


def kalibr_size_effect(accelerometers: dict[str, list[float]], omega: Array, omega_dot: Array) -> Array:
    """What Kalibr's model adds to the specific force at the origin of its frame i, M = I."""
    r = [np.array(accelerometers[f"r{axis}_i"]) for axis in "xyz"]
    at = [np.cross(omega_dot, p) + np.cross(omega, np.cross(omega, p)) for p in r]
    return np.array([at[k][k] for k in range(3)])


def psins_size_effect(clbt: dict[str, list[float]], omega: Array, omega_dot: Array) -> Array:
    """What `imuclbt` takes off the specific force: `SS [rx; ry; rz]` of imulvS.m, Cba = I."""

    def skew_trials(v: Array) -> Array:
        return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])

    W = skew_trials(omega_dot) + skew_trials(omega) @ skew_trials(omega)
    SS = np.zeros((3, 9))
    for k in range(3):
        SS[k, 3 * k : 3 * k + 3] = W[k]
    return SS @ np.concatenate([clbt["rx"], clbt["ry"], clbt["rz"]])


def test_what_is_exported_means_the_same_size_effect_there() -> None:
    rng = np.random.default_rng(2)
    given = arms()
    for _ in range(5):
        omega, omega_dot = rng.normal(size=3), rng.normal(size=3)
        S = size_effect_rate(omega, omega_dot, np.eye(3))
        x_origin = convert(given, "x").r_b.ravel()
        # rounded to 1e-12 m, times rates of a few rad/s
        np.testing.assert_allclose(
            kalibr_size_effect(to_kalibr(given)["accelerometers"], omega, omega_dot), S @ x_origin, atol=1e-10
        )
        np.testing.assert_allclose(
            psins_size_effect(to_psins(given), omega, omega_dot), S @ given.r_b.ravel(), atol=1e-10
        )


@pytest.mark.parametrize("document", [{}, {"accelerometers": {"M": [[1]]}}, {"accelerometers": None}])
def test_a_file_of_kalibr_without_arms_is_refused(document: dict[str, Any]) -> None:
    with pytest.raises(
        InputError, match="Kalibr: accelerometers: expected rx_i, ry_i, rz_i as three numbers"
    ):
        from_kalibr(document)


@pytest.mark.parametrize(
    "clbt", [{}, {"rx": [1, 2], "ry": [0, 0, 0], "rz": [0, 0, 0]}, {"rx": "a", "ry": [0] * 3, "rz": [0] * 3}]
)
def test_a_struct_of_psins_without_arms_is_refused(clbt: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="PSINS: clbt: expected rx, ry, rz as three numbers"):
        from_psins(clbt)
