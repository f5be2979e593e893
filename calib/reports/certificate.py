"""Calibration certificate: the front matter of a session's report, in the sense of ISO/IEC 17025, 7.8."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.estimation.joint import estimate_joint
from calib.identification import IdentificationResult
from calib.lever_arms.gauge import LeverArms
from calib.messages import Message, english
from calib.reports.document import Block, Document, KeyValues, Paragraph, Section, Table, sanitise
from calib.reports.format import mm
from calib.reports.identification import document as report
from imudrv.arrays import Array
from imudrv.bench import Bench
from imudrv.calibration import Calibration
from imudrv.units import MM

_SOURCES = {
    "accelerometer bias": ("accelerometer_bias",),
    "accelerometer scale factor": ("accelerometer_scale",),
    "accelerometer misalignment": ("accelerometer_misalignment",),
    "gyro bias": ("gyro_bias",),
    "gyro scale factor and misalignment (axis of rotation)": ("gyro_scale", "gyro_misalignment"),
    "gyro-accelerometer skew": ("skew",),
}
"""Priors of each source of uncertainty."""

_DIFFERENCES = tuple(f"r_x - r_{other}, {axis}" for other in "yz" for axis in "XYZ")


@dataclass(frozen=True)
class Particulars:
    """What the session knows beside the identification.

    Attributes
    ----------
    number : str
        Of the certificate.
    bench : Bench
        Who, where and with what.
    operator : str
        Who did it.
    procedure : str
        Name and edition.
    measured : str
        First and last date.
    attempts : tuple of (str, str)
        Rejected attempts and skipped steps, and why.
    verified : Message
        Outcome of the verification.
    is_simulated : bool
        The unit is a simulated one.
    """

    number: str
    bench: Bench
    operator: str
    procedure: str
    measured: str
    attempts: tuple[tuple[str, str], ...]
    verified: Message
    is_simulated: bool


def document(
    identification: IdentificationResult, arms: Sequence[LeverArms], particulars: Particulars
) -> Document:
    """Return the certificate, with the report of the identification as its annex.

    Parameters
    ----------
    identification : IdentificationResult
        Result of the identification.
    arms : sequence of LeverArms
        The lever arms in each gauge to be shown.
    particulars : Particulars
        What else belongs on a certificate.

    Returns
    -------
    Document
    """
    annex = report(identification, arms)
    result, *others = annex.sections
    prior = identification.prior_calibration.calibration
    return Document(
        f"Calibration certificate {particulars.number}",
        f"Inner lever arms of unit {sanitise(prior.serial_number)}",
        (
            Section("Laboratory, item and dates", tuple(_particulars(identification, particulars))),
            Section("Procedure and environment", tuple(_procedure(identification, particulars))),
            replace(result, title="Results", blocks=(*result.blocks, _COVERAGE)),
            Section("Uncertainty budget", tuple(_budget(identification))),
            Section("Traceability", tuple(_traceability(identification, particulars))),
            Section("Before and after adjustment", tuple(_adjustment(prior, particulars))),
            Section("Decision rule and deviations", tuple(_deviations(particulars))),
            Section("Signatures", tuple(_signatures(particulars))),
            *(replace(section, title=f"Annex: {section.title}") for section in others),
            Section("End of the certificate", ()),
        ),
    )


_COVERAGE = Paragraph(
    "U = k u with the coverage factor k = 2: for a normal distribution, a coverage probability of about 95 %."
)


def _particulars(identification: IdentificationResult, given: Particulars) -> Iterator[Block]:
    bench, prior = given.bench, identification.prior_calibration.calibration
    rows = (
        ("laboratory", bench.laboratory),
        ("address", bench.address),
        ("customer", bench.customer),
        ("bench", bench.bench),
        ("operator", given.operator),
        ("authorised by", bench.authorised_by),
        ("maker", bench.unit.maker),
        ("type", bench.unit.type),
        ("serial number", prior.serial_number),
        ("condition", "in working order: the checks before the measurement have passed"),
        ("received", ""),
        ("measured", given.measured),
        ("issued", f"{identification.created:%Y-%m-%d}"),
        ("software", identification.software),
    )
    yield KeyValues(tuple((name, sanitise(value)) for name, value in rows))
    if blank := [name for name, value in rows if not value]:
        yield Paragraph(f"Left blank, as not stated: {', '.join(blank)}.")
    yield Paragraph("The results relate only to this item, in the condition in which it was measured.")


def _procedure(identification: IdentificationResult, given: Particulars) -> Iterator[Block]:
    site, warm = identification.site, [t for source in identification.sources for t in source.temperatures]
    gravity = "normal gravity of the site" if site.gravity_m_s2 is None else "measured, from the site file"
    degc = "not reported by the unit"
    if warm:
        degc = (
            f"{min(t.least_degc for t in warm):.1f} to {max(t.most_degc for t in warm):.1f} degC, in the unit"
        )
    yield KeyValues(
        (
            ("procedure", sanitise(given.procedure)),
            ("temperature", degc),
            (
                "site",
                f"latitude {site.latitude_deg:.6f} deg, longitude {site.longitude_deg:.6f} deg, "
                f"height {site.height_m:.1f} m",
            ),
            ("gravity", f"{site.gravity:.5f} m/s^2, {gravity}"),
        )
    )
    if given.bench.instruments:
        yield Table(
            "Instruments and surveys",
            ("", "serial number", "certificate", "valid until"),
            tuple(
                (sanitise(i.name), i.serial_number, i.certificate, i.valid_until or "")
                for i in given.bench.instruments
            ),
        )


def _budget(identification: IdentificationResult) -> Iterator[Block]:
    total = identification.result.differences_sigma.ravel()
    parts = {name: _part(identification, keys, total) for name, keys in _SOURCES.items()}
    known = np.sqrt(np.sum([part**2 for part in parts.values()], axis=0))
    noise = np.sqrt(np.maximum(total**2 - known**2, 0.0))
    rows = {
        "noise: velocity and angle random walk, pulses": noise,
        **parts,
        "combined, u": total,
        "U, k = 2": 2.0 * total,
    }
    yield Table(
        "Standard uncertainty of the differences by source, mm",
        ("", *_DIFFERENCES),
        tuple((name, *(mm(float(u), ".4f") for u in row)) for name, row in rows.items()),
    )
    yield Paragraph(
        "The part of a source is what the combined uncertainty loses when the source is known exactly; the "
        "noise, as estimated in the rests, has the remainder. A common shift of the three points is not "
        "determined: the gauge fixes it."
    )


def _part(identification: IdentificationResult, keys: Sequence[str], total: Array) -> Array:
    """Return the part of some priors in the uncertainty of the differences, m."""
    known = identification.priors.knowing(keys)
    without = estimate_joint(identification.runs, known).differences_sigma.ravel()
    part: Array = np.sqrt(np.maximum(total**2 - without**2, 0.0))
    return part


def _traceability(identification: IdentificationResult, given: Particulars) -> Iterator[Block]:
    site = identification.site
    origin = "the site's survey" if site.gravity_m_s2 is not None else "the normal gravity formula of WGS 84"
    for text in (
        "Angle: half turns, closed by the direction of gravity and the rotation of the Earth.",
        f"Acceleration: local gravity, from {origin}.",
        "Time: the unit's clock, compared with that of the host at every sample.",
    ):
        yield Paragraph(text)


def _adjustment(prior: Calibration, given: Particulars) -> Iterator[Block]:
    size_effect = prior.size_effect
    before = "no lever arms: the size effect was not compensated"
    if size_effect is not None:
        arms = "; ".join(
            f"r_{i} ({', '.join(f'{v:+.3f}' for v in r)})"
            for i, r in zip("xyz", size_effect.r_m / MM, strict=True)
        )
        before = f"{arms} mm, gauge {size_effect.gauge}"
    yield KeyValues(
        (
            ("before", before),
            ("after", "the results above, in the unit's certificate"),
            ("verification", english(given.verified)),
        )
    )


def _deviations(given: Particulars) -> Iterator[Block]:
    yield Paragraph(
        "Decision rule: the result is accepted by a person if no verdict above is bad; the uncertainty is "
        "stated and not subtracted from a limit (simple acceptance)."
    )
    if given.attempts:
        yield KeyValues(tuple((sanitise(what), sanitise(why)) for what, why in given.attempts))
    else:
        yield Paragraph("Deviations: none; no attempt was rejected and no step was skipped.")


def _signatures(given: Particulars) -> Iterator[Block]:
    line = "_" * 30
    yield KeyValues(
        (
            (f"operator {sanitise(given.operator)}".strip(), f"date {line}  signature {line}"),
            (
                f"authorised by {sanitise(given.bench.authorised_by)}".strip(),
                f"date {line}  signature {line}",
            ),
        )
    )
    yield Paragraph("This certificate may be reproduced only in full. The annexes belong to it.")
