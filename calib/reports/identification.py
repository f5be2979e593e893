"""The report of an identification: one content, as text for a terminal and as one HTML file.

A report is a function of the findings: it tells, and computes nothing but means, extremes and other units.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from math import hypot
from typing import Final

import numpy as np
from rich.console import RenderableType
from scipy.special import chdtri

from calib.estimation.result import LeverArmEstimate, ParameterEstimate, RunResult
from calib.estimation.runs import Priors, Run
from calib.identification import CaptureSummary, IdentificationResult, scatter
from calib.lever_arms.gauge import LeverArms
from calib.reports import figures
from calib.reports.document import Block, Document, Figure, KeyValues, Paragraph, Section, Table, sanitise
from calib.reports.format import counted, decimals, three_digits
from calib.reports.html import as_html
from calib.reports.text import as_text, blocks_text, for_terminal
from imudrv.arrays import Array
from imudrv.units import ARCSEC, DEG, DEG_PER_H, MM, PPM, STANDARD_GRAVITY, UG, URAD


def report_text(findings: IdentificationResult, arms: Sequence[LeverArms]) -> str:
    """Tell the findings as plain text of 80 columns.

    Parameters
    ----------
    findings : Findings
        What was found.
    arms : sequence of Arms
        The lever arms in each gauge that is to be told, the one asked for first.

    Returns
    -------
    str
        Lines.
    """
    return as_text(_document(findings, arms))


def report_for_terminal(findings: IdentificationResult, arms: Sequence[LeverArms]) -> RenderableType:
    """The same for a console of rich's."""
    return for_terminal(_document(findings, arms))


def arms_text(arms: LeverArms) -> str:
    """Tell lever arms alone, with their gauge, as plain text."""
    return blocks_text([_arms_table(arms)])


def report_html(findings: IdentificationResult, arms: Sequence[LeverArms]) -> str:
    """Tell the findings as one HTML file, figures inside, nothing loaded from elsewhere.

    Parameters
    ----------
    findings, arms
        As for `report_text`.

    Returns
    -------
    str
        The file.
    """
    return as_html(_document(findings, arms))


def _document(findings: IdentificationResult, arms: Sequence[LeverArms]) -> Document:
    return Document(
        f"Inner lever arms of unit {sanitise(findings.basis.calibration.serial_number)}",
        f"Identification of {findings.created:%Y-%m-%d %H:%M} UTC, {findings.software}",
        (
            Section("Result", tuple(_result(findings, arms))),
            Section("What was measured", tuple(_measured(findings))),
            Section("Rotations", tuple(_rotations(findings))),
            Section("Motions that do not serve", tuple(_rejected(findings.sources))),
            Section("Velocity before and after", tuple(_velocities(findings.result))),
            Section("The estimate", tuple(_estimate(findings))),
            Section("Limits", tuple(Paragraph(text) for text in _limits(findings, arms[0]))),
        ),
    )


def _result(findings: IdentificationResult, arms: Sequence[LeverArms]) -> Iterator[Block]:
    result = findings.result
    yield KeyValues(tuple(verdict(findings)))
    yield Paragraph("u is the standard uncertainty (k = 1), U the expanded one (k = 2).")
    for told in arms:
        yield _arms_table(told)
    sigma = result.differences_sigma
    places = decimals(sigma)
    yield Table(
        "Differences of the sensing points, mm: the same in every gauge",
        ("", "value", "u", "U"),
        tuple(
            (
                f"r_x - r_{other}, {axis}",
                f"{result.differences[i, j] / MM:+.{places}f}",
                f"{sigma[i, j] / MM:.{places}f}",
                f"{2.0 * sigma[i, j] / MM:.{places}f}",
            )
            for i, other in enumerate("yz")
            for j, axis in enumerate("XYZ")
        ),
    )
    C_ba = findings.basis.calibration.accelerometer.C_ba_array
    yield Figure(
        f"Sensing points, gauge {arms[0].gauge}, and sensing directions. Grey cross: origin of b; dot in a "
        "circle: towards the reader, cross in it: away",
        lambda: figures.sensing_points(arms[0].r_b, C_ba),
    )


def _arms_table(arms: LeverArms) -> Table:
    """Nine numbers, with their gauge."""
    head: tuple[str, ...] = ("", "X", "Y", "Z")
    values = arms.r_b / MM
    if arms.covariance is None:
        rows = [(f"r_{i}", *(f"{v:+.3f}" for v in values[k])) for k, i in enumerate("xyz")]
        return Table(f"Sensing points in body axes, mm, gauge {arms.gauge}", head, tuple(rows))
    sigma = np.sqrt(np.maximum(np.diag(arms.covariance), 0.0)).reshape(3, 3) / MM
    places = decimals(sigma * MM)
    return Table(
        f"Sensing points in body axes, mm, gauge {arms.gauge}",
        (*head, "u(X)", "u(Y)", "u(Z)"),
        tuple(
            (
                f"r_{i}",
                *(f"{v + 0.0:+.{places}f}" for v in values[k]),
                *(f"{s:.{places}f}" for s in sigma[k]),
            )
            for k, i in enumerate("xyz")
        ),
    )


