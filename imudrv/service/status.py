"""Status of a running service, and the health that follows from it."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, Self

import numpy as np
from pydantic import TypeAdapter, ValidationError

from imudrv.errors import InputError
from imudrv.imu.clock import ClockReport
from imudrv.imu.sequence import SampleCounts
from imudrv.messages import LANGUAGES, catalogue, named
from imudrv.records import Flag, Records
from imudrv.service.latency import LatencyReport
from imudrv.service.status_socket import FORMAT, VERSION
from imudrv.sinks.base import SinkState
from imudrv.wire.layout import Layout
from imudrv.wording import Count


@dataclass(frozen=True)
class PortStatus:
    """State of the port.

    Parameters
    ----------
    url : str
        As in the settings.
    state, trouble : str
        Fields of `imudrv.diagnosis.LineState`.
    users : list of str
        Other programs that have the port open; looked for after losses only.
    reconnects : int
        Number of times that a lost port was opened again.
    source : str
        ``hardware``, ``simulator`` or ``replay``.
    """

    url: str
    state: str
    trouble: str
    users: list[str]
    reconnects: int
    source: str


@dataclass(frozen=True)
class CalibrationStatus:
    """Calibration in use.

    Parameters
    ----------
    path : str
        Calibration file.
    sha256 : str
        SHA-256 of the content in use.
    exchanges : int
        Number of replacements since the start.
    refused : str
        Why the file's present content is not used; empty if it is.
    """

    path: str
    sha256: str
    exchanges: int
    refused: str


@dataclass(frozen=True)
class SampleStatus(SampleCounts):
    """Sample counts, with the number of samples lost in the last second."""

    lost_last_s: int


@dataclass(frozen=True)
class RejectedStatus:
    """Number of runs of input rejected for one reason, and their length, bytes (on CAN: messages)."""

    runs: int
    length: int


@dataclass(frozen=True)
class UnitStatus:
    """Status word of the latest sample, and the names of its bits that apply and that mean a fault."""

    word: int
    bits: list[str]
    faults: list[str]

    @classmethod
    def of(cls, word: int, layout: Layout) -> Self:
        """Name the bits of a status word."""
        bits = layout.active_bits(word)
        return cls(word, list(bits.values()), [n for mask, n in bits.items() if mask & layout.status.fault])


@dataclass(frozen=True)
class IncrementStatus:
    """Latest increment: the fields of `imudrv.records.INCREMENTS`, flags by name."""

    counter: int
    t_ns: int
    interval_ns: int
    dtheta_b: list[float]
    dv_b: list[float]
    flags: list[str]

    @classmethod
    def of(cls, increment: Records) -> Self:
        """Convert one record."""
        return cls(
            counter=int(increment["counter"]),
            t_ns=int(increment["t_ns"]),
            interval_ns=int(increment["interval_ns"]),
            dtheta_b=increment["dtheta_b"].tolist(),
            dv_b=increment["dv_b"].tolist(),
            flags=[name for name, flag in Flag.__members__.items() if flag & int(increment["flags"])],
        )


@dataclass(frozen=True)
class Status:
    """Status of a service at one time.

    Parameters
    ----------
    software : str
        Version of the product.
    pid : int
        Process of the service.
    t_ns : int
        Host time, ns.
    uptime_s : float
        Time since the start.
    port : PortStatus
    profile, unit : str
        Name of the profile, serial number of the unit.
    calibration : CalibrationStatus
    rate_hz, nominal_rate_hz : float
        Samples per second over the last second, and by the profile.
    samples : SampleStatus
    rejected : dict of str to RejectedStatus
        By reason.
    clock : ClockReport
    latency : LatencyReport
    temperature_degc : dict of str to (float or None)
        Latest temperatures; None if the unit does not send one.
    unit_status : UnitStatus
    sinks : list of SinkState
    recording : SinkState or None
        None if nothing is recorded.
    last : IncrementStatus
    notices : list of str
        Further warnings, a sentence each.
    events : list of str
        Latest events with their time, oldest first.
    """

    software: str
    pid: int
    t_ns: int
    uptime_s: float
    port: PortStatus
    profile: str
    unit: str
    calibration: CalibrationStatus
    rate_hz: float
    nominal_rate_hz: float
    samples: SampleStatus
    rejected: dict[str, RejectedStatus]
    clock: ClockReport
    latency: LatencyReport
    temperature_degc: dict[str, float | None]
    unit_status: UnitStatus
    sinks: list[SinkState]
    recording: SinkState | None
    last: IncrementStatus
    notices: list[str]
    events: list[str]

    @property
    def health(self) -> str:
        """``fail`` if there are failures, ``warn`` if there are warnings only, else ``ok``."""
        texts = catalogue(LANGUAGES[0])
        return "fail" if any(self._failures(texts)) else "warn" if any(self._warnings(texts)) else "ok"

    def reasons(self, language: str = LANGUAGES[0]) -> list[str]:
        """Return the reasons of `health` in one of the languages, failures first.

        Notices, and what a port or an output reports in words of its own, stay English.
        """
        texts = catalogue(language)
        return [*self._failures(texts), *self._warnings(texts)]

    def _failures(self, texts: Mapping[str, str]) -> Iterator[str]:
        """Yield why no valid samples are output, or none are recorded."""
        port, recording = self.port, self.recording
        if port.state not in ("streaming", "ended"):
            state = named(texts, "port", port.state)
            yield texts["reason_port"].format(state=state, trouble=port.trouble or port.url)
        if not self.samples.closes:
            yield texts["reason_counts"]
        if recording and not recording.healthy:
            state = named(texts, "output", recording.state)
            yield texts["reason_recording"].format(path=recording.url, state=state)

    def _warnings(self, texts: Mapping[str, str]) -> Iterator[str]:
        """Yield what a person should look at although samples are output."""
        for name in self.unit_status.faults:
            yield texts["reason_unit"].format(fault=name)
        for sink in self.sinks:
            if not sink.healthy:
                yield texts["reason_output"].format(url=sink.url, state=named(texts, "output", sink.state))
        if self.port.users:
            yield texts["reason_users"].format(programs=", ".join(self.port.users))
        if self.samples.lost_last_s:
            yield texts["reason_lost"].format(samples=Count(self.samples.lost_last_s))
        if self.port.state == "streaming" and not self.clock.locked:
            yield texts["reason_clock"]
        yield from self.notices

    def to_json(self) -> dict[str, Any]:
        """Return the JSON document of the status socket and of recordings."""
        samples = asdict(self.samples) | {"lost": self.samples.lost, "closes": self.samples.closes}
        return {
            "format": FORMAT,
            "version": VERSION,
            **asdict(self),
            "samples": samples,
            "clock": self.clock._asdict(),
            "latency": self.latency._asdict(),
            "sinks": [sink._asdict() for sink in self.sinks],
            "recording": self.recording._asdict() if self.recording else None,
            "health": self.health,
            "reasons": self.reasons(),
        }

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> "Status":
        """Return the status of a JSON document.

        Raises
        ------
        InputError
            The document does not come from a service of this version.
        """
        try:
            return _ADAPTER.validate_python(document)
        except ValidationError as error:
            fault = error.errors()[0]
            raise InputError(
                f"status: {'.'.join(map(str, fault['loc']))}: {fault['msg']}; "
                "restart the service if it runs another version of imudrv than this command"
            ) from error


_ADAPTER: Final = TypeAdapter(Status)


def temperatures(pulses: Records, layout: Layout) -> dict[str, float | None]:
    """Return the temperatures of one sample by name, degC rounded to 0.001; None if not sent."""
    degc = zip(layout.temperature_names, pulses["temperature_degc"].tolist(), strict=False)
    return {name: round(t, 3) if np.isfinite(t) else None for name, t in degc}
