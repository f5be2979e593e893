"""Each form of a capture gives the bytes or the messages that were stored in it."""

import gzip
from pathlib import Path

import numpy as np
import pytest
import zstandard

from imudrv.capture_files import CaptureFile
from imudrv.records import EXTENDED, MESSAGE, Reason, Records
from imudrv.wire.candump import CandumpDecoder, format_candump


def content(path: Path) -> bytes:
    file = CaptureFile(path)
    pieces = list(file.pieces())
    assert sum(piece.bytes_read for piece in pieces) == file.size
    return b"".join(piece.data for piece in pieces)


def decoded(path: Path) -> tuple[Records, list[int]]:
    """Messages of a log, and the reasons of its rejects."""
    log = CandumpDecoder()
    messages, rejects = log.feed(content(path))
    return messages, rejects["reason"].tolist()


def written(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc", ".csv", ".db"])
def test_a_log_of_python_can_gives_its_messages(
    can_logs: dict[str, Path], messages: Records, suffix: str
) -> None:
    found, reasons = decoded(can_logs[suffix])
    expected = messages.copy()
    if suffix == ".asc":
        expected["t_ns"] -= expected["t_ns"][0]
    # times are floats in these formats, and whole microseconds in a candump log
    np.testing.assert_allclose(found["t_ns"], expected["t_ns"], rtol=0, atol=1001)
    for name in ("id", "length", "fd", "data"):
        np.testing.assert_array_equal(found[name], expected[name])
    assert reasons == ([] if suffix == ".trc" else [Reason.ERROR_FRAME, Reason.NOT_A_MESSAGE])


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc"])
@pytest.mark.parametrize("pack", [gzip.compress, zstandard.compress])
def test_a_packed_log_gives_the_same(can_logs: dict[str, Path], tmp_path: Path, suffix: str, pack) -> None:
    archive = ".gz" if pack is gzip.compress else ".zst"
    packed = written(tmp_path, f"unit{suffix}{archive}", pack(can_logs[suffix].read_bytes()))
    assert content(packed) == content(can_logs[suffix])


@pytest.mark.parametrize("pack", [gzip.compress, zstandard.compress])
def test_an_archive_of_several_parts_is_unpacked_whole(tmp_path: Path, pack) -> None:
    parts = [np.random.default_rng(n).bytes(300_000) for n in range(3)]
    archive = ".gz" if pack is gzip.compress else ".zst"
    assert content(written(tmp_path, f"unit.raw{archive}", b"".join(map(pack, parts)))) == b"".join(parts)


def test_times_of_an_asc_log_since_the_event_before_are_not_taken_for_times(tmp_path: Path) -> None:
    text = b"base hex  timestamps relative\nno internal events logged\n 0.5 1  150  Rx   d 1 01\n"
    messages, _ = decoded(written(tmp_path, "unit.asc", text))
    assert messages["t_ns"].tolist() == [0]


SCREEN = b"""\
  can0  150   [8]  01 00 FF FF 02 00 40 00
  can0  18FF0150   [2]  AB CD
  can0  158  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B
  can0  150   [0]
  can0  RX - -  151   [1]  7F
  can0  TX B E  151   [1]  7F   '.'
  can0  150   [2]  remote request
  can0  20000004   [8]  00 08 00 00 00 00 00 00   ERRORFRAME
	controller-problem{rx-overflow}
"""


def test_lines_of_candumps_screen_become_those_of_its_log(tmp_path: Path) -> None:
    assert content(written(tmp_path, "unit.txt", SCREEN)).splitlines() == [
        b"(0.000000) can0 150#0100FFFF02004000",
        b"(0.000000) can0 18FF0150#ABCD",
        b"(0.000000) can0 158##1000102030405060708090A0B",
        b"(0.000000) can0 150#",
        b"(0.000000) can0 151#7F",
        b"(0.000000) can0 151#7F",
        b"(0.000000) can0 150#R",
        b"(0.000000) can0 20000004#0008000000000000",
        b"\tcontroller-problem{rx-overflow}",
    ]


# two channels in turn: a message comes after one that is later
ZERO_TIMES = [f"000.{128 * (n - n % 2 + 3 * (n % 2)):06}" for n in range(40)]
DIFFERENCES = ["000.000000", *(f"000.{128 if n % 2 else 872:06}" for n in range(1, 40))]


SCREEN_LINE, LOG_LINE = " ({})  can0  150   [1]  00\n", "({}) can0 150#00\n"
EPOCH = (["1700000000.000028", "1700000000.000156"], [1_700_000_000_000_028, 1_700_000_000_000_156])
FROM_ZERO = (ZERO_TIMES, [128 * (n - n % 2 + 3 * (n % 2)) for n in range(40)])
SINCE_BEFORE = (DIFFERENCES, [1000 * (n // 2) + 128 * (n % 2) for n in range(40)])
DATES = (["2023-11-14 22:13:20.000028", "2024-02-29 00:00:00.5"], [1_700_000_000_000_028, None])
NO_MONTH = (["2023-13-14 22:13:20.000028", "2023-11-14 22:13:20.000028"], [None, 1_700_000_000_000_028])


@pytest.mark.parametrize(
    ("form", "times", "t_us"),
    [
        *((form, *times) for form in (SCREEN_LINE, LOG_LINE) for times in (EPOCH, FROM_ZERO, SINCE_BEFORE)),
        (SCREEN_LINE, *DATES),
        (SCREEN_LINE, *NO_MONTH),
    ],
    ids=["-t a", "-t z", "-t d", "-L", "-L -t z", "-L -t d", "-t A", "no such month"],
)
def test_times_of_candump_are_those_of_the_messages(
    tmp_path: Path, form: str, times: list[str], t_us: list[int | None]
) -> None:
    lines = "".join(form.format(time) for time in times)
    messages, reasons = decoded(written(tmp_path, "unit.log", lines.encode()))
    assert (messages["t_ns"] // 1000).tolist() == [t for t in t_us if t is not None]
    assert len(reasons) == t_us.count(None)


DATA = bytes(range(256)) * 3 + b"\xeb\x90\x50"


def hexdump_c(data: bytes) -> str:
    rows = [data[n : n + 16] for n in range(0, len(data), 16)]
    lines = [
        f"{16 * n:08x}  {row[:8].hex(' ')}  {row[8:].hex(' ')}  |{'.' * len(row)}|"
        for n, row in enumerate(rows)
    ]
    return "\n".join([*lines, f"{len(data):08x}", ""])


def xxd(data: bytes) -> str:
    rows = [data[n : n + 16] for n in range(0, len(data), 16)]
    return "".join(f"{16 * n:08x}: {row.hex(' ', -2):39}  {'0' * len(row)}\n" for n, row in enumerate(rows))


@pytest.mark.parametrize(
    "text",
    [
        "\n".join(DATA[n : n + 16].hex(" ").upper() for n in range(0, len(DATA), 16)),
        "\r\n".join(DATA[n : n + 10].hex(" ") + " " for n in range(0, len(DATA), 10)),
        "\n".join(DATA[n : n + 30].hex() for n in range(0, len(DATA), 30)),
        xxd(DATA),
        hexdump_c(DATA),
    ],
    ids=["16 a line", "10 a line", "xxd -p", "xxd", "hexdump -C"],
)
def test_a_hex_dump_gives_its_bytes(tmp_path: Path, text: str) -> None:
    assert content(written(tmp_path, "unit.txt", text.encode())) == DATA


def test_a_candump_log_and_wire_bytes_are_read_as_they_are(tmp_path: Path, messages: Records) -> None:
    text, data = format_candump(messages), np.random.default_rng(3).bytes(2_000_000)
    assert content(written(tmp_path, "unit.log", text)) == text
    assert content(written(tmp_path, "unit.raw", data)) == data


def test_a_can_fd_message_and_a_channels_name_pass_through_mdf(tmp_path: Path) -> None:
    pytest.importorskip("asammdf", reason="needs the extra mf4")
    import can

    path = tmp_path / "unit.mf4"
    with can.Logger(path) as writer:
        writer.on_message_received(can.Message(1.7e9, 0x150, is_extended_id=True, data=b"\1\2", channel=3))
    messages, _ = decoded(path)
    assert messages["id"].tolist() == [EXTENDED | 0x150]
    assert messages.dtype == MESSAGE
