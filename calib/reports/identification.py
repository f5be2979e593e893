"""Report of an identification.

The report is a function of the result: it computes only means, extremes and other units.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from math import hypot
from typing import Final

import numpy as np

from calib.estimation.priors import Priors
from calib.estimation.result import LeaveOneOut, LeverArmEstimate, ParameterEstimate, TurnResult
from calib.estimation.runs import Run
from calib.identification import CaptureSummary, IdentificationResult, scatter
from calib.lever_arms.gauge import LeverArms
from calib.messages import english, message
from calib.reports import figures
from calib.reports.document import (
    Block,
    Document,
    Figure,
    KeyValues,
    Paragraph,
    Say,
    Section,
    Table,
    sanitise,
)
from calib.reports.format import counted, decimals, mm, three_digits
from calib.reports.html import as_html
from calib.reports.text import blocks_text
from calib.reports.verdict import redundancy_mark, scatter_mark, verdict
from imudrv.arrays import Array
from imudrv.units import ARCSEC, DEG, DEG_PER_H, MM, PPM, STANDARD_GRAVITY, UG, URAD


def document(identification: IdentificationResult, arms: Sequence[LeverArms]) -> Document:
    """Return the report of an identification.

    Parameters
    ----------
    identification : IdentificationResult
        Result of the identification.
    arms : sequence of LeverArms
        The lever arms in each gauge to be shown, the requested one first.

    Returns
    -------
    Document
    """
    return Document(
        f"Inner lever arms of unit {sanitise(identification.prior_calibration.calibration.serial_number)}",
        f"Identification of {identification.created:%Y-%m-%d %H:%M} UTC, {identification.software}",
        (
            Section("Result", tuple(result_blocks(identification, arms))),
            Section("Input data", tuple(_inputs(identification))),
            Section("Rotations", tuple(_rotations(identification))),
            Section("Rejected motions", tuple(_rejected(identification.sources))),
            Section("Velocity before and after compensation", tuple(_velocities(identification.result))),
            Section("The estimate", tuple(_estimate(identification))),
            Section("Limits", tuple(Paragraph(text) for text in _limits(identification, arms[0]))),
        ),
    )


def terminal_document(
    identification: IdentificationResult, arms: Sequence[LeverArms], verbose: bool = False
) -> Document:
    """Return the result with the verdict at the end, as text that scrolls away is read.

    Parameters
    ----------
    identification, arms
        As for `document`.
    verbose : bool
        The other sections precede the result.

    Returns
    -------
    Document
    """
    whole = document(identification, arms)
    result, *others = whole.sections
    marks, *tables = result.blocks
    return replace(whole, sections=(*(others if verbose else ()), Section(result.title, (*tables, marks))))


def report_html(identification: IdentificationResult, arms: Sequence[LeverArms]) -> str:
    """Return the report as one HTML file with its figures, see `document`."""
    return as_html(document(identification, arms))


def arms_text(arms: LeverArms) -> str:
    """Return lever arms alone, with their gauge, as plain text."""
    return blocks_text([_arms_table(arms)])


def result_blocks(
    identification: IdentificationResult, arms: Sequence[LeverArms], say: Say = english
) -> Iterator[Block]:
    """Return verdict, arms and differences of a report.

    Parameters
    ----------
    identification, arms
        As for `document`.
    say : callable
        Language of the report.

    Returns
    -------
    iterator of Block
    """
    result = identification.result
    yield KeyValues(tuple((mark, say(text)) for mark, text in verdict(identification)))
    yield Paragraph(say(message("u_and_U")))
    for one in arms:
        yield _arms_table(one, say)
    sigma = result.differences_sigma
    fixed = f".{decimals(sigma)}f"
    yield Table(
        say(message("differences_table")),
        ("", say(message("value")), "u", "U"),
        tuple(
            (
                f"r_x - r_{other}, {axis}",
                mm(result.differences[i, j], f"+{fixed}"),
                mm(sigma[i, j], fixed),
                mm(2.0 * sigma[i, j], fixed),
            )
            for i, other in enumerate("yz")
            for j, axis in enumerate("XYZ")
        ),
    )
    C_ba = np.array(identification.prior_calibration.calibration.accelerometer.C_ba)
    yield Figure(
        say(message("points_figure", gauge=arms[0].gauge)), lambda: figures.sensing_points(arms[0].r_b, C_ba)
    )


def _arms_table(arms: LeverArms, say: Say = english) -> Table:
    """Return the nine components, with their uncertainties if these are known."""
    title = say(message("arms_table", gauge=arms.gauge))
    if arms.covariance is None:
        rows = [(f"r_{i}", *(mm(v, "+.3f") for v in r)) for i, r in zip("xyz", arms.r_b, strict=True)]
        return Table(title, ("", "X", "Y", "Z"), tuple(rows))
    sigma = np.sqrt(np.maximum(np.diag(arms.covariance), 0.0)).reshape(3, 3)
    fixed = f".{decimals(sigma)}f"
    return Table(
        title,
        ("", "X", "Y", "Z", "u(X)", "u(Y)", "u(Z)"),
        tuple(
            (f"r_{i}", *(mm(v, f"+{fixed}") for v in r), *(mm(u, fixed) for u in row))
            for i, r, row in zip("xyz", arms.r_b, sigma, strict=True)
        ),
    )


def _inputs(identification: IdentificationResult) -> Iterator[Block]:
    prior, site, result = identification.prior_calibration, identification.site, identification.result
    gravity = "normal gravity" if site.gravity_m_s2 is None else f"gravity {site.gravity_m_s2:.6f} m/s^2"
    yield KeyValues(
        (
            ("unit", sanitise(prior.calibration.serial_number)),
            ("calibration", f"{sanitise(prior.name)} of {prior.calibration.created:%Y-%m-%d}"),
            ("SHA-256", prior.sha256),
            (
                "site",
                f"latitude {site.latitude_deg:.6f} deg, longitude {site.longitude_deg:.6f} deg, "
                f"height {site.height_m:.1f} m, {gravity}",
            ),
            ("method", _METHODS[result.method]),
            ("pivot", "at rest at the origin of the body frame" if result.gauge == "given" else "unknown"),
        )
    )
    for source in identification.sources:
        warm = ", ".join(
            f"{channel.replace('_', ' ')} {least:.1f} to {most:.1f}"
            for channel, least, most in source.temperatures
        )
        parts = [source.name, source.profile] + ([f"channel {source.channel}"] if source.channel else [])
        yield KeyValues(
            (
                ("capture", sanitise(", ".join(parts))),
                ("SHA-256", source.sha256),
                ("contents", f"{source.rotations.segments.duration_s:.1f} s; {source.counts}"),
                ("temperature", f"{warm} degC" if warm else "not reported by the unit"),
            )
        )


def _rotations(identification: IdentificationResult) -> Iterator[Block]:
    limits = identification.limits
    yield Paragraph(
        f"A rotation is accepted if its angle is {limits.angle_deg:g} +- {limits.angle_tolerance_deg:g} deg, "
        f"its peak rate at least {limits.least_peak_deg_per_s:g} deg/s, its axis at most "
        f"{limits.axis_tilt_deg:g} deg off the vertical, the rest before it at least "
        f"{limits.rest_before_s:g} s and the rest after it at least {limits.rest_after_s:g} s long, with at "
        f"most {counted(limits.missing, 'missing sample')}, no saturation and no fault reported by the unit."
    )
    for number, (run, result) in enumerate(
        zip(identification.runs, identification.result.runs, strict=True), start=1
    ):
        yield KeyValues(((f"run {number}", sanitise(run.label)), *_rotation(run)))
        yield from map(_velocity_and_design, result.turns)
        yield Figure(
            f"Run {number}. Grey: the turns. A constant offset comes from the pulse quantisation of the "
            "first velocity",
            partial(figures.velocities, run, result),
        )


def _rotation(run: Run) -> Iterator[tuple[str, str]]:
    """Return what was detected of the turns of a run and its rests."""
    aligned, before = run.aligned, run.turns[0].before
    yield "rest before", f"{before.duration_s:.1f} s; {counted(before.missing, 'missing sample')}"
    for turn, label in zip(run.turns, run.turn_labels, strict=True):
        yield (
            f"turn {sanitise(label)}",
            f"{turn.angle_deg:+.2f} deg about {turn.axis} up, {turn.duration_s:.2f} s, "
            f"peak {turn.peak_deg_per_s:.1f} deg/s, axis {turn.axis_tilt_deg:.2f} deg off the vertical; "
            f"then {turn.after.duration_s:.1f} s of rest; "
            f"{counted(turn.missing + turn.after.missing, 'missing sample')}",
        )
        if not turn.accepted:
            yield "outside the limits", "; ".join(map(english, turn.reasons))
    yield (
        "alignment",
        f"{aligned.duration_s:.1f} s: heading {aligned.heading_rad / DEG:.3f} deg, u "
        f"{aligned.heading_sigma_rad / DEG:.3f} deg; level u {aligned.level_sigma_rad / ARCSEC:.1f} arcsec; "
        f"{sanitise(str(aligned.motion)) if aligned.motion else 'no motion'}",
    )


def _velocity_and_design(turn: TurnResult) -> Table:
    return Table(
        f"V, mm/s, and H, m/s per m of each component, of turn {sanitise(turn.label)}",
        ("", "east", "north", "up"),
        (
            ("V", *(mm(v, "+.2f") for v in turn.V_n)),
            *(
                (f"H, r_{i} {axis}", *(f"{h + 0.0:+.4f}" for h in turn.H[:, 3 * i_at + axis_at]))
                for i_at, i in enumerate("xyz")
                for axis_at, axis in enumerate("XYZ")
            ),
        ),
    )


def _rejected(sources: Sequence[CaptureSummary]) -> Iterator[Block]:
    rejected = [(source.name, *one) for source in sources for one in source.rotations.rejected]
    for name, rotation, reasons in rejected:
        yield KeyValues(
            (
                (
                    "motion",
                    f"{sanitise(name)} from {rotation.start_s:.1f} to {rotation.stop_s:.1f} s, "
                    f"{rotation.angle_deg:+.1f} deg about {rotation.axis} up",
                ),
                *(("rejected", english(reason)) for reason in reasons),
            )
        )
    if not rejected:
        yield Paragraph("None: every motion in the captures is accepted.")


def _velocities(result: LeverArmEstimate) -> Iterator[Block]:
    yield Table(
        "Horizontal velocity gained in each turn, mm/s",
        ("turn", "measured", "residual", "ratio", "scatter"),
        tuple(
            (
                f"{number}  {sanitise(turn.label)}",
                mm(_speed(turn.V_n)),
                mm(_speed(turn.compensated_n)),
                f"{_speed(turn.compensated_n) / _speed(turn.V_n):.1%}",
                mm(scatter(run), ".3f"),
            )
            for number, (run, turn) in enumerate(
                ((run, turn) for run in result.runs for turn in run.turns), start=1
            )
        ),
    )
    yield Paragraph(
        "'Residual' is V - H R: only the size effect is subtracted; bias, tilt and misalignment remain. "
        "'Scatter' is the rms of the residuals at rest about their mean."
    )
    yield Figure(
        "Horizontal velocity before and after compensation", lambda: figures.before_after(result.turns)
    )


def _speed(v_n: Array) -> float:
    return hypot(v_n[0], v_n[1])


def _estimate(identification: IdentificationResult) -> Iterator[Block]:
    result = identification.result
    yield from _observability(result, identification.priors.arm)
    yield Paragraph(" ".join(map(english, (scatter_mark(result).text, redundancy_mark(result).text))))
    yield _noise(result)
    yield Table("Prior uncertainties", ("", "u"), tuple(priors_rows(identification.priors)))
    if result.parameters:
        names = _names(result)
        yield Table(
            "Parameters estimated with the lever arms",
            ("", "value", "u", "prior u", ""),
            tuple(_parameter(n, name) for n, name in zip(result.parameters, names, strict=True)),
        )
        yield _correlations(identification, names)
    if result.leave_one_out:
        yield _leave_one_out(result)


def _observability(result: LeverArmEstimate, arm_m: float) -> Iterator[Block]:
    yield Paragraph(f"Observability. {result.reason[:1].upper()}{result.reason[1:]}.")
    yield Table(
        "Principal directions of (r_x, r_y, r_z): u, mm. Singular values of the stacked H: s, m/s per m",
        ("", *(str(k) for k in range(1, 10))),
        (
            ("u", *(three_digits(s / MM) for s in result.direction_sigma)),
            ("s", *(three_digits(s) for s in result.singular_values)),
        ),
    )
    yield Figure(
        f"Standard uncertainty of each direction; above {arm_m / MM:g} mm it is unobservable",
        lambda: figures.directions(result.direction_sigma, result.rank, arm_m),
    )


def _noise(result: LeverArmEstimate) -> KeyValues:
    noise = result.noise
    return KeyValues(
        (
            (
                "gyros",
                f"angle random walk {noise.angle_walk / DEG * 60.0:.5f} deg/sqrt(h), from the alignments",
            ),
            (
                "accelerometers",
                f"horizontal: velocity random walk {noise.velocity_walk * 60.0:.5f} m/s/sqrt(h), from the "
                "alignments",
            ),
        )
    )


def _leave_one_out(result: LeverArmEstimate) -> Table:
    return Table(
        "Largest change of r_x, r_y, r_z if one rotation is omitted, mm, and its u; p of its agreement",
        ("without", "rank", "r_x", "u", "r_y", "u", "r_z", "u", "p"),
        tuple((sanitise(one.label), str(one.rank), *_shifts(one)) for one in result.leave_one_out),
    )


def _shifts(one: LeaveOneOut) -> Iterator[str]:
    if one.shift_m is None or one.sigma_m is None or one.test is None:
        yield from ("unobservable", "") * 3
        yield ""
        return
    for shift, sigma in zip(np.abs(one.shift_m), one.sigma_m, strict=True):
        at = int(shift.argmax())
        yield mm(float(shift[at]), ".4f")
        yield mm(float(sigma[at]), ".4f")
    yield f"{one.test.p_value:.2g}"


def _correlations(identification: IdentificationResult, names: Sequence[str]) -> Table:
    correlation = identification.differences_correlation
    largest = np.argsort(-np.abs(correlation), axis=1)[:, :2]
    return Table(
        "Correlation of the differences with these parameters: the two largest",
        ("", "with", "rho", "with", "rho"),
        tuple(
            (
                f"r_x - r_{'yz'[row // 3]}, {'XYZ'[row % 3]}",
                *chain.from_iterable((names[k], f"{correlation[row, k]:+.2f}") for k in largest[row]),
            )
            for row in range(6)
        ),
    )


def _limits(identification: IdentificationResult, arms: LeverArms) -> Iterator[str]:
    if identification.result.gauge != "given":
        yield (
            "A common shift of the three sensing points is not known: rotations between rests determine only "
            "their differences. The gauge fixes the origin of the body frame. Another gauge changes "
            "compensated data by a rigid lever arm and does not change the velocity at rest."
        )
        if arms.gauge == "given":
            yield "Gauge given: one sensing point was specified, and is taken as exact."
    else:
        yield (
            "All nine components assume that the pivot is at rest at the origin of the body frame. A pivot "
            "that moves with the rotation appears as a common shift of the three points."
        )
    yield (
        "The uncertainties include what is in the model: noise as estimated in the rests, and biases, scale "
        "factors and misalignments within their priors. They do not include bending of body or mount, a "
        "reference that moves during the rests, or dither in the gyro increments."
    )
    yield (
        "The lever arms belong to this unit and to the calibration named above; with another C_ba or other "
        "scale factors, repeat the identification. They are valid at the temperatures above only."
    )


def priors_rows(priors: Priors) -> Iterator[tuple[str, str]]:
    """Return names and values of the priors, in the usual units."""
    if priors.covariance is not None:
        yield "biases, scales, misalignments", "covariance of the certificate"
    else:
        yield "accelerometer bias", f"{priors.accelerometer_bias / UG:g} ug"
        yield "accelerometer scale", f"{priors.accelerometer_scale / PPM:g} ppm"
        yield "accelerometer misalignment", f"{priors.accelerometer_misalignment / URAD:g} urad"
        yield "gyro bias", f"{priors.gyro_bias / DEG_PER_H:g} deg/h"
        yield "gyro scale", f"{priors.gyro_scale / PPM:g} ppm"
        yield "gyro misalignment", f"{priors.gyro_misalignment / URAD:g} urad"
    yield "accelerometer bias from run to run", f"{priors.accelerometer_bias_of_run / UG:g} ug"
    yield "gyro bias from run to run", f"{priors.gyro_bias_of_run / DEG_PER_H:g} deg/h"
    skew = f"{priors.skew * 1e3:g} ms"
    yield (
        "gyro-accelerometer skew",
        skew if not priors.expected_skew else f"{skew} about {priors.expected_skew * 1e3:g} ms",
    )


def _names(result: LeverArmEstimate) -> list[str]:
    """Return readable names of the parameters, with runs by number."""
    runs = {run.label: f"run {k + 1}" for k, run in enumerate(result.runs)}
    tilts = {"east": "tilt about east", "north": "tilt about north", "up": "heading"}
    names = []
    for parameter in result.parameters:
        head, _, part = parameter.name.rpartition("_")
        kind, _, label = head.partition(" ")
        if label in runs:
            kind = kind.replace("_", " ")
            names.append(f"{runs[label]} {tilts[part] if kind == 'phi' else f'{kind} {part}'}")
        else:
            names.append(parameter.name.replace("_", " "))
    return names


def _parameter(n: ParameterEstimate, name: str) -> tuple[str, ...]:
    unit, factor = _unit(n.name)
    return (name, *(three_digits(value / factor) for value in (n.value, n.sigma, n.prior)), unit)


def _unit(name: str) -> tuple[str, float]:
    """Return the unit of a parameter in the report, and its size."""
    if name.startswith("accelerometer_bias"):
        return "ug", UG
    if name.startswith("gyro_bias"):
        return "deg/h", DEG_PER_H
    if name.startswith("skew"):
        return "ms", 1e-3
    if name.startswith("quadratic"):
        return "ug/g^2", UG / STANDARD_GRAVITY**2
    if name.endswith(("_xx", "_yy", "_zz")):
        return "ppm", PPM
    return "urad", URAD


_METHODS: Final = {
    "joint": "joint estimate of the arms with biases, tilts and misalignments from all rests",
    "plain": "plain V = H R, one velocity for each rotation",
}