def verdict(findings: IdentificationResult) -> Iterator[tuple[str, str]]:
    """Judge the findings.

    Parameters
    ----------
    findings : Findings
        What was found.

    Yields
    ------
    (str, str)
        'good', 'note', 'caution' or 'bad', and why, in a sentence.
    """
    result = findings.result
    worst = float(result.differences_sigma.max())
    nine = result.gauge == "given"
    yield (
        "good",
        f"{'All nine components' if nine else 'The six differences'} of the sensing points are determined by "
        f"{counted(len(result.runs), 'rotation')}, method {result.method}; the largest standard uncertainty "
        f"of a difference is {worst / MM:.3f} mm.",
    )
    if result.consistent:
        yield _agreement(result)
    for refusal in result.refusals:
        yield "bad", f"{sanitise(refusal[0].upper() + refusal[1:])}. No certificate is made."
    shifts = [
        (one.label, float(np.abs(one.shift_m).max()))
        for one in result.leave_one_out
        if one.shift_m is not None
    ]
    if shifts:
        label, shift = max(shifts, key=lambda item: item[1])
        yield (
            "note",
            f"Leaving out one rotation changes no component by more than {shift / MM:.3f} mm "
            f"({sanitise(label)}).",
        )
    else:
        yield (
            "note",
            "The arms are determined, not checked: no redundant rotation. A second set, turned the other "
            "way, checks them.",
        )
    for n in result.parameters:
        if n.name == "skew_s" and not n.observable:
            yield (
                "note",
                "These rotations do not determine a gyro-accelerometer skew; the uncertainties allow for one "
                f"of {n.prior * 1e3:g} ms (1 sigma).",
            )
    for k, run in enumerate(findings.runs):
        if run.aligned.motion is not None:
            yield "caution", f"Run {k + 1} moved while it was aligned: {sanitise(run.aligned.motion)}."
    for note in result.notes:
        yield "caution", f"{sanitise(note)}."


def _agreement(result: LeverArmEstimate) -> tuple[str, str]:
    n = result.degrees_of_freedom
    if n == 0:
        return "caution", "As many equations as unknowns: no residuals, nothing to judge the model by."
    low, high = float(chdtri(n, 0.975)), float(chdtri(n, 0.025))
    told = (
        f"chi-square {result.chi_square:.1f} with {n} degrees of freedom, 95 % band {low:.1f} to {high:.1f}"
    )
    if not result.consistent:
        return "bad", f"The velocities contradict the model: {told}."
    if result.chi_square > high:
        return (
            "caution",
            f"The velocities scatter more than chance allows: {told}. The uncertainties may be too small "
            f"by a factor of {(result.chi_square / n) ** 0.5:.2f}.",
        )
    if result.chi_square < low:
        return (
            "note",
            f"The velocities scatter less than expected: {told}. The uncertainties are cautious.",
        )
    if 2 * len(result.runs) <= 6:  # two equations a rotation for six differences: none checks the arms
        return "good", f"The velocities scatter at rest as the noise makes expect: {told}."
    return "good", f"The velocities agree with the model: {told}."


def _measured(findings: IdentificationResult) -> Iterator[Block]:
    basis, site, result = findings.basis, findings.site, findings.result
    gravity = "normal gravity" if site.gravity_m_s2 is None else f"gravity {site.gravity_m_s2:.6f} m/s^2"
    yield KeyValues(
        (
            ("unit", sanitise(basis.calibration.serial_number)),
            ("calibration", f"{sanitise(basis.name)} of {basis.calibration.created:%Y-%m-%d}"),
            ("SHA-256", basis.sha256),
            (
                "site",
                f"latitude {site.latitude_deg:.6f} deg, longitude {site.longitude_deg:.6f} deg, "
                f"height {site.height_m:.1f} m, {gravity}",
            ),
            ("method", _METHODS[result.method]),
            ("pivot", "the origin of b, known to stay still" if result.gauge == "given" else "not known"),
        )
    )
    for source in findings.sources:
        warm = ", ".join(
            f"{channel.replace('_', ' ')} {least:.1f} to {most:.1f}"
            for channel, least, most in source.temperatures
        )
        parts = [source.name, source.profile] + ([f"channel {source.channel}"] if source.channel else [])
        yield KeyValues(
            (
                ("capture", sanitise(", ".join(parts))),
                ("SHA-256", source.sha256),
                ("contents", f"{source.evidence.segments.duration_s:.1f} s; {source.counts}"),
                ("temperature", f"{warm} degC" if warm else "not told by the unit"),
            )
        )


