"""The check kernel against the standard library and against published check values."""

import binascii
import zlib
from typing import Any

import numpy as np
import pytest

from imudrv.wire.check import check_table, compute
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
