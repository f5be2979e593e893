"""Examination of a port, its data and the system, step by step, with a fix for each fault."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final
from urllib.parse import urlencode

import numpy as np

from imudrv import diagnosis, profiles
from imudrv.diagnosis import Mismatch
from imudrv.doctor.device import System, device_steps, interface_step, limits, usb
from imudrv.doctor.traffic import check_line_errors, check_line_load, check_mismatch, check_traffic
from imudrv.doctor.verdict import Finding, Verdict
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.ports import Port, PortEndedError, PortLostError, open_port
from imudrv.profiles.schema import CanLine, Profile, SerialLine
from imudrv.records import MESSAGE, Records, Source
from imudrv.units import NS
from imudrv.url import Url, split, value

BAUDRATES: Final = (460_800, 921_600, 115_200, 230_400, 1_000_000, 2_000_000, 3_000_000, 57_600, 38_400)
"""Tried in this order if the data fits no profile at the expected baud rate."""

LISTEN_S: Final = 3.0
"""Time for which the port is read, s."""

_TRY_S: Final = 0.5

_DISCARD_S: Final = 0.1

_MAX_AMOUNT: Final = 1 << 24  # bytes or messages

_SILENCE_FIX: Final = {
    "serial": "check the unit's power, the choice of port, the wiring (RX/TX or A/B swapped?) and the ground",
    "can": "check the unit's power, the termination at both ends and the bit rate on both sides",
}


def doctor(url: str, profile: str | None, say: Callable[[str], None]) -> bool:
    """Examine a port and report each step.

    Parameters
    ----------
    url : str
        As for `imudrv.ports.open_port`.
    profile : str or None
        Name or path; None: find out which profile fits.
    say : callable
        Called with one step at a time.

    Returns
    -------
    bool
        Whether no step failed.

    Raises
    ------
    InputError
        The URL or the profile is wrong.
    """
    healthy = True
    for step in examine(url, profile, LISTEN_S):
        say(str(step))
        healthy &= step.verdict is not Verdict.FAIL
    say("healthy" if healthy else "not healthy: fix the steps marked 'fail'")
    return healthy


@dataclass(frozen=True)
class _Target:
    """A port to be examined.

    Parameters
    ----------
    url : Url
        URL of the port.
    profile : Profile
        Expected profile, with the line settings of the URL.
    is_given : bool
        Whether the user named the profile.
    system : System
        The system around the port.
    """

    url: Url
    profile: Profile
    is_given: bool
    system: System

    @property
    def has_line_settings(self) -> bool:
        """Whether the port has settings that can be wrong; a pty and a network have none."""
        if self.url.scheme in ("can", "hwgrep", "rfc2217"):
            return True
        device = self.url.device
        return device is not None and not device.resolve().is_relative_to("/dev/pts")

    def shipped(self, line: SerialLine | CanLine) -> list[Profile]:
        """Return the shipped profiles for this kind of line, with its settings if the port has any."""
        fitting = [p for p in map(profiles.load, profiles.shipped()) if isinstance(p.line, type(line))]
        if not self.has_line_settings:
            return fitting
        return [p.model_copy(update={"line": line}) for p in fitting]


def examine(
    url: str, profile: str | None, listen_s: float, system: System | None = None
) -> Iterator[Finding]:
    """Examine a port, step by step.

    Parameters
    ----------
    url, profile
        As for `doctor`.
    listen_s : float
        Time for which the port is read, s.
    system : System, optional
        The system around the port; by default this machine's.

    Yields
    ------
    Finding
        In order. After a fault that makes further steps pointless only the system's limits follow.
    """
    parts = split(url)
    expected = profiles.load(profile) if profile is not None else _default_profile(parts)
    target = _Target(parts, _with_line_of(parts, expected), profile is not None, system or System())
    reachable = True
    for step in _before_opening(target):
        reachable &= step.verdict is not Verdict.FAIL
        yield step
    if target.is_given:
        yield check_line_load(target.profile)
    if reachable:
        yield from _on_the_port(target, listen_s)
    yield from limits()


def _default_profile(parts: Url) -> Profile:
    """Return a profile whose line settings are tried first if the user names none."""
    transport = "can" if parts.scheme == "can" else "serial"
    return next(p for p in map(profiles.load, profiles.OWN) if p.transport == transport)


def _with_line_of(parts: Url, profile: Profile) -> Profile:
    """Return the profile with the line settings of the URL."""
    kind = type(profile.line)
    asked = {name: value(text) for name, text in parts.options.items() if name in kind.model_fields}
    line = settings_file.parse({**profile.line.model_dump(), **asked}, kind, parts.text)
    return profile.model_copy(update={"line": line})


def _before_opening(target: _Target) -> Iterator[Finding]:
    if target.url.device is not None:
        yield from device_steps(target.url.device, target.system)
    elif target.url.scheme == "can" and target.url.address.startswith("socketcan/"):
        yield interface_step(target.url.address.removeprefix("socketcan/"), target.system)


def _on_the_port(target: _Target, listen_s: float) -> Iterator[Finding]:
    try:
        port = open_port(target.url.text, target.profile)
    except PortLostError as error:
        yield Finding("open", Verdict.FAIL, str(error), "fix that and try again")
        return
    try:
        yield Finding("open", Verdict.OK, target.url.text)
        if target.url.device is not None:
            yield from usb(target.url.device.resolve().name, target.system)
        before = port.line_errors()
        data, span_s, trouble = _listen(port, target.profile.transport, listen_s)
        errors = port.line_errors().since(before)
    finally:
        port.close()
    if trouble:
        yield Finding("data", Verdict.FAIL, trouble, "check plug, cable and adapter")
        return
    if any(errors):
        yield check_line_errors(errors)
    profile = target.profile
    if not target.is_given and len(data):
        profile = diagnosis.best_profile(target.shipped(profile.line), data) or profile
    traffic = diagnosis.decode_traffic(profile, data)
    if traffic.fits:
        if not target.is_given:
            yield Finding("profile", Verdict.OK, f"the data fits {profile.name}: --profile {profile.name}")
            yield check_line_load(profile)
        yield from check_traffic(profile, traffic, span_s, port.source is Source.HARDWARE)
        return
    # A bus passes only the profile's identifiers, so silence may hide other messages.
    may_fit = len(data) or profile.transport == "can"
    fitting = _fitting_profile(target, data) if may_fit else None
    if len(data) or fitting is not None:
        yield check_mismatch(Mismatch(profile, traffic, fitting), target.is_given)
    else:
        found = f"silence: nothing received in {listen_s:g} s"
        yield Finding("data", Verdict.FAIL, found, _SILENCE_FIX[profile.transport])


def _listen(port: Port, transport: str, seconds: float) -> tuple[bytes | Records, float, str]:
    """Return the data that arrives, the time from first to last arrival (s), and why the port was lost."""
    pieces: list[bytes | Records] = []
    first_ns = last_ns = amount = 0
    trouble = ""
    begin_s = time.monotonic()
    try:
        while time.monotonic() - begin_s < _DISCARD_S and port.source is Source.HARDWARE:
            port.read(_DISCARD_S)  # what the system has buffered says nothing about the rate
        begin_s = time.monotonic()
        while (left := begin_s + seconds - time.monotonic()) > 0 and amount < _MAX_AMOUNT:
            t_ns, data, _ = port.read(left)
            if len(data):
                first_ns = first_ns or t_ns
                last_ns = t_ns
                amount += len(data)
                pieces.append(data)
    except PortEndedError:
        pass
    except PortLostError as error:
        trouble = str(error)
    span_s = max((last_ns - first_ns) * NS, 1e-3)
    if transport == "serial":
        return b"".join(p for p in pieces if isinstance(p, bytes)), span_s, trouble
    return np.concatenate([np.zeros(0, MESSAGE), *pieces]), span_s, trouble


def _fitting_profile(target: _Target, data: bytes | Records) -> Profile | None:
    """Return the profile and line settings that fit: first for the data received, then by trying others."""
    if (found := diagnosis.best_profile(target.shipped(target.profile.line), data)) is not None:
        return found
    for other, options in _attempts(target):
        try:
            port = open_port(f"{target.url.scheme}://{target.url.address}?{urlencode(options)}", other)
        except (InputError, PortLostError):
            continue  # the device does not support that baud rate
        try:
            data, _, _ = _listen(port, other.transport, _TRY_S)
        finally:
            port.close()
        if (found := diagnosis.best_profile([other, *target.shipped(other.line)], data)) is not None:
            return found
    return None


def _attempts(target: _Target) -> Iterator[tuple[Profile, dict[str, str]]]:
    """Yield profiles, and the URL options with which to open the port for them."""
    profile = target.profile
    if isinstance(profile.line, CanLine):
        for other in map(profiles.load, profiles.shipped()):
            if other.transport == "can" and other.name != profile.name:
                yield other, {}
    elif target.has_line_settings:
        for baudrate in BAUDRATES:
            if baudrate != profile.line.baudrate:
                line = profile.line.model_copy(update={"baudrate": baudrate})
                options = {**target.url.options, "baudrate": str(baudrate)}
                yield profile.model_copy(update={"line": line}), options
