import numpy as np
import pytest
from numpy.typing import NDArray
from size_effect import size_effect_increment, size_effect_rate

Array = NDArray[np.float64]
C_BA = np.eye(3) + 1e-2 * np.array([[0.0, 2.0, -1.0], [-0.6, 0.0, 0.4], [-0.7, 0.3, 0.0]])


def felt(omega: Array, omega_dot: Array, r_b: Array) -> Array:
    """What the three accelerometers feel through their places, read into b: point by point."""
    A = np.linalg.inv(C_BA)
    at = [np.cross(omega_dot, r) + np.cross(omega, np.cross(omega, r)) for r in r_b]
    return C_BA @ np.array([a @ f for a, f in zip(A, at, strict=True)])


def test_S_is_what_the_three_sensing_points_feel() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        omega, omega_dot, r_b = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(3, 3))
        S = size_effect_rate(omega, omega_dot, C_BA)
        np.testing.assert_allclose(
            S @ r_b.ravel(), felt(omega, omega_dot, r_b), atol=1e-13
        )  # rounding of terms of ten


def test_a_steady_turn_pulls_towards_the_axis() -> None:
    # X's sensing point 0.1 m out along X, 2 rad/s about Z: 0.4 m/s^2 inwards, and nothing else is felt
    R = np.zeros(9)
    R[0] = 0.1
    np.testing.assert_allclose(
        size_effect_rate((0, 0, 2), (0, 0, 0), np.eye(3)) @ R, [-0.4, 0, 0], atol=1e-15
    )


def test_a_common_shift_is_a_lever_arm() -> None:
    omega, omega_dot, d = np.array([0.3, -0.2, 1.0]), np.array([0.1, 2.0, -0.5]), np.array([0.1, 0.2, -0.3])
    expected = np.cross(omega_dot, d) + np.cross(omega, np.cross(omega, d))
    # C_ba inv(C_ba) drops out: rounding
    np.testing.assert_allclose(size_effect_rate(omega, omega_dot, C_BA) @ np.tile(d, 3), expected, atol=1e-15)


@pytest.mark.parametrize("T", [1e-3, 5e-3])
def test_an_increment_is_the_integral_of_S(T: float) -> None:
    # Rocking at 3 Hz, +-1 rad/s, about three axes; the intervals of 0.1 s stacked.
    amplitude, w, phase = np.array([1.0, 0.7, -0.5]), 2.0 * np.pi * 3.0, np.array([0.0, 1.0, 2.0])

    def omega(t: Array) -> Array:
        return amplitude * np.sin(w * t[..., None] + phase)

    def angle(t: Array) -> Array:
        return -amplitude / w * np.cos(w * t[..., None] + phase)

    ends = np.arange(0.0, 0.1 + T / 2, T)
    S = size_effect_increment(
        omega(ends[:-1]), omega(ends[1:]), np.diff(angle(ends), axis=0), np.full(len(ends) - 1, T), C_BA
    )
    assert S.shape == (len(ends) - 1, 3, 9)
    x, weight = np.polynomial.legendre.leggauss(12)
    t = 0.05 + 0.05 * x
    rates = size_effect_rate(omega(t), amplitude * w * np.cos(w * t[:, None] + phase), C_BA)
    expected = 0.05 * np.einsum("j,jab->ab", weight, rates)
    # The mean rate is taken for that in the middle: w^2 T^2 / 24 of it, four sixths of its square, for 0.1 s.
    np.testing.assert_allclose(S.sum(axis=0), expected, atol=2.0 * (w * T) ** 2 / 24.0 * 0.1)
    assert np.abs(expected).max() > 0.5


def test_the_tangential_part_telescopes() -> None:
    # Noise of a rate between two intervals: what it does in one, it undoes in the next, but for its square.
    rate = np.array([[0.0, 0.0, 0.0], [1e-6, -2e-6, 3e-6], [0.0, 0.0, 0.0]])
    S = size_effect_increment(rate[:-1], rate[1:], np.zeros((2, 3)), np.full(2, 1e-3), C_BA)
    assert np.abs(S[0]).max() > 1e-6
    np.testing.assert_allclose(S.sum(axis=0), 0.0, atol=1e-14)  # T (3e-6)^2
