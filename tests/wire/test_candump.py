"""Candump text both ways, against a second reader made of one regular expression."""

import re
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imudrv.errors import InputError
from imudrv.records import EXTENDED, MESSAGE, REJECT, Reason
from imudrv.wire.candump import LONGEST_LINE, MOST_CHANNELS, CandumpDecoder, format_candump

LINE = re.compile(
    rb"\((\d{1,10})\.(\d{1,9})\)[ \t\r]+([^\x00-\x20]+)[ \t\r]+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    rb"#(#[0-9A-Fa-f])?((?:[0-9A-Fa-f]{2})*)(?:[ \t\r]+[RT])?[ \t\r]*"
)


def record(t_ns: int, identifier: int, data: bytes, fd: bool = False) -> np.ndarray:
    message = np.zeros(1, MESSAGE)
    message["t_ns"], message["id"], message["length"], message["fd"] = t_ns, identifier, len(data), fd
    message["data"][0, : len(data)] = list(data)
    return message


def decoded(*pieces: bytes):
    """Messages and rejects of all pieces, the end included, with the accounting checked on the way."""
    messages, rejects, _ = decoded_channel(None, *pieces)
    return messages, rejects


def decoded_channel(channel: str | None, *pieces: bytes):
    """The same for a channel; with the number of messages of each channel in the log."""
    decoder = CandumpDecoder(channel)
    found = [decoder.feed(piece) for piece in pieces]
    assert decoder.bytes_fed == sum(map(len, pieces))
    found.append(decoder.close())
    assert decoder.pending == 0
    assert decoder.bytes_fed == sum(map(len, pieces))
    messages, rejects = zip(*found, strict=True)
    return np.concatenate(messages), np.concatenate(rejects), decoder.channels


def read_by_expression(text: bytes, wanted: bytes | None):
    """What `decoded_channel` should give; every byte of `text` is looked at in exactly one line."""
    messages, rejects = [np.zeros(0, MESSAGE)], []
    channels: dict[str, int] = {}
    offset = 0
    for line in re.findall(rb"[^\n]*\n|[^\n]+", text):
        content = line.removesuffix(b"\n")
        reason = Reason.NOT_A_MESSAGE if line.endswith(b"\n") else Reason.UNFINISHED
        match = LINE.fullmatch(content) if len(content) <= LONGEST_LINE else None
        if match is not None:
            seconds, fraction, channel, identifier, fd, digits = match.groups()
            data = bytes.fromhex(digits.decode())
            number = int(identifier, 16) + (EXTENDED if len(identifier) == 8 else 0)
            is_error = 0x20000000 <= number - EXTENDED <= 0x3FFFFFFF
            fits = is_error or int(identifier, 16) <= (0x7FF if len(identifier) == 3 else 0x1FFFFFFF)
            if fits and len(data) <= (64 if fd else 8) and int(seconds) < 9_223_372_035:
                if is_error:
                    rejects.append((offset, len(line), Reason.ERROR_FRAME))
                    offset += len(line)
                    continue
                t_ns = int(seconds) * 10**9 + int(fraction.ljust(9, b"0"))
                wanted = channel if wanted is None else wanted
                if channel == wanted:
                    messages.append(record(t_ns, number, data, fd is not None))
                name = channel.decode("ascii", "backslashreplace")
                channels[name] = channels.get(name, 0) + 1
            else:
                rejects.append((offset, len(line), reason))
        elif content.strip(b" \t\r") or len(content) > LONGEST_LINE:
            rejects.append((offset, len(line), reason))
        offset += len(line)
    return np.concatenate(messages), np.array(rejects, REJECT), channels


GOOD = b"(1700000000.123456) can0 150#0001FFFF02004000\n"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (GOOD, record(1_700_000_000_123_456_000, 0x150, bytes.fromhex("0001FFFF02004000"))),
        (
            b"(1.000000001) vcan-1 00000158##1abCD\r\n",
            record(1_000_000_001, EXTENDED | 0x158, b"\xab\xcd", fd=True),
        ),
        (b"(0.5) can0 1FFFFFFF#\n", record(500_000_000, EXTENDED | 0x1FFFFFFF, b"")),
        (b"(0000000012.000000)  can0\t7ff#00 R\n", record(12 * 10**9, 0x7FF, b"\0")),
        (b"(12.000000) can0 7FF#00 T\r\n", record(12 * 10**9, 0x7FF, b"\0")),
        (b"(12.0) c 001##0" + b"5A" * 64 + b"\n", record(12 * 10**9, 1, b"\x5a" * 64, fd=True)),
        (b"(12.0) c 001#01", record(12 * 10**9, 1, b"\1")),
    ],
)
def test_a_line_becomes_its_message(line, message):
    messages, rejects = decoded(line)
    assert np.array_equal(messages, message)
    assert rejects.size == 0


