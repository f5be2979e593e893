"""Identified lever arms, or a certificate, against the true ones, which only a simulation knows."""

from typing import Any, Final

import numpy as np

from calib.estimation.result import TO_DIFFERENCES
from calib.lever_arms.gauge import LeverArms
from calib.reports.document import Block, Document, KeyValues, Paragraph, Section, Table
from imudrv.calibration import Calibration
from imudrv.units import MM

LEAST_U: Final = 1e-12
"""Below it a number is fixed by the gauge."""


_PAIRS: Final = ("r_x - r_y", "r_x - r_z")


def comparison(found: LeverArms, true: LeverArms, name: str) -> Document:
    """Return the comparison of lever arms with true ones.

    Parameters
    ----------
    found : LeverArms
        The result, with covariance.
    true : LeverArms
        In any gauge: the differences of the points are compared, and the points from their centroid.
    name : str
        Name of the file with the true ones.

    Returns
    -------
    Document
    """
    error = found.r_b - true.r_b
    off = (TO_DIFFERENCES @ error.ravel()).reshape(2, 3) / MM
    rms = float(np.sqrt(((error - error.mean(axis=0)) ** 2).mean())) / MM
    results = [("rms error of the nine components, from their centroid", f"{rms:.4f} mm")]
    rows = {f"{pair}, error": row for pair, row in zip(_PAIRS, off, strict=True)}
    if found.covariance is not None:
        u = np.sqrt(np.diag(TO_DIFFERENCES @ found.covariance @ TO_DIFFERENCES.T)).reshape(2, 3) / MM
        rows |= {f"{pair}, u": row for pair, row in zip(_PAIRS, u, strict=True)}
        results.append(("largest error of a difference", f"{np.abs(off / u).max():.1f} u"))
    table = tuple((name, *(f"{x:.4f}" for x in row)) for name, row in rows.items())
    blocks = KeyValues(tuple(results)), Table("Differences, mm", ("", "X", "Y", "Z"), table)
    return Document("Against the truth", name, (Section("Error", blocks),))


def calibration_comparison(found: Calibration, true: Calibration, name: str) -> Document:
    """Return the comparison of the sensors of a certificate with true ones.

    Parameters
    ----------
    found : Calibration
        The result, with its covariance in the provenance (`calib sensors`).
    true : Calibration
        Of the simulated unit.
    name : str
        Its name.

    Returns
    -------
    Document
        The error of each number that was estimated, in the unit of the file, and in its u.
    """
    covariance = None if found.sensors is None else found.sensors.covariance
    rows, largest = [], 0.0
    if covariance is not None:
        for path, variance in zip(covariance.names, np.diag(covariance.matrix).tolist(), strict=True):
            u = max(variance, 0.0) ** 0.5
            if u < LEAST_U or (".C_" in path and path[-5] == path[-2]):  # rows have the length 1
                continue
            error = _number(found, path) - _number(true, path)
            largest = max(largest, abs(error) / u)
            rows.append((path, f"{error:.3g}", f"{u:.3g}", f"{abs(error) / u:.1f}"))
    blocks: tuple[Block, ...] = (Paragraph("Nothing to compare: the session estimated no calibration."),)
    if rows:
        head = ("", "error", "u", "error in u")
        table = Table("Errors of the numbers that were estimated", head, tuple(rows))
        blocks = KeyValues((("largest error", f"{largest:.1f} u"),)), table
    return Document("Against the truth", name, (Section("Error", blocks),))


def _number(calibration: Calibration, path: str) -> float:
    """Return a number of a certificate by its path, such as gyro.C_bg[1][0]."""
    place: Any = calibration.model_dump(exclude={"provenance"})
    for key in path.replace("]", "").replace("[", ".").split("."):
        place = place[int(key)] if key.isdigit() else place[key]
    return float(place)
