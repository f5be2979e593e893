"""One attempt at a step: increments in, navigation log out."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.detection.blocks import Block
from calib.detection.segments import Rotation, Segmenter
from calib.detection.tracking import RotationTracker
from calib.procedure.events import NavigationLog
from imudrv.arrays import Array
from imudrv.nav.alignment import Aligned, Alignment
from imudrv.nav.mechanisation import Navigator
from imudrv.records import Records
from imudrv.vectors import Vector

_BLOCKS_PER_PASS: Final = 500


class JudgedTurn(NamedTuple):
    """A rotation that has ended."""

    begun: int | None  # counter of a sample in it
    is_within_limits: bool


class Attempt:
    """Samples of one attempt, from the first sample at rest.

    Attributes
    ----------
    aligned : Aligned or None
        Latest result of the alignment.
    heading_rad : float
        Clockwise deviation of the pose from its heading, at the end of the alignment.
    turn : RotationTracker
        Current rotation.
    number : int
        Its number, from 1.
    turns : list of JudgedTurn
        The rotations that have ended.
    samples : int
        Number of samples so far.
    """

    def __init__(self) -> None:
        self.aligned: Aligned | None = None
        self.heading_rad = 0.0
        self.turn = RotationTracker()
        self.number = 1
        self.turns: list[JudgedTurn] = []
        self.samples = 0
        self._first = self._last = -1  # counters
        self._waiting: list[Records] = []
        self._segmenter = Segmenter()
        self._alignment: Alignment | None = None
        self._after_alignment: Records | None = None
        self._navigator: Navigator | None = None
        self._navigated: list[tuple[NDArray[np.int64], Array, Array]] = []

    def append(self, block: Block) -> None:
        """Append a block."""
        if not self.samples:
            self._first = int(block.rows["counter"][0])
        self._last = block.last
        self.samples += len(block.rows)
        self._waiting.append(block.rows)
        if len(self._waiting) >= _BLOCKS_PER_PASS:
            self.process()

    def process(self) -> None:
        """Segment, align or navigate the blocks that were appended."""
        if not self._waiting:
            return
        rows = np.concatenate(self._waiting)
        self._waiting.clear()
        self._segmenter.feed(rows)
        if self._navigator is not None:
            self._navigate(self._navigator, rows)
        elif self._alignment is not None:
            self._after_alignment = self._alignment.feed(rows)

    def align(self, alignment: Alignment) -> None:
        """Start an alignment with the next block."""
        self.process()
        self._alignment = alignment

    def navigate(self, navigator: Navigator, up_b: Vector) -> None:
        """Start the log anew at the end of the alignment, or at the next block; `up_b` is the vertical."""
        self._navigator, self.turn = navigator, RotationTracker(up_b)
        self._navigated.clear()
        if self._after_alignment is not None:
            self._navigate(navigator, self._after_alignment)
            self._after_alignment = None

    def _navigate(self, navigator: Navigator, rows: Records) -> None:
        result = navigator.feed(rows)
        self._navigated.append((result["counter"].copy(), result["v_n"].copy(), result["H"].copy()))

    def next_turn(self, turns: int) -> None:
        """Start to track another rotation of a run of `turns`."""
        self.turn, self.number = RotationTracker(self.turn.up_b), min(len(self.turns) + 1, turns)

    def judge(self, is_within_limits: bool) -> None:
        """Count the current rotation, which has ended."""
        self.turns.append(JudgedTurn(self.turn.begun, is_within_limits))

    def rotation(self, begun: int | None) -> Rotation | None:
        """Return the rotation that was detected in the blocks processed so far, and contains a counter."""
        rotations = self._segmenter.result().rotations
        return next((r for r in rotations if begun is not None and r.stop > begun), None)

    def log(self, step_id: str, number: int, interval_s: float) -> NavigationLog:
        """Return velocity and H of all navigated samples."""
        counter, v_n, H = (np.concatenate(parts) for parts in zip(*self._navigated, strict=True))
        t_s = (counter + 1 - counter[0]) * interval_s
        return NavigationLog(step_id, number, self._first, self._last, counter, t_s, v_n, H)