@pytest.mark.parametrize(
    "line",
    [
        b"(1700000000.123456) can0 150#R",
        b"(1700000000.123456) can0 150#R8",
        b"(1700000000.123456) can0 150#000",
        b"(1700000000.123456) can0 150#000102030405060708",
        b"(1700000000.123456) can0 158##1" + b"00" * 65,
        b"(1700000000.123456) can0 158##",
        b"(1700000000.123456) can0 1500#00",
        b"(1700000000.123456) can0 FFF#00",
        b"(1700000000.123456) can0 40000000#00",
        b"(1700000000.123456) can0 60000004#0008000000000000",
        b"(1700000000.123456) can0 20000004#000800000000000",
        b"(1700000000.123456) can0 150#00 X",
        b"(1700000000.123456) can0 150#00R",
        b"(1700000000.123456) can0150#00",
        b"(1700000000.123456)can0 150#00",
        b"(1700000000) can0 150#00",
        b"(.5) can0 150#00",
        b"(1.) can0 150#00",
        b"(99999999999.5) can0 150#00",
        b"(9999999999.5) can0 150#00",
        b"(1.0123456789) can0 150#00",
        b"1700000000.123456 can0 150#00",
        b"(1.0) " + b"c" * LONGEST_LINE + b" 150#00",
        b" " * (LONGEST_LINE + 1),
        b"\0\0\0\0",
        b"x",
    ],
)
def test_a_bad_line_is_one_reject_and_affects_no_other(line):
    text = GOOD + line + b"\n" + GOOD
    messages, rejects = decoded(text)
    assert messages.size == 2
    assert messages[0] == messages[1]
    assert rejects.tolist() == [(len(GOOD), len(line) + 1, Reason.NOT_A_MESSAGE)]


@pytest.mark.parametrize("identifier", [b"20000004", b"20000080", b"20000204", b"3fffffff"])
def test_an_error_frame_is_a_reject_of_its_own_reason(identifier):
    line = b"(1700000000.123456) can0 " + identifier + b"#0008000000000000"
    messages, rejects = decoded(line + b"\n" + GOOD + line)
    assert messages.size == 1
    assert rejects.tolist() == [
        (0, len(line) + 1, Reason.ERROR_FRAME),
        (len(line) + 1 + len(GOOD), len(line), Reason.ERROR_FRAME),
    ]


def test_the_same_number_with_11_and_with_29_bits_is_two_identifiers():
    messages, _ = decoded(b"(1.0) can0 150#00\n(1.0) can0 00000150#00\n")
    assert messages["id"].tolist() == [0x150, EXTENDED | 0x150]
    lines = format_candump(messages).splitlines()
    assert [line.split()[-1] for line in lines] == [b"150#00", b"00000150#00"]


def test_blank_lines_are_nothing():
    messages, rejects = decoded(b"\n\r\n \t\r\n" + GOOD + b"\n")
    assert (messages.size, rejects.size) == (1, 0)


def test_a_cut_last_line_is_unfinished():
    _, rejects = decoded(GOOD + GOOD[:30])
    assert rejects.tolist() == [(len(GOOD), 30, Reason.UNFINISHED)]


def test_a_line_without_end_is_not_kept():
    decoder = CandumpDecoder()
    decoder.feed(b"x" * 1000)
    tracemalloc.start()
    for _ in range(99):
        decoder.feed(b"x" * 1000)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 10_000, "a line of 100 kB, of which a few hundred bytes may stay"
    assert decoder.pending == 100_000
    messages, rejects = decoder.feed(b"\nx\n" + GOOD)
    assert messages.size == 1
    assert rejects.tolist() == [(0, 100_001, Reason.NOT_A_MESSAGE), (100_001, 2, Reason.NOT_A_MESSAGE)]


def test_written_messages_are_read_again():
    random = np.random.default_rng(1)
    messages = np.concatenate(
        [
            record(
                int(random.integers(0, 2**62)) // 1000 * 1000,
                int(random.integers(0, 0x800)) if i % 2 else EXTENDED | int(random.integers(0, 0x20000000)),
                random.bytes(random.integers(0, 65 if fd else 9)),
                fd,
            )
            for i in range(200)
            for fd in (False, True)
        ]
    )
    again, rejects = decoded(format_candump(messages, "can1"))
    assert rejects.size == 0
    assert np.array_equal(again, messages)


def test_written_text_is_what_candump_writes():
    classic = record(1_700_000_000_123_456_789, 0x150, bytes.fromhex("0001ffff02004000"))
    fd = record(5_000_001_000, EXTENDED | 0x18FF0001, b"\xab", fd=True)
    assert format_candump(classic) == GOOD
    assert format_candump(fd, "can1") == b"(0000000005.000001) can1 18FF0001##1AB\n"
    assert format_candump(classic[:0]) == b""


def test_what_a_log_cannot_hold_is_refused():
    with pytest.raises(InputError, match=r"message 1: expected a time from 1970 on, got -1 ns"):
        format_candump(np.concatenate([record(0, 1, b""), record(-1, 1, b"")]))
    for channel in ("", "can 0", "a" * 17, "can\n"):
        with pytest.raises(InputError, match="channel: expected 1 to 16 printable"):
            format_candump(record(0, 1, b""), channel)


