"""Report of the noise of a unit."""

from collections.abc import Iterator
from math import isnan

from calib.noise.analysis import ChannelNoise, NoiseResult
from calib.noise.model import KINDS, VELOCITY_WALK, Coefficient, N
from calib.reports import figures
from calib.reports.document import Block, Document, Figure, KeyValues, Paragraph, Section, Table, sanitise
from calib.reports.format import three_digits
from calib.reports.html import as_html
from imudrv.wording import counted

_NOTE = (
    "N is the square root of a two-sided density, as in IEEE 647 and 952: that of a one-sided one, "
    "divided by sqrt(2). Uncertainties are standard ones; < is an upper limit (95 %) of what is not observed."
)
_LIMITS = (
    "95 %, and for any data: no other noise makes a deviation smaller. In brackets: averaging time. That of "
    "Q is for an error of the pulse count that is white at that time. Below each limit: the estimate at that "
    "time, if nothing else made the deviation."
)


def document(result: NoiseResult) -> Document:
    """Return the report of a result."""
    names = ", ".join(sanitise(capture.name) for capture in result.captures)
    sections = [Section("Verdict", (KeyValues(result.verdicts),))]
    if any(channel.fit.is_accepted for channel in result.channels):
        sections.append(Section("Coefficients", (*_coefficients(result), Paragraph(_NOTE))))
    if any(not channel.fit.is_accepted for channel in result.channels):
        sections.append(Section("Upper limits", (*_limits(result), Paragraph(_LIMITS))))
    sections += [
        Section("Fit", (_fits(result),)),
        Section("Allan deviation", tuple(_curves(result))),
        Section("Data", tuple(_data(result))),
    ]
    return Document("Noise", names, tuple(sections))


def report_html(result: NoiseResult) -> str:
    """Return the report as one HTML file with figures."""
    return as_html(document(result))


def _sensors(result: NoiseResult) -> Iterator[tuple[str, tuple[ChannelNoise, ...]]]:
    yield "Gyros", result.channels[:3]
    yield "Accelerometers", result.channels[3:]


def _coefficients(result: NoiseResult) -> Iterator[Block]:
    for title, channels in _sensors(result):
        if not any(channel.fit.is_accepted for channel in channels):
            continue
        units = channels[0].units
        rows = [(k, units[k]) for k in range(len(KINDS))]
        if title == "Accelerometers":
            rows.insert(N + 1, (N, VELOCITY_WALK))
        yield Table(
            title,
            ("", "X", "Y", "Z"),
            tuple(
                (f"{KINDS[k]}, {unit.unit}", *(_value(channel, k, unit) for channel in channels))
                for k, unit in rows
            ),
        )


def _value(channel: ChannelNoise, k: int, unit: Coefficient) -> str:
    fit = channel.fit
    if not fit.is_accepted:
        return "-"
    value, sigma = float(fit.value[k]) / unit.si, float(fit.sigma[k]) / unit.si
    if isnan(value):
        return f"< {three_digits(float(fit.below[k]) / unit.si)}"
    return f"{three_digits(value)} +- {sigma:.1g}"


def _limits(result: NoiseResult) -> Iterator[Block]:
    for title, channels in _sensors(result):
        if all(channel.fit.is_accepted for channel in channels):
            continue
        rows = []
        for k, unit in enumerate(channels[0].units):
            found = [None if channel.fit.is_accepted else channel.bounds[k] for channel in channels]
            limits = (f"{three_digits(b.value / unit.si)} ({b.tau_s:.3g} s)" if b else "-" for b in found)
            estimates = (three_digits(b.estimate / unit.si) if b else "-" for b in found)
            rows += [(f"{KINDS[k]} <=, {unit.unit}", *limits), ("estimate", *estimates)]
        yield Table(title, ("", "X", "Y", "Z"), tuple(rows))


def _fits(result: NoiseResult) -> Table:
    return Table(
        "Model of IEEE 647 and 952",
        ("", "from, s", "to, s", "chi-square / degree", "degrees"),
        tuple(
            (
                channel.name,
                f"{channel.fit.tau_s[0]:.3g}",
                f"{channel.fit.tau_s[-1]:.3g}",
                three_digits(channel.fit.reduced_chi_square),
                str(channel.fit.degrees_of_freedom),
            )
            for channel in result.channels
        ),
    )


def _curves(result: NoiseResult) -> Iterator[Block]:
    for title, channels in _sensors(result):
        unit = channels[0].units[2]

        def draw(channels: tuple[ChannelNoise, ...] = channels, unit: Coefficient = unit) -> bytes:
            return figures.allan_deviations(result.tau_s, channels, unit.unit, unit.si)

        yield Figure(f"{title}: points with their 68 % band, the fitted model, and its five parts", draw)
        rows = tuple(
            (f"{tau_s:.3g}", *(three_digits(float(channel.deviation[k]) / unit.si) for channel in channels))
            for k, tau_s in _decades(result)
        )
        yield Table(f"{title}, {unit.unit}", ("averaging time, s", "X", "Y", "Z"), rows)


def _decades(result: NoiseResult) -> Iterator[tuple[int, float]]:
    """Yield number and value of averaging times a decade apart."""
    below = 0.0
    for k, tau_s in enumerate(result.tau_s[: result.usable].tolist()):
        if tau_s >= 9.99 * below:
            below = tau_s
            yield k, tau_s


def _data(result: NoiseResult) -> Iterator[Block]:
    calibration = result.calibration
    yield KeyValues(
        (
            ("at rest", f"{result.at_rest_s:.1f} s, the longest stretch {result.longest_s:.1f} s"),
            ("scale factors", "nominal ones of the profile" if calibration is None else calibration.name),
            *((sanitise(capture.name), capture.counts) for capture in result.captures),
            ("software", result.software),
        )
    )
    rows = tuple(
        (f"{sanitise(capture.name)}: {what}", f"{begin_s:.1f}", f"{end_s:.1f}")
        for capture in result.captures
        for what, begin_s, end_s in capture.disturbances
    )
    if rows:
        total = sum(capture.disturbed for capture in result.captures)
        more = "" if total == len(rows) else f", the first of {counted(total, 'place')}"
        yield Table(f"Left out{more}", ("", "from, s", "to, s"), rows)
