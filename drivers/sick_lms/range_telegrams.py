"""Telegrams with measured values, both ways: whole and partial scans, sub-ranges, means, reflectivity.

LMS2XX section 6. Behind the command stand, little endian:

| telegram | layout before the indices and the status byte |
|---|---|
| B0 | count, values |
| B6 mean of n scans | n, count, values |
| B7 sub-range | first, last, count, values |
| BE sub-range with fields | first, last, count, values, and field values that are kept as they are |
| BF mean of a sub-range | n, first, last, count, values |
| C4 LMS Fast | count, values, and reflectivity that is kept as it is: WORD n, first, last, n bytes |
| F5 up to five sub-ranges | WORD n, n x (first, last, count of pairs, pairs of range and energy) |

n is a byte but in F5. Scan and telegram index follow where the configuration appends them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.sick_lms.telegrams import RANGES, STATUS_OK, Command

MOST_VALUES = 401
MEAN = Command.MEAN.answer
SUB_RANGE = Command.SUB_RANGE.answer
SUB_RANGE_FIELDS = Command.SUB_RANGE_FIELDS.answer
SUB_RANGE_MEAN = Command.SUB_RANGE_MEAN.answer
FAST_REFLECTIVITY = Command.FAST_REFLECTIVITY.answer
REFLECTIVITY = Command.REFLECTIVITY.answer

PLACED = frozenset((SUB_RANGE, SUB_RANGE_FIELDS, SUB_RANGE_MEAN))
"""Tell which values of the scan they hold."""
AVERAGED = frozenset((MEAN, SUB_RANGE_MEAN))
RANGE_COMMANDS = frozenset((RANGES, FAST_REFLECTIVITY, REFLECTIVITY)) | PLACED | AVERAGED
"""All telegrams with measured values."""
MOST_AVERAGED = 250
MOST_SUB_RANGES = 5
AT_ONCE = 0x8000
"""In the first value's number: partial scans, sent at once."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeTelegram:
    """Neighbouring measured values of a whole or a partial scan."""

    codes: NDArray[np.uint16]
    """[n] values as they came, flags included."""
    unit: int
    """0 cm, 1 mm; 2 was 10 cm on old types."""
    partial: bool = False
    """One mirror turn of an interlaced scan, always over 180 degrees."""
    quarter: int = 0
    """First angle of a partial scan, in quarters of a degree."""
    indices: tuple[int, int] | None = None
    """Scan index (counts mirror turns) and telegram index, where the configuration appends them."""
    status: int = STATUS_OK
    command: int = RANGES
    """First byte of the payload."""
    first: int = 1
    """Number of the first value in its scan, from 1."""
    averaged: int = 1
    """Scans that each value is the mean of."""
    rest: bytes = b""
    """What stands between the values and the indices: field values (BE) or reflectivity (C4)."""

    @classmethod
    def parse(cls, payload: bytes) -> "RangeTelegram":
        """From a payload that `layout_fits` accepts, other than F5."""
        command, status = payload[0], payload[-1]
        at, averaged, first = 1, 1, 1
        if command in AVERAGED:
            averaged, at = payload[at], at + 1
        if command in PLACED:
            first, at = _word(payload, at), at + 4
        word = _word(payload, at)
        count = word & 0x3FF
        behind = at + 2 + 2 * count
        end = _end_of_rest(payload, behind)
        return cls(
            codes=np.frombuffer(payload, "<u2", count, at + 2),
            unit=word >> 14,
            partial=bool(word & 0x2000),
            quarter=word >> 11 & 0x03,
            indices=(payload[end], payload[end + 1]) if len(payload) == end + 3 else None,
            status=status,
            command=command,
            first=first & ~AT_ONCE,
            averaged=averaged,
            rest=payload[behind:end],
        )

    @property
    def count_word(self) -> int:
        """Number of values, partial scan and unit in one word."""
        return count_word(len(self.codes), self.unit, self.partial, self.quarter)

    @property
    def last(self) -> int:
        """Number of the last value in its scan."""
        return self.first + len(self.codes) - 1

    def serialise(self) -> bytes:
        """A payload of any kind but F5."""
        data = bytearray((self.command,))
        if self.command in AVERAGED:
            data.append(self.averaged)
        if self.command in PLACED:
            data += _bytes(self.first | (AT_ONCE if self.partial else 0), self.last)
        data += _bytes(self.count_word) + self.codes.astype("<u2").tobytes() + self.rest
        return bytes(data) + bytes(self.indices or ()) + bytes((self.status,))