LINES = st.one_of(
    st.just(GOOD),
    st.tuples(
        st.sampled_from([b"(1.5)", b"(9999999999.5)", b"(0001.123456789)", b"(1.)"]),
        st.sampled_from([b" can0 ", b"\tc\r ", b" ", b" c0" * 2]),
        st.sampled_from(
            [
                b"150#",
                b"7FF#",
                b"800#",
                b"00000150##1",
                b"1fffffff#",
                b"20000004#",
                b"40000000#",
                b"150##",
                b"15#",
            ]
        ),
        st.integers(0, 66)
        .flatmap(lambda n: st.binary(min_size=n, max_size=n))
        .map(lambda b: b.hex().encode()),
        st.sampled_from([b"\n", b" R\n", b"\tT \r\n", b"R\n", b" R T\n", b"0\n", b""]),
    ).map(b"".join),
    st.sampled_from(
        [b"\n", b" \r\n", b"x" * 300 + b"\n", b"x" * 255, b"(1.0) c 150#", b"00" * 9 + b" T\r\n"]
    ),
    st.binary(max_size=20),
    st.tuples(st.integers(0, len(GOOD) - 1), st.integers(0, 255)).map(
        lambda change: GOOD[: change[0]] + bytes([change[1]]) + GOOD[change[0] + 1 :]
    ),
)


@settings(deadline=None, max_examples=150)
@given(
    st.lists(LINES, max_size=8).map(b"".join),
    st.lists(st.integers(0, 600), max_size=6),
    st.sampled_from([None, "can0", "c", "can", "can00", ""]),
)
def test_any_text_in_any_pieces_gives_what_the_expression_gives(text, cuts, channel):
    edges = [0, *sorted(min(cut, len(text)) for cut in cuts), len(text)]
    pieces = [text[a:b] for a, b in pairwise(edges)]
    messages, rejects, channels = decoded_channel(channel, *pieces)
    wanted = None if channel is None else channel.encode()
    expected_messages, expected_rejects, expected_channels = read_by_expression(text, wanted)
    assert np.array_equal(messages, expected_messages)
    assert rejects.tolist() == expected_rejects.tolist()
    assert channels == expected_channels


def lines_of(*channels: str) -> bytes:
    """A message of each, numbered by its identifier."""
    return b"".join(format_candump(record(0, n, b""), channel) for n, channel in enumerate(channels))


def test_only_the_first_or_the_chosen_channel_is_decoded() -> None:
    log = lines_of("can1", "can0", "can1", "can10", "can", "can0")
    for channel, ids in ((None, [0, 2]), ("can1", [0, 2]), ("can0", [1, 5]), ("can", [4]), ("can2", [])):
        messages, rejects, channels = decoded_channel(channel, log)
        assert messages["id"].tolist() == ids
        assert rejects.size == 0
        assert channels == {"can1": 2, "can0": 2, "can10": 1, "can": 1}


def test_a_line_that_is_no_message_chooses_no_channel() -> None:
    messages, _, channels = decoded_channel(None, b"(1.0) can9 150#0\n" + lines_of("can0", "can0"))
    assert (messages.size, channels) == (2, {"can0": 2})


def test_a_log_of_more_channels_than_are_distinguished_is_counted_completely() -> None:
    names = [f"can{n}" for n in range(MOST_CHANNELS + 3)]
    messages, _, channels = decoded_channel("can2", lines_of(*names * 2))
    assert messages["id"].tolist() == [2, 2 + len(names)]
    assert channels.pop("others") == 6
    assert channels == dict.fromkeys(["can2", *names[:2], *names[3:MOST_CHANNELS]], 2)


def test_a_second_channel_is_refused_from_its_first_message_on_unless_one_was_chosen() -> None:
    chosen, open_to_any = CandumpDecoder("can0"), CandumpDecoder()
    for decoder in (chosen, open_to_any):
        for _ in range(3):
            decoder.feed(lines_of(*["can0"] * 1000))
            decoder.check_channel("any.log", "--channel ")
        assert decoder.feed(lines_of("can1"))[0].size == 0
    chosen.check_channel("any.log", "--channel ")
    for _ in range(2):
        with pytest.raises(
            InputError,
            match=r"any\.log: expected messages of one CAN channel, got those of can0 and can1; "
            "choose one, as with --channel can0",
        ):
            open_to_any.check_channel("any.log", "--channel ")
        open_to_any.feed(lines_of("can0"))


@pytest.mark.parametrize("channel", ["can2", "", "can 0", "can0\0", "\0", "c" * 1000, "\ud800"])
def test_a_channel_that_is_not_in_the_log_is_refused_at_its_end(channel: str) -> None:
    decoder = CandumpDecoder(channel)
    decoder.feed(lines_of("vcan3", "can1", "can0"))
    decoder.check_channel("any.log", "--channel ")  # it may still come
    decoder.close()
    with pytest.raises(InputError, match="got those of can0, can1 and vcan3"):
        decoder.check_channel("any.log", "--channel ")


def test_names_of_channels_cannot_control_a_terminal() -> None:
    decoder = CandumpDecoder()
    decoder.feed(b"(1.0) \x9b31m 150#00\n(1.0) \xe2\x80\xae 150#00\n")
    assert list(decoder.channels) == [r"\x9b31m", r"\xe2\x80\xae"]
