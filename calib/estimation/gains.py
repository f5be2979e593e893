"""Velocities V and H of each turn, as in the literature, and the result of a run."""

from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib.detection.blocks import BLOCK_NS
from calib.detection.noise import BIN_S
from calib.estimation.result import RunResult, TurnResult
from calib.estimation.runs import Run
from imudrv.arrays import Array
from imudrv.units import NS

ROWS_PER_BIN: Final = round(BIN_S / (BLOCK_NS * NS))
"""Rows at rest that are averaged for a figure."""


GAIN_WINDOW_S: Final = 0.5
"""Averaging window for the velocity before and after a turn, s."""


Fit: TypeAlias = Callable[[Array, NDArray[np.int64]], Array]
"""Estimated velocity, (n, 3) m/s, at some times in the arrests of some numbers."""


def velocity_gain(run: Run, k: int = 0) -> tuple[Array, Array]:
    """Return the gains V and H of turn k: means over the half second after minus those before."""
    before, after = gain_rows(run, k)
    rows = run.rows
    V = run.v_n[after].mean(axis=0) - run.v_n[before].mean(axis=0)
    return V, rows["H"][after].mean(axis=0) - rows["H"][before].mean(axis=0)


def velocity_gains(runs: Sequence[Run]) -> list[tuple[Array, Array]]:
    """Return the gains V and H of all accepted turns."""
    return [velocity_gain(run, k) for run in runs for k, turn in enumerate(run.turns) if turn.accepted]


def gain_rows(run: Run, k: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of the half second before turn k and of that after it."""
    n = round(GAIN_WINDOW_S / (BLOCK_NS * NS))
    return np.flatnonzero(run.arrests[k])[-n:], np.flatnonzero(run.arrests[k + 1])[:n]


def rest_growth(run: Run) -> Array:
    """Return the rate at which H grows in the rest before the first turn, (3, 9), 1/s; in theory zero."""
    at = run.arrests[0]
    t_s = run.t_s[at]
    return np.asarray(np.einsum("n,nij->ij", t_s, run.rows["H"][at]) / (t_s @ t_s), np.float64)


def singular_values_of(gains: Sequence[tuple[Array, Array]]) -> Array:
    """Return the singular values of the stacked horizontal H, nine of them."""
    s = np.zeros(9)
    H = np.concatenate([h[:2] for _, h in gains])
    s[: min(H.shape)] = np.linalg.svd(H, compute_uv=False)
    return s


def run_result(run: Run, R: Array, fitted: Fit) -> RunResult:
    """Return the result of one run.

    Parameters
    ----------
    run : Run
        The run.
    R : ndarray, shape (9,)
        Estimated sensing points, m.
    fitted : Fit
        Estimated velocity at rest.

    Returns
    -------
    RunResult
    """
    turns = []
    for k, (turn, label) in enumerate(zip(run.turns, run.turn_labels, strict=True)):
        V, H = velocity_gain(run, k)
        turns.append(TurnResult(label, turn.accepted, V, H, V - H @ R))
    bins = [_whole_bins(at, from_the_end=k == 0) for k, at in enumerate(run.arrests)]
    rows = np.concatenate(bins)
    t_s, arrest = run.t_s[rows].mean(axis=1), np.repeat(np.arange(len(bins)), [len(at) for at in bins])
    return RunResult(
        run.label,
        tuple(turns),
        float(np.abs(run.rows["H"][gain_rows(run, 0)[0], :2].mean(axis=0)).max()),
        run.rate_filter,
        run.lines,
        t_s,
        run.v_n[rows][..., :2].mean(axis=1),
        fitted(t_s, arrest)[:, :2],
    )


def _whole_bins(mask: NDArray[np.bool_], *, from_the_end: bool) -> NDArray[np.int64]:
    """Return the rows of each whole bin, (bins, rows per bin)."""
    at = np.flatnonzero(mask)
    over = len(at) % ROWS_PER_BIN
    at = at[over:] if from_the_end else at[: len(at) - over]
    return at.reshape(-1, ROWS_PER_BIN)
