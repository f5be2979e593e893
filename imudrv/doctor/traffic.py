"""Findings about received data: line load, losses, rate, status; or which profile fits instead."""

from collections.abc import Iterator
from typing import Final

from imudrv import diagnosis, profiles
from imudrv.diagnosis import Mismatch, TrafficSummary
from imudrv.doctor.verdict import Finding, Verdict
from imudrv.ports.base import LineErrors
from imudrv.profiles.line_load import line_load
from imudrv.profiles.schema import Profile, SerialLine
from imudrv.wording import counted

_HEAVY_LOAD: Final = 0.9


def check_line_load(profile: Profile) -> Finding:
    """Check that the line can carry the profile's samples."""
    load = line_load(profile)
    line = profile.line
    speed = f"{line.baudrate} baud" if isinstance(line, SerialLine) else f"{line.bitrate} bit/s"
    found = f"{profile.name} at {profile.rate_hz:g} Hz takes {100 * load:.1f} % of {speed}"
    if load > 1.0:
        return Finding("line load", Verdict.FAIL, found, "set the unit and the port to a higher line rate")
    if load > _HEAVY_LOAD:
        return Finding("line load", Verdict.WARN, found, "a higher line rate would leave a reserve")
    return Finding("line load", Verdict.OK, found)


def check_traffic(
    profile: Profile, traffic: TrafficSummary, span_s: float, in_real_time: bool
) -> Iterator[Finding]:
    """Check data that fits its profile.

    Parameters
    ----------
    profile : Profile
        Profile of the data.
    traffic : TrafficSummary
        The data, decoded with it.
    span_s : float
        Time from the first arrival to the last, s.
    in_real_time : bool
        Whether the unit sends at its own pace; otherwise its rate is not checked.

    Yields
    ------
    Finding
    """
    counts = traffic.counts
    found = diagnosis.explain(profile, traffic, span_s)
    if traffic.is_clean:
        yield Finding("data", Verdict.OK, found)
    else:
        fix = "check cable, ground, termination and line settings; is this machine overloaded?"
        yield Finding("data", Verdict.FAIL, f"{found}; {counts}", fix)
    if counts.restarts:
        found = f"it jumped back {counted(counts.restarts, 'time')}"
        yield Finding("counter", Verdict.WARN, found, "check the unit's power supply")
    rate_hz = diagnosis.rate(traffic, span_s)
    if in_real_time and abs(rate_hz / profile.rate_hz - 1.0) > diagnosis.RATE_TOLERANCE:
        found = f"expected {profile.rate_hz:g} samples/s, the unit counts {rate_hz:.0f}"
        fix = "set sample_rate_hz in the profile, or the rate in the unit"
        yield Finding("rate", Verdict.FAIL, found, fix)
    bits = ", ".join(traffic.set_bits) or "no bit set"
    if {bit.name for bit in profile.status_bits if bit.means == "fault"} & set(traffic.set_bits):
        yield Finding("status", Verdict.WARN, bits, "the unit itself reports a fault; see its manual")
    else:
        yield Finding("status", Verdict.OK, bits)
    if traffic.degc:
        degc = (
            f"{name.replace('_', ' ')} {f'{t:.2f} degC' if t == t else 'not received'}"
            for name, t in traffic.degc.items()
        )
        yield Finding("temperatures", Verdict.OK, ", ".join(degc))


def check_line_errors(errors: LineErrors) -> Finding:
    """Report errors that the driver of the line has counted."""
    if errors.framing or errors.parity:
        fix = "check baud rate, parity and stop bits on both sides, the ground, and the swap of A and B"
        return Finding("line errors", Verdict.FAIL, str(errors), fix)
    fix = "the machine is too slow for this line: use another USB socket or adapter, and `--realtime`"
    return Finding("line errors", Verdict.WARN, str(errors), fix)


def check_mismatch(mismatch: Mismatch, is_given: bool) -> Finding:
    """Report data that does not fit the expected profile.

    Parameters
    ----------
    mismatch : Mismatch
        What was found; the profile that fits has the line settings at which it does.
    is_given : bool
        Whether the user named the expected profile.

    Returns
    -------
    Finding
    """
    profile, fitting = mismatch.profile, mismatch.fitting
    is_serial = profile.transport == "serial"
    amount = f"{mismatch.traffic.amount} {'bytes' if is_serial else 'messages'}"
    found = f"{amount}, no frame of {profile.name}: {mismatch}"
    if fitting is None:
        at = " at any usual baud rate" if is_serial else ""
        fix = "check the line settings against the unit's manual; for another wire format write a profile"
        return Finding("data", Verdict.FAIL, f"{found}; no shipped profile fits{at}", fix)
    fixes = [] if is_given and fitting.name == profile.name else [f"--profile {fitting.name}"]
    if isinstance(fitting.line, SerialLine):
        found += f" at {fitting.line.baudrate}"
        usual = profiles.load(fitting.name).line
        if (isinstance(usual, SerialLine) and usual.baudrate != fitting.line.baudrate) or not fixes:
            fixes.append(f"?baudrate={fitting.line.baudrate} in the URL")
    return Finding("data", Verdict.FAIL, found, "use " + " and ".join(fixes))
