"""Shipped and random units, and what they send."""

import itertools
from importlib import resources
from typing import Any, Final

import numpy as np
import yaml
from numpy.random import Generator

from imudrv import profiles
from imudrv.files import settings_file
from imudrv.profiles.schema import Profile
from imudrv.records import PULSES
from imudrv.wire.encode import CanEncoder, StreamEncoder
from imudrv.wire.layout import Layout

from .random_input import pick

TEXTS: Final = {name: (resources.files(profiles) / f"{name}.yaml").read_text() for name in profiles.OWN}
PLAIN: Final = {name: yaml.safe_load(text) for name, text in TEXTS.items()}
SHIPPED: Final = {name: profiles.load(name).layout() for name in TEXTS}
SERIAL: Final = tuple(name for name, layout in SHIPPED.items() if not layout.can)
CAN: Final = tuple(name for name, layout in SHIPPED.items() if layout.can)


def random_profile(rng: Generator) -> dict[str, Any]:
    """Return a random serial profile: its parts in any order, with gaps."""
    widths, totals = (8, 16, 24, 32), bool(rng.integers(2))
    pulse = f"{pick(rng, 'ui')}{pick(rng, widths)}"
    fields = [{"name": name, "type": f"u{pick(rng, widths)}"} for name in ("counter", "status")]
    fields += [{"name": "temperature", "type": f"i{pick(rng, widths)}", "sensor": "gyro"}]
    for name, axis in itertools.product(("gyro", "accelerometer"), "xyz"):
        fields += [{"name": name, "axis": axis, "type": pulse if totals else f"i{pick(rng, widths)}"}]
    sync = bytes(pick(rng, (0xEB, 0x90, 0)) for _ in range(rng.integers(1, 5)))
    constant: dict[str, Any] = {"value": pick(rng, (0xEB, 0x90, 0))}
    check: dict[str, Any] = {"kind": pick(rng, ("crc", "crc", "sum")), "width": pick(rng, (8, 16, 32))}
    parts, at = [*fields, constant, check], len(sync)
    for part in (parts[i] for i in rng.permutation(len(parts))):
        part["offset"] = at + int(rng.integers(3))
        at = part["offset"] + int(part.get("width", part.get("type", "-8")[1:])) // 8
    length, mask = at + int(rng.integers(3)), (1 << check["width"]) - 1
    sides = ((0, check["offset"]), (check["offset"] + check["width"] // 8, length))
    begin, end = pick(rng, [side for side in sides if side[0] < side[1]])
    first = int(rng.integers(begin, end))
    check["covers"] = [[first, int(rng.integers(first, end))]]
    check |= {name: int(rng.integers(mask + 1)) for name in ("init", "xor_out")}
    if check["kind"] == "crc":
        check |= {"polynomial": int(rng.integers(mask)) + 1, "reflected": bool(rng.integers(2))}
    check |= {"prefix": "50 26"} if rng.integers(2) else {}
    message = {"sync": sync.hex(" "), "length": length, "fields": fields, "constants": [constant]}
    sensor = {"values": "total" if totals else "increment", "unit": "pulse"}
    return PLAIN[SERIAL[0]] | {
        "byte_order": pick(rng, ("little", "big")),
        "gyro": sensor,
        "accelerometer": sensor,
        "status_bits": [],
        "messages": [message | ({"checks": [check]} if rng.integers(4) else {})],
    }


def random_can_profile(rng: Generator) -> dict[str, Any]:
    """Return a shipped CAN profile with another byte order, other counts, slow messages and counters."""
    profile, counter, messages = PLAIN[pick(rng, CAN)], pick(rng, ("u8", "u16")), []
    for kind in profile["messages"]:
        fields = [f | {"type": counter} if f["name"] == "counter" else f for f in kind["fields"]]
        is_slow = kind.get("every", 1) > 1
        messages.append(kind | ({"every": pick(rng, (2, 5, 30))} if is_slow else {"fields": fields}))
    order = pick(rng, ("little", "big"))
    sensor = {"values": pick(rng, ("increment", "total")), "unit": "pulse"}
    return profile | {"byte_order": order, "gyro": sensor, "accelerometer": sensor, "messages": messages}


def layout_of(profile: str | dict[str, Any]) -> Layout:
    """Return the layout of a shipped profile, by name, or of a random one."""
    if isinstance(profile, str):
        return SHIPPED[profile]
    return settings_file.parse(profile, Profile, "random profile").layout()


def transmit(rng: Generator, layout: Layout, count: int) -> Any:
    """Return bytes or messages of a unit; the counter jumps and wraps, some parts are late."""
    span = 1 << layout.sequence.bits
    steps = rng.choice([1, 0, 2, 7, 70, -1, -30, -300], count, p=[0.93, *[0.01] * 7])
    limit = pick(rng, (layout.pulse_limit, min(layout.pulse_limit, 40)))
    pulses = np.zeros(count, PULSES)
    pulses["counter"] = (pick(rng, (0, span - 5, span // 2, 1000)) + np.cumsum(steps)) % span
    pulses["arrival_ns"] = rng.integers(2**60) + 1_000_000 * np.arange(count)
    for sensor in ("gyro", "accelerometer"):
        pulses[sensor] = rng.integers(-limit, limit + 1, (count, 3))
    pulses["temperature_degc"] = rng.normal(35.0, 20.0, (count, 1))
    pulses["status"] = rng.choice([0, 0, 0, 1, 2, 64], count)
    sent = (CanEncoder if layout.can else StreamEncoder)(layout).encode(pulses)
    late = rng.integers(6, size=len(sent)) * (rng.random(len(sent)) < 0.05)
    sent = sent[np.argsort(np.arange(len(sent)) + late, kind="stable")]
    return sent if layout.can else sent.tobytes()