def _rotations(findings: IdentificationResult) -> Iterator[Block]:
    limits = findings.limits
    yield Paragraph(
        f"A rotation serves if it turns {limits.angle_deg:g} +- {limits.angle_tolerance_deg:g} deg, with a "
        f"peak of {limits.least_peak_deg_per_s:g} deg/s at least, about an axis {limits.axis_tilt_deg:g} deg "
        f"off the vertical at most, after {limits.rest_before_s:g} s of rest and before "
        f"{limits.rest_after_s:g} s, with {counted(limits.missing, 'sample')} missing at most, no axis "
        "saturated and no fault told."
    )
    for k, (run, told) in enumerate(zip(findings.runs, findings.result.runs, strict=True)):
        rotation, aligned = run.rotation, run.aligned
        before, after = rotation.before, rotation.after
        assert before is not None
        assert after is not None
        yield KeyValues(
            (
                (f"run {k + 1}", sanitise(run.label)),
                (
                    "rotation",
                    f"{rotation.angle_deg:+.2f} deg about {rotation.axis} up, {rotation.duration_s:.2f} s, "
                    f"peak {rotation.peak_deg_per_s:.1f} deg/s, axis {rotation.axis_tilt_deg:.2f} deg off "
                    "the vertical",
                ),
                (
                    "rests",
                    f"{before.duration_s:.1f} s before, {after.duration_s:.1f} s after; "
                    f"{counted(rotation.missing, 'sample')} missing in the rotation, "
                    f"{before.missing + after.missing} in the rests",
                ),
                (
                    "alignment",
                    f"{aligned.duration_s:.1f} s: heading {aligned.heading_rad / DEG:.3f} deg, u "
                    f"{aligned.heading_sigma_rad / DEG:.3f} deg; level u "
                    f"{aligned.level_sigma_rad / ARCSEC:.1f} arcsec; "
                    f"{sanitise(aligned.motion) if aligned.motion else 'stood still'}",
                ),
                ("verdict", "serves: within all limits"),
            )
        )
        yield Table(
            "V, mm/s, and H, m/s per m of each component, after the rotation",
            ("", "east", "north", "up"),
            (
                ("V", *(f"{v / MM:+.2f}" for v in told.V_n)),
                *(
                    (f"H, r_{i} {axis}", *(f"{h + 0.0:+.4f}" for h in told.H[:, 3 * i_at + axis_at]))
                    for i_at, i in enumerate("xyz")
                    for axis_at, axis in enumerate("XYZ")
                ),
            ),
        )
        yield Figure(
            f"Run {k + 1}. Grey: the rotation. A constant offset is that of the first velocity, from pulses",
            _drawn(run, told),
        )


def _drawn(run: Run, told: RunResult) -> Callable[[], bytes]:
    return lambda: figures.velocities(run, told)


def _rejected(sources: Sequence[CaptureSummary]) -> Iterator[Block]:
    rejected = [(source.name, *one) for source in sources for one in source.evidence.rejected]
    for name, rotation, reasons in rejected:
        yield KeyValues(
            (
                (
                    "motion",
                    f"{sanitise(name)} from {rotation.start_s:.1f} to {rotation.stop_s:.1f} s, "
                    f"{rotation.angle_deg:+.1f} deg about {rotation.axis} up",
                ),
                *(("rejected", reason) for reason in reasons),
            )
        )
    if not rejected:
        yield Paragraph("None: every motion in the captures serves.")


def _velocities(result: LeverArmEstimate) -> Iterator[Block]:
    def size(v_n: Array) -> float:
        return hypot(v_n[0], v_n[1]) / MM

    yield Table(
        "Horizontal velocity after the rotation, mm/s",
        ("run", "measured", "left", "ratio", "scatter"),
        tuple(
            (
                f"{k + 1}  {sanitise(run.label)}",
                f"{size(run.V_n):.2f}",
                f"{size(run.compensated_n):.2f}",
                f"{size(run.compensated_n) / size(run.V_n):.1%}",
                f"{scatter(run) / MM:.3f}",
            )
            for k, run in enumerate(result.runs)
        ),
    )
    yield Paragraph(
        "'Left' is V - H R, the size effect taken off and nothing else: what remains is residual bias, tilt "
        "and misalignment. 'Scatter' is the rms of the residuals at rest about their mean."
    )
    yield Figure(
        "Horizontal velocity before and after compensation", lambda: figures.before_after(result.runs)
    )


