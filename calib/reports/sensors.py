"""Report of a calibration of the sensors: a function of the result."""

from collections.abc import Iterator
from functools import partial
from itertools import groupby
from math import floor, log10
from typing import Final

import numpy as np

from calib.reports import sensors_figures as figures
from calib.reports.document import Block, Document, Figure, KeyValues, Paragraph, Section, Table, sanitise
from calib.reports.html import as_html
from calib.sensors.certificate import software, why_none
from calib.sensors.result import Estimate, SensorsResult
from calib.sensors.verdict import worst_residuals
from imudrv.units import ARCSEC, DEG, DEG_PER_H, DEG_PER_SQRT_H, UG
from imudrv.wording import counted

CORRELATED: Final = 0.9
"""Correlation that is named."""
TEN_MGAL: Final = 1e-4


def document(result: SensorsResult) -> Document:
    """Return the report of a calibration of the sensors."""
    sections = [
        Section("Verdict", (KeyValues(tuple((one.mark, sanitise(one.text)) for one in result.verdict)),)),
        Section("Parameters", tuple(_parameters(result))),
        Section("Rests and motions", tuple(_rests(result))),
        Section("Gravity and noise", tuple(_gravity(result))),
    ]
    if details := tuple(_details(result)):
        sections.append(Section("Details", details))
    return Document(
        f"Sensors of unit {sanitise(result.inputs.serial_number)}",
        f"Calibration of {result.created:%Y-%m-%d %H:%M} UTC, {software()}",
        tuple(sections),
    )


def report_html(result: SensorsResult) -> str:
    """Return the report as one HTML file with its figures, see `document`."""
    return as_html(document(result))


def _parameters(result: SensorsResult) -> Iterator[Block]:
    if result.adjustment is None:
        yield Paragraph("None was estimated.")
        return
    yield Paragraph("u is the standard uncertainty (k = 1), U the expanded one (k = 2).")
    shown = (one for one in result.estimates if one.is_shown)
    for group, numbers in groupby(shown, lambda one: one.path.rpartition(".")[0]):
        yield Table(
            group or "others",
            ("", "value", "u", "U", "observable", "before"),
            tuple(_row(one) for one in numbers),
        )
    if result.missing:
        yield KeyValues(tuple(("to add", sanitise(text)) for text in result.missing))
    if refusal := why_none(result):
        yield Paragraph(f"No certificate: {sanitise(refusal)}")


def _row(one: Estimate) -> tuple[str, ...]:
    unit, name = 1.0, one.path.rpartition(".")[2]
    if name.startswith("C_"):
        unit, name = ARCSEC, f"{name}, arcsec"
    digits = _decimals(one.sigma / unit)
    return (
        name,
        f"{one.value / unit:.{digits}f}",
        f"{one.sigma / unit:.{digits}f}",
        f"{2.0 * one.sigma / unit:.{digits}f}",
        "yes" if one.observable else "no",
        f"{one.start / unit:.{digits}f}",
    )


def _decimals(sigma: float) -> int:
    """Return the number of decimals that shows two digits of an uncertainty."""
    return int(np.clip(1 - floor(log10(sigma)), 0, 9)) if sigma > 0.0 else 6


def _rests(result: SensorsResult) -> Iterator[Block]:
    evidence, adjustment = result.evidence, result.adjustment
    several = len(evidence.captures) > 1
    sigmas = {}
    if adjustment is not None:
        for block, sigma in zip(adjustment.system.blocks, worst_residuals(adjustment), strict=True):
            sigmas[block.is_motion, block.number] = sigma
    for one in result.inputs.captures:
        yield Paragraph(f"{sanitise(one.name)}: {one.counts}")
    rows = []
    for k, (rest, pose) in enumerate(zip(evidence.rests, result.poses, strict=True)):
        link = next((n for n, link in enumerate(evidence.links) if link.before == k), None)
        rows.append(
            (
                f"{rest.session + 1}: {pose}" if several else pose,
                f"{rest.start_s:.1f}",
                f"{rest.duration_s:.1f}",
                f"{rest.degc[0]:.2f}" if np.isfinite(rest.degc[0]) else "",
                f"{sigmas[False, k]:.1f}" if (False, k) in sigmas else "",
                "none" if link is None else f"{evidence.links[link].duration_s:.1f}",
                f"{sigmas[True, link]:.1f}" if link is not None and (True, link) in sigmas else "",
                f"{result.leave_one_out[k]:.2f}" if result.leave_one_out else "",
            )
        )
    yield Table(
        "Rests, each with the motion after it; residuals in sigma; growth of a sigma without the rest",
        ("rest", "at, s", "length, s", "degC", "residual", "motion, s", "residual", "growth"),
        tuple(rows),
    )
    if evidence.left:
        yield KeyValues(
            tuple(
                (f"{one.what} {one.start_s:.1f} to {one.stop_s:.1f} s", sanitise(one.reason))
                for one in evidence.left
            )
        )
    if adjustment is not None:
        yield Figure(
            "Residuals, in sigma; dots: gyros, crosses: accelerometers", partial(figures.residuals, result)
        )
        yield Figure(
            "Direction of up in body axes at each rest, in order", partial(figures.attitudes, result)
        )
    if any(np.isfinite(rest.degc).any() for rest in evidence.rests):
        yield Figure("Temperature of the rests, degC", partial(figures.temperatures, result))
    if not evidence.links:
        return
    yield Paragraph(
        f"The fastest motion turned a gyro at {evidence.fastest / DEG:.0f} deg/s. Scale and bias of a laser "
        "gyro depend on the rate: the numbers hold up to there."
    )


