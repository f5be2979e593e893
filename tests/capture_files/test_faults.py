"""A file that is damaged, named wrongly or made with ill intent is one message, and takes little memory."""

import gzip
import sqlite3
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard

from imudrv.capture_files import CaptureFile
from imudrv.errors import InputError

SUFFIXES = (".asc", ".blf", ".trc", ".csv", ".db")
PACKERS = {".gz": gzip.compress, ".zst": zstandard.ZstdCompressor(write_checksum=True).compress}


def read(path: Path) -> int:
    """Read a file to its end; return the length of its content."""
    return sum(len(piece.data) for piece in CaptureFile(path).pieces())


def written(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


REFUSED = [
    ("unit.log", b"LOGG" + bytes(200), r"named \.log, but is a Vector BLF log; rename it to unit\.blf"),
    ("unit.raw", gzip.compress(b"x"), r"named \.raw, but is a gzip archive; rename it to unit\.gz"),
    (
        "unit",
        b";$FILEVERSION=2.1\n",
        r"named without a suffix, but is a PEAK TRC log; rename it to unit\.trc",
    ),
    ("unit.blf", b"(1.0) can0 150#00\n", r"named \.blf, but is a candump log; rename it to unit\.log"),
    ("unit.asc", b"LOGG" + bytes(200), r"named \.asc, but is a Vector BLF log; rename it to unit\.blf"),
    ("unit.csv", b"a,b\n1,2\n", r"named \.csv, but does not begin like a CSV log of python-can"),
    ("unit.mcap", bytes(99), r"named \.mcap, but does not begin like a recording"),
    ("unit.raw", b"PK\x03\x04" + bytes(99), r"expected a capture, got a zip archive.*; unpack it"),
    ("unit.log", b"\xd4\xc3\xb2\xa1" + bytes(99), r"got a packet capture of Wireshark; .*candump -L"),
    ("unit.i50n", b"I50N\x01" + bytes(99), r"got increments as I50N datagrams; they are compensated"),
    ("unit.raw", b"", "expected a capture, got an empty file"),
    ("unit.raw.gz", gzip.compress(b""), "expected a capture, got an empty file in a gzip archive"),
    ("unit.gz.gz", gzip.compress(gzip.compress(b"x")), "got a gzip archive in a gzip archive; unpack it"),
    (
        "unit.db.gz",
        gzip.compress(b"SQLite format 3\0"),
        "got an SQLite log .* in a gzip archive; unpack it",
    ),
    ("unit.blf.gz", gzip.compress(b"(1.0) can0 150#00\n"), r"named \.blf, but is a candump log"),
    (
        "unit.trc",
        b";$FILEVERSION=1.2\n",
        r"a PEAK TRC log, line 1: .* expected version 1\.0, .*got '1\.2'",
    ),
    (
        "unit.txt",
        b"EB 90 50 26\nEB 90 5\n",
        "a hex dump, line 2: .* expected bytes in hexadecimal digits",
    ),
    (
        "unit.txt",
        b"00000000: eb90 5026  ..P&\n00000010: eb90  ..\n",
        "line 2: .* expected the address 00000004",
    ),
    ("unit.csv", b"timestamp,arbitration_id,extended,remote,error,dlc,data\n1,2\n", "CSV log .*, line 2"),
]


@pytest.mark.parametrize(("name", "data", "message"), REFUSED, ids=[name for name, *_ in REFUSED])
def test_a_file_that_cannot_be_read_is_named_for_what_it_is(
    tmp_path: Path, name: str, data: bytes, message: str
) -> None:
    path = written(tmp_path, name, data)
    with pytest.raises(InputError, match=f"{path}: .*{message}" if ", line" not in message else message):
        read(path)


def test_mdf_without_its_package_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("imudrv.capture_files.can_logs.find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"asammdf, which is not installed; pip install 'imu50\[mf4\]'"):
        read(written(tmp_path, "unit.mf4", b"MDF     4.10    " + bytes(200)))


@pytest.mark.parametrize("suffix", PACKERS)
@pytest.mark.parametrize("part", [0.3, 0.9, 0.999])
def test_a_truncated_archive_is_named_with_the_place(tmp_path: Path, suffix: str, part: float) -> None:
    packed = PACKERS[suffix](np.random.default_rng(1).bytes(500_000))
    path = written(tmp_path, f"unit.raw{suffix}", packed[: int(part * len(packed))])
    with pytest.raises(InputError, match=r"archive, damaged or truncated at byte \d+ of \d+"):
        read(path)


@pytest.mark.parametrize("suffix", PACKERS)
def test_a_damaged_archive_is_named(tmp_path: Path, suffix: str) -> None:
    data = b"".join(b"%d " % n for n in range(50_000))
    packed = bytearray(PACKERS[suffix](data))
    packed[len(packed) // 2] ^= 0x55
    with pytest.raises(InputError, match="archive, damaged or truncated"):
        read(written(tmp_path, f"unit.raw{suffix}", bytes(packed)))


@pytest.mark.parametrize("suffix", [*SUFFIXES, *PACKERS, ".mf4", ".mcap", ".i50n"])
def test_noise_is_refused_under_every_name(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path, f"unit{suffix}", np.random.default_rng(5).bytes(5000))
    with pytest.raises(InputError, match=f"named {suffix}, but does not begin like"):
        read(path)


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".screen.txt", ".hex.txt"])
def test_whatever_is_wrong_in_a_log_is_an_input_error_or_nothing(
    tmp_path: Path, can_logs: dict[str, Path], suffix: str
) -> None:
    random = np.random.default_rng(7)
    if suffix in can_logs:
        sound = can_logs[suffix].read_bytes()
    elif suffix == ".hex.txt":
        sound = b"".join(b"%08x: eb90 5026 c0d4 0100  ..P&....\n" % n for n in range(0, 4000, 8))
    else:
        sound = b" (2023-11-14 22:13:20.000028)  can0  150   [8]  01 00 FF FF 02 00 40 00\n" * 500
    messages = []
    for _ in range(60):
        data = bytearray(sound)
        keep = min(200, len(data) // 4)  # so that the file is still recognised
        for _ in range(int(random.integers(1, 30))):
            at = int(random.integers(keep, len(data)))
            kind = int(random.integers(4))
            if kind == 0:
                data[at] = int(random.integers(256))
            elif kind == 1:
                del data[at : at + int(random.integers(1, 50))]
            elif kind == 2:
                data[at:at] = random.bytes(int(random.integers(1, 50)))
            else:
                data[at : at + 4] = b"\xff\xff\xff\x7f"
            if len(data) <= keep:
                break
        try:
            read(written(tmp_path, f"unit{suffix}", bytes(data)))
        except InputError as error:
            messages.append(str(error))
    assert all(str(tmp_path) in message for message in messages)
    assert messages or suffix == ".screen.txt", "no damage was noticed"


@pytest.mark.parametrize(
    ("name", "start"),
    [
        ("unit.asc", b"base hex  timestamps absolute\n"),
        ("unit.trc", b";$FILEVERSION=1.1\n"),
        ("unit.csv", b"timestamp,arbitration_id,extended,remote,error,dlc,data\n"),
        ("unit.txt", b"EB 90 50 26\n"),
        ("unit.log", b"  can0  150   [1]  00\n"),
    ],
)
def test_a_line_without_end_is_refused_and_takes_no_memory(tmp_path: Path, name: str, start: bytes) -> None:
    path = written(tmp_path, name, start + b"0" * 30_000_000)
    with pytest.raises(InputError, match="expected lines of up to 65536 characters, got a longer one"):
        bounded(path)


@pytest.mark.parametrize("suffix", PACKERS)
def test_an_archive_that_unpacks_to_much_takes_little_memory(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path, f"unit.raw{suffix}", PACKERS[suffix](bytes(200_000_000)))
    assert path.stat().st_size < 1_000_000
    assert bounded(path) == 200_000_000


def bounded(path: Path) -> int:
    """Read a file within the memory of a few pieces; see `read`."""
    tracemalloc.start()
    try:
        return read(path)
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        # a piece, its parts, and 2^15 times what is unpacked at once
        assert peak < 50_000_000, f"{peak} bytes of memory"


def blf(*objects: bytes) -> bytes:
    """A BLF log of objects, with the header that python-can asks for."""
    return b"LOGG" + struct.pack("<L", 144) + bytes(136) + b"".join(objects)


def blf_object(kind: int, body: bytes, size: int | None = None) -> bytes:
    size = 16 + len(body) if size is None else size
    return b"LOBJ" + struct.pack("<HHLL", 16, 1, size, kind) + body + bytes(size % 4)


def container(data: bytes) -> bytes:
    return blf_object(10, struct.pack("<H6xL4x", 2, len(data)) + zlib.compress(data))


@pytest.mark.parametrize(
    ("log", "message"),
    [
        (blf(container(bytes(30_000_000))), "byte 144: a container is damaged, or too large"),
        (
            blf(blf_object(10, bytes(99), size=0xFFFFFFF0)),
            "byte 144: expected an object, got b'LOBJ' of 4294967280",
        ),
        (blf(blf_object(10, b"", size=3)), "byte 144: expected an object"),
        (blf(container(b"x" * 1000)[:-20]), "truncated"),
        (blf(b"LOBJ"), "byte 144: the log is truncated"),
        (b"LOGG" + struct.pack("<L", 0xFFFFFFFF) + bytes(200), "byte 4: expected the size of the header"),
        (
            blf(*[container(b"LOBJ" + struct.pack("<HHLL", 32, 1, 2**32 - 1, 1) + bytes(99_980))] * 700),
            "no CAN message in",
        ),
    ],
    ids=["bomb", "large", "small", "cut container", "cut object", "header", "endless object"],
)
def test_an_absurd_blf_log_is_refused_and_takes_little_memory(
    tmp_path: Path, log: bytes, message: str
) -> None:
    path = written(tmp_path, "unit.blf", log)
    tracemalloc.start()
    with pytest.raises(InputError, match=message):
        read(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 400_000_000, (
        f"{peak} bytes of memory"
    )  # python-can copies the 2^26 bytes of the longest search


def database(path: Path, script: str) -> Path:
    connection = sqlite3.connect(path)
    connection.executescript(script)
    connection.close()
    return path


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("CREATE TABLE other (a)", "expected the table 'messages' of python-can, got none"),
        (
            "CREATE TABLE t (a); CREATE VIEW messages AS WITH RECURSIVE n(ts) AS "
            "(SELECT 1.0 UNION ALL SELECT ts FROM n) SELECT * FROM n",
            "expected the table 'messages'",
        ),
        ("CREATE TABLE messages (ts)", "no such column"),
        (
            "CREATE TABLE messages (ts, arbitration_id, extended, remote, error, dlc, data);"
            "INSERT INTO messages VALUES (1.0, 1, 0, 0, 0, 8, zeroblob(90000000))",
            "too big",
        ),
    ],
)
def test_an_absurd_database_is_refused(tmp_path: Path, script: str, message: str) -> None:
    with pytest.raises(InputError, match=f"an SQLite log of python-can: .*{message}"):
        bounded(database(tmp_path / "unit.db", script))
