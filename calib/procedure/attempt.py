"""One attempt at a step: increments in, navigation log out."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.detection.blocks import Block
from calib.detection.segments import Rotation, Segmenter
from calib.detection.tracking import RestAverages, RotationTracker
from calib.procedure.events import NavigationLog
from imudrv.arrays import Array
from imudrv.nav.alignment import MIN_ALIGNMENT_S, Aligned, Alignment
from imudrv.nav.mechanisation import Navigator
from imudrv.records import Records
from imudrv.vectors import Vector

_BLOCKS_A_FLUSH: Final = 500


class Attempt:
    """The evidence of one attempt, from when the unit stands still."""

    def __init__(self) -> None:
        self.alignment: Alignment | None = None
        self.aligned: Aligned | None = None
        self.heading = 0.0  # how far it stood turned clockwise, rad
        self.means = RestAverages()
        self.look_s = MIN_ALIGNMENT_S  # when the alignment is looked at next
        self.turn = RotationTracker()
        self._held: list[Records] = []
        self._behind: Records | None = None  # samples behind the alignment's window
        self._segmenter = Segmenter()
        self._navigator: Navigator | None = None
        self.samples = 0  # since the first one held
        self._first: int | None = None
        self._last = 0
        self._navigated: list[tuple[NDArray[np.int64], Array, Array]] = []

    def hold(self, block: Block) -> None:
        """Append a block."""
        if self._first is None:
            self._first = int(block.rows["counter"][0])
        self._last = block.last
        self.samples += len(block.rows)
        self._held.append(block.rows)
        if len(self._held) >= _BLOCKS_A_FLUSH:
            self.flush()

    def flush(self) -> None:
        """Take what is held through segments, alignment and navigation."""
        if not self._held:
            return
        rows = np.concatenate(self._held)
        self._held.clear()
        self._segmenter.feed(rows)
        if self._navigator is not None:
            self._navigate(rows)
        elif self.alignment is not None:
            self._behind = self.alignment.feed(rows)

    def navigate(self, navigator: Navigator, up_b: Vector) -> None:
        """Begin the log."""
        self._navigator, self.turn = navigator, RotationTracker(up_b)
        self._navigated.clear()
        if self._behind is not None:
            self._navigate(self._behind)
            self._behind = None

    def _navigate(self, rows: Records) -> None:
        assert self._navigator is not None
        told = self._navigator.feed(rows)
        self._navigated.append((told["counter"].copy(), told["v_n"].copy(), told["H"].copy()))

    def rotation(self) -> Rotation | None:
        """The turn, as the segments have it."""
        begun = self.turn.begun
        assert begun is not None
        return next((r for r in self._segmenter.result().rotations if r.stop > begun), None)

    def log(self, step_id: str, number: int, interval_s: float) -> NavigationLog:
        """Return velocity and H of all navigated samples."""
        assert self._first is not None
        counter, v_n, H = (np.concatenate(parts) for parts in zip(*self._navigated, strict=True))
        t_s = (counter + 1 - counter[0]) * interval_s
        return NavigationLog(step_id, number, self._first, self._last, counter, t_s, v_n, H)
