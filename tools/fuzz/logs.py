"""Target: capture files in every form, packed and plain."""

import contextlib
import functools
import gzip
import tempfile
import tracemalloc
from pathlib import Path
from typing import Final

import can
import numpy as np
import zstandard
from numpy.random import Generator

from imudrv.capture import Capture
from imudrv.errors import InputError
from imudrv.wire.candump import format_candump

from .properties import Cuts, Setup
from .random_input import mutated, pick, small_number
from .recordings import exhaust
from .units import CAN, SERIAL, SHIPPED, transmit

MOST_BYTES: Final = 128 << 20
"""Bound on the memory of a reader: python-can copies what it searches."""
WRITERS: Final = {
    ".asc": can.ASCWriter,
    ".blf": can.BLFWriter,
    ".trc": can.TRCWriter,
    ".csv": can.CSVWriter,
    ".db": can.SqliteWriter,
}
TOKENS: Final = (
    *(b"LOBJ", b"\xff\xff\xff\xff", b"\0\0\0\0", b"\n", b",", b" ", b"0", b"-1", b"nan", b"1e400", b"\x80"),
    *(b";$FILEVERSION=9\n", b"date \n", b"base hex timestamps relative\n", b"A" * 70_000, b"\0" * 70_000),
)


@functools.cache
def log_of(suffix: str) -> bytes:
    """Return a good log of python-can."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"unit{suffix}"
        writer = WRITERS[suffix](path)
        for row in transmit(np.random.default_rng(1), SHIPPED[CAN[0]], 30):
            data = row["data"][: row["length"]].tobytes()
            writer(
                can.Message(row["t_ns"] * 1e-9, int(row["id"]), is_extended_id=False, data=data, channel=1)
            )
        writer.stop()
        return path.read_bytes()


def make_log(rng: Generator) -> tuple[Setup, bytes]:
    """Return a damaged log or capture, often in an archive; also much of it."""
    name = pick(rng, (*WRITERS, *WRITERS, ".log", ".log", ".txt", ".hex", ".raw", ".mcap", ".i50n", ""))
    if name in WRITERS:
        data = log_of(name)
    elif name in (".log", ".txt"):
        data = format_candump(transmit(rng, SHIPPED[pick(rng, CAN)], small_number(rng, 90)))
        if name == ".txt":
            data = data.replace(b"#", b"   [8]  ")
    else:
        data = transmit(rng, SHIPPED[pick(rng, SERIAL)], small_number(rng, 90))
        data = data.hex(" ").encode() if name == ".hex" else data
    data = mutated(rng, data, TOKENS) if rng.integers(8) else data
    data *= pick(rng, (1,) * 40 + (0, 2, 9, (4 << 20) // max(1, len(data))))
    way = int(rng.integers(6))
    if way in (0, 1):
        data = (gzip.compress(data), zstandard.compress(data))[way] * pick(rng, (1, 1, 1, 2))
        data = mutated(rng, data, TOKENS) if rng.integers(3) == 0 else data
        name += (".gz", ".zst")[way]
    return name if rng.integers(20) else pick(rng, (*WRITERS, ".gz", ".zst", ".mf4")), data


def check_log(suffix: Setup, data: bytes, _: Cuts) -> None:
    """Check that a capture is decoded within bounded memory, and its counts close, or is refused."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"unit{suffix}"
        path.write_bytes(data)
        tracemalloc.start()
        try:
            for profile in (None, CAN[0], SERIAL[0]):
                with contextlib.suppress(InputError):
                    capture = Capture(path, profile)
                    exhaust(capture.pulses())
                    assert capture.tracker.counts.closes
                    assert capture.hints is not None
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < MOST_BYTES, f"{peak} bytes of memory"