def parse_ranges(payload: bytes) -> list[RangeTelegram]:
    """The measured values of a payload that `layout_fits` accepts: one part, or one for each sub-range of F5."""
    if payload[0] != REFLECTIVITY:
        return [RangeTelegram.parse(payload)]
    parts, at = [], 3
    for _ in range(_word(payload, 1)):
        first, word = _word(payload, at), _word(payload, at + 4)
        count = word & 0x3FF
        pairs = np.frombuffer(payload, "<u2", 2 * count, at + 6)
        parts.append((first, word, pairs[::2]))
        at += 6 + 4 * count
    indices = (payload[at], payload[at + 1]) if len(payload) == at + 3 else None
    return [
        RangeTelegram(
            codes,
            word >> 14,
            bool(word & 0x2000),
            word >> 11 & 0x03,
            indices,
            payload[-1],
            command=REFLECTIVITY,
            first=first & ~AT_ONCE,
        )
        for first, word, codes in parts
    ]


def serialise_reflectivity(parts: list[RangeTelegram], energies: list[NDArray[np.uint16]]) -> bytes:
    """An F5 payload: each part with the energies [n] of its values; indices and status are those of the first part."""
    data = bytearray((REFLECTIVITY,)) + _bytes(len(parts))
    for part, energy in zip(parts, energies, strict=True):
        data += _bytes(part.first | (AT_ONCE if part.partial else 0), part.last, part.count_word)
        data += np.column_stack((part.codes, energy)).astype("<u2").tobytes()
    return bytes(data) + bytes(parts[0].indices or ()) + bytes((parts[0].status,))


def layout_fits(payload: bytes) -> bool:
    """Do counts, numbers of values and length of a payload with measured values agree?"""
    command, size = payload[0], len(payload)
    if command == REFLECTIVITY:
        return _reflectivity_fits(payload)
    at = 1
    if command in AVERAGED:
        if not 2 <= payload[at] <= MOST_AVERAGED:
            return False
        at += 1
    first = last = None
    if command in PLACED:
        first, last, at = _word(payload, at) & ~AT_ONCE, _word(payload, at + 2) & ~AT_ONCE, at + 4
    if size < at + 3:
        return False
    count = _word(payload, at) & 0x3FF
    if not 1 <= count <= MOST_VALUES:
        return False
    if first is not None and last is not None and not (first >= 1 and last - first + 1 == count):
        return False
    behind = at + 2 + 2 * count
    if command == FAST_REFLECTIVITY and size < behind + 7:
        return False
    end = _end_of_rest(payload, behind)
    return size - end in (1, 3) or (command == SUB_RANGE_FIELDS and size >= behind + 1)


def _reflectivity_fits(payload: bytes) -> bool:
    size, at = len(payload), 3
    if size < 4 or not 1 <= _word(payload, 1) <= MOST_SUB_RANGES:
        return False
    for _ in range(_word(payload, 1)):
        if size < at + 7:
            return False
        first, last = _word(payload, at) & ~AT_ONCE, _word(payload, at + 2) & ~AT_ONCE
        count = _word(payload, at + 4) & 0x3FF
        if not (1 <= count <= MOST_VALUES and first >= 1 and last - first + 1 == count):
            return False
        at += 6 + 4 * count
    return size - at in (1, 3)


def _end_of_rest(payload: bytes, behind: int) -> int:
    """Where the indices or the status byte begin, given where the values end."""
    match payload[0]:
        case Command.FAST_REFLECTIVITY.answer:
            return behind + 6 + _word(payload, behind)
        case Command.SUB_RANGE_FIELDS.answer:
            return len(payload) - 1
    return behind


def count_word(count: int, unit: int, partial: bool = False, quarter: int = 0) -> int:
    """The word before the values."""
    return count | quarter << 11 | partial << 13 | unit << 14


def _word(payload: bytes, at: int) -> int:
    return payload[at] | payload[at + 1] << 8


def _bytes(*words: int) -> bytes:
    return b"".join(word.to_bytes(2, "little") for word in words)
