"""The device of a port: does it exist, can it be opened, do other programs use it, does it add latency."""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from imudrv.doctor.verdict import Finding, Verdict
from imudrv.ports.holders import holders
from imudrv.ports.permission import RULES_ADVICE, permission_advice
from imudrv.posix import resource, termios
from imudrv.service.runtime import PRIORITY

_LOW_LATENCY: Final = 1 << 13  # ASYNC_LOW_LATENCY, linux/tty_flags.h


_IFF_UP: Final = 1


@dataclass(frozen=True)
class System:
    """Folders in which the system describes itself.

    Parameters
    ----------
    sys, proc, dev : Path
        Usually /sys, /proc and /dev.
    """

    sys: Path = Path("/sys")
    proc: Path = Path("/proc")
    dev: Path = Path("/dev")


def limits() -> Iterator[Finding]:
    """Check that `--realtime` would be granted to this user: scheduling priority and locked memory."""
    if resource is None:
        return
    for name, limit, enough, key, unit in (
        ("real-time priority", resource.RLIMIT_RTPRIO, PRIORITY, "rtprio 50", "LimitRTPRIO=50"),
        ("locked memory", resource.RLIMIT_MEMLOCK, math.inf, "memlock unlimited", "LimitMEMLOCK=infinity"),
    ):
        soft, _ = resource.getrlimit(limit)
        if os.geteuid() == 0 or soft == resource.RLIM_INFINITY or soft >= enough:
            yield Finding(name, Verdict.OK, "enough for --realtime")
        else:
            found = f"the limit is {soft}: --realtime would be refused; it matters only on a loaded machine"
            fix = (
                f"put the line '{_user()} - {key}' into /etc/security/limits.d/imu50.conf and log in again, "
                f"or {unit} into the systemd unit"
            )
            yield Finding(name, Verdict.WARN, found, fix)


def _user() -> str:
    return os.environ.get("USER", "YOUR_NAME")


def device_steps(device: Path, system: System) -> Iterator[Finding]:
    """Check the device of a serial port, where a port is a file."""
    if termios is None:
        return
    if not device.exists():
        ports = ", ".join(map(str, candidates(system)))
        fix = (
            f"use one of {ports}" if ports else "plug in the unit's adapter; this machine has no serial port"
        )
        yield Finding("device", Verdict.FAIL, f"{device} does not exist", fix)
        return
    target = device.resolve()
    yield Finding("device", Verdict.OK, str(device) if target == device else f"{device} is {target}")
    if not os.access(device, os.R_OK | os.W_OK):
        found = f"this user cannot open {device}"
        yield Finding("permission", Verdict.FAIL, found, permission_advice(device))
        return
    yield Finding("permission", Verdict.OK, "this user can open it")
    users, all_inspected = holders(target, system.proc)
    if users:
        found = f"open in {', '.join(users)}: each program would receive only a part of the bytes"
        yield Finding("busy", Verdict.FAIL, found, "stop that program")
    else:
        whose = "no other program has" if all_inspected else "none of this user's other programs has"
        yield Finding("busy", Verdict.OK, f"{whose} it open")


def candidates(system: System) -> list[Path]:
    """Return the serial ports of this machine, by their stable names if they have one."""
    named = sorted((system.dev / "serial" / "by-id").glob("*"))
    taken = {path.resolve() for path in named}
    plain = sorted(path for kind in ("ttyUSB*", "ttyACM*") for path in system.dev.glob(kind))
    return named + [path for path in plain if path.resolve() not in taken]


def interface_step(name: str, system: System) -> Finding:
    """Check a CAN interface."""
    interface = system.sys / "class" / "net" / name
    if not interface.exists():
        others = sorted(path.name for path in interface.parent.glob("*can*"))
        found = f"there is no CAN interface {name}" + (f", but {', '.join(others)}" if others else "")
        return Finding("interface", Verdict.FAIL, found, "plug in the adapter, or load its driver")
    flags = int(_read(interface / "flags") or "0", 16)
    if not flags & _IFF_UP:
        fix = f"sudo ip link set {name} up type can bitrate 1000000 (for CAN FD: dbitrate 5000000 fd on)"
        return Finding("interface", Verdict.FAIL, f"{name} is down", fix)
    return Finding(
        "interface", Verdict.OK, f"{name} is up; `ip -details link show {name}` shows its bit rate"
    )


def usb(name: str, system: System) -> Iterator[Finding]:
    """Check the settings of an adapter that add latency.

    Parameters
    ----------
    name : str
        Name of the device, such as ``ttyUSB0``.
    system : System
        The system.

    Yields
    ------
    Finding
        One for each setting that the device has.
    """
    timer = system.sys / "bus" / "usb-serial" / "devices" / name / "latency_timer"
    latency_ms = _read(timer)
    if latency_ms in ("0", "1"):
        yield Finding("latency timer", Verdict.OK, f"{latency_ms} ms")
    elif latency_ms:
        found = f"{latency_ms} ms: samples arrive in bursts of that length"
        fix = f"echo 1 | sudo tee {timer}; permanently: {RULES_ADVICE}"
        yield Finding("latency timer", Verdict.WARN, found, fix)
    flags = _read(system.sys / "class" / "tty" / name / "flags")
    if flags and int(flags, 16) & _LOW_LATENCY:
        yield Finding("low latency", Verdict.OK, "set")
    elif flags:
        fix = f"sudo setserial /dev/{name} low_latency"
        yield Finding("low latency", Verdict.WARN, "not set: the driver may delay bytes", fix)
    device = (system.sys / "class" / "tty" / name / "device").resolve()
    adapter = next((folder for folder in (device, *device.parents) if (folder / "idVendor").exists()), None)
    if adapter is None:
        return
    control = adapter / "power" / "control"
    if _read(control) == "auto":
        fix = f"echo on | sudo tee {control}; permanently: {RULES_ADVICE}"
        yield Finding("USB autosuspend", Verdict.WARN, "on: the adapter may be suspended", fix)
    else:
        yield Finding("USB autosuspend", Verdict.OK, "off")


def _read(path: Path) -> str:
    """Return the text of a system file; empty if it cannot be read."""
    try:
        return path.read_text().strip()
    except OSError:
        return ""
