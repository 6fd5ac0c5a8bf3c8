"""What can be told to be no telegram, beside the checksum, which is weak (LMS2XX section 2).

A header is judged as soon as its seven bytes are there, the whole payload once its last byte is.
"""

import re

from drivers.sick_lms.range_telegrams import (
    AT_ONCE,
    AVERAGED,
    FAST_REFLECTIVITY,
    MOST_AVERAGED,
    MOST_SUB_RANGES,
    MOST_VALUES,
    PLACED,
    RANGE_COMMANDS,
    REFLECTIVITY,
    SUB_RANGE_FIELDS,
    layout_fits,
)
from drivers.sick_lms.telegrams import (
    LONGEST_PAYLOAD,
    LONGEST_REFLECTIVITY,
    POWER_ON,
    RANGES,
    REFUSED,
    RESETTING,
    SOURCE,
    Command,
)

_LENGTHS = {
    POWER_ON: range(8, 65),
    RESETTING: range(2, 3),
    REFUSED: range(2, 3),
    Command.MODE.answer: range(3, 4),
    Command.STATUS.answer: range(132, 161),
    Command.ERRORS.answer: range(2, 259, 2),
    Command.COUNTERS.answer: range(6, 7),
    Command.TYPE.answer: range(8, 65),
    Command.VARIANT.answer: range(7, 8),
    Command.READ_CONFIGURATION.answer: range(32, 37, 2),  # 30, 32 or 34 bytes of record
    Command.WRITE_CONFIGURATION.answer: range(33, 38, 2),
}
"""Payload lengths of the answers that this driver asks for, but for B0h."""

_UNASKED_LENGTHS = {
    0xE6: range(3, 4),  # power-on rate
    0xFB: range(3, LONGEST_PAYLOAD + 1),  # configuration, part 2
    0xFC: range(3, LONGEST_PAYLOAD + 1),
}

UNASKED = (RANGE_COMMANDS - {RANGES}) | frozenset(_UNASKED_LENGTHS)
"""Answers to requests that this driver never makes; recordings may hold them."""

_COMMANDS = b"".join(b"\\x%02x" % command for command in sorted(RANGE_COMMANDS.union(_LENGTHS, UNASKED)))
HEADER_PATTERN = re.compile(b"\\x02\\x80[\\x00-\\xff][\\x00-\\x06][" + _COMMANDS + b"]")
"""Where a header can begin: STX, address, a LEN that is not too long, and a command that there is."""

_RESULTS = {Command.MODE.answer: 2, Command.VARIANT.answer: 1, Command.WRITE_CONFIGURATION.answer: 1}
"""Largest result byte of an answer."""
_TEXT = frozenset((POWER_ON, Command.TYPE.answer))
_PRINTABLE = bytes(range(0x20, 0x7F)) + b"\0"


def header_fits(command: int, length: int, word: int) -> bool:
    """Can a frame begin with this command, LEN and the two bytes behind the command?"""
    if command == RANGES:
        values = word & 0x3FF
        return 1 <= values <= MOST_VALUES and length - 2 * values in (4, 6)  # 6: with scan and telegram index
    if command in RANGE_COMMANDS:
        longest = LONGEST_REFLECTIVITY if command == REFLECTIVITY else LONGEST_PAYLOAD
        return length <= longest and _ranges_fit(command, length, word)
    return length in _LENGTHS.get(command, ()) or length in _UNASKED_LENGTHS.get(command, ())


def _ranges_fit(command: int, length: int, word: int) -> bool:
    if command in AVERAGED:
        return 2 <= word & 0xFF <= MOST_AVERAGED and length >= 7 and length % 2 == 1
    if command in PLACED:
        return 1 <= word & ~AT_ONCE <= MOST_VALUES and length >= 10 and (command == SUB_RANGE_FIELDS or length % 2 == 0)
    if command == FAST_REFLECTIVITY:
        values = word & 0x3FF
        return 1 <= values <= MOST_VALUES and length >= 10 + 2 * values
    return 1 <= word <= MOST_SUB_RANGES and length >= 4 + 10 * word


def payload_fits(payload: bytes) -> bool:
    """Can this be a whole payload, status byte and all? What `header_fits` could not see yet."""
    command = payload[0]
    if command in RANGE_COMMANDS:
        return layout_fits(payload)
    if command in _TEXT:
        return not payload[1:-1].translate(None, _PRINTABLE)
    return payload[1] <= _RESULTS.get(command, 0xFF)


def status_fits(status: int) -> bool:
    """Can this be a status byte? Severity 0..4; source old scanner 00b, scanner 10b, special device 11b."""
    return status & 0x07 <= 4 and status & SOURCE != 0x08
