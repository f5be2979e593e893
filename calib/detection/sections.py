"""Sections of a capture: the unit restarts between them, and no rest or motion spans that.

A counter that goes back, or forward by more than an hour, is that of a unit that restarted.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Final

import numpy as np

from calib.detection.segments import Segmenter, Segments, find_segments
from imudrv.errors import InputError
from imudrv.records import Records
from imudrv.units import NS

LONGEST_GAP_S: Final = 3600.0
"""Longest time without samples for which a unit is believed to have stayed on, s."""


def split_at_restarts(pieces: Iterable[Records], counter_step: int = 1) -> Iterator[tuple[int, Records]]:
    """Divide a capture where the unit restarted.

    Parameters
    ----------
    pieces : iterable of INCREMENTS or of pulses
        In the order of arrival.
    counter_step : int
        Step of the counter from sample to sample.

    Yields
    ------
    (int, ndarray)
        Number of the section, from 0, and samples of it.
    """
    section, newest = 0, None
    for piece in pieces:
        if not len(piece):
            continue
        counter = piece["counter"]
        steps = np.diff(counter, prepend=counter[0] - 1 if newest is None else newest)
        longest = counter_step * LONGEST_GAP_S / (float(np.median(piece["interval_ns"])) * NS)
        newest = counter[-1]
        for k, part in enumerate(np.split(piece, np.flatnonzero((steps <= 0) | (steps > longest)))):
            section += k > 0
            if len(part):
                yield section, part


def find_sections(
    pieces: Iterable[Records], smooth: Callable[[Iterable[Records]], Iterable[Records]]
) -> list[Segments]:
    """Return the rests and motions of each section of a capture.

    Parameters
    ----------
    pieces : iterable of INCREMENTS
        In the order of arrival.
    smooth : callable
        Filter of the increments of a section, for the detection.

    Returns
    -------
    list of Segments
        One for each section; none of its rests and motions if it is too short.

    Raises
    ------
    InputError
        The whole capture is too short.
    """
    sections: list[Segments] = []
    fault: InputError | None = None
    for _, parts in groupby(split_at_restarts(pieces), key=itemgetter(0)):
        segmenter = Segmenter(begin_s=sum(section.duration_s for section in sections))
        for piece in smooth(part for _, part in parts):
            segmenter.feed(piece)
        try:
            sections.append(segmenter.result())
        except InputError as error:
            fault = fault or error
            sections.append(Segments(0.0, 0.0, (), ()))
    if fault and not any(section.rests for section in sections):
        raise fault
    return sections or [find_segments(())]


def joined(sections: Sequence[Segments]) -> Segments:
    """Return the rests and motions of all sections together."""
    return Segments(
        max(section.interval_s for section in sections),
        sum(section.duration_s for section in sections),
        tuple(rest for section in sections for rest in section.rests),
        tuple(rotation for section in sections for rotation in section.rotations),
    )