def _estimate(findings: IdentificationResult) -> Iterator[Block]:
    result, priors = findings.result, findings.priors
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
        f"Standard uncertainty of each direction; worse than {priors.arm / MM:g} mm is not seen",
        lambda: figures.directions(result.direction_sigma, result.rank, priors.arm),
    )
    yield Paragraph(f"Consistency. {_agreement(result)[1]}")
    noise = result.noise
    yield KeyValues(
        (
            (
                "gyros",
                f"angle random walk {noise.angle_walk / DEG * 60.0:.5f} deg/sqrt(h), found in the rests",
            ),
            (
                "level accels",
                f"velocity random walk {noise.velocity_walk * 60.0:.5f} m/s/sqrt(h), white noise "
                f"{noise.velocity_white / MM:.4f} mm/s, found in the rests",
            ),
        )
    )
    yield Table("What was taken to be known before", ("", "u"), tuple(priors_rows(priors)))
    if result.parameters:
        names = _names(result)
        yield Table(
            "Estimated beside the arms",
            ("", "value", "u", "u before", ""),
            tuple(_nuisance(n, words) for n, words in zip(result.parameters, names, strict=True)),
        )
        yield _correlations(findings, names)
    if result.leave_one_out:
        yield Table(
            "Each rotation left out in turn: largest change of r_x, r_y, r_z, mm",
            ("without", "rank", "r_x", "r_y", "r_z"),
            tuple(
                (
                    sanitise(one.label),
                    str(one.rank),
                    *(
                        ("not seen",) * 3
                        if one.shift_m is None
                        else (f"{np.abs(row).max() / MM:.3f}" for row in one.shift_m)
                    ),
                )
                for one in result.leave_one_out
            ),
        )


def _correlations(findings: IdentificationResult, names: Sequence[str]) -> Table:
    correlation = findings.differences_correlation
    largest = np.argsort(-np.abs(correlation), axis=1)[:, :2]
    return Table(
        "Correlation of the differences with these: the two largest",
        ("", "with", "rho", "with", "rho"),
        tuple(
            (
                f"r_x - r_{'yz'[row // 3]}, {'XYZ'[row % 3]}",
                *chain.from_iterable((names[k], f"{correlation[row, k]:+.2f}") for k in largest[row]),
            )
            for row in range(6)
        ),
    )


def _limits(findings: IdentificationResult, arms: LeverArms) -> Iterator[str]:
    result = findings.result
    if result.gauge != "given":
        yield (
            "Where the three points lie together is not known: rotations between rests see only how they lie "
            "to each other. The gauge says where the origin of b was put. Another gauge moves compensated "
            "data by a rigid lever arm and leaves the velocity at rest as it is."
        )
        if arms.gauge == "given":
            yield "Gauge given: where one of the points lies was stated, and is taken as exact."
    else:
        yield (
            "All nine components rest on the pivot's standing still at the origin of b. A pivot that moves "
            "with the rotation is told as a common shift of the three points."
        )
    yield (
        "The uncertainties hold for what is in the model: noise as found in the rests, and biases, scale "
        "factors and misalignments as large as the priors say. They do not hold for a body or mount that "
        "bends, a reference that moves during the rests, or dither in the gyros' increments."
    )
    yield (
        "The arms belong to this unit, and to the calibration that is named above; with another C_ba or "
        "other scale factors identify again. They were found at the temperatures above; "
        "nothing is said of others."
    )


def priors_rows(priors: Priors) -> Iterator[tuple[str, str]]:
    """Priors in the units of the field: what, and how much."""
    yield "accelerometer bias", f"{priors.accelerometer_bias / UG:g} ug"
    yield "accelerometer scale", f"{priors.accelerometer_scale / PPM:g} ppm"
    yield "accelerometer misalignment", f"{priors.accelerometer_misalignment / URAD:g} urad"
    yield "gyro bias", f"{priors.gyro_bias / DEG_PER_H:g} deg/h"
    yield "gyro scale", f"{priors.gyro_scale / PPM:g} ppm"
    yield "gyro misalignment", f"{priors.gyro_misalignment / URAD:g} urad"
    yield "gyro-accelerometer skew", f"{priors.skew * 1e3:g} ms"


def _names(result: LeverArmEstimate) -> list[str]:
    """Names of the nuisances in words, runs by their numbers."""
    runs = {f"phi {run.label}": f"run {k + 1}" for k, run in enumerate(result.runs)}
    tilts = {"east": "tilt about east", "north": "tilt about north", "up": "heading"}
    names = []
    for nuisance in result.parameters:
        head, _, part = nuisance.name.rpartition("_")
        names.append(f"{runs[head]} {tilts[part]}" if head in runs else nuisance.name.replace("_", " "))
    return names


def _nuisance(n: ParameterEstimate, words: str) -> tuple[str, ...]:
    unit, factor = _unit(n.name)
    return (words, *(three_digits(value / factor) for value in (n.value, n.sigma, n.prior)), unit)


def _unit(name: str) -> tuple[str, float]:
    """Unit that a nuisance is told in, and its size."""
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
