"""Figures of the report of the sensors, as SVG."""

import numpy as np

from calib.reports.figures import COLOURS, drawing
from calib.sensors.result import SensorsResult


def residuals(result: SensorsResult) -> bytes:
    """Draw the residuals of each rest and motion in sigma, and the limit of 5."""
    adjustment = result.adjustment
    with drawing(2.4) as (figure, svg):
        axes = figure.subplots(1, 2, sharey=True)
        for one, is_motion, title in zip(axes, (False, True), ("rests", "motions"), strict=True):
            one.set(title=title, xlabel="number")
            one.axhline(5.0, color=COLOURS[1], linewidth=0.6)
            one.axhline(-5.0, color=COLOURS[1], linewidth=0.6)
            if adjustment is None:
                continue
            ratio = adjustment.residual / adjustment.residual_sigma
            for block in adjustment.system.blocks:
                if block.is_motion == is_motion:
                    values = ratio[block.rows]
                    one.plot(np.full(3, block.number + 1), values[:3], ".", color=COLOURS[0])
                    one.plot(
                        np.full(len(values) - 3, block.number + 1),
                        values[3:],
                        "x",
                        color=COLOURS[2],
                        markersize=3,
                    )
        axes[0].set_ylabel("residual, sigma")
    return svg.getvalue()


def attitudes(result: SensorsResult) -> bytes:
    """Draw where up was in body axes: longitude about Z, height above the XY plane."""
    with drawing(2.6) as (figure, svg):
        axes = figure.subplots()
        if result.adjustment is not None:
            ups = np.array([C.T[:, 2] for C in result.adjustment.attitudes])
            azimuth = np.degrees(np.arctan2(ups[:, 1], ups[:, 0]))
            height = np.degrees(np.arcsin(np.clip(ups[:, 2], -1.0, 1.0)))
            axes.plot(azimuth, height, "-", color="#cccccc", linewidth=0.5)
            axes.plot(azimuth, height, "o", color=COLOURS[0], markersize=4)
            for k, place in enumerate(zip(azimuth, height, strict=True)):
                at = (3, -9) if k % 2 else (3, 3)  # a turn in place leaves up where it was
                axes.annotate(str(k + 1), place, at, textcoords="offset points", fontsize=6)
        axes.set(
            xlim=(-190, 190),
            ylim=(-95, 95),
            xlabel="direction of up about Z from X, deg",
            ylabel="above the XY plane, deg",
        )
    return svg.getvalue()


def temperatures(result: SensorsResult) -> bytes:
    """Draw the temperatures of the rests over time, capture by capture."""
    with drawing(2.0) as (figure, svg):
        axes = figure.subplots()
        for session in sorted({rest.session for rest in result.evidence.rests}):
            rests = [rest for rest in result.evidence.rests if rest.session == session]
            t = [0.5 * (rest.start_s + rest.stop_s) / 60.0 for rest in rests]
            degc = np.array([rest.degc for rest in rests])
            for k, name in enumerate(("gyros", "accelerometer x", "y", "z")):
                if np.isfinite(degc[:, k]).any():
                    colour = (*COLOURS, "#8a8f98")[k]
                    axes.plot(t, degc[:, k], ".-", color=colour, label=name if session == 0 else None)
        axes.set(xlabel="minutes from the beginning of the capture", ylabel="degC")
        axes.legend()
    return svg.getvalue()