def _gravity(result: SensorsResult) -> Iterator[Block]:
    site, noise = result.inputs.site, result.evidence.noise
    source = "normal gravity of WGS-84" if site.gravity_m_s2 is None else "measured, from the site file"
    rows = [
        ("gravity", f"{site.gravity:.5f} m/s^2, {source}, u {result.gravity_sigma / 1e-5:.0f} mGal"),
        (
            "10 mGal more",
            f"would make all three K smaller by {TEN_MGAL / site.gravity * 1e6:.1f} ppm, nothing else",
        ),
        ("gyros", f"angle random walk {noise.angle_walk / DEG_PER_SQRT_H:.5f} deg/sqrt(h) in the rests"),
        ("accelerometers", f"velocity random walk {noise.velocity_walk / UG:.2f} ug/sqrt(Hz) in the rests"),
    ]
    if result.evidence.is_dithered:
        rows.append(("dither", "in the increments of the gyros; the rates of the size effect are filtered"))
    adjustment = result.adjustment
    if adjustment is not None:
        gyro, accelerometer, *_ = adjustment.wander
        freedom = counted(adjustment.degrees_of_freedom, "degree")
        rows += [
            ("wander", f"{gyro / DEG_PER_H:.4f} deg/h, {accelerometer / UG:.2f} ug from rest to rest"),
            (
                "chi-square",
                f"{adjustment.chi_square:.1f} with {freedom} of freedom, reduced {adjustment.reduced:.2f}; "
                f"{counted(adjustment.iterations, 'iteration')}",
            ),
        ]
    if result.faces is not None:
        theta = ", ".join(f"{value:+.1f}" for value in result.faces.theta / ARCSEC)
        tilt = ", ".join(f"{value:+.1f}" for value in result.faces.tilt_n / ARCSEC)
        rows += [
            (
                "faces",
                f"turned from the gyros by {theta} arcsec; plate tilted by {tilt} arcsec east and north",
            ),
            ("repeatability", f"set down to {result.faces.repeatability / ARCSEC:.2f} arcsec"),
        ]
    yield KeyValues(tuple(rows))
    if not any(one.path.startswith("accelerometer.asymmetry") for one in result.estimates):
        yield Paragraph(
            "At 0 and 1 g a quadratic term and different scales for positive and negative input look the "
            "same; the one that was chosen (--nonlinearity) holds both."
        )


def _details(result: SensorsResult) -> Iterator[Block]:
    pairs = tuple(_correlations(result))
    if pairs:
        yield Table(f"Correlations above {CORRELATED:g}", ("", "with", "correlation"), pairs)
    if result.faces is not None:
        yield Table(
            "Squareness of the faces, arcsec",
            ("", "X", "Y", "Z"),
            tuple(
                (name, *(f"{value:+.2f}" for value in d / ARCSEC))
                for name, d in result.faces.squareness.items()
            ),
        )


def _correlations(result: SensorsResult) -> Iterator[tuple[str, str, str]]:
    C = result.covariance
    sigma = np.sqrt(np.maximum(np.diag(C), 0.0))
    rows = [k for k, one in enumerate(result.estimates) if one.is_shown and one.observable and sigma[k] > 0.0]
    for i, a in enumerate(rows):
        for b in rows[:i]:
            if abs(correlation := C[a, b] / (sigma[a] * sigma[b])) > CORRELATED:
                yield result.estimates[a].path, result.estimates[b].path, f"{correlation:+.3f}"
