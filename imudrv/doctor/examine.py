"""Looks at a port, what arrives and the system, step by step, and says how to mend what is not right."""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final
from urllib.parse import urlencode

import numpy as np

from imudrv import diagnosis, profiles
from imudrv.doctor.device import System, device_steps, interface_step, limits, usb
from imudrv.doctor.verdict import Finding, Verdict
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.ports import Port, PortEndedError, PortLostError, open_port
from imudrv.ports.url import Url, split, value
from imudrv.profiles.schema import CanLine, Profile, SerialLine
from imudrv.records import MESSAGE, Reason, Records, Source
from imudrv.units import NS

BAUDRATES: Final = (460_800, 921_600, 115_200, 230_400, 1_000_000, 2_000_000, 3_000_000, 57_600, 38_400)
"""Tried one after the other where the line's is not right."""


LISTEN_S: Final = 3.0


TRY_S: Final = 0.5


_AFTER_SILENCE: Final = {
    "serial": "is the unit powered, is it this port, are the lines the right way round (RX/TX, A/B), "
    "is ground connected?",
    "can": "is the unit powered, is the bus terminated at both ends, is the bit rate the same on both sides?",
}


_DISCARD_S: Final = 0.1


_MOST: Final = 1 << 24


_HEAVY: Final = 0.9


def doctor(url: str, profile: str | None, say: Callable[[str], None]) -> bool:
    """Examine a port and tell each step.

    Parameters
    ----------
    url : str
        As for `imudrv.ports.open_port`.
    profile : str or None
        Name or path; None: find out which it is.
    say : callable
        Told one step at a time.

    Returns
    -------
    bool
        Nothing must be mended.

    Raises
    ------
    InputError
        A URL or profile that makes no sense.
    """
    healthy = True
    for step in examine(url, profile, LISTEN_S):
        say(str(step))
        healthy &= step.verdict is not Verdict.FAIL
    say("healthy" if healthy else "something must be mended, see above")
    return healthy


def examine(
    url: str, profile: str | None, listen_s: float, system: System | None = None
) -> Iterator[Finding]:
    """Examine a port, step by step.

    Parameters
    ----------
    url, profile
        As for `doctor`.
    listen_s : float
        How long to listen.
    system : System, optional
        This one's if absent.

    Yields
    ------
    Step
        In order; after one without which the next cannot be, the system's limits are all that follows.
    """
    system = system or System()
    parts = split(url)
    given = profiles.load(profile) if profile is not None else _first(parts)
    wanted = _with_line(parts, given)
    device = _device(parts)
    reachable = True
    for step in _before(parts, device, system):
        reachable &= step.verdict is not Verdict.FAIL
        yield step
    if profile is not None:
        yield _load(wanted)
    if reachable:
        yield from _on_the_port(parts, wanted, profile is not None, listen_s, device, system)
    yield from limits()


def _first(parts: Url) -> Profile:
    """A profile to begin with where none is given."""
    transport = "can" if parts.scheme == "can" else "serial"
    return next(p for p in map(profiles.load, profiles.shipped()) if p.transport == transport)


def _with_line(parts: Url, profile: Profile) -> Profile:
    """The profile with the line settings that the URL has."""
    kind = type(profile.line)
    asked = {name: value(text) for name, text in parts.options.items() if name in kind.model_fields}
    line = settings_file.parse({**profile.line.model_dump(), **asked}, kind, parts.text)
    return profile.model_copy(update={"line": line})


def _device(parts: Url) -> Path | None:
    """The device file of a serial port."""
    return Path(parts.address) if parts.scheme == "serial" and os.name == "posix" else None


def _before(parts: Url, device: Path | None, system: System) -> Iterator[Finding]:
    """What can be told before the port is open."""
    if device is not None:
        yield from device_steps(device, system)
    elif parts.scheme == "can" and parts.address.startswith("socketcan/"):
        yield interface_step(parts.address.removeprefix("socketcan/"), system)


