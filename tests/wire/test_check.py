"""The check kernel against the standard library, published check values, and plain definitions."""

import binascii
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imudrv.wire.check import check_table, compute, compute_plain
from imudrv.wire.layout import Check, CheckKind


def check(kind: CheckKind, width: int, **parameters: Any) -> Check:
    """A check whose bytes are still to be set."""
    return Check(kind, width, (), 0, **parameters)


CCITT_FALSE = check(CheckKind.CRC, 16, polynomial=0x1021, init=0xFFFF)
CRC_32 = check(CheckKind.CRC_REFLECTED, 32, polynomial=0x04C11DB7, init=0xFFFFFFFF, xor_out=0xFFFFFFFF)

# Check values of "123456789": G. Cook, Catalogue of parametrised CRC algorithms (reveng.sourceforge.io).
PUBLISHED = {
    "CRC-16/IBM-3740 (CCITT-FALSE)": (CCITT_FALSE, 0x29B1),
    "CRC-16/XMODEM": (check(CheckKind.CRC, 16, polynomial=0x1021), 0x31C3),
    "CRC-16/MODBUS": (check(CheckKind.CRC_REFLECTED, 16, polynomial=0x8005, init=0xFFFF), 0x4B37),
    "CRC-16/KERMIT": (check(CheckKind.CRC_REFLECTED, 16, polynomial=0x1021), 0x2189),
    "CRC-8/SMBUS": (check(CheckKind.CRC, 8, polynomial=0x07), 0xF4),
    "CRC-8/MAXIM-DOW": (check(CheckKind.CRC_REFLECTED, 8, polynomial=0x31), 0xA1),
    "CRC-8/I-432-1": (check(CheckKind.CRC, 8, polynomial=0x07, xor_out=0x55), 0xA1),
    "CRC-32/ISO-HDLC (zlib)": (CRC_32, 0xCBF43926),
    "CRC-32/BZIP2": (
        check(CheckKind.CRC, 32, polynomial=0x04C11DB7, init=0xFFFFFFFF, xor_out=0xFFFFFFFF),
        0xFC891918,
    ),
    "CRC-10/ATM": (check(CheckKind.CRC, 10, polynomial=0x233), 0x199),
    "CRC-11/FLEXRAY": (check(CheckKind.CRC, 11, polynomial=0x385, init=0x01A), 0x5A3),
    "CRC-12/CDMA2000": (check(CheckKind.CRC, 12, polynomial=0xF13, init=0xFFF), 0xD4D),
    "CRC-12/DECT": (check(CheckKind.CRC, 12, polynomial=0x80F), 0xF5B),
    "CRC-14/DARC": (check(CheckKind.CRC_REFLECTED, 14, polynomial=0x0805), 0x082D),
    "CRC-15/CAN": (check(CheckKind.CRC, 15, polynomial=0x4599), 0x059E),
    "CRC-15/MPT1327": (check(CheckKind.CRC, 15, polynomial=0x6815, xor_out=1), 0x2566),
    "CRC-17/CAN-FD": (check(CheckKind.CRC, 17, polynomial=0x1685B), 0x04F03),
    "CRC-21/CAN-FD": (check(CheckKind.CRC, 21, polynomial=0x102899), 0x0ED841),
    "CRC-24/OPENPGP": (check(CheckKind.CRC, 24, polynomial=0x864CFB, init=0xB704CE), 0x21CF02),
    "CRC-24/BLE": (check(CheckKind.CRC_REFLECTED, 24, polynomial=0x00065B, init=0x555555), 0xC25A56),
    "CRC-31/PHILIPS": (
        check(CheckKind.CRC, 31, polynomial=0x04C11DB7, init=0x7FFFFFFF, xor_out=0x7FFFFFFF),
        0x0CE9E46C,
    ),
}


def check_value(described: Check, message: bytes, before: bytes = b"", behind: bytes = b"") -> int:
    """Check of `message`, which the kernel finds between the two others."""
    data = np.frombuffer(before + message + behind + bytes(8), np.uint8)
    return compute(data, len(before), check_table(described._replace(ranges=((0, len(message)),))))


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_published_check_values_are_computed(name):
    described, published = PUBLISHED[name]
    assert check_value(described, b"123456789") == published


def test_ccitt_false_and_crc_32_agree_with_the_standard_library_at_every_length_to_100():
    random = np.random.default_rng(5)
    for length in range(101):
        message = random.bytes(length)
        assert check_value(CCITT_FALSE, message) == binascii.crc_hqx(message, 0xFFFF)
        assert check_value(CRC_32, message) == zlib.crc32(message)


def test_neighbouring_bytes_do_not_matter():
    random = np.random.default_rng(6)
    for length in (0, 1, 7, 8, 9, 38):
        message = random.bytes(length)
        alone = check_value(CCITT_FALSE, message)
        assert check_value(CCITT_FALSE, message, before=random.bytes(3), behind=random.bytes(5)) == alone


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_prefix_counts_like_bytes_in_front(name):
    described, published = PUBLISHED[name]
    for split in range(10):
        prefixed = described._replace(prefix=b"123456789"[:split])
        assert check_value(prefixed, b"123456789"[split:]) == published


