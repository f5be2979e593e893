"""Which directions of the lever arms are observable, in words."""

from collections.abc import Sequence

import numpy as np

from calib.estimation.runs import Run
from calib.messages import Message, message
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.units import MM


def rank_reason(rank: int, sigma: Array, limit: float) -> Message:
    """Return the reason for the rank, in words."""
    observable = message("rank_observable", rank=rank, worst_mm=float(sigma[rank - 1]) / MM)
    if rank == 9:
        return observable
    return message(
        "rank_limited", observable=observable, next_mm=float(sigma[rank]) / MM, limit_mm=limit / MM
    )


def require_axes(runs: Sequence[Run]) -> None:
    """Raise `InputError` if the unit was not turned about each axis."""
    turned = [axis for axis in "ZXY" if any(turn.about == axis for run in runs for turn in run.turns)]
    missing = [axis for axis in "ZXY" if axis not in turned]
    if missing:
        there = f"{turned[0]} up alone is" if len(turned) == 1 else f"{' up and '.join(turned)} up are"
        more = "captures" if len(missing) > 1 else "a capture"
        raise InputError(f"identification: {there} not enough: add {more} with {' up and '.join(missing)} up")


def unobservable_text(sigma: Array, directions: Array, basis: Array, limit: float) -> str:
    """Return the message for rotations that do not determine R; names the directions."""
    wanted = basis.shape[1]
    rank = min(wanted, int((sigma < limit).sum()))
    inside = basis @ basis.T @ directions[:, sigma >= limit]
    vectors, size, _ = np.linalg.svd(inside, full_matrices=False)
    names = "; ".join(_direction(d) for d in vectors[:, size > 0.5].T)
    return (
        f"identification: expected rotations that determine {wanted} directions of the lever arms, "
        f"got {rank}; unobservable to {limit / MM:g} mm: {names}; add rotations with another axis up"
    )


def _direction(d: Array) -> str:
    """Return a direction as text: '+0.71 x_Z -0.71 y_Z', components of r_x, r_y, r_z along body axes."""
    terms = [f"{a}_{b}" for a in "xyz" for b in "XYZ"]
    d = d * np.sign(d[np.argmax(np.abs(d))])
    return " ".join(f"{value:+.2f} {term}" for value, term in zip(d, terms, strict=True) if abs(value) > 0.1)


def require_runs(runs: Sequence[Run]) -> None:
    """Raise `InputError` unless there is a run."""
    if not runs:
        raise InputError(
            "identification: expected at least one accepted rotation, got none; see why they were rejected"
        )
