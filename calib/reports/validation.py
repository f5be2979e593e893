"""The report of a validation: what compensation does to the velocity, judged; as text and as HTML."""

from collections.abc import Iterator, Sequence
from math import isnan, nan

from calib.reports import figures
from calib.reports.document import Block, Document, Figure, KeyValues, Paragraph, Section, Table, sanitise
from calib.validation.trial import FAST_DEG_PER_S, FIRST_S, Trial
from calib.validation.verdict import MAX_CHANGE, MIN_REDUCTION, TrialMetrics
from imudrv.units import MM


def document(unit: str, trials: Sequence[tuple[Trial, TrialMetrics]], drawn: int) -> Document:
    """Tell trials.

    Parameters
    ----------
    unit : str
        Whose trials they are.
    trials : sequence of (Trial, Judged)
        In order.
    drawn : int
        So many of them, the first, with their figures.

    Returns
    -------
    Document
    """
    return Document(
        f"Validation of {sanitise(unit)}",
        "Velocity at rest, in error: Normal without, Compensation with the size effect taken off",
        (
            Section("Verdicts", tuple(_verdicts(trials))),
            Section("What is compared", tuple(Paragraph(text) for text in _compared())),
            *(Section(sanitise(trial.name), tuple(_one(trial, judged))) for trial, judged in trials[:drawn]),
        ),
    )


def verdict(trial: Trial, judged: TrialMetrics) -> tuple[str, str]:
    """Judge a trial: 'good' or 'bad', and why, in a sentence."""
    mark = "good" if judged.good else "bad"
    if judged.expected == "smaller":
        return mark, (
            f"{sanitise(trial.name)}: horizontal velocity right after the motion "
            f"{judged.first[0] / MM:.2f} mm/s without, {judged.first[1] / MM:.2f} mm/s with compensation: "
            f"{judged.smaller_by:.2%} smaller, want {MIN_REDUCTION:.0%}."
        )
    return mark, (
        f"{sanitise(trial.name)}: compensation changes the horizontal velocity by {judged.change / MM:.3f} "
        f"mm/s rms; want less than {MAX_CHANGE:.0%} of the {judged.whole[0] / MM:.3f} mm/s without it, and "
        f"less than the {judged.noise / MM:.3f} mm/s of the sensors' noise."
    )


def _verdicts(trials: Sequence[tuple[Trial, TrialMetrics]]) -> Iterator[Block]:
    yield KeyValues(tuple(verdict(trial, judged) for trial, judged in trials))
    moved = [(trial, course) for trial, _ in trials if (course := trial.normal.aligned.motion)]
    if moved:
        yield KeyValues(tuple(("caution", sanitise(f"{trial.name}: {how}")) for trial, how in moved))
    yield Table(
        f"Horizontal velocity, mm/s: mean over {FIRST_S:g} s right after the motion; then rms apart from the "
        "twin over all the rest after it",
        ("", "Normal", "Comp.", "twin", "smaller", "Normal", "Comp."),
        tuple(
            (
                sanitise(trial.name),
                *(_mm(v) for v in judged.first),
                f"{judged.smaller_by:.2%}" if judged.expected == "smaller" else "",
                *(_mm(v) for v in judged.effect),
            )
            for trial, judged in trials
        ),
    )


def _compared() -> Iterator[str]:
    yield (
        "The same pulses are compensated, aligned and navigated twice, at the centroid of the three sensing "
        "points. The figures are those of the rests, where the true velocity is zero; during the motion it "
        "is not, and there it depends on the gauge."
    )
    yield (
        f"After a motion of more than {FAST_DEG_PER_S:g} deg/s the mean velocity over the first "
        f"{FIRST_S:g} s of rest is judged. What follows is a ramp, from residual biases and tilts, that is "
        "in both courses alike and no business of the lever arms. 'Noise' is what the random walks of the "
        "sensors, as the rests show them, make of velocity in the time since the alignment."
    )
    yield (
        "'Twin' is a unit that only a simulation has: the same errors, noise and motion, but accelerometers "
        "that all sense in one point, at the gyros' time, and gyros free of dither. No compensation can do "
        "better than the twin but by chance."
    )


def _one(trial: Trial, judged: TrialMetrics) -> Iterator[Block]:
    yield Table(
        f"Velocity right after the motion, mean over {FIRST_S:g} s, mm/s",
        ("", "east", "north", "up"),
        tuple(
            (name, *(f"{v / MM:+.2f}" for v in row))
            for name, row in zip(("Normal", "Compensation"), judged.first_n, strict=True)
        ),
    )
    yield Table(
        "Horizontal velocity in the rests, rms, mm/s",
        ("", "before", "after", "apart from the twin"),
        tuple(
            (name, *(_mm(v) for v in values))
            for name, values in (
                ("Normal", (judged.before[0], judged.whole[0], judged.effect[0])),
                ("Compensation", (judged.before[1], judged.whole[1], judged.effect[1])),
                ("twin", (nan, judged.whole[2], nan)),
                ("change", (nan, judged.change, nan)),
                ("noise", (nan, judged.noise, nan)),
            )
        ),
    )
    yield Figure(
        f"{sanitise(trial.name)}: velocity error; grey: the motion, where velocity is not zero",
        lambda: figures.courses(trial.t_s, trial.normal.v_n, trial.compensated.v_n, trial.moved_s),
    )


def _mm(value: float) -> str:
    return "" if isnan(value) else f"{value / MM:.2f}"
