"""Calibration certificate: the front matter of a session's report, in the sense of ISO/IEC 17025, 7.8."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

from calib.identification import IdentificationResult
from calib.lever_arms.gauge import LeverArms
from calib.messages import Message, message
from calib.reports.budget import budget
from calib.reports.document import (
    Block,
    Document,
    KeyValues,
    Paragraph,
    Say,
    Section,
    Table,
    sanitise,
    translations,
)
from calib.reports.identification import document as report
from calib.reports.identification import result_blocks
from imudrv.bench import Bench
from imudrv.calibration import Calibration
from imudrv.units import MM

_LINE: Final = "_" * 24
"""Where a person writes."""


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
    received : str
        Date on which the unit was received.
    procedure : Message
        Name and edition.
    measured : tuple of (str, str)
        First and last date.
    attempts : tuple of (Message, Message)
        Rejected attempts and skipped steps, and why.
    verified : Message
        Outcome of the verification.
    """

    number: str
    bench: Bench
    operator: str
    received: str
    procedure: Message
    measured: tuple[str, str]
    attempts: tuple[tuple[Message, Message], ...]
    verified: Message


def documents(
    identification: IdentificationResult, arms: Sequence[LeverArms], particulars: Particulars
) -> dict[str, Document]:
    """Return the certificate in each language, with the report of the identification as annex.

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
    dict of str to Document
        By the names of `LANGUAGES`.
    """
    return translations(partial(_document, identification, arms, particulars))


def _document(
    identification: IdentificationResult,
    arms: Sequence[LeverArms],
    particulars: Particulars,
    say: Say,
) -> Document:
    prior = identification.prior_calibration.calibration
    annex = report(identification, arms, say).sections[1:]
    result = (*result_blocks(identification, arms, say), Paragraph(say(message("coverage"))))
    return Document(
        say(message("certificate_title", number=particulars.number)),
        say(message("certificate_subtitle", unit=sanitise(prior.serial_number))),
        (
            Section(say(message("section_item")), tuple(_item(identification, particulars, say))),
            Section(say(message("section_procedure")), tuple(_procedure(identification, particulars, say))),
            Section(say(message("section_results")), result),
            Section(say(message("section_budget")), tuple(budget(identification, arms[0], say))),
            Section(say(message("section_traceability")), tuple(_traceability(identification, say))),
            Section(say(message("section_adjustment")), (_adjustment(prior, particulars, say),)),
            Section(say(message("section_deviations")), tuple(_deviations(particulars, say))),
            Section(say(message("section_signatures")), tuple(_signatures(particulars, say))),
            *(
                replace(section, title=say(message("section_annex", title=section.title)))
                for section in annex[:-1]
            ),
            Section(
                say(message("section_annex", title=annex[-1].title)),
                (*annex[-1].blocks, Paragraph(say(message("section_end")))),
            ),
        ),
    )


def _item(identification: IdentificationResult, given: Particulars, say: Say) -> Iterator[Block]:
    bench, prior = given.bench, identification.prior_calibration.calibration
    first, last = given.measured
    rows = (
        (message("item_laboratory"), bench.laboratory),
        (message("item_address"), bench.address),
        (message("item_customer"), bench.customer),
        (message("item_bench"), bench.bench),
        (message("item_operator"), given.operator),
        (message("item_authorised_by"), bench.authorised_by),
        (message("item_maker"), bench.unit.maker),
        (message("item_type"), bench.unit.type),
        (message("item_serial_number"), prior.serial_number),
        (message("item_condition"), say(message("in_working_order"))),
        (message("item_received"), given.received),
        (
            message("item_measured"),
            first if first == last else say(message("period", first=first, last=last)),
        ),
        (message("item_issued"), f"{identification.created:%Y-%m-%d}"),
        (message("item_software"), identification.software),
    )
    yield KeyValues(tuple((say(name), sanitise(value)) for name, value in rows))
    if blank := tuple(name for name, value in rows if not value):
        yield Paragraph(say(message("left_blank", names=blank)))
    yield Paragraph(say(message("this_item_only")))


def _procedure(identification: IdentificationResult, given: Particulars, say: Say) -> Iterator[Block]:
    site, warm = identification.site, [t for source in identification.sources for t in source.temperatures]
    degc = message("temperature_unknown")
    if warm:
        low, high = min(t.least_degc for t in warm), max(t.most_degc for t in warm)
        degc = message("temperature_range", low_degc=low, high_degc=high)
    position = message(
        "site_position",
        latitude_deg=site.latitude_deg,
        longitude_deg=site.longitude_deg,
        height_m=site.height_m,
    )
    gravity = message("gravity_normal", gravity_m_s2=site.gravity)
    if site.gravity_m_s2 is not None:
        gravity = message("gravity_measured", gravity_m_s2=site.gravity)
    rows = (
        (message("procedure_used"), given.procedure),
        (message("temperature_of_unit"), degc),
        (message("room"), message("room_not_recorded")),
        (message("site"), position),
        (message("local_gravity"), gravity),
    )
    yield KeyValues(tuple((say(name), sanitise(say(value))) for name, value in rows))
    if given.bench.instruments:
        head = (
            message("instrument"),
            message("item_serial_number"),
            message("instrument_certificate"),
            message("instrument_valid_until"),
        )
        yield Table(
            say(message("instruments")),
            tuple(map(say, head)),
            tuple(
                (sanitise(i.name), i.serial_number, i.certificate, i.valid_until or "")
                for i in given.bench.instruments
            ),
        )


def _traceability(identification: IdentificationResult, say: Say) -> Iterator[Block]:
    gravity = message("traceability_gravity_normal")
    if identification.site.gravity_m_s2 is not None:
        gravity = message("traceability_gravity_measured")
    yield Paragraph(say(message("traceability_angle")))
    yield Paragraph(say(gravity))
    yield Paragraph(say(message("traceability_time")))


def _adjustment(prior: Calibration, given: Particulars, say: Say) -> Block:
    before, size_effect = message("adjustment_no_arms"), prior.size_effect
    if size_effect is not None:
        arms = tuple(
            f"r_{i} ({', '.join(f'{v:+.3f}' for v in r)})"
            for i, r in zip("xyz", size_effect.r_m / MM, strict=True)
        )
        before = message("adjustment_arms", arms=arms, gauge=size_effect.gauge)
    rows = (
        (message("adjustment_before"), before),
        (message("adjustment_after"), message("adjustment_result")),
        (message("adjustment_verification"), given.verified),
    )
    return KeyValues(tuple((say(name), say(value)) for name, value in rows))


def _deviations(given: Particulars, say: Say) -> Iterator[Block]:
    yield Paragraph(say(message("decision_rule")))
    if given.attempts:
        yield KeyValues(tuple((sanitise(say(what)), sanitise(say(why))) for what, why in given.attempts))
    else:
        yield Paragraph(say(message("no_deviations")))


def _signatures(given: Particulars, say: Say) -> Iterator[Block]:
    operator, authorised = sanitise(given.operator), sanitise(given.bench.authorised_by)
    yield Paragraph(say(message("signed_operator", name=operator, line=_LINE)))
    yield Paragraph(say(message("signed_authorised", name=authorised, line=_LINE)))
    yield Paragraph(say(message("only_in_full")))
    yield Paragraph(say(message("words_in_figures")))
