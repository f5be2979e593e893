"""First look at a capture: pulses, rates, specific force, losses and temperatures over time, as one figure.

A file of any length is drawn from its envelope: the least and the largest value in each of some thousand
intervals, so that no spike is hidden and memory stays bounded.
"""

from base64 import b64encode
from collections.abc import Iterator, Sequence
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from imudrv.arrays import Array
from imudrv.calibration import Calibration, coefficients
from imudrv.capture import Advance, Capture
from imudrv.imu.compensation import Compensator
from imudrv.records import Flag, Records
from imudrv.units import DEG, NS
from imudrv.wire.layout import Layout

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST: Final = 4096
"""Most intervals of an envelope."""

_BAD: Final = int(Flag.SATURATED | Flag.FAULT | Flag.GAP_LENGTH_UNKNOWN | Flag.TEMPERATURE_RANGE)

_COLOURS: Final = ("#1f5fa8", "#b8561a", "#3b7a4b", "#7a4b9c", "#8a8f98", "#a8871f", "#1f9aa8", "#b3261e")

_LOSSES: Final = ("missing", "flagged")

_PAGE: Final = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy"
      content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>body {{ font: 15px sans-serif; margin: 2rem; }} img {{ max-width: 100%; }}</style>
</head>
<body><h1>{title}</h1><p>{summary}</p><img alt="{title}" src="data:image/png;base64,{image}"></body>
</html>
"""


class Envelope:
    """Least and largest value of some columns in intervals of equal numbers of rows.

    Parameters
    ----------
    width : int
        Number of columns.
    """

    def __init__(self, width: int) -> None:
        self._rows_each = 1
        self._low, self._high = np.empty((0, width)), np.empty((0, width))
        self._rest = np.empty((0, width))

    def feed(self, values: Array) -> None:
        """Take rows, shape (n, width); NaN is no value."""
        rows = np.concatenate([self._rest, values])
        n = len(rows) // self._rows_each
        self._rest = rows[n * self._rows_each :]
        whole = rows[: n * self._rows_each].reshape(n, self._rows_each, rows.shape[1])
        self._low = np.concatenate([self._low, np.fmin.reduce(whole, axis=1)])
        self._high = np.concatenate([self._high, np.fmax.reduce(whole, axis=1)])
        while len(self._low) >= 2 * MOST:
            n = len(self._low) // 2 * 2
            left = self._low[n:], self._high[n:]  # of an odd one out; it is wider than its rows
            self._low = np.concatenate([np.fmin(self._low[:n:2], self._low[1:n:2]), left[0]])
            self._high = np.concatenate([np.fmax(self._high[:n:2], self._high[1:n:2]), left[1]])
            self._rows_each *= 2

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Least and largest values, each of shape (intervals, width)."""
        if not len(self._rest):
            return self._low, self._high
        low = np.concatenate([self._low, np.fmin.reduce(self._rest, axis=0)[None]])
        return low, np.concatenate([self._high, np.fmax.reduce(self._rest, axis=0)[None]])


class Panel(NamedTuple):
    """Some columns on one axis."""

    title: str
    names: tuple[str, ...]
    envelope: Envelope


