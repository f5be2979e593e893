"""The turn that a procedure plans for a turntable, against the gyros; it is never a measurement."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from calib.axes import side, vector
from calib.messages import Message, message
from calib.procedure.schema import PlannedTurn
from imudrv.units import DEG

TOLERANCE_DEG: Final = 5.0
SCALE: Final = 0.05
"""Tolerances of the angle: of the table, deg, and of a gyro that was never calibrated, relative."""


def turn_fault(turn: PlannedTurn, turned_b: Sequence[float]) -> Message | None:
    """Return what is wrong with the motion into a pose; None if nothing is.

    Parameters
    ----------
    turn : PlannedTurn
        As planned.
    turned_b : sequence of 3 float
        Sums of the angle increments since the rest before, body axes, rad.

    Returns
    -------
    Message or None
        The angles, and what explains the difference: the sign, a factor of ten, another axis.
    """
    wanted = turn.deg * vector(turn.about)
    turned = np.asarray(turned_b) / DEG
    tolerance = TOLERANCE_DEG + SCALE * abs(turn.deg)
    if np.abs(turned - wanted).max() <= tolerance:
        return None
    about = float(turned @ vector(turn.about))
    axis = int(np.abs(turned).argmax())

    def fits(angle: float) -> bool:
        return bool(np.abs(turned - angle * vector(turn.about)).max() <= tolerance)

    if abs(turn.deg) > tolerance and fits(-turn.deg):
        cause = message("turn_sign")
    elif abs(turn.deg) > tolerance and (fits(10.0 * turn.deg) or fits(0.1 * turn.deg)):
        cause = message("turn_tenfold")
    elif abs(turned[axis]) > tolerance and axis != "XYZ".index(turn.about[1]):
        cause = message("turn_axis", axis="XYZ"[axis], turned_deg=float(turned[axis]))
    else:
        cause = message("turn_other")
    return message(
        "turn_differs",
        about=side(turn.about),
        turned_deg=about,
        wanted_deg=turn.deg,
        tolerance_deg=tolerance,
        cause=cause,
    )
