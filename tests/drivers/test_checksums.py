"""The checksum against the manual's examples."""

import numpy as np
import pytest

from drivers.checksums import lms_crc

RECORD = "00 00 70 00 00 00 01 00 00 02 02" + " 00" * 21 + " 02 00"
TYPE = b"LMS200;301063;V02.10 ".hex(" ")
VECTORS = [
    ("02 00 01 00 10", "34 12"),
    ("02 00 01 00 31", "15 12"),
    ("02 00 01 00 32", "16 12"),
    ("02 00 01 00 35", "11 12"),
    ("02 00 01 00 3A", "1E 12"),
    ("02 00 01 00 74", "50 12"),
    ("02 00 01 00 7B", "5F 12"),
    ("02 00 02 00 20 24", "34 08"),
    ("02 00 02 00 20 25", "35 08"),
    ("02 00 02 00 20 40", "50 08"),
    ("02 00 02 00 20 41", "51 08"),
    ("02 00 02 00 20 42", "52 08"),
    ("02 00 02 00 20 48", "58 08"),
    ("02 00 02 00 30 01", "31 18"),
    ("02 00 02 00 36 02", "3E 1E"),
    ("02 00 02 00 66 00", "9C 4E"),
    ("02 00 05 00 3B B4 00 32 00", "3B 1F"),
    ("02 00 05 00 37 01 00 69 01", "EB 75"),
    ("02 00 05 00 44 01 00 B5 00", "68 37"),
    ("02 00 06 00 20 27 1B 00 2B 01", "FF FE"),
    ("02 00 07 00 75 01 00 01 00 91 01", "7D B6"),
    ("02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53", "BE C5"),
    ("02 00 0A 00 20 30 53 49 43 4B 5F 4C 4D 53", "EE F5"),
    ("02 00 23 00 77 " + RECORD, "11 88"),
    ("02 80 03 00 A0 00 10", "16 0A"),
    ("02 80 02 00 91 10", "79 30"),
    ("02 80 02 00 92 10", "7F 33"),
    ("02 80 02 00 B2 10", "3F 13"),
    ("02 80 06 00 B5 00 00 01 00 10", "04 42"),
    ("02 80 07 00 BB 01 B4 00 32 00 10", "03 9D"),
    (f"02 80 17 00 BA {TYPE} 10", "22 61"),
    (f"02 80 17 00 90 {TYPE} 10", "63 5E"),
    (f"02 80 25 00 F7 01 {RECORD} 10", "C5 7A"),
    (f"02 80 24 00 F4 {RECORD} 10", "3C FB"),
]


@pytest.mark.parametrize(("body", "crc"), VECTORS)
def test_lms_crc_equals_the_manuals_example(body: str, crc: str) -> None:
    """Every telegram of the manual that is not misprinted has this checksum."""
    data = bytes.fromhex(body)

    assert lms_crc(data, 0, len(data)).to_bytes(2, "little") == bytes.fromhex(crc)


def test_lms_crc_sees_every_single_bit_error() -> None:
    """One wrong bit anywhere changes the checksum."""
    rng = np.random.default_rng(1)
    data = rng.integers(0, 256, 370, dtype=np.uint8)
    right = lms_crc(data.tobytes(), 0, data.size)

    for bit in range(8 * data.size):
        wrong = data.copy()
        wrong[bit // 8] ^= 1 << bit % 8
        assert lms_crc(wrong.tobytes(), 0, wrong.size) != right


def test_lms_crc_equals_the_manuals_definition_bit_by_bit() -> None:
    """Any length, at any place of a buffer: as the register of the manual shifts, one byte after the other."""
    data = np.random.default_rng(2).integers(0, 256, 900, dtype=np.uint8)
    for start, end in [(0, n) for n in range(1, 40)] + [(7, 821), (1, 373), (88, 900), (5, 5)]:
        register = previous = 0
        for byte in data[start:end].tolist():
            register <<= 1
            if register & 0x10000:
                register = (register & 0xFFFF) ^ 0x8005
            register ^= previous << 8 | byte
            previous = byte
        assert lms_crc(data.tobytes(), start, end) == register
