#!/usr/bin/env python3
"""Feed the product what no unit, bus or user should ever send, and see that its promises hold.

    tools/run python tools/fuzz.py [--seconds N | --cases N] [--seed S] [--only TARGET] [--first I]

Targets: the decoders (stream, candump, can, datagram), settings files (yaml), and the way from a capture to
compensated increments (chain). Case I of a target follows from the seed and I alone. The first failure is
made small, written to a file, and ends the run with exit code 1; Ctrl-C ends it with the summary.
"""

import argparse
import contextlib
import functools
import io
import itertools
import json
import math
import os
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import yaml
from numpy.random import Generator
from rich.console import Console
from rich.table import Table

from imudrv import profiles
from imudrv.calibration import Calibration, coefficients
from imudrv.errors import InputError
from imudrv.files import model, settings_file
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import NAMES, rate_filter
from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles.schema import Profile
from imudrv.records import EXTENDED, INCREMENTS, MESSAGE, PULSES, Records, Source
from imudrv.service.settings import Settings
from imudrv.sim import scenario
from imudrv.site import Site
from imudrv.terminal import INTERRUPTED, OK, OUR_FAULT
from imudrv.wire.can import OPEN_SAMPLES, CanAssembler
from imudrv.wire.candump import LONGEST_LINE, CandumpDecoder, format_candump
from imudrv.wire.datagram import _LAYOUT, DATAGRAM, SIZE, DatagramDecoder, encode
from imudrv.wire.decoder import CaptureDecoder
from imudrv.wire.encode import CanEncoder, StreamEncoder
from imudrv.wire.layout import COUNTER, Layout
from imudrv.wire.stream import StreamDecoder

Setup: TypeAlias = Any
"""What a case needs beside its bytes, as a literal: a failure can be pasted into a test."""
Cuts: TypeAlias = Sequence[int]

LIMIT_S: Final = 60.0
"""Most that a case may take: none needs a second, but machines stand still at times."""
SHRINK_S: Final = 60.0
"""How long to make a failure smaller."""
TEXTS: Final = {name: (resources.files(profiles) / f"{name}.yaml").read_text() for name in profiles.OWN}
PLAIN: Final = {name: yaml.safe_load(text) for name, text in TEXTS.items()}
SHIPPED: Final = {name: profiles.load(name).layout() for name in TEXTS}
SERIAL: Final = tuple(name for name, layout in SHIPPED.items() if not layout.can)
CAN: Final = tuple(name for name, layout in SHIPPED.items() if layout.can)

# Random input


def pick(rng: Generator, choices: Sequence[Any]) -> Any:
    """One of them, as it is: numpy would make it its own type."""
    return choices[int(rng.integers(len(choices)))]


def some(rng: Generator, most: int = 300) -> int:
    """A number below `most`, mostly a small one."""
    return int(rng.integers(pick(rng, (2, 5, 30, 30, most))))


