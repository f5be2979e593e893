"""The C header and the receiver built on it, fed live, against the numbers that were sent."""

import itertools
import re
import shutil
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from realtime import DEADLINE_S, free_port

import imudrv
from imudrv.records import INCREMENTS, Flag, Records, Source
from imudrv.wire.datagram import SIZE, encode

SHARE = Path(imudrv.__file__).parent / "share"
STRICT = ("-Wall", "-Wextra", "-Werror", "-std=c99", "-pedantic")

# ICD, section 7.
WORKED = bytes.fromhex(
    "49 35 30 4e 01 02 41 00 40 e2 01 00 40 42 0f 00 15 cd 85 3d fe 9c 97 17"
    "8d ed b5 a0 f7 c6 b0 3e 8d ed b5 a0 f7 c6 c0 be 54 e4 10 71 73 2a c9 3e"
    "00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 6e a3 01 bc 05 12 84 3f f2 8a 07 dd"
)

DECODE = r"""
#include <stdio.h>
#include "i50n.h"

/* Bytes on standard input; what became of them on standard output. */
int main(void)
{
    static uint8_t bytes[1025];
    struct i50n_sample s;
    const size_t n = fread(bytes + 1, 1, sizeof bytes - 1, stdin); /* at an odd address */
    const int result = i50n_decode(bytes + 1, n, &s);
    printf("%d", result);
    if (result == I50N_OK)
        printf(" %d %d %lu %lu %lld", s.source, s.flags, (unsigned long)s.counter,
               (unsigned long)s.interval_ns, (long long)s.t_ns);
    return 0;
}
"""


@pytest.fixture(scope="module")
def cc() -> str:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler called cc")
    return compiler