def _load(profile: Profile) -> Finding:
    load = diagnosis.line_load(profile)
    line = profile.line
    speed = f"{line.baudrate} baud" if isinstance(line, SerialLine) else f"{line.bitrate} bit/s"
    found = f"{profile.name} at {profile.sample_rate_hz:g} Hz takes {100 * load:.1f} % of {speed}"
    if load > 1.0:
        return Finding("line load", Verdict.FAIL, found, "set the unit and the port to a faster line")
    if load > _HEAVY:
        return Finding("line load", Verdict.WARN, found, "a faster line would leave room")
    return Finding("line load", Verdict.OK, found)


def _on_the_port(
    parts: Url, profile: Profile, given: bool, listen_s: float, device: Path | None, system: System
) -> Iterator[Finding]:
    try:
        port = open_port(parts.text, profile)
    except PortLostError as error:
        yield Finding("open", Verdict.FAIL, str(error), "mend that and try again")
        return
    try:
        yield Finding("open", Verdict.OK, parts.text)
        if device is not None:
            yield from usb(device.resolve().name, system)
        data, span_s, trouble = _listen(port, listen_s)
    finally:
        port.close()
    if trouble:
        yield Finding("data", Verdict.FAIL, trouble, "look at plug, cable and adapter")
        return
    if not given and len(data):
        profile = diagnosis.best_profile(_shipped(parts, profile.line, device), data) or profile
    heard = diagnosis.decode_traffic(profile, data) if len(data) else None
    if heard is not None and heard.fits:
        if not given:
            yield Finding("profile", Verdict.OK, f"this is {profile.name}: --profile {profile.name}")
            yield _load(profile)
        yield from check_traffic(profile, heard, span_s, port.source is Source.HARDWARE)
        return
    # a bus lets only the profile's identifiers through, so that silence may mean others
    found = _looks_like(parts, profile, data, device) if heard or profile.transport == "can" else None
    if heard is not None or found is not None:
        yield mismatch(profile, heard or diagnosis.decode_traffic(profile, data), found, given)
        return
    yield Finding(
        "data", Verdict.FAIL, f"silence: nothing in {listen_s:g} s", _AFTER_SILENCE[profile.transport]
    )


def _listen(port: Port, seconds: float) -> tuple[bytes | Records, float, str]:
    """What arrives, from its first to its last arrival how long, and what ended it too early."""
    pieces: list[bytes | Records] = []
    first_ns = last_ns = amount = 0
    trouble = ""
    begin_s = time.monotonic()
    try:
        while time.monotonic() - begin_s < _DISCARD_S and port.source is Source.HARDWARE:
            port.read(_DISCARD_S)  # what had gathered before says nothing about the rate
        begin_s = time.monotonic()
        while (left := begin_s + seconds - time.monotonic()) > 0 and amount < _MOST:
            t_ns, data = port.read(left)
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
    if pieces and isinstance(pieces[0], bytes):
        return b"".join(p for p in pieces if isinstance(p, bytes)), span_s, trouble
    return np.concatenate([np.zeros(0, MESSAGE), *pieces]), span_s, trouble


def check_traffic(
    profile: Profile, heard: diagnosis.TrafficSummary, span_s: float, in_real_time: bool
) -> Iterator[Finding]:
    """Whether data of the right profile is as it should be.

    Parameters
    ----------
    profile : Profile
        As which the data was read.
    heard : Heard
        What was found.
    span_s : float
        From the first arrival to the last.
    in_real_time : bool
        The rate means something.

    Yields
    ------
    Step
    """
    counts = heard.counts
    found = diagnosis.explain(profile, heard, span_s)
    if heard.is_clean:
        yield Finding("data", Verdict.OK, found)
    else:
        yield Finding(
            "data",
            Verdict.FAIL,
            f"{found}; {counts}",
            "look at cable, ground, termination and line settings; is the reader quick enough?",
        )
    if counts.restarts:
        yield Finding(
            "counter", Verdict.WARN, f"it jumped back {counts.restarts} times", "does the unit's power hold?"
        )
    rate = diagnosis.rate(heard, span_s)
    if in_real_time and abs(rate / profile.sample_rate_hz - 1.0) > diagnosis.RATE_TOLERANCE:
        yield Finding(
            "rate",
            Verdict.FAIL,
            f"expected {profile.sample_rate_hz:g} samples/s, the unit counts {rate:.0f}",
            "set sample_rate_hz in the profile, or the rate in the unit",
        )
    means = {bit.name: bit.means for bit in profile.status_bits}
    faults = [name for name in heard.set_bits if means[name] == "fault"]
    yield Finding(
        "status",
        Verdict.WARN if faults else Verdict.OK,
        ", ".join(heard.set_bits) or "no bit set",
        "the unit itself reports a fault; see its manual" if faults else "",
    )
    if heard.degc:
        degc = (
            f"{name.replace('_', ' ')} {t:.2f} degC" if t == t else f"{name.replace('_', ' ')} not heard"
            for name, t in heard.degc.items()
        )
        yield Finding("temperatures", Verdict.OK, ", ".join(degc))


