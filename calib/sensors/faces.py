"""Body axes along the faces that the unit stood on (contract, 3.5).

    C_k^T (up + p) = (I + [theta x]) (e_k + d_k)

with e_k the axis nearest to the normal of the face that is up, p the tilt of the plate in n, d_k the error of
squareness of that face, theta the turn from the present axes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from calib.axes import Side, axis_name, vector
from calib.sensors.equations import skew_matrix
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.units import ARCSEC

SQUARENESS: Final = 3 * ARCSEC
"""Prior of the squareness of a face, 1 sigma."""
SETTING: Final = 1 * ARCSEC
"""Least uncertainty of the attitude of the unit on its face, 1 sigma; the residuals show more."""
PLATE: Final = 0.1
"""Prior of the tilt of the plate, rad."""


@dataclass(frozen=True)
class Faces:
    """Where the faces are.

    Attributes
    ----------
    C : ndarray, shape (3, 3)
        From the axes along the gyros to those along the faces.
    theta_covariance : ndarray, shape (3, 3)
        rad^2.
    tilt_n : ndarray, shape (2,)
        Tilt of the plate, east and north, rad.
    squareness : dict of str to ndarray, shape (3,)
        d of each face that was up, rad.
    repeatability : float
        Rms of the residuals: how well the unit is set down, rad.
    """

    C: Array
    theta_covariance: Array
    tilt_n: Array
    squareness: dict[Side, Array]
    repeatability: float

    @property
    def theta(self) -> Array:
        """Turn from the axes along the gyros to those along the faces, rad."""
        return Rotation.from_matrix(self.C.T).as_rotvec()


def find_faces(attitudes: Sequence[Array]) -> Faces:
    """Return where the faces are.

    Parameters
    ----------
    attitudes : sequence of ndarray, shape (3, 3)
        C_nb of the rests.

    Returns
    -------
    Faces

    Raises
    ------
    InputError
        Fewer than two different faces were up: a turn about the vertical is not determined.
    """
    names = [axis_name(C.T @ [0.0, 0.0, 1.0]) for C in attitudes]
    if len({name[1] for name in names}) < 2:
        raise InputError(
            f"frame faces: expected rests on faces of two axes at least, got {', '.join(sorted(set(names)))} "
            "up; use --frame gyro"
        )
    faces = sorted(set(names))
    C = np.eye(3)
    rms = SETTING
    for _ in range(4):
        x, covariance, residual = _solve(attitudes, C, names, faces, max(rms, SETTING))
        rms = float(np.sqrt(np.mean(residual**2)))
        C = Rotation.from_rotvec(-x[:3]).as_matrix() @ C
    squareness = {name: x[5 + 3 * k : 8 + 3 * k] for k, name in enumerate(faces)}
    return Faces(C, covariance[:3, :3], x[3:5], squareness, rms)


def _solve(
    attitudes: Sequence[Array], C: Array, names: Sequence[Side], faces: Sequence[Side], setting: float
) -> tuple[Array, Array, Array]:
    """Return theta, p and d, their covariance, and the residuals along the faces, rad."""
    n = 5 + 3 * len(faces)
    N, rhs = np.zeros((n, n)), np.zeros(n)
    N[3, 3] = N[4, 4] = 1.0 / PLATE**2
    N[5:, 5:] = np.eye(n - 5) / SQUARENESS**2
    rows, values = [], []
    for C_nb, name in zip(attitudes, names, strict=True):
        e = vector(name)
        A = np.zeros((3, n))
        in_b = C @ C_nb.T
        A[:, :3] = -skew_matrix(e)  # theta x e
        A[:, 3:5] = -in_b[:, :2]
        at = 5 + 3 * faces.index(name)
        A[:, at : at + 3] = np.eye(3)
        across = np.eye(3)[e == 0.0]
        rows.append(across @ A)
        values.append(across @ (in_b[:, 2] - e))
    X, y = np.concatenate(rows), np.concatenate(values)
    N += X.T @ X / setting**2
    rhs += X.T @ y / setting**2
    covariance = np.asarray(np.linalg.inv(N), np.float64)
    x = covariance @ rhs
    return x, covariance, y - X @ x
