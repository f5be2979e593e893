"""Report of a validation: velocity with and without compensation, and the verdicts."""

from collections.abc import Iterator, Sequence
from math import nan

from calib.reports import figures
from calib.reports.document import Block, Document, Figure, KeyValues, Paragraph, Section, Table, sanitise
from calib.reports.format import mm
from calib.validation.trial import FAST_DEG_PER_S, FIRST_S
from calib.validation.verdict import MAX_CHANGE, MIN_REDUCTION, Validation


def document(unit: str, validations: Sequence[Validation], drawn: int) -> Document:
    """Return the report of a validation.

    Parameters
    ----------
    unit : str
        Name of the unit, for the title.
    validations : sequence of Validation
        The trials in their order.
    drawn : int
        Number of trials, from the first, that get a section with tables and a figure.

    Returns
    -------
    Document
    """
    return Document(
        f"Validation of {sanitise(unit)}",
        "Velocity error at rest without (Normal) and with size-effect compensation (Compensation)",
        (
            Section("Verdicts", tuple(_verdicts(validations))),
            Section("Method", tuple(Paragraph(text) for text in _method(_has_twin(validations)))),
            *(Section(sanitise(one.trial.name), tuple(_trial(one))) for one in validations[:drawn]),
        ),
    )


def verdict(validation: Validation) -> tuple[str, str]:
    """Return the verdict on a trial: 'good' or 'bad', and a sentence that gives the reason."""
    v, name = validation, sanitise(validation.trial.name)
    mark = "good" if v.good else "bad"
    if v.trial.expected == "reduced":
        return mark, (
            f"{name}: horizontal velocity right after the motion "
            f"{mm(v.first[0])} mm/s without, {mm(v.first[1])} mm/s with compensation: "
            f"reduced by {v.reduction:.2%}, required {MIN_REDUCTION:.0%}."
        )
    return mark, (
        f"{name}: compensation changes the horizontal velocity by "
        f"{mm(v.change, '.3f')} mm/s rms; required less than {MAX_CHANGE:.0%} of the "
        f"{mm(v.whole[0], '.3f')} mm/s without it, and less than the {mm(v.noise, '.3f')} mm/s "
        "of the sensor noise."
    )


def _verdicts(validations: Sequence[Validation]) -> Iterator[Block]:
    yield KeyValues(tuple(map(verdict, validations)))
    moved = [(one.trial.name, motion) for one in validations if (motion := one.trial.normal.aligned.motion)]
    if moved:
        yield KeyValues(tuple(("caution", sanitise(f"{name}: {motion}")) for name, motion in moved))
    title = f"Horizontal velocity, mm/s: mean over the first {FIRST_S:g} s after the motion"
    columns: Sequence[int] = (0, 1, 2, 4)
    if _has_twin(validations):
        title += "; then rms difference from the twin over the whole rest after it"
        columns = range(7)
    rows = [
        (
            sanitise(one.trial.name),
            *(mm(v) for v in one.first),
            f"{one.reduction:.2%}" if one.trial.expected == "reduced" else "",
            *(mm(v) for v in one.effect),
        )
        for one in validations
    ]
    head, *body = (
        tuple(row[k] for k in columns)
        for row in [("", "Normal", "Comp.", "twin", "reduced", "Normal", "Comp."), *rows]
    )
    yield Table(title, head, tuple(body))


def _has_twin(validations: Sequence[Validation]) -> bool:
    """Return whether there is a twin: there is none of recordings."""
    return any(one.trial.twin is not None for one in validations)


def _method(has_twin: bool) -> Iterator[str]:
    yield (
        "The same pulses are compensated, aligned and navigated twice, with the centroid of the three "
        "sensing points as origin. Only rests are evaluated, because the true velocity is zero there; "
        "during the motion it is not, and depends on the gauge."
    )
    yield (
        f"After a motion of more than {FAST_DEG_PER_S:g} deg/s the mean velocity over the first "
        f"{FIRST_S:g} s of rest is evaluated. Afterwards residual biases and tilts cause a ramp, which is "
        "the same in both navigations and independent of the lever arms. 'Noise' is the velocity that the "
        "random walks of the sensors, estimated in the rests, cause in the time since the alignment."
    )
    if not has_twin:
        return
    yield (
        "'Twin' is a simulated unit with the same errors, noise and motion, but with accelerometers that all "
        "sense at one point, at the time of the gyros, and with gyros free of dither. Compensation can be "
        "better than the twin only by chance."
    )


def _trial(validation: Validation) -> Iterator[Block]:
    trial = validation.trial
    yield Table(
        f"Velocity after the motion, mean over the first {FIRST_S:g} s, mm/s",
        ("", "east", "north", "up"),
        tuple(
            (name, *(mm(v, "+.2f") for v in row))
            for name, row in zip(("Normal", "Compensation"), validation.first_n, strict=True)
        ),
    )
    has_twin = _has_twin([validation])
    rows = [
        ("Normal", validation.before[0], validation.whole[0], validation.effect[0]),
        ("Compensation", validation.before[1], validation.whole[1], validation.effect[1]),
        *([("twin", nan, validation.whole[2], nan)] if has_twin else []),
        ("change", nan, validation.change, nan),
        ("noise", nan, validation.noise, nan),
    ]
    head = ("", "before", "after", *(["difference from the twin"] if has_twin else []))
    yield Table(
        "Horizontal velocity in the rests, rms, mm/s",
        head,
        tuple((name, *(mm(v) for v in values))[: len(head)] for name, *values in rows),
    )
    yield Figure(
        f"{sanitise(trial.name)}: velocity error; grey: the motion, where velocity is not zero",
        lambda: figures.navigations(trial.t_s, trial.normal.v_n, trial.compensated.v_n, trial.moved_s),
    )
