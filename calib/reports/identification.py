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
from calib.messages import Message, english, message, verbatim
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
from calib.reports.format import decimals, mm, three_digits
from calib.reports.html import as_html
from calib.reports.text import blocks_text
from calib.reports.verdict import redundancy_mark, rest_motion, scatter_mark, verdict
from imudrv.arrays import Array
from imudrv.units import ARCSEC, DEG, DEG_PER_H, MM, PPM, STANDARD_GRAVITY, UG, URAD


def document(identification: IdentificationResult, arms: Sequence[LeverArms], say: Say = english) -> Document:
    """Return the report of an identification.

    Parameters
    ----------
    identification : IdentificationResult
        Result of the identification.
    arms : sequence of LeverArms
        The lever arms in each gauge to be shown, the requested one first.
    say : callable
        Language of the report; the words within figures are English.

    Returns
    -------
    Document
    """
    unit, result = identification.prior_calibration.calibration.serial_number, identification.result
    sections = (
        (message("report_result"), result_blocks(identification, arms, say)),
        (message("report_inputs"), _inputs(identification, say)),
        (message("report_rotations"), _rotations(identification, say)),
        (message("report_rejected"), _rejected(identification.sources, say)),
        (message("report_velocities"), _velocities(result, say)),
        (message("report_estimate"), _estimate(identification, say)),
        (message("report_limits"), map(Paragraph, map(say, _limits(identification, arms[0])))),
    )
    created = f"{identification.created:%Y-%m-%d %H:%M}"
    return Document(
        say(message("certificate_subtitle", unit=sanitise(unit))),
        say(message("report_subtitle", created=created, software=identification.software)),
        tuple(Section(say(title), tuple(blocks)) for title, blocks in sections),
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


def arms_text(arms: LeverArms, say: Say = english) -> str:
    """Return lever arms alone, with their gauge, as plain text."""
    return blocks_text([_arms_table(arms, say)])


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
    yield KeyValues(tuple((mark, sanitise(say(text))) for mark, text in verdict(identification)))
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


def _inputs(identification: IdentificationResult, say: Say) -> Iterator[Block]:
    prior, site, result = identification.prior_calibration, identification.site, identification.result
    position = message(
        "site_position",
        latitude_deg=site.latitude_deg,
        longitude_deg=site.longitude_deg,
        height_m=site.height_m,
    )
    gravity = message("gravity_normal", gravity_m_s2=site.gravity)
    if site.gravity_m_s2 is not None:
        gravity = message("gravity_measured", gravity_m_s2=site.gravity)
    created = f"{prior.calibration.created:%Y-%m-%d}"
    yield _pairs(
        say,
        (message("item_serial_number"), verbatim(prior.calibration.serial_number)),
        (message("report_calibration"), message("report_file_of", name=prior.name, created=created)),
        (message("report_sha256"), verbatim(prior.sha256)),
        (message("site"), position),
        (message("local_gravity"), gravity),
        (message("report_method"), _METHODS[result.method]),
        (message("report_pivot"), _PIVOTS[result.gauge]),
    )
    for source in identification.sources:
        parts = [verbatim(source.name), verbatim(source.profile)]
        parts += [message("report_channel", name=source.channel)] if source.channel else []
        warm = tuple(
            message("report_temperature", channel=channel.replace("_", " "), low_degc=low, high_degc=high)
            for channel, low, high in source.temperatures
        )
        yield _pairs(
            say,
            (message("report_capture"), _listed(tuple(parts))),
            (message("report_sha256"), verbatim(source.sha256)),
            (message("report_contents"), _contents(source)),
            (message("temperature_of_unit"), _listed(warm) if warm else message("temperature_unknown")),
        )


def _pairs(say: Say, *rows: tuple[Message, Message]) -> KeyValues:
    return KeyValues(tuple((sanitise(say(name)), sanitise(say(value))) for name, value in rows))


def _listed(parts: tuple[Message, ...]) -> Message:
    return message("reasons", reasons=parts)


def _contents(source: CaptureSummary) -> Message:
    counts = source.counts
    others = (
        (counts.reference, message("count_reference", n=counts.reference)),
        (counts.damaged, message("count_damaged", n=counts.damaged)),
        (counts.torn, message("count_torn", n=counts.torn)),
        (counts.missing, message("count_missing", n=counts.missing)),
        (counts.out_of_order, message("count_out_of_order", n=counts.out_of_order)),
        (counts.duplicate, message("count_duplicate", n=counts.duplicate)),
        (counts.invalid_counter, message("count_invalid_counter", n=counts.invalid_counter)),
        (counts.restarts, message("count_restarts", n=counts.restarts)),
        (counts.recovered, message("count_recovered", n=counts.recovered)),
    )
    good = message("count_good", n=counts.good)
    return message(
        "report_samples",
        duration_s=source.rotations.segments.duration_s,
        expected=counts.expected,
        parts=(good, *(part for n, part in others if n)),
    )


def _rotations(identification: IdentificationResult, say: Say) -> Iterator[Block]:
    limits = identification.limits
    accepted = message(
        "rotation_limits",
        angle_deg=limits.angle_deg,
        tolerance_deg=limits.angle_tolerance_deg,
        peak_deg_per_s=limits.least_peak_deg_per_s,
        tilt_deg=limits.axis_tilt_deg,
        before_s=limits.rest_before_s,
        after_s=limits.rest_after_s,
        missing=limits.missing,
    )
    yield Paragraph(say(accepted))
    for number, (run, result) in enumerate(
        zip(identification.runs, identification.result.runs, strict=True), start=1
    ):
        yield _pairs(say, (message("run", run=number), verbatim(run.label)), *_rotation(run))
        for turn in result.turns:
            yield _velocity_and_design(turn, say)
        yield Figure(say(message("run_figure", run=number)), partial(figures.velocities, run, result))


def _rotation(run: Run) -> Iterator[tuple[Message, Message]]:
    """Return what was detected of the turns of a run and its rests."""
    aligned, before = run.aligned, run.turns[0].before
    yield (
        message("rest_before"),
        message("rest_before_found", duration_s=before.duration_s, missing=before.missing),
    )
    for turn, label in zip(run.turns, run.turn_labels, strict=True):
        found = message(
            "turn_found",
            angle_deg=turn.angle_deg,
            axis=turn.axis,
            duration_s=turn.duration_s,
            peak_deg_per_s=turn.peak_deg_per_s,
            tilt_deg=turn.axis_tilt_deg,
            rest_s=turn.after.duration_s,
            missing=turn.missing + turn.after.missing,
        )
        yield message("turn", turn=label), found
        if not turn.accepted:
            yield message("outside_limits"), _listed(turn.reasons)
    alignment = message(
        "alignment_found",
        duration_s=aligned.duration_s,
        heading_deg=aligned.heading_rad / DEG,
        heading_u_deg=aligned.heading_sigma_rad / DEG,
        level_u_arcsec=aligned.level_sigma_rad / ARCSEC,
        motion=rest_motion(aligned.motion) if aligned.motion else message("no_motion"),
    )
    yield message("source_alignment"), alignment


def _velocity_and_design(turn: TurnResult, say: Say) -> Table:
    return Table(
        say(message("velocity_table", turn=sanitise(turn.label))),
        ("", *map(say, _DIRECTIONS)),
        (
            ("V", *(mm(v, "+.2f") for v in turn.V_n)),
            *(
                (f"H, r_{i} {axis}", *(f"{h + 0.0:+.4f}" for h in turn.H[:, 3 * i_at + axis_at]))
                for i_at, i in enumerate("xyz")
                for axis_at, axis in enumerate("XYZ")
            ),
        ),
    )


def _rejected(sources: Sequence[CaptureSummary], say: Say) -> Iterator[Block]:
    rejected = [(source.name, *one) for source in sources for one in source.rotations.rejected]
    for name, rotation, reasons in rejected:
        motion = message(
            "motion_found",
            capture=name,
            start_s=rotation.start_s,
            stop_s=rotation.stop_s,
            angle_deg=rotation.angle_deg,
            axis=rotation.axis,
        )
        why = ((message("motion_rejected"), reason) for reason in reasons)
        yield _pairs(say, (message("motion"), motion), *why)
    if not rejected:
        yield Paragraph(say(message("none_rejected")))


def _velocities(result: LeverArmEstimate, say: Say) -> Iterator[Block]:
    head = (
        message("column_turn"),
        message("column_measured"),
        message("column_residual"),
        message("column_ratio"),
        message("column_scatter"),
    )
    yield Table(
        say(message("gained_table")),
        tuple(map(say, head)),
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
    yield Paragraph(say(message("gained_explained")))
    yield Figure(say(message("gained_figure")), lambda: figures.before_after(result.turns))


def _speed(v_n: Array) -> float:
    return hypot(v_n[0], v_n[1])


def _estimate(identification: IdentificationResult, say: Say) -> Iterator[Block]:
    result = identification.result
    yield from _observability(result, identification.priors.arm, say)
    yield Paragraph(say(scatter_mark(result).text))
    yield Paragraph(say(redundancy_mark(result).text))
    noise = result.noise
    yield _pairs(
        say,
        (message("gyros"), message("gyro_walk", walk=noise.angle_walk / DEG * 60.0)),
        (message("accelerometers"), message("accelerometer_walk", walk=noise.velocity_walk * 60.0)),
    )
    priors = tuple((say(name), say(u)) for name, u in _priors(identification.priors))
    yield Table(say(message("priors_table")), ("", "u"), priors)
    if result.parameters:
        names = [say(name) for name in _names(result)]
        yield Table(
            say(message("parameters_table")),
            ("", say(message("value")), "u", say(message("prior_u")), ""),
            tuple(_parameter(n, name) for n, name in zip(result.parameters, names, strict=True)),
        )
        yield _correlations(identification, names, say)
    if result.leave_one_out:
        yield _leave_one_out(result, say)


def _observability(result: LeverArmEstimate, arm_m: float, say: Say) -> Iterator[Block]:
    yield Paragraph(say(message("observability", reason=result.reason)))
    yield Table(
        say(message("directions_table")),
        ("", *(str(k) for k in range(1, 10))),
        (
            ("u", *(three_digits(s / MM) for s in result.direction_sigma)),
            ("s", *(three_digits(s) for s in result.singular_values)),
        ),
    )
    yield Figure(
        say(message("directions_figure", limit_mm=arm_m / MM)),
        lambda: figures.directions(result.direction_sigma, result.rank, arm_m),
    )


def _leave_one_out(result: LeverArmEstimate, say: Say) -> Table:
    head = say(message("column_without")), say(message("column_rank"))
    return Table(
        say(message("without_table")),
        (*head, "r_x", "u", "r_y", "u", "r_z", "u", "p"),
        tuple((sanitise(one.label), str(one.rank), *_shifts(one, say)) for one in result.leave_one_out),
    )


def _shifts(one: LeaveOneOut, say: Say) -> Iterator[str]:
    if one.shift_m is None or one.sigma_m is None or one.test is None:
        yield from (say(message("unobservable")), "") * 3
        yield ""
        return
    for shift, sigma in zip(np.abs(one.shift_m), one.sigma_m, strict=True):
        at = int(shift.argmax())
        yield mm(float(shift[at]), ".4f")
        yield mm(float(sigma[at]), ".4f")
    yield f"{one.test.p_value:.2g}"


def _correlations(identification: IdentificationResult, names: Sequence[str], say: Say) -> Table:
    correlation = identification.differences_correlation
    largest = np.argsort(-np.abs(correlation), axis=1)[:, :2]
    return Table(
        say(message("correlation_table")),
        ("", *(say(message("column_with")), "rho") * 2),
        tuple(
            (
                f"r_x - r_{'yz'[row // 3]}, {'XYZ'[row % 3]}",
                *chain.from_iterable((names[k], f"{correlation[row, k]:+.2f}") for k in largest[row]),
            )
            for row in range(6)
        ),
    )


def _limits(identification: IdentificationResult, arms: LeverArms) -> Iterator[Message]:
    if identification.result.gauge != "given":
        yield message("limit_shift")
        if arms.gauge == "given":
            yield message("limit_given")
    else:
        yield message("limit_pivot")
    yield message("limit_model")
    yield message("limit_unit")


def _priors(priors: Priors) -> Iterator[tuple[Message, Message]]:
    """Return names and values of the priors, in the usual units."""
    if priors.covariance is not None:
        yield message("biases_scales_misalignments"), message("covariance_of_certificate")
    else:
        yield message("source_accelerometer_bias"), verbatim(f"{priors.accelerometer_bias / UG:g} ug")
        yield message("source_accelerometer_scale"), verbatim(f"{priors.accelerometer_scale / PPM:g} ppm")
        misalignment = verbatim(f"{priors.accelerometer_misalignment / URAD:g} urad")
        yield message("source_accelerometer_misalignment"), misalignment
        yield message("source_gyro_bias"), verbatim(f"{priors.gyro_bias / DEG_PER_H:g} deg/h")
        yield message("source_gyro_scale"), verbatim(f"{priors.gyro_scale / PPM:g} ppm")
        yield message("source_gyro_misalignment"), verbatim(f"{priors.gyro_misalignment / URAD:g} urad")
    bias, drift = priors.accelerometer_bias_of_run / UG, priors.gyro_bias_of_run / DEG_PER_H
    yield message("of_run", name=message("source_accelerometer_bias")), verbatim(f"{bias:g} ug")
    yield message("of_run", name=message("source_gyro_bias")), verbatim(f"{drift:g} deg/h")
    skew = verbatim(f"{priors.skew * 1e3:g} ms")
    if priors.expected_skew:
        skew = message("skew_about", skew_ms=priors.skew * 1e3, expected_ms=priors.expected_skew * 1e3)
    yield message("source_skew"), skew


def _names(result: LeverArmEstimate) -> Iterator[Message]:
    """Yield readable names of the parameters, with runs by number."""
    numbers = {run.label: k + 1 for k, run in enumerate(result.runs)}
    for parameter in result.parameters:
        head, _, part = parameter.name.rpartition("_")
        kind, _, label = head.partition(" ")
        name = _TILTS[part] if kind == "phi" else message("of_axis", name=_KINDS[kind], axis=part)
        if kind == "skew":
            name = _KINDS[kind]
        yield message("parameter_of_run", run=numbers[label], name=name) if label in numbers else name


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


_METHODS: Final = {"joint": message("method_joint"), "plain": message("method_plain")}
_PIVOTS: Final = {"given": message("pivot_at_rest"), "centroid": message("pivot_unknown")}
_DIRECTIONS: Final = message("east_axis"), message("north_axis"), message("up_axis")
_TILTS: Final = {
    "east": message("tilt_about_east"),
    "north": message("tilt_about_north"),
    "up": message("heading"),
}
_KINDS: Final = {
    "accelerometer_bias": message("source_accelerometer_bias"),
    "accelerometer_matrix": message("accelerometer_matrix"),
    "gyro_bias": message("source_gyro_bias"),
    "gyro_matrix": message("gyro_matrix"),
    "quadratic": message("quadratic"),
    "skew": message("source_skew"),
}
"""Parameters by the beginning of their names."""
