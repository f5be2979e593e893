"""Processing chain for live and recorded data: decode, count, compensate, stamp."""

from typing import Final, NamedTuple

import numpy as np

from imudrv.imu.clock import ClockModel
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import RateFilterName
from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles.schema import Profile
from imudrv.records import INCREMENTS, PULSES, Flag, Records
from imudrv.wire.decoder import FrameDecoder


class PipelineOutput(NamedTuple):
    """Result of one arrival.

    Parameters
    ----------
    pulses : ndarray of PULSES
        Decoded samples.
    increments : ndarray of INCREMENTS
        Compensated and stamped; with a rate filter that lags, they belong to earlier samples.
    """

    pulses: Records
    increments: Records


_NOTHING: Final = PipelineOutput(np.zeros(0, PULSES), np.zeros(0, INCREMENTS))


class Pipeline:
    """Converts received data to stamped increments; any cut of the data into pieces gives the same bits.

    Parameters
    ----------
    profile : Profile
        Profile of the unit.
    coefficients : Coefficients
        Calibration of the unit.
    rate_filter : {'causal', 'centred', 'dither'}
        Rate filter of the size effect.
    """

    def __init__(self, profile: Profile, coefficients: Coefficients, rate_filter: RateFilterName) -> None:
        self._layout = profile.layout()
        self._rate_filter = rate_filter
        self.decoder = FrameDecoder(self._layout)
        self.tracker = SequenceTracker(self._layout)
        self.clock = ClockModel(self._layout.interval_ns, profile.transmission_ns, self._layout.counter_step)
        self._compensator = Compensator(coefficients, self._layout, rate_filter)
        self._next: Compensator | None = None
        self._repeats = False
        self._last_ns = 0  # time by the counter of the newest increment output, while it matters

    def feed(self, data: bytes | memoryview | Records, t_ns: int) -> PipelineOutput:
        """Process an arrival.

        Parameters
        ----------
        data : bytes-like or ndarray of MESSAGE
            Wire bytes, or CAN messages.
        t_ns : int
            Time of arrival by the host clock, ns.

        Returns
        -------
        PipelineOutput
        """
        return self._process(self.decoder.feed(data, t_ns))

    def close(self) -> PipelineOutput:
        """End the stream and return what was held back."""
        pulses, increments = self._process(self.decoder.close())
        rest = self._compensator.close()
        if self._repeats:
            rest = self._drop_overlap(rest)
        return PipelineOutput(pulses, np.concatenate([increments, self.clock.stamp(rest)]))

    def replace_calibration(self, coefficients: Coefficients) -> None:
        """Replace the calibration between two samples.

        The new compensation first runs beside the old one until its rates are known, so that no sample
        lacks its size effect.

        Parameters
        ----------
        coefficients : Coefficients
            The new calibration.
        """
        self._next = Compensator(coefficients, self._layout, self._rate_filter)
        self._repeats = True

    def _process(self, frames: Records) -> PipelineOutput:
        if not len(frames):
            return _NOTHING
        pulses = self.tracker.feed(frames)
        if not len(pulses):
            return PipelineOutput(pulses, _NOTHING.increments)
        self.clock.feed(pulses)
        increments = self._compensator.feed(pulses)
        if self._next is not None:
            increments = self._switched(self._next, pulses, increments)
        if self._repeats:
            increments = self._drop_overlap(increments)
        return PipelineOutput(pulses, self.clock.stamp(increments))

    def _switched(self, new: Compensator, pulses: Records, old: Records) -> Records:
        """Return increments of the old calibration until the new one knows its rates, then of the new one."""
        fresh = new.feed(pulses)
        if new.has_size_effect:
            ready = fresh["flags"] & Flag.SIZE_EFFECT != 0
        else:
            ready = np.ones(len(fresh), np.bool_)
        if not ready.any():
            return old
        since = fresh["t_ns"][ready.argmax()]
        if new.lag < self._compensator.lag:
            old = np.concatenate([old, self._compensator.close()])
        self._compensator, self._next = new, None
        return np.concatenate([old[old["t_ns"] < since], fresh[fresh["t_ns"] >= since]])

    def _drop_overlap(self, increments: Records) -> Records:
        """Drop increments already output: a new compensation that lags more gives some samples again."""
        fresh = increments[increments["t_ns"] > self._last_ns]
        if len(fresh):
            # Nothing is repeated once the new one has passed the last increment of the old one.
            self._repeats = self._next is not None or len(fresh) < len(increments)
            self._last_ns = int(fresh["t_ns"][-1])
        return fresh
