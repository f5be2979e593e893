"""Printing in the background: nothing that happens to the output reaches the caller."""

import os
import re
from contextlib import suppress
from pathlib import Path

from realtime import until

from imudrv.service.printer import LIMIT, Printer


def test_lines_are_printed_complete_and_in_order(tmp_path: Path) -> None:
    with (tmp_path / "text").open("w", encoding="ascii") as text:
        with Printer(text) as printer:
            for n in range(LIMIT):
                printer.say(f"{n} µ")  # as far as the output knows the character
        assert printer.lost == 0
        assert not printer.notices()
    assert (tmp_path / "text").read_text().splitlines() == [f"{n} \\xb5" for n in range(LIMIT)]


def test_a_blocked_output_loses_the_oldest_lines_and_reports_their_number() -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, b"\n")  # until nothing goes in
    os.set_blocking(writer, True)
    said = [f"line {n:4d}" for n in range(3 * LIMIT)]
    with open(writer, "w") as text:
        printer = Printer(text)
        for line in said:
            printer.say(line)
        until(printer.notices, "a notice")
        (found,) = re.findall(r"accepts no text; .* waiting lines: (\d+), lost: (\d+)$", *printer.notices())
        waiting, lost = map(int, found)
        assert waiting + lost == len(said)
        assert waiting in (LIMIT, LIMIT + 1)  # it is late or early that the first line leaves the queue
        got = bytearray()
        while not got.endswith(f"{said[-1]}\n".encode()):
            got += os.read(reader, 1 << 16)
        until(lambda: not printer.notices(), "the end of the notice")
        assert printer.lost == lost
        printer.close()
    os.close(reader)
    lines = [line for line in got.decode().splitlines() if line]
    printed = [line for line in lines if line in said]
    notes = re.findall(r"\(lost lines: (\d+)\)", got.decode())
    assert len(printed) == waiting
    assert printed == sorted(printed)
    assert printed[-LIMIT:] == said[-LIMIT:]
    assert sum(map(int, notes)) == lost
    assert len(lines) == len(printed) + len(notes)


def test_an_output_that_fails_is_tried_again_with_each_line(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    reader = os.open(tmp_path / "fifo", os.O_RDONLY | os.O_NONBLOCK)
    with (tmp_path / "fifo").open("w") as text, Printer(text) as printer:
        os.close(reader)
        printer.say("nobody")
        printer.say("reads this")
        until(lambda: printer.lost == 2, "both lines lost")
        assert printer.failure.endswith("fifo: cannot be written: Broken pipe; lost lines: 2")
        assert printer.notices() == [printer.failure]
        reader = os.open(tmp_path / "fifo", os.O_RDONLY | os.O_NONBLOCK)
        printer.say("but this")
        until(lambda: not printer.notices(), "the line written")
        assert os.read(reader, 1000) == b"(lost lines: 2)\nbut this\n"
        os.close(reader)


def test_without_an_output_nothing_is_missed() -> None:
    with Printer(None) as printer:
        printer.say("to nobody")
    assert printer.lost == 0


def test_control_sequences_in_a_name_are_printed_as_text(tmp_path: Path) -> None:
    with (tmp_path / "text").open("w") as text, Printer(text) as printer:
        printer.say("port \x1b[2J\x07 not available")
    assert (tmp_path / "text").read_text() == "port \\x1b[2J\\x07 not available\n"