def mismatch(
    profile: Profile, heard: diagnosis.TrafficSummary, found: Profile | None, given: bool
) -> Finding:
    """What to say of data that is not the profile's.

    Parameters
    ----------
    profile : Profile
        The one that was expected.
    heard : Heard
        The data, read with it.
    found : Profile or None
        The one that fits, with the line that it came with.
    given : bool
        The user named the profile.

    Returns
    -------
    Step
    """
    if profile.transport == "can":
        what = f"{heard.syncs} messages of {profile.name}, never a whole sample"
    else:
        why = "CRC never right" if Reason.CHECK_FAILED in heard.rejected else "never a whole frame"
        sync = profile.messages[0].sync
        what = f"{heard.amount} bytes, sync {sync} seen {heard.syncs} times, {why}"
    if found is None:
        return Finding(
            "data",
            Verdict.FAIL,
            f"{what}; no shipped profile fits at any usual rate",
            "check the line settings against the unit's manual; for another wire format write a profile",
        )
    fix = [] if given and found.name == profile.name else [f"--profile {found.name}"]
    at = ""
    if isinstance(found.line, SerialLine):
        at = f" at {found.line.baudrate}"
        usual = profiles.load(found.name).line
        if (isinstance(usual, SerialLine) and usual.baudrate != found.line.baudrate) or not fix:
            fix.append(f"?baudrate={found.line.baudrate} in the URL")
    return Finding(
        "data", Verdict.FAIL, f"{what}: this looks like {found.name}{at}", "use " + " and ".join(fix)
    )


def _looks_like(parts: Url, profile: Profile, data: bytes | Records, device: Path | None) -> Profile | None:
    """The profile and line that fit: first in the data that is there, then by trying."""
    if (found := diagnosis.best_profile(_shipped(parts, profile.line, device), data)) is not None:
        return found
    for other, options in _attempts(parts, profile, device):
        text = f"{parts.scheme}://{parts.address}?{urlencode(options)}"
        try:
            port = open_port(text, other)
        except (InputError, PortLostError):
            continue  # such a rate does not exist here
        try:
            data, _, _ = _listen(port, TRY_S)
        finally:
            port.close()
        if (found := diagnosis.best_profile([other, *_shipped(parts, other.line, device)], data)) is not None:
            return found
    return None


def _attempts(parts: Url, profile: Profile, device: Path | None) -> Iterator[tuple[Profile, dict[str, str]]]:
    if isinstance(profile.line, CanLine):
        for other in map(profiles.load, profiles.shipped()):
            if other.transport == "can" and other.name != profile.name:
                yield other, {}
        return
    if not _has_line(parts, device):
        return
    for baudrate in BAUDRATES:
        if baudrate != profile.line.baudrate:
            line = profile.line.model_copy(update={"baudrate": baudrate})
            options = {**parts.options, "baudrate": str(baudrate)}
            yield profile.model_copy(update={"line": line}), options


def _has_line(parts: Url, device: Path | None) -> bool:
    """Whether the port has settings that can be wrong; a pty and a network have none."""
    if parts.scheme in ("can", "hwgrep", "rfc2217"):
        return True
    return device is not None and not device.resolve().is_relative_to("/dev/pts")


def _shipped(parts: Url, line: SerialLine | CanLine, device: Path | None) -> list[Profile]:
    """Shipped profiles of a kind of line, with this one's settings where it has any."""
    fitting = [p for p in map(profiles.load, profiles.shipped()) if isinstance(p.line, type(line))]
    if not _has_line(parts, device):
        return fitting
    return [p.model_copy(update={"line": line}) for p in fitting]
