"""Results of a session of rests: what `calib sensors` and `calib noise` compute from its recordings."""

from typing import Any, NamedTuple

from calib.bench.state import SessionState
from calib.messages import Message
from calib.noise.analysis import analyse_noise
from calib.noise.documents import certificate as noise_certificate
from calib.reports import noise as noise_report
from calib.reports import sensors as sensors_report
from calib.reports.document import Document, Section, Table
from calib.reports.text import blocks_text
from calib.sensors.calibrate import calibrate_sensors
from calib.sensors.certificate import certificate as sensors_certificate
from calib.sensors.certificate import why_none
from imudrv.calibration import Calibration


class RestsResult(NamedTuple):
    """Result of a session of rests, see `calib.bench.kinds.SessionResult`.

    Attributes
    ----------
    verdicts : tuple of (str, Message)
        Marks and reasons.
    certificate : Calibration or None
        The unit's new certificate; None: the verdict, or what is not observable, allows none.
    document : Document
        The report.
    title : str
        Title of the section with the numbers.
    """

    verdicts: tuple[tuple[str, Message], ...]
    certificate: Calibration | None
    document: Document
    title: str

    @property
    def _numbers(self) -> Section | None:
        return next((section for section in self.document.sections if section.title == self.title), None)

    def text(self, language: str) -> str:
        """Return the numbers as text; it is English in every language."""
        return blocks_text(self._numbers.blocks) if self._numbers else ""

    @property
    def page(self) -> dict[str, Any]:
        """The numbers as a table for the page."""
        blocks = self._numbers.blocks if self._numbers else ()
        tables = [block for block in blocks if isinstance(block, Table)]
        rows = [[[table.title], table.head, *table.rows] for table in tables]
        return {"table": [list(row) for of_table in rows for row in of_table if row != [""]]}


def calibrate_session(session: SessionState) -> RestsResult:
    """Calibrate the sensors from the recordings of a session."""
    has_start = session.plan.certificate.sha256 is not None
    result = calibrate_sensors(
        session.recordings(),
        site=session.site(),
        unit=session.plan.unit,
        start=session.initial_calibration().calibration if has_start else None,
        procedure=session.procedure(),
    )
    return RestsResult(
        tuple((one.mark, one.what) for one in result.verdict),
        None if why_none(result) else sensors_certificate(result),
        sensors_report.document(result),
        "Parameters",
    )


def analyse_session(session: SessionState) -> RestsResult:
    """Compute the noise from the recordings of a session."""
    result = analyse_noise(session.recordings(), calibration=session.initial_calibration())
    return RestsResult(
        result.judgements,
        None if result.is_bad else noise_certificate(result),
        noise_report.document(result),
        "Upper limits" if result.is_bad else "Coefficients",
    )