class Overview:
    """Envelopes of a capture.

    Parameters
    ----------
    capture : Capture
        The capture; it is read here.
    calibration : Calibration or None
        For rates and specific force; without it those of a unit that sends pulses are not drawn.
    advance : callable
        Called with the number of bytes read after each piece.

    Raises
    ------
    InputError
        See `Capture.pulses`.
    """

    def __init__(self, capture: Capture, calibration: Calibration | None, advance: Advance) -> None:
        self._layout = layout = capture.layout
        self._compensator = None if calibration is None else Compensator(coefficients(calibration), layout)
        self._interval_s = layout.interval_ns * NS
        self._temperatures = tuple(layout.temperature_names)
        self._t = Envelope(1)
        self.panels = list(self._of(layout))
        self._last_s = self._elapsed_s = 0.0
        self._lost = self._bad = 0.0
        for pulses in capture.pulses(advance):
            if len(pulses):
                self._feed(pulses)
        self.title = f"{capture.path.name}: {layout.name}"
        self.summary = str(capture.tracker.counts)

    def png(self) -> bytes:
        """Return the figure."""
        from matplotlib.figure import Figure

        t, _ = self._t.bounds
        figure = Figure(figsize=(11.0, 2.1 * len(self.panels) + 0.6), layout="constrained")
        figure.suptitle(f"{self.title}\n{self.summary}", fontsize=9)
        axes: Sequence[Axes] = np.atleast_1d(figure.subplots(len(self.panels), 1, sharex=True)).tolist()
        for axis, panel in zip(axes, self.panels, strict=True):
            low, high = panel.envelope.bounds
            n = min(len(t), len(low))
            for k, name in enumerate(panel.names):
                colour = _COLOURS[k % len(_COLOURS)]
                axis.fill_between(t[:n, 0], low[:n, k], high[:n, k], color=colour, alpha=0.35, linewidth=0)
                axis.plot(t[:n, 0], 0.5 * (low[:n, k] + high[:n, k]), color=colour, linewidth=0.8, label=name)
            axis.set_ylabel(panel.title, fontsize=8)
            axis.grid(True, color="#e3e5e8")
            if panel.names == _LOSSES:
                axis.set_ylim(bottom=0.0, top=max(1.0, float(np.nanmax(high)) * 1.1))
            if panel.names:
                axis.legend(loc="upper right", fontsize=7, ncols=len(panel.names))
        axes[-1].set_xlabel("time, s")
        out = BytesIO()
        figure.savefig(out, format="png", dpi=110)
        return out.getvalue()

    def html(self) -> str:
        """Return the figure in a page that loads nothing from elsewhere."""
        image = b64encode(self.png()).decode()
        return _PAGE.format(title=escape(self.title), summary=escape(self.summary), image=image)

    def _of(self, layout: Layout) -> Iterator[Panel]:
        for name, sensor in (("gyro", layout.gyro), ("accelerometer", layout.accelerometer)):
            if sensor.in_pulses:
                yield Panel(f"{name}, pulses a sample", ("X", "Y", "Z"), Envelope(3))
        if self._compensator is not None or not layout.gyro.in_pulses:
            yield Panel("rate, deg/s", ("X", "Y", "Z"), Envelope(3))
        if self._compensator is not None or not layout.accelerometer.in_pulses:
            yield Panel("specific force, m/s$^2$", ("X", "Y", "Z"), Envelope(3))
        yield Panel("samples, in all", _LOSSES, Envelope(2))
        if self._temperatures:
            names = tuple(name.replace("_", " ") for name in self._temperatures)
            yield Panel("temperature, degC", names, Envelope(len(names)))

    def _feed(self, pulses: Records) -> None:
        elapsed_s = pulses["elapsed_ns"] * NS
        span_s = pulses["interval_ns"] * NS
        before_s = np.concatenate([[self._elapsed_s], elapsed_s[:-1]])
        gap_s = np.maximum(elapsed_s - before_s - span_s, 0.0)  # a unit that restarts counts from 0
        missing = np.rint(gap_s / self._interval_s) * ((pulses["flags"] & Flag.MISSING_BEFORE) != 0)
        flagged = (pulses["flags"] & _BAD) != 0
        t = self._last_s + np.cumsum(span_s + gap_s)
        lost, bad = self._lost + np.cumsum(missing), self._bad + np.cumsum(flagged)
        self._elapsed_s = float(elapsed_s[-1])
        self._last_s, self._lost, self._bad = float(t[-1]), float(lost[-1]), float(bad[-1])
        self._t.feed(t[:, None])
        values: list[Array] = [
            pulses[name].astype(np.float64)
            for name, sensor in (("gyro", self._layout.gyro), ("accelerometer", self._layout.accelerometer))
            if sensor.in_pulses
        ]
        values += self._rates(pulses, span_s)
        values.append(np.stack([lost, bad], axis=1))
        if self._temperatures:
            values.append(pulses["temperature_degc"][:, : len(self._temperatures)])
        for panel, columns in zip(self.panels, values, strict=True):
            panel.envelope.feed(columns)

    def _rates(self, pulses: Records, span_s: Array) -> list[Array]:
        if self._compensator is not None:
            increments = self._compensator.feed(pulses)  # late by the filter's lag, which no eye sees
            seconds = increments["interval_ns"][:, None] * NS
            return [increments["dtheta_b"] / seconds / DEG, increments["dv_b"] / seconds]
        found = []
        if not self._layout.gyro.in_pulses:
            found.append(pulses["gyro"] / span_s[:, None] / DEG)
        if not self._layout.accelerometer.in_pulses:
            found.append(pulses["accelerometer"] / span_s[:, None])
        return found