def mutated(rng: Generator, data: bytes, tokens: Sequence[bytes], unit: int = 1) -> bytes:
    """Damage in up to a dozen places, each some `unit`s long; `tokens` are what is put in between."""
    out = bytearray(data)
    for _ in range(int(rng.integers(12))):
        at = int(rng.integers(len(out) // unit + 1)) * unit
        end = at + int(rng.geometric(0.1)) * unit
        action = int(rng.integers(16))
        if action < 5 and at < len(out):
            out[at + int(rng.integers(unit))] ^= 1 << int(rng.integers(8))
        elif action < 7:
            del out[at:end]
        elif action < 9:
            out[at:at] = rng.bytes(end - at)
        elif action < 11:
            out[at:at] = out[at:end]
        elif action < 15:
            token = pick(rng, tokens)
            out[at : at + len(token) * (action % 2)] = token
        elif at > len(out) // 2:
            del out[at:]
    return bytes(out)


def random_cuts(rng: Generator, size: int) -> list[int]:
    """Where the input is cut: at every byte, at many places or at few."""
    if size < 300 and rng.integers(3) == 0:
        return list(range(size))
    return sorted(rng.integers(0, size + 1, pick(rng, (1, 3, 10, 60))).tolist())


def random_profile(rng: Generator) -> dict[str, Any]:
    """A serial profile of a unit that nobody has built: its parts in any order, with gaps."""
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
    check["first"] = int(rng.integers(begin, end))
    check["last"] = int(rng.integers(check["first"], end))
    check |= {name: int(rng.integers(mask + 1)) for name in ("init", "xor_out")}
    check |= {"polynomial": int(rng.integers(mask)) + 1, "reflected": bool(rng.integers(2))}
    check |= {"prefix": "50 26"} if rng.integers(2) else {}
    message = {"sync": sync.hex(" "), "length": length, "fields": fields, "constants": [constant]}
    return PLAIN[SERIAL[0]] | {
        "byte_order": pick(rng, ("little", "big")),
        "counts": "total" if totals else "increment",
        "messages": [message | ({"check": check} if rng.integers(4) else {})],
    }


def random_can_profile(rng: Generator) -> dict[str, Any]:
    """A shipped CAN profile with another byte order, other counts, slow messages and counters."""
    profile, counter, messages = PLAIN[pick(rng, CAN)], pick(rng, ("u8", "u16")), []
    for kind in profile["messages"]:
        fields = [f | {"type": counter} if f["name"] == "counter" else f for f in kind["fields"]]
        is_slow = kind.get("every", 1) > 1
        messages.append(kind | ({"every": pick(rng, (2, 5, 30))} if is_slow else {"fields": fields}))
    order, counts = pick(rng, ("little", "big")), pick(rng, ("increment", "total"))
    return profile | {"byte_order": order, "counts": counts, "messages": messages}


def layout_of(profile: str | dict[str, Any]) -> Layout:
    """Layout of a shipped profile, by name, or of an invented one."""
    if isinstance(profile, str):
        return SHIPPED[profile]
    return settings_file.parse(profile, Profile, "invented").layout()


def wire(rng: Generator, layout: Layout, count: int) -> Any:
    """What comes of a unit, bytes or messages: the counter leaps and wraps, some of it comes late."""
    span = 1 << layout.counter_bits
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


# What every decoder promises


def pieces(data: Any, cuts: Cuts) -> list[Any]:
    """Cut bytes or records; cuts behind the end do nothing."""
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(edges)]


def fed(decoder: Any, parts: list[Any], holds: Callable[[int, int, int], bool]) -> list[Records]:
    """All that comes of the parts; `holds` is told after each how much was fed and how many of each came."""
    found, size, items, rejects = [], 0, 0, 0
    for feed, data in [*((decoder.feed, part) for part in parts), (decoder.close, b"")]:
        found.append(feed(data) if feed == decoder.feed else feed())
        size, items, rejects = size + len(data), items + len(found[-1][0]), rejects + len(found[-1][-1])
        assert holds(size, items, rejects), f"after {size}: not all is accounted for, or too much is kept"
    assert decoder.pending == 0
    return joined(found)


def joined(found: Iterable[Sequence[Records]]) -> list[Records]:
    """What came piece by piece, in one."""
    return [np.concatenate(arrays) for arrays in zip(*found, strict=True)]


def both(decode: Callable[[list[Any]], Sequence[Records]], data: Any, cuts: Cuts) -> Sequence[Records]:
    """What comes of the data as a whole, if it is the same in pieces, bit for bit, padding apart."""
    whole = decode([data])
    for one, other in zip(whole, decode(pieces(data, cuts)), strict=True):
        assert len(one) == len(other), f"whole: {len(one)} items, in pieces: {len(other)}"
        for name in one.dtype.names or (...,):
            assert one[name].tobytes() == other[name].tobytes(), f"{name} differs between whole and in pieces"
    return whole


def plain_search(layout: Layout, data: bytes) -> list[int]:
    """Offsets of the good messages of a stream: tried one by one, each alone."""
    (kind,), decoder, offsets, at = layout.messages, StreamDecoder(layout), [], 0
    while 0 <= (at := data.find(kind.constants[0][1], at)) <= len(data) - kind.length:
        good = len(decoder.feed(data[at : at + kind.length]).frames) == 1
        decoder.close()
        offsets += [at] * good
        at += kind.length if good else 1
    return offsets


# Streams


def make_stream(rng: Generator) -> tuple[Setup, bytes]:
    """Frames, parts of them, false beginnings, noise."""
    profile = pick(rng, SERIAL) if rng.integers(2) else random_profile(rng)
    layout = layout_of(profile)
    header = bytes(value for _, value in layout.messages[0].constants)
    tokens = [header, header[:1], 2 * header, wire(rng, layout, 1), wire(rng, layout, 2)[3:]]
    return profile, mutated(rng, wire(rng, layout, some(rng)) or rng.bytes(some(rng, 3000)), tokens)


def check_stream(profile: Setup, data: bytes, cuts: Cuts) -> None:
    """Every frame that a plain search finds, no other, each number right; every byte in one place."""
    layout = layout_of(profile)
    (kind,), order = layout.messages, "big" if layout.big_endian else "little"

    def decode(parts: list[bytes]) -> list[Records]:
        decoder = StreamDecoder(layout)
        return fed(decoder, parts, lambda n, *_: decoder.bytes_fed == n and decoder.pending < kind.length)

    frames, rejects = both(decode, data, cuts)
    offsets, end = frames["offset"].tolist(), 0
    stretches = [(at, kind.length) for at in offsets] + [(at, size) for at, size, _ in rejects.tolist()]
    for at, size in sorted(stretches):
        assert (at, size > 0) == (end, True), f"byte {end}: expected one stretch to begin, one does at {at}"
        end = at + size
    assert end == len(data), f"{end} of {len(data)} bytes accounted for"
    skipped = np.diff([0, *(at + kind.length for at in offsets)]) - kind.length
    assert np.array_equal(frames["damaged"], -(-skipped // kind.length)), "damaged frames are counted wrong"
    plain = plain_search(layout, data)
    assert offsets == plain, f"frames at {offsets}, a plain search finds them at {plain}"
    for frame, at in zip(frames, offsets, strict=True):
        pulses = (*frame["gyro"], *frame["accelerometer"])
        numbers = [int(n) for n in (frame["counter"], *pulses, frame["status"], *frame["temperature"])]
        for f in kind.fields:
            value = int.from_bytes(data[at + f.offset :][: f.bits // 8], order, signed=f.signed)
            assert (value - numbers[f.target]) % 2**32 == 0, f"frame at {at}: {f} is {value}"


# Candump logs


def make_candump(rng: Generator) -> tuple[Setup, bytes]:
    """Lines of right and wrong words, and a real log, mutated."""
    words = (
        (b"(1.5)", b"(1700000000.123456)", b"(9999999999.5)", b"(0001.123456789)", b"(1.)", b"(.5)", b""),
        (b" ", b" can0 ", b"\tc\r ", b" c0 c0 ", b" " + b"c" * int(rng.integers(300)) + b" "),
        (b"150", b"7FF", b"800", b"00000151", b"1fffffff", b"15", b"20000000"),
        (b"#", b"##1", b"##", b"#R", b""),
        tuple(rng.bytes(n).hex().encode() for n in (0, 1, 7, 8, 9, 64, 65)),
        (b"\n", b"\n", b"\r\n", b" R\n", b"\tT \r\n", b"R\n", b"0\n", b"", b"\n \t\n"),
    )
    lines = b"".join(pick(rng, group) for _ in range(some(rng, 60)) for group in words)
    lines += format_candump(wire(rng, SHIPPED[pick(rng, CAN)], some(rng, 60)))
    return None, mutated(rng, lines, [word for group in words for word in group])


def check_candump(_: Setup, data: bytes, cuts: Cuts) -> None:
    """Each line is a message, a reject or blank; what was read can be written and read again."""
    channels: list[dict[str, int]] = []

    def decode(parts: list[bytes]) -> list[Records]:
        decoder, kept = CandumpDecoder(), LONGEST_LINE + 1
        found = fed(decoder, parts, lambda n, *_: decoder.bytes_fed == n and decoder._line.size <= kept)
        channels.append(decoder.channels)
        return found

    messages, rejects = both(decode, data, cuts)
    assert channels[0] == channels[1], f"whole: {channels[0]}, in pieces: {channels[1]}"
    bad = {offset: size for offset, size, _ in rejects.tolist()}
    offset = lines = 0
    for line in io.BytesIO(data):
        assert bad.pop(offset, len(line)) == len(line), f"line at {offset}: its reject has another length"
        lines += bool(line.strip(b" \t\r\n")) or len(line.rstrip(b"\n")) > LONGEST_LINE
        offset += len(line)
    assert not bad, f"rejects that begin no line: {bad}"
    assert lines == sum(channels[0].values()) + len(rejects), f"{lines} lines, messages {channels[0]}"
    assert len(messages) == next(iter(channels[0].values()), 0), f"{len(messages)} messages of {channels[0]}"
    assert np.all(messages["length"] <= np.where(messages["fd"], 64, 8)), "more data than a bus carries"
    identifiers = messages["id"]
    limits = np.where(identifiers & EXTENDED, 2**29, 2**11)
    assert np.all(identifiers & ~np.uint32(EXTENDED) < limits), "no bus has such an identifier"
    again, _ = decode([format_candump(messages)])
    again["t_ns"] += messages["t_ns"] % 1000  # a log has microseconds
    assert np.array_equal(again, messages)


# CAN messages


def make_can(rng: Generator) -> tuple[Setup, bytes]:
    """A unit's messages, with restarts, mutated."""
    profile = pick(rng, CAN) if rng.integers(2) else random_can_profile(rng)
    layout = layout_of(profile)
    sent = np.concatenate([wire(rng, layout, some(rng, 800)) for _ in range(rng.integers(1, 3))])
    tokens = [m.tobytes() for m in (wire(rng, layout, 1), wire(rng, layout, 2)[:-1], sent[:3], sent[-9:])]
    return profile, mutated(rng, sent.tobytes(), tokens, MESSAGE.itemsize)


def check_can(profile: Setup, data: bytes, cuts: Cuts) -> None:
    """Every message in one place, at any moment."""
    layout = layout_of(profile)
    parts = sum(kind.every == 1 for kind in layout.messages)
    hold = 2 * max(
        (kind.every for kind in layout.messages if kind.every > 1 and kind.has(COUNTER)), default=0
    )

    def assemble(batches: list[Records]) -> list[Records]:
        decoder = CanAssembler(layout)

        def holds(n: int, frames: int, rejects: int) -> bool:
            known = parts * frames + rejects + decoder.slow + decoder.foreign + decoder.pending
            return decoder.messages_fed == n == known and decoder.pending <= parts * (OPEN_SAMPLES + hold)

        return fed(decoder, batches, holds)

    messages = np.frombuffer(data, MESSAGE).copy()
    frames, rejects = both(assemble, messages, [cut // MESSAGE.itemsize for cut in cuts])
    ends = [*frames["offset"].tolist(), *rejects["offset"].tolist()]
    assert len(set(ends)) == len(ends), "a message stands in two places"
    assert set(ends) <= set(range(len(messages)))


# Datagrams


def make_datagram(rng: Generator) -> tuple[Setup, bytes]:
    """Datagrams with any bits in them, mutated."""
    sent = encode(np.frombuffer(rng.bytes(some(rng) * INCREMENTS.itemsize), INCREMENTS), Source.REPLAY)
    return None, mutated(rng, sent, [b"I50N", b"I50N\x01", sent[:SIZE], sent[5:SIZE]])


def check_datagram(_: Setup, data: bytes, cuts: Cuts) -> None:
    """Every datagram that a plain search finds, no other, each number right; every byte in one place."""
    end = bytes(SIZE) + encode(np.zeros(1, INCREMENTS), Source.REPLAY)  # ends whatever has begun

    def receive(parts: list[bytes]) -> list[Records]:
        decoder, found = DatagramDecoder(), []
        for part in [*parts, end]:
            found.append(decoder.feed(part))
            assert decoder._tail.size < SIZE, f"{decoder._tail.size} bytes are kept"
        return joined(found)

    increments, source, rejects = both(receive, data, cuts)
    assert SIZE * len(increments) + rejects["length"].sum() == len(data) + len(end)
    plain = b"".join((data + end)[at : at + SIZE] for at in plain_search(_LAYOUT, data + end))
    rows = np.frombuffer(plain, DATAGRAM)
    assert len(rows) == len(increments), f"{len(increments)} datagrams, a plain search finds {len(rows)}"
    assert np.array_equal(source, rows["source"])
    for name in set(DATAGRAM.names or ()) & set(INCREMENTS.names or ()):
        assert increments[name].astype(DATAGRAM[name].base).tobytes() == rows[name].tobytes(), name


# Settings files

MODELS: Final = (Calibration, Site, Profile, scenario.Scenario, Settings)
CALIBRATION: Final = scenario.NOMINAL.model_dump(mode="json", exclude_none=True) | {
    "temperature": {
        "reference_degc": 35,
        "range_degc": [10, 60],
        "gyro_bias_deg_per_h_per_k": [0.01, -0.02, 0.03],
        "gyro_scale_ppm_per_k": [2, -3, 4],
        "accelerometer_bias_ug_per_k": [10, -20, 15],
        "accelerometer_scale_ppm_per_k": [20, -30, 10],
    },
    "provenance": {"runs": ["a", "b"], "sigma": {"x": 0.1}},
}
SCENARIOS: Final = resources.files("imudrv.sim") / "scenarios"
FILES: Final = (
    yaml.safe_dump(CALIBRATION),
    "{latitude_deg: 28.2, longitude_deg: 113, height_m: 60.0, gravity_m_s2: 9.7917}",
    "{port: a, profile: b, calibration: c.yaml, outputs: ['udp://a:1'], rate_filter: dither, realtime: true}",
    *TEXTS.values(),
    *((SCENARIOS / f"{name}.yaml").read_text() for name in scenario.shipped()),
)
ODD: Final = (
    *(None, True, 0, -1, 7, 1.5, 5e-324, 1e-9, 1e200, -1e308, np.inf, np.nan, 2**63, 10**25, [], {}),
    *("", "x", "\ud800", "\0", "é\u2028", "50\u00a026", "EB 90", "SerialLine", {"SerialLine": {"x": 1}}),
    *("9999-12-31T23:59:59-14:00", "2026-11-22", [1e308] * 3, {"provenance": [{}]}, {"k" * 99: 1}, [[1, 2]]),
)
WORDS: Final = (
    *b"~ .nan -.inf 1e999 0x8000000000000000 0017 1:30 [ ] { } , : ? a: &a *a <<: !!str # - > |".split(),
    *(b"\n", b"\n  ", b"\n- ", b"\n---\n", b"\n...\n", b"%YAML 9.9\n", b"|\n  x", b" ", b"\t", b"- " * 40),
    *(b"'", b'"', b'"\\ud800"', b'"\\UFFFFFFFF"', b"\0", b"\xff", b"\xed\xa0\x80", "\x85".encode()),
    *("\u2028".encode(), "\ufeff".encode(), "\u00a0".encode(), b"format: imu50-site\n"),
)
ROWS: Final = (
    b"k%d: 1\n",
    b"- %d\n",
    b"- [[%d\n",
    b"{a%d: ",
    b"a%d: {latitude_deg: x}\n",
    b"- {rest: {b%d: 1}}\n",
)


def make_yaml(rng: Generator) -> tuple[Setup, bytes]:
    """Shipped files with bytes or values changed; words of YAML; now and then too much of one thing."""
    text, way = pick(rng, FILES), int(rng.integers(60))
    if way < 30:
        return None, mutated(rng, text.encode(), WORDS)
    if way < 52:
        document = yaml.load(text, Loader=yaml.CSafeLoader)
        for _ in range(rng.integers(1, 4)):
            document = changed(rng, document)
        return None, json.dumps(document).encode()
    if way < 59:
        return None, b"".join(pick(rng, WORDS) for _ in range(some(rng)))
    head = pick(rng, ("", f"{text}\n", f"{text}\nmotion:\n", f"{text}\nmessages:\n"))
    row = pick(rng, ROWS)
    return None, head.encode() + b"".join(row % n for n in range(16_000))


def changed(rng: Generator, value: Any) -> Any:
    """Plain data with one place changed, lost or doubled."""
    if not isinstance(value, dict | list) or not value or rng.integers(8) == 0:
        return pick(rng, ODD)
    items = list(value.items() if isinstance(value, dict) else enumerate(value))
    at, action = int(rng.integers(len(items))), int(rng.integers(12))
    key, old = items[at]
    items[at : at + 1] = [] if action == 0 else [(key, changed(rng, old))]
    items += [(str(pick(rng, ODD)), old)] if action == 1 else []
    return dict(items) if isinstance(value, dict) else [item for _, item in items]


def check_yaml(_: Setup, data: bytes, __: Cuts) -> None:
    """Only our error comes out; what is read can be used, and comes back the same when written."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "settings.yaml"
        path.write_bytes(data)
        with contextlib.suppress(InputError):
            settings_file.kind(path)
        for model in MODELS:
            try:
                settings = settings_file.read(path, model)
            except InputError as error:
                if not getattr(error, "faults", True):
                    raise AssertionError("refused without a fault") from error
                continue
            copy = path.with_stem(model.__name__)
            settings_file.write(copy, settings)
            assert settings_file.read(copy, model) == settings, "what was written is another"
            use(settings)


def use(settings: model.Model) -> None:
    """Begin what a command would do with a good file."""
    rng = np.random.default_rng(0)
    if isinstance(settings, scenario.Scenario):
        scenario.samples(settings, 1_000_000)
    elif isinstance(settings, Calibration):
        layout = SHIPPED[SERIAL[0]]
        pulses = SequenceTracker(layout).feed(StreamDecoder(layout).feed(wire(rng, layout, 9)).frames)
        require_finite(Compensator(coefficients(settings), layout, FILTERS["causal"]).feed(pulses))
    elif isinstance(settings, Profile):
        layout = settings.layout()
        decoder, tracker = (CanAssembler if layout.can else StreamDecoder)(layout), SequenceTracker(layout)
        pulses = tracker.feed(decoder.feed(wire(rng, layout, 9)).frames)
        assert tracker.counts.closes
        assert not np.isinf(pulses["temperature_degc"]).any(), "a temperature is not finite"


# The whole chain

COEFFICIENTS: Final = coefficients(settings_file.parse(CALIBRATION, Calibration, "a unit"))
FILTERS: Final = {name: rate_filter(name, 1_000_000) for name in NAMES}


def make_chain(rng: Generator) -> tuple[Setup, bytes]:
    """A mutated capture of a shipped profile."""
    name = pick(rng, tuple(SHIPPED))
    sent, more = (wire(rng, SHIPPED[name], n) for n in (some(rng), 3))
    if SHIPPED[name].can:
        sent, more = format_candump(sent), format_candump(more)
    tokens = [more, more[: len(more) // 2], more[:4], b"\n", rng.bytes(50)]
    return [name, pick(rng, NAMES), bool(rng.integers(4))], mutated(rng, sent, tokens)


def check_chain(setup: Setup, data: bytes, cuts: Cuts) -> None:
    """The counts add up at any moment; what comes out is finite, goes forward, and is the same in pieces."""
    name, filter_name, size_effect = setup
    layout = SHIPPED[name]
    numbers = COEFFICIENTS if size_effect else replace(COEFFICIENTS, r_b=None)
    outcomes: list[Any] = []

    def run(parts: list[bytes]) -> list[Records]:
        decoder, tracker = CaptureDecoder(layout), SequenceTracker(layout)
        compensator, out = Compensator(numbers, layout, FILTERS[filter_name]), []
        for feed in (*(functools.partial(decoder.feed, part) for part in parts), decoder.close):
            out.append(compensator.feed(tracker.feed(feed())))
            assert tracker.counts.closes, f"{tracker.counts} does not add up"
        outcomes.append((tracker.counts, decoder.rejected))
        return [np.concatenate([*out, compensator.close()])]

    (increments,) = both(run, data, cuts)
    assert outcomes[0] == outcomes[1], f"whole: {outcomes[0]}, in pieces: {outcomes[1]}"
    counts, rejected = outcomes[0]
    assert len(increments) == counts.good
    assert np.all(np.diff(increments["t_ns"]) > 0), "time goes back"
    require_finite(increments)
    if not layout.can:
        lost = sum(entry.length for entry in rejected.values())
        assert layout.messages[0].length * counts.frames + lost == len(data)


def require_finite(increments: Records) -> None:
    """No infinity and no NaN."""
    for name in ("dtheta_b", "dv_b"):
        assert np.isfinite(increments[name]).all(), f"{name} is not finite"


# The run


@dataclass
class Target:
    """What is fuzzed, and how far it has come."""

    name: str
    make: Callable[[Generator], tuple[Setup, bytes]]
    check: Callable[[Setup, bytes, Cuts], None]
    unit: int = 1  # bytes that belong together
    cases: int = 0
    size: int = 0
    seconds: float = 0.0


TARGETS: Final = (
    Target("stream", make_stream, check_stream),
    Target("candump", make_candump, check_candump),
    Target("can", make_can, check_can, MESSAGE.itemsize),
    Target("datagram", make_datagram, check_datagram),
    Target("yaml", make_yaml, check_yaml),
    Target("chain", make_chain, check_chain),
)


@dataclass
class Case:
    """One input of a target."""

    target: Target
    seed: int
    number: int
    setup: Setup = None
    data: bytes = b""
    cuts: Cuts = ()

    def run(self) -> None:
        """Make the input and check it."""
        index = [t.name for t in TARGETS].index(self.target.name)
        rng = np.random.default_rng([self.seed, index, self.number])
        self.setup, self.data = self.target.make(rng)
        self.cuts = random_cuts(rng, len(self.data))
        begin = time.perf_counter()
        self.target.check(self.setup, self.data, self.cuts)
        self.target.seconds += time.perf_counter() - begin
        self.target.cases += 1
        self.target.size += len(self.data)

    def shrink(self, error: Exception) -> Exception:
        """Leave out what the failure does not need: cuts, and parts of the input, large ones first."""

        def attempt(data: bytes, cuts: Cuts) -> bool:
            nonlocal error
            try:
                self.target.check(self.setup, data, cuts)
            except Exception as other:
                if type(other) is type(error):
                    error, self.data, self.cuts = other, data, cuts
                    return True
            return False

        unit, end = self.target.unit, time.monotonic() + SHRINK_S
        attempt(self.data, ())
        for step in (unit << k for k in reversed(range((len(self.data) // unit).bit_length()))):
            at = 0
            while at < len(self.data) and time.monotonic() < end:
                at += 0 if attempt(self.data[:at] + self.data[at + step :], self.cuts) else step
        for cut in itertools.takewhile(lambda _: time.monotonic() < end, self.cuts):
            attempt(self.data, [c for c in self.cuts if c != cut])
        return error

    def told(self) -> str:
        """How to see it again; the input goes to a file."""
        name = self.target.name
        path = Path(tempfile.gettempdir()) / f"fuzz-{name}-{self.seed}-{self.number}.bin"
        path.write_bytes(self.data)
        data = f"Path({str(path)!r}).read_bytes()" if len(self.data) > 500 else repr(self.data)
        return (
            f"again: tools/fuzz.py --only {name} --seed {self.seed} --first {self.number} --cases 1\n"
            f"input, {len(self.data)} bytes: {path}\n"
            f"call: {self.target.check.__name__}({self.setup!r}, {data}, {list(self.cuts)})"
        )


class Watch(threading.Thread):
    """Ends the run when a case takes for ever; from another thread, as kernels cannot be interrupted."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.stopped = threading.Event()
        self.case: Case | None = None
        self.since = time.monotonic()

    def run(self) -> None:
        """Look once a second."""
        while not self.stopped.wait(1.0):
            if self.case and time.monotonic() - self.since > LIMIT_S:
                print(
                    f"{self.case.target.name} takes more than {LIMIT_S:.0f} s\n{self.case.told()}", flush=True
                )
                os._exit(OUR_FAULT)


def run(cases: Iterable[Case], seconds: float, out: Console) -> int:
    """Run cases until there are no more, time is up, or one fails; the exit code."""
    end, watch = time.monotonic() + seconds, Watch()
    watch.start()
    with out.status("", refresh_per_second=4) as status, warnings.catch_warnings():
        warnings.simplefilter("error")  # a user would see them
        try:
            for case in cases:
                watch.case, watch.since = case, time.monotonic()
                if watch.since > end:
                    break
                status.update(f"{case.target.name} {case.number:,}")
                case.run()
        except Exception as error:
            watch.stopped.set()
            out.print(*traceback.format_tb(error.__traceback__)[-3:], sep="", markup=False)
            out.print(f"{case.target.name} failed: {type(error).__name__}: {error}", markup=False)
            status.update("making the input small; Ctrl-C leaves it as it is")
            size = len(case.data)
            with contextlib.suppress(KeyboardInterrupt):
                out.print(f"made small, from {size} bytes: {case.shrink(error)}", markup=False)
            out.print(case.told(), markup=False)
            return OUR_FAULT
        finally:
            watch.stopped.set()
    return OK


def summary(targets: Sequence[Target]) -> Table:
    """What each target got; rates are of the checks, without the making of the input."""
    table = Table("target", "cases", "MB", "cases/s", "MB/s")
    for column in table.columns[1:]:
        column.justify = "right"
    for t in targets:
        seconds = t.seconds or math.inf
        rates = f"{t.cases / seconds:,.0f}", f"{t.size / seconds / 1e6:.3f}"
        table.add_row(t.name, f"{t.cases:,}", f"{t.size / 1e6:.2f}", *rates)
    return table


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seconds", type=float, help="how long (default: 60 if no --cases are given)")
    parser.add_argument("--cases", type=int, help="how many of each target")
    parser.add_argument("--seed", type=int, default=1, help="same seed, same cases (default: %(default)s)")
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first case (default: %(default)s)"
    )
    parser.add_argument("--only", choices=[t.name for t in TARGETS], help="one target instead of all")
    options = parser.parse_args(argv)
    if min(options.seed, options.first, options.cases or 0, options.seconds or 0) < 0:
        parser.error("expected numbers of 0 or more")
    targets = [replace(t) for t in TARGETS if options.only in (None, t.name)]
    numbers = itertools.islice(itertools.count(options.first), options.cases)
    seconds = options.seconds or (60.0 if options.cases is None else math.inf)
    out = Console(highlight=False, soft_wrap=True)
    try:
        code = run((Case(t, options.seed, n) for n in numbers for t in targets), seconds, out)
    except KeyboardInterrupt:
        code = INTERRUPTED
    out.print(summary(targets), f"seed {options.seed}", sep="\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
