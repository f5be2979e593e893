"""Target: recordings, through the reader, the decoder, every export and the packer."""

import contextlib
import functools
import json
import struct
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Final

import lz4.frame
import numpy as np
import zstandard
from mcap.writer import MCAP0_MAGIC
from numpy.random import Generator

from imudrv.capture import Capture
from imudrv.errors import InputError
from imudrv.recording.export import KINDS, export
from imudrv.recording.format import CLOCK, EVENTS, INCREMENTS, STATUS, WIRE, pack_messages
from imudrv.recording.pack import pack
from imudrv.recording.reader import Recording
from imudrv.records import INCREMENTS as INCREMENT
from imudrv.records import Source
from imudrv.wire.datagram import encode

from .chain import CALIBRATION
from .properties import Cuts, Setup
from .random_input import mutated, pick, small_number
from .settings import changed
from .units import CAN, SERIAL, SHIPPED, TEXTS, transmit

MOST_BYTES: Final = 64 << 20
"""What `Recording` promises to hold in memory at most."""
TOPICS: Final = (WIRE, CLOCK, INCREMENTS, STATUS, EVENTS)
PACK: Final[dict[bytes, Callable[[bytes], bytes]]] = {
    b"zstd": zstandard.compress,
    b"lz4": lz4.frame.compress,
    b"": bytes,
}


def record_of(opcode: int, body: bytes) -> bytes:
    """Return an MCAP record."""
    return struct.pack("<BQ", opcode, len(body)) + body


def text_of(text: str) -> bytes:
    """Return text as MCAP has it."""
    return struct.pack("<I", len(text.encode())) + text.encode()


def chunk(rng: Generator, records: bytes) -> bytes:
    """Return records in a chunk; its length, its compression or its content may be wrong."""
    name = pick(rng, tuple(PACK))
    size = pick(rng, (len(records),) * 12 + (0, len(records) + 1, 1 << 24, 1 << 40))
    data = PACK[name](records)
    named = pick(rng, (name,) * 12 + (b"zstd", b"lz4", b"", b"rar"))
    return record_of(6, struct.pack("<QQQI", 0, 0, size, 0) + text_of(named.decode()) + blob(data))


def blob(data: bytes) -> bytes:
    """Return bytes as MCAP has them."""
    return struct.pack("<Q", len(data)) + data


def make_recording(rng: Generator) -> tuple[Setup, bytes]:
    """Return a recording in chunks and without, with bombs, foreign records, damage and cuts."""
    name = pick(rng, SERIAL + CAN)
    layout = SHIPPED[name]

    def attachment(title: str, text: str) -> bytes:
        return record_of(9, bytes(16) + text_of(title) + text_of("") + blob(text.encode()) + bytes(4))

    def channel(number: int, topic: str, encoding: str) -> bytes:
        named = struct.pack("<HH", number, 0) + text_of(topic) + text_of(encoding)
        return record_of(4, named + text_of(""))

    encoding = pick(rng, ("can-messages" if layout.can else "bytes",) * 9 + ("bytes", "can-messages"))
    definitions = b"".join(
        channel(number, topic, encoding if topic == WIRE else "json")
        for number, topic in enumerate(TOPICS)
        if rng.integers(30)
    )

    def message() -> bytes:
        topic = int(rng.integers(len(TOPICS) + (rng.integers(20) == 0)))
        if topic == 0:
            sent = transmit(rng, layout, small_number(rng, 60))
            data = pack_messages(sent, np.array([len(sent)]))[0].tobytes() if layout.can else sent
        elif topic == 2:
            made = np.frombuffer(rng.bytes(small_number(rng) * INCREMENT.itemsize), INCREMENT)
            data = encode(made, Source.REPLAY)
        else:
            document = {"offset_ns": 5, "slept_ns": 0, "text": "unplugged", "rate_hz": 1.0}
            data = json.dumps(changed(rng, document) if rng.integers(4) == 0 else document).encode()
        data = pick(rng, (data,) * 300 + (b"", bytes(1 << 20), b"[" * (1 << 16)))
        times = struct.pack("<QQ", *(pick(rng, (1000,) * 9 + (2**63, 2**64 - 1)) for _ in range(2)))
        return record_of(5, struct.pack("<HI", topic, 0) + times + data)

    def piece() -> bytes:
        way = int(rng.integers(20))
        if way == 0:
            return pick(rng, (definitions, attachment("calibration.yaml", json.dumps(CALIBRATION))))
        if way == 1:
            return record_of(int(rng.integers(1, 256)), rng.bytes(small_number(rng, 90)))
        if way == 2:  # a bomb
            large = channel(int(rng.integers(9, 99)), "/t" * 9000, "")
            one = pick(rng, (message(), large, bytes(99), piece()))
            most = pick(rng, (1 << 16, 1 << 18, 18 << 20 if len(one) > 1000 else 1 << 20))
            return chunk(rng, one * (1 + most // (1 + len(one))))
        records = b"".join(message() for _ in range(small_number(rng, 20)))
        return chunk(rng, records) if way < 10 else records

    profile = pick(rng, (TEXTS[name],) * 12 + (TEXTS[pick(rng, SERIAL + CAN)], ""))
    head = MCAP0_MAGIC + record_of(1, text_of("") * 2) + attachment("profile.yaml", profile)
    if rng.integers(2):
        head += attachment("calibration.yaml", json.dumps(CALIBRATION))
    body = definitions + b"".join(piece() for _ in range(small_number(rng, 12)))
    end = pick(rng, (b"", record_of(15, bytes(4)) + record_of(2, bytes(20)) + MCAP0_MAGIC))
    if rng.integers(3):
        return name, head + body + end
    return name, pick(rng, (b"", head)) + mutated(
        rng, pick(rng, (body, head + body)), [definitions, end, body[:99]]
    )


def check_recording(name: Setup, data: bytes, _: Cuts) -> None:
    """Check that a recording is read within bounded memory, or refused with its name."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "run.mcap", Path(folder) / "out"
        path.write_bytes(data)
        reads: list[Callable[[], object]] = [
            lambda: exhaust(Recording(path).arrivals()),
            lambda: exhaust(Recording(path).increments()),
            lambda: exhaust(Recording(path).statuses()),
            lambda: exhaust(Recording(path).events()),
            lambda: exhaust(Recording(path).calibrations()),
            lambda: (Recording(path).origin, repr(Recording(path))),
            lambda: pack(path, out),
            *(functools.partial(decode, path, profile) for profile in (None, name, SERIAL[0], CAN[0])),
            *(functools.partial(convert, path, kind, out) for kind in KINDS),
        ]
        tracemalloc.start()
        try:
            for read in reads:
                with contextlib.suppress(InputError):
                    read()
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < MOST_BYTES, f"{peak} bytes of memory"


def exhaust(items: object) -> None:
    """Take all items of an iterator."""
    for _ in items:  # type: ignore[attr-defined]
        pass


def decode(path: Path, profile: str | None) -> None:
    """Decode a recording as the commands do; the counts must close."""
    capture = Capture(path, profile)
    exhaust(capture.pulses())
    assert capture.tracker.counts.closes


def convert(path: Path, kind: str, out: Path) -> None:
    """Export a recording."""
    export(Recording(path), kind, out.with_suffix(".mcap" if kind == "ros2" else f".{kind}"))
