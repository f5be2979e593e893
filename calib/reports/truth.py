"""Identified lever arms against the true ones, which only a simulation knows."""

from typing import Final

import numpy as np

from calib.estimation.result import TO_DIFFERENCES
from calib.lever_arms.gauge import LeverArms
from calib.reports.document import Document, KeyValues, Section, Table
from imudrv.units import MM

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