@pytest.fixture(scope="module")
def receiver(cc: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    program = tmp_path_factory.mktemp("c") / "i50n_receiver"
    subprocess.run([cc, *STRICT, "-o", program, SHARE / "i50n_receiver.c"], check=True)
    return program


@pytest.fixture(scope="module")
def decode(cc: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("c")
    (folder / "decode.c").write_text(DECODE)
    command = [cc, *STRICT, f"-I{SHARE}", "-o", folder / "decode", folder / "decode.c"]
    # Where the sanitizers are installed they see what a warning does not: overruns, unaligned access.
    sanitized = [*command, "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    if subprocess.run(sanitized, check=False, capture_output=True).returncode:
        subprocess.run(command, check=True)
    return folder / "decode"


def increments(count: int) -> Records:
    rng = np.random.default_rng(count)
    rows = np.zeros(count, INCREMENTS)
    rows["counter"] = (2**32 - 10 + np.arange(count)) % 2**32
    rows["interval_ns"] = 1_000_000 * rng.integers(1, 5, count)
    rows["t_ns"] = 1_700_000_000_000_000_000 + 1_000_000 * np.arange(count)
    rows["dtheta_b"] = rng.normal(size=(count, 3)) * 1e-6
    rows["dv_b"] = rng.normal(size=(count, 3)) * 1e-2
    rows["flags"] = rng.integers(0, 2**9, count)
    return rows


class Running:
    """A receiver that listens, and somebody who sends to it."""

    def __init__(self, program: Path, *arguments: str, quiet: bool = False) -> None:
        self._address = "127.0.0.1", free_port()
        options = ["-q"] if quiet else []
        self._process = subprocess.Popen(
            [program, *options, str(self._address[1]), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        assert self._process.stderr
        assert self._process.stderr.readline() == f"listening on 127.0.0.1:{self._address[1]}\n"

    def send(self, packet: bytes) -> None:
        self._sender.sendto(packet, self._address)

    def lines(self, interrupt: bool = False) -> list[str]:
        if interrupt:
            self._process.send_signal(signal.SIGINT)
        out, _ = self._process.communicate(timeout=DEADLINE_S)
        assert self._process.returncode == 0
        return out.splitlines()

    def first_line(self) -> str:
        assert self._process.stdout
        return self._process.stdout.readline()

    def close(self) -> None:
        self._sender.close()
        self._process.kill()
        self._process.communicate()


Start = Callable[..., Running]


@pytest.fixture
def running(receiver: Path) -> Iterator[Start]:
    started: list[Running] = []

    def start(*arguments: str, quiet: bool = False) -> Running:
        started.append(Running(receiver, *arguments, quiet=quiet))
        return started[-1]

    yield start
    for one in started:
        one.close()


def printed(rows: Records) -> list[str]:
    return [
        " ".join(
            [
                f"{row['counter']} {row['interval_ns']} {row['t_ns']} {row['flags']:04x}",
                *(f"{float(v):.17g}" for v in (*row["dtheta_b"], *row["dv_b"])),
            ]
        )
        for row in rows
    ]


def test_every_number_sent_live_is_printed_bit_for_bit(running: Start) -> None:
    sent = increments(200)
    one = running("200")
    for a, b in itertools.pairwise([*range(100), 112, 140, 200]):
        one.send(encode(sent[a:b], Source.SIMULATOR))
    lines = one.lines()
    assert lines == [*printed(sent), "received 200, lost 0, bad 0"]
    numbers = np.array([[float(n) for n in line.split()[4:]] for line in lines[:-1]])
    np.testing.assert_array_equal(numbers[:, :3], sent["dtheta_b"])
    np.testing.assert_array_equal(numbers[:, 3:], sent["dv_b"])


def test_lost_and_damaged_samples_are_counted(running: Start) -> None:
    sent = increments(30)
    damaged = bytearray(encode(sent[12:15], Source.HARDWARE))
    damaged[SIZE + 20] ^= 4  # of the middle one
    one = running("23", quiet=True)
    one.send(encode(sent[:8], Source.HARDWARE))
    one.send(b"")
    one.send(bytes(damaged))
    one.send(encode(sent[14:16], Source.HARDWARE))  # the first one comes twice
    one.send(encode(sent[9:10], Source.HARDWARE))  # late
    one.send(b"I50N")
    one.send(encode(sent[20:], Source.HARDWARE))
    # 8 to 11, 13, and 16 to 19 did not come in their turn.
    assert one.lines() == ["received 23, lost 9, bad 2"]


def test_a_restarted_unit_has_lost_nothing(running: Start) -> None:
    sent = increments(30)
    sent["counter"] = [*range(1000, 1020), *range(10)]
    one = running("30", quiet=True)
    one.send(encode(sent[:15], Source.HARDWARE))
    one.send(encode(sent[15:], Source.HARDWARE))
    assert one.lines() == ["received 30, lost 0, bad 0"]


def test_an_interrupt_ends_it_with_the_summary(running: Start) -> None:
    one = running()
    one.send(WORKED)
    assert one.first_line() == (
        "123456 1000000 1700000000123456789 0041 9.9999999999999995e-07 -1.9999999999999999e-06 "
        "3.0000000000000001e-06 0 0 0.0097999999999999997\n"
    )
    assert one.lines(interrupt=True) == ["received 1, lost 0, bad 0"]


@pytest.mark.parametrize(
    "arguments", [[], ["0"], ["port"], ["65536"], ["5005", "0"], ["5005", "1", "2"], ["-q"]]
)
def test_a_wrong_call_prints_the_usage(receiver: Path, arguments: list[str]) -> None:
    run = subprocess.run(
        [receiver, *arguments], check=False, capture_output=True, text=True, timeout=DEADLINE_S
    )
    assert (run.returncode, run.stderr) == (2, "usage: i50n_receiver [-q] PORT [COUNT]\n")


def result(program: Path, data: bytes) -> str:
    return subprocess.run(
        [program], input=data, check=True, capture_output=True, timeout=DEADLINE_S
    ).stdout.decode()


def number(name: str) -> str:
    """Of a result, as the header has it."""
    results = re.search(r"enum i50n_result \{(.*?)\}", (SHARE / "i50n.h").read_text())
    assert results
    return str(re.findall(r"I50N_\w+", results.group(1)).index(name))


def test_the_worked_datagram_of_the_icd_is_decoded(decode: Path) -> None:
    assert result(decode, WORKED) == f"0 2 {0x41} 123456 1000000 1700000000123456789"
    assert result(decode, WORKED + b"more").startswith("0 ")


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (b"", "I50N_TOO_SHORT"),
        (WORKED[:-1], "I50N_TOO_SHORT"),
        (b"i" + WORKED[1:], "I50N_BAD_MAGIC"),
        (WORKED[1:] + b"I", "I50N_BAD_MAGIC"),
        (WORKED[:4] + b"\2" + WORKED[5:], "I50N_BAD_VERSION"),
        (WORKED[:-1] + b"\0", "I50N_BAD_CRC"),
    ],
)
def test_an_invalid_datagram_is_reported_with_the_reason(decode: Path, data: bytes, name: str) -> None:
    assert result(decode, data) == number(name)


@pytest.mark.parametrize("at", range(5, SIZE, 7))
def test_one_changed_bit_is_detected(decode: Path, at: int) -> None:
    damaged = bytearray(WORKED)
    damaged[at] ^= 1 << at % 8
    assert result(decode, bytes(damaged)) == number("I50N_BAD_CRC")


def test_the_flags_are_those_of_the_driver() -> None:
    text = (SHARE / "i50n.h").read_text()
    found = {name: 1 << int(bit) for name, bit in re.findall(r"I50N_(\w+) = 1 << (\d+)", text)}
    assert found == {flag.name: flag.value for flag in Flag}


def test_the_header_is_cpp_too(tmp_path: Path) -> None:
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("needs a C++ compiler called c++")
    source = tmp_path / "uses.cpp"
    source.write_text(
        '#include "i50n.h"\nint main() { i50n_sample s; return i50n_decode(nullptr, 0, &s) != 1; }\n'
    )
    options = ["-Wall", "-Wextra", "-Werror", "-std=c++11", "-pedantic", f"-I{SHARE}"]
    subprocess.run([compiler, *options, "-o", tmp_path / "uses", source], check=True)
    subprocess.run([tmp_path / "uses"], check=True)