@pytest.mark.parametrize("width", [8, 16, 32])
def test_a_sum_is_that_of_the_bytes_modulo_its_width(width):
    random = np.random.default_rng(7)
    for length in (0, 1, 50, 100, 300):
        message = random.bytes(length)
        sums = check(CheckKind.SUM, width, init=3, xor_out=0x5A, prefix=b"\xff\x01")
        assert check_value(sums, message) == ((sum(message) + 3 + 0xFF + 1) % 2**width) ^ 0x5A


# First sum in the upper half of the value; the usual notation has it in the lower one.
FLETCHER = {
    "UBX-MON-VER, a poll (u-blox M8 protocol specification)": (16, 256, 1, bytes.fromhex("0a040000"), 0x0E34),
    "Fletcher-16 of abcde": (16, 255, 1, b"abcde", 0xF0C8),
    "Fletcher-16 of abcdef": (16, 255, 1, b"abcdef", 0x5720),
    "Fletcher-16 of abcdefgh": (16, 255, 1, b"abcdefgh", 0x2706),
    "Fletcher-32 of abcdef": (32, 65535, 2, b"abcdef", 0x2D2A5650),
    "Fletcher-32 of abcdefgh": (32, 65535, 2, b"abcdefgh", 0x9591EBE1),
}


@pytest.mark.parametrize("name", FLETCHER)
def test_the_published_fletcher_checks_are_computed(name: str) -> None:
    width, modulo, word, message, published = FLETCHER[name]
    assert check_value(check(CheckKind.FLETCHER, width, modulo=modulo, word=word), message) == published


def test_the_internet_checksum_of_rfc_1071_is_a_sum_of_words_in_ones_complement() -> None:
    words = check(CheckKind.SUM, 16, word=2, modulo=65535, big_endian=True)
    message = bytes.fromhex("0001 f203 f4f5 f6f7")
    assert check_value(words, message) == 0xDDF2
    assert check_value(words._replace(xor_out=0xFFFF), message) == 0x220D


def by_definition(c: Check, covered: bytes) -> int:
    """The value of a check, bit by bit and number by number."""
    mask = (1 << c.width) - 1
    order = "big" if c.big_endian else "little"
    numbers = [int.from_bytes(covered[k : k + c.word], order) for k in range(0, len(covered), c.word)]
    if c.kind is CheckKind.XOR:
        value = c.init
        for number in numbers:
            value ^= number
    elif c.kind is CheckKind.SUM:
        value = (c.init + sum(numbers)) % (c.modulo or mask + 1)
    elif c.kind is CheckKind.FLETCHER:
        modulo = c.modulo or 1 << (c.width // 2)
        first = second = 0
        for number in numbers:
            first = (first + number) % modulo
            second = (second + first) % modulo
        value = first << (c.width // 2) | second
    else:
        value = crc_by_definition(c, covered)
    return ((-value if c.negated else value) ^ c.xor_out) & mask


def crc_by_definition(c: Check, covered: bytes) -> int:
    """Polynomial division of the bits, first bit first; Williams, section 9."""
    is_reflected = c.kind is CheckKind.CRC_REFLECTED
    register = c.init
    for byte in covered:
        for k in range(8):
            bit = byte >> (k if is_reflected else 7 - k) & 1
            top = register >> (c.width - 1)
            register = register << 1 & ((1 << c.width) - 1)
            if bit != top:
                register ^= c.polynomial
    return int(f"{register:0{c.width}b}"[::-1], 2) if is_reflected else register


@st.composite
def checks(draw: st.DrawFn) -> Check:
    """Any check that a profile can describe, over ranges of the first 64 bytes."""
    kind = draw(st.sampled_from(CheckKind))
    word = draw(st.sampled_from([1, 2])) if kind in (CheckKind.SUM, CheckKind.FLETCHER) else 1
    width = {CheckKind.XOR: 8, CheckKind.FLETCHER: 16 * word}.get(kind) or draw(st.integers(8, 32))
    numbers = st.integers(0, (1 << width) - 1)
    edges = sorted(
        draw(st.lists(st.integers(0, 32), min_size=2, max_size=8).filter(lambda e: len(e) % 2 == 0))
    )
    around = st.binary(max_size=16).map(lambda b: b[: len(b) // word * word])
    is_plain_sum = kind in (CheckKind.SUM, CheckKind.FLETCHER)
    return Check(
        kind,
        width,
        tuple((2 * a, 2 * b) for a, b in zip(edges[::2], edges[1::2], strict=True)),
        0,
        big_endian=draw(st.booleans()),
        polynomial=draw(st.integers(1, (1 << width) - 1)),
        init=0 if kind is CheckKind.FLETCHER else draw(numbers),
        xor_out=draw(numbers),
        word=word,
        modulo=draw(st.sampled_from([0, 255, 251])) if is_plain_sum else 0,
        negated=draw(st.booleans()),
        prefix=draw(around),
        suffix=draw(around),
    )


@given(checks(), st.binary(min_size=64, max_size=64), st.integers(0, 5))
def test_any_check_of_any_ranges_has_the_value_of_its_definition(c: Check, data: bytes, before: int) -> None:
    covered = c.prefix + b"".join(data[a:b] for a, b in c.ranges) + c.suffix
    message = np.frombuffer(bytes(before) + data + bytes(8), np.uint8)
    expected = by_definition(c, covered)
    assert compute(message, before, check_table(c)) == expected
    if c.is_plain:
        assert compute_plain(message, before, check_table(c)) == expected
