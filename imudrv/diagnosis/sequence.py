"""Good frames that are not in sequence, as a profile with a wrong counter makes them."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.imu.sequence import SampleCounts
from imudrv.wording import counted

_LEAST_FRAMES: Final = 10


def sequence_fault(counts: SampleCounts, gaps: int, counters: NDArray[np.int64]) -> str:
    """Say what is wrong if most good frames do not continue the counter.

    Parameters
    ----------
    counts : SampleCounts
        Counts of all frames.
    gaps : int
        Number of samples output with samples missing before them.
    counters : ndarray of int64, shape (n,)
        Counters of the first frames as received.

    Returns
    -------
    str
        What was found and what to set; empty if most frames are in sequence.
    """
    dropped = counts.frames - counts.good - counts.reference
    if counts.frames < _LEAST_FRAMES or 2 * max(dropped, gaps, counts.restarts) <= counts.frames:
        return ""
    found = (
        f"most of the {counts.frames} good frames do not continue the counter: {dropped} not output, "
        f"{gaps} after a gap, {counted(counts.restarts, 'restart')}"
    )
    steps, frequencies = np.unique(np.diff(counters), return_counts=True)
    if not len(steps) or 2 * frequencies.max() <= frequencies.sum():
        return f"{found}; check offset, type and byte order of the counter in the profile"
    step = int(steps[frequencies.argmax()])
    if step == 0:
        return f"{found}; it does not change: check its offset in the profile"
    return (
        f"{found}; it advances by {step} from frame to frame: "
        f"if that is one sample, set `step: {step}` of the counter in the profile"
    )
