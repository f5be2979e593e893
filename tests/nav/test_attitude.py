import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from imudrv.nav.attitude import rotation

number = st.floats(-10.0, 10.0)


def test_a_quarter_turn_about_up_takes_east_to_north() -> None:
    np.testing.assert_allclose(
        rotation((0, 0, 5), np.pi / 2) @ [1, 0, 0], [0, 1, 0], atol=1e-16
    )  # cos(pi/2) = 6e-17


@given(st.tuples(number, number, number).filter(lambda a: np.linalg.norm(a) > 1e-3), number)
def test_rotation_agrees_with_an_independent_one(axis: tuple[float, float, float], angle: float) -> None:
    expected = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    # ten radians, a few roundings
    np.testing.assert_allclose(rotation(axis, angle), expected, atol=2e-15)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (1, 2, 3)])
def test_turns_about_one_axis_add_up(axis: tuple[float, float, float]) -> None:
    # a few roundings of numbers below one
    np.testing.assert_allclose(rotation(axis, 0.7) @ rotation(axis, 0.5), rotation(axis, 1.2), atol=1e-15)
