"""The telegrams of a SICK LMS2xx beside the measured values: frame, requests and answers, both ways.

Command numbers and positions are those of LMS2XX sections 2, 4 and 5. A *payload* is what stands between LEN and the
checksum: command, data and, from the scanner, the status byte at its end.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from drivers.checksums import lms_crc

STX = 0x02
ACK = 0x06
NAK = 0x15
FROM_SCANNER = 0x80
"""Added to address and command of everything the scanner sends."""

OVERHEAD = 6
"""Bytes of a frame beside its payload: STX, address, LEN, checksum."""
LONGEST_PAYLOAD = 808
HEADER = 7
"""Bytes of a frame that `header_fits` looks at; no frame is shorter than 8."""

STATUS_OK = 0x10
SOURCE = 0x18
"""Status bits that tell which kind of scanner speaks; they never change."""


class Command(IntEnum):
    """Requests; the answer to each is its number + 80h."""

    RESET = 0x10
    MODE = 0x20
    SCAN = 0x30
    STATUS = 0x31
    ERRORS = 0x32
    COUNTERS = 0x35
    TYPE = 0x3A
    VARIANT = 0x3B
    READ_CONFIGURATION = 0x74
    WRITE_CONFIGURATION = 0x77

    @property
    def answer(self) -> int:
        """First byte of the answer's payload."""
        return self | FROM_SCANNER


POWER_ON = 0x90
RESETTING = 0x91
REFUSED = 0x92
RANGES = Command.SCAN.answer


class Mode(IntEnum):
    """First data byte of the mode command 20h (section 5.1)."""

    INSTALLATION = 0x00
    STREAM = 0x24
    STOP = 0x25
    STREAM_PARTIAL = 0x2A
    BAUD_38400 = 0x40
    BAUD_19200 = 0x41
    BAUD_9600 = 0x42
    BAUD_500000 = 0x48


BAUD_MODES = {
    9600: Mode.BAUD_9600,
    19200: Mode.BAUD_19200,
    38400: Mode.BAUD_38400,
    500000: Mode.BAUD_500000,
}
BAUD_WORDS = {500000: 0x8001, 38400: 0x8019, 19200: 0x8033, 9600: 0x8067}
"""Positions 116-117 of the status telegram."""
PASSWORD = b"SICK_LMS"


def request(payload: bytes, address: int = 0) -> bytes:
    """A frame to the scanner."""
    return _frame(address, payload)


def answer(payload: bytes) -> bytes:
    """A frame from the scanner; `payload` ends with the status byte."""
    return _frame(FROM_SCANNER, payload)


def _frame(address: int, payload: bytes) -> bytes:
    body = bytes((STX, address)) + len(payload).to_bytes(2, "little") + payload
    return body + checksum(body).to_bytes(2, "little")


def checksum(body: bytes) -> int:
    """The checksum that follows `body`."""
    return lms_crc(np.frombuffer(body, np.uint8), 0, len(body))


_LENGTHS = {
    POWER_ON: range(8, 65),
    RESETTING: range(2, 3),
    REFUSED: range(2, 3),
    Command.MODE.answer: range(3, 4),
    Command.STATUS.answer: range(132, 161),
    Command.TYPE.answer: range(8, 65),
    Command.VARIANT.answer: range(7, 8),
    Command.READ_CONFIGURATION.answer: range(32, 37, 2),  # 30, 32 or 34 bytes of record
    Command.WRITE_CONFIGURATION.answer: range(33, 38, 2),
}
"""Payload lengths of each answer but B0h, whose length follows from its count word."""

_UNASKED_LENGTHS = {
    Command.COUNTERS.answer: range(6, 7),
    Command.ERRORS.answer: range(2, LONGEST_PAYLOAD + 1, 2),
    0xB6: range(7, LONGEST_PAYLOAD + 1),  # mean values
    0xB7: range(8, LONGEST_PAYLOAD + 1),  # sub-range
    0xBE: range(8, LONGEST_PAYLOAD + 1),  # sub-range with fields
    0xBF: range(9, LONGEST_PAYLOAD + 1),  # mean of a sub-range
    0xC4: range(8, LONGEST_PAYLOAD + 1),  # ranges and reflectivity
    0xE6: range(3, 4),  # power-on rate
    0xF5: range(8, LONGEST_PAYLOAD + 1),  # ranges and reflectivity of sub-ranges
    0xFB: range(3, LONGEST_PAYLOAD + 1),  # configuration, part 2
    0xFC: range(3, LONGEST_PAYLOAD + 1),
}
"""Answers to requests that this driver never makes: recognised in recordings, and counted."""

UNASKED = frozenset(_UNASKED_LENGTHS)

_MOST_VALUES = 401


def header_fits(command: int, length: int, word: int) -> bool:
    """Can a frame begin with this command, LEN and the two bytes behind the command?"""
    if command == RANGES:
        values = word & 0x3FF
        return 1 <= values <= _MOST_VALUES and length - 2 * values in (4, 6)  # 6: with scan and telegram index
    return length in _LENGTHS.get(command, ()) or length in _UNASKED_LENGTHS.get(command, ())


def payload_fits(payload: bytes) -> bool:
    """Can this be a whole payload, status byte and all? What `header_fits` could not see yet."""
    return True


def status_fits(status: int) -> bool:
    """Can this be a status byte? Severity 0..4; source old scanner 00b, scanner 10b, special device 11b."""
    return status & 0x07 <= 4 and status & SOURCE != 0x08


@dataclass(frozen=True, slots=True)
class DeviceType:
    """Type string of 90h and BAh, as `LMS221;302063;V02.30 `."""

    text: str

    @classmethod
    def parse(cls, payload: bytes) -> "DeviceType":
        """From a 90h or BAh payload."""
        return cls(payload[1:-1].decode("ascii", "replace"))

    def serialise(self, command: int, status: int = STATUS_OK) -> bytes:
        """Payload of `command` (90h or BAh)."""
        return bytes((command,)) + self.text.encode("ascii") + bytes((status,))

    @property
    def model(self) -> str:
        """Type and number without the firmware."""
        return ";".join(self.text.split(";")[:2]).strip()


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """The parts of status telegram B1h that matter here (section 5.3)."""

    firmware: str
    serial: str
    operating_mode: int
    measuring_mode: int
    angle_deg: int
    resolution_cdeg: int
    """1/100 degree."""
    baud: int | None
    """None for a word that the manual does not list."""
    unit: int
    """0 cm, 1 mm."""

    @classmethod
    def parse(cls, payload: bytes) -> "DeviceStatus":
        """From a B1h payload."""

        def word(at: int) -> int:
            return int.from_bytes(payload[at : at + 2], "little")

        return cls(
            firmware=payload[1:8].decode("ascii", "replace").strip(),
            serial=payload[10:18].decode("ascii", "replace").strip(),
            operating_mode=payload[8],
            measuring_mode=payload[102],
            angle_deg=word(107),
            resolution_cdeg=word(109),
            baud={w: b for b, w in BAUD_WORDS.items()}.get(word(116)),
            unit=payload[122],
        )

    def serialise(self, status: int = STATUS_OK) -> bytes:
        """A B1h payload; what is not held here is that of a healthy scanner."""
        payload = bytearray(154)
        payload[0] = Command.STATUS.answer
        payload[1:8] = self.firmware.encode("ascii").ljust(7)[:7]
        payload[8] = self.operating_mode
        payload[10:18] = self.serial.encode("ascii").rjust(8, b"0")[:8]
        payload[67:69] = (148).to_bytes(2, "little")  # us for 1/90 of a mirror turn: 13.32 ms
        payload[83] = 100  # laser power, per cent
        payload[102] = self.measuring_mode
        payload[107:109] = self.angle_deg.to_bytes(2, "little")
        payload[109:111] = self.resolution_cdeg.to_bytes(2, "little")
        payload[111] = 2
        payload[116:118] = (BAUD_WORDS[self.baud] if self.baud else 0).to_bytes(2, "little")
        payload[118] = 2
        payload[122] = self.unit
        payload[123] = 1
        payload[124:131] = b"V01.00 "
        payload[153] = status
        return bytes(payload)


@dataclass(frozen=True, slots=True)
class Configuration:
    """The configuration record of 74h, 77h, F4h and F7h: 30, 32 or 34 bytes (section 5.5), kept as they are."""

    record: bytes

    @classmethod
    def parse(cls, payload: bytes) -> "Configuration":
        """From an F4h or F7h payload (F7h has a result byte before the record)."""
        return cls(payload[1 if payload[0] == Command.READ_CONFIGURATION.answer else 2 : -1])

    def serialise_write(self) -> bytes:
        """Payload of the request that writes this record to the EEPROM."""
        return bytes((Command.WRITE_CONFIGURATION,)) + self.record

    def serialise_read(self, status: int = STATUS_OK) -> bytes:
        """Payload of the scanner's answer F4h."""
        return bytes((Command.READ_CONFIGURATION.answer,)) + self.record + bytes((status,))

    def serialise_written(self, accepted: bool, status: int = STATUS_OK) -> bytes:
        """Payload of the scanner's answer F7h."""
        return bytes((Command.WRITE_CONFIGURATION.answer, accepted)) + self.record + bytes((status,))

    @property
    def appends_indices(self) -> bool:
        """Block C bit 1: scan and telegram index behind the values."""
        return bool(self.record[4] & 0x02)

    @property
    def measuring_mode(self) -> int:
        """Block D: how wide the distances are, and what the bits above them mean."""
        return self.record[5]

    @property
    def unit(self) -> int:
        """Block E: 0 cm, 1 mm."""
        return self.record[6]

    def with_format(self, measuring_mode: int, unit: int) -> "Configuration":
        """The same record with another measuring mode and unit."""
        return Configuration(self.record[:5] + bytes((measuring_mode, unit)) + self.record[7:])


@dataclass(frozen=True, slots=True)
class Variant:
    """Scanning angle and resolution: request 3Bh, answer BBh (section 5.2)."""

    angle_deg: int
    resolution_cdeg: int

    @classmethod
    def parse(cls, payload: bytes) -> "Variant":
        """From a 3Bh or BBh payload; BBh has a result byte before the words and the status behind."""
        at = 1 if payload[0] == Command.VARIANT else 2
        return cls(
            int.from_bytes(payload[at : at + 2], "little"),
            int.from_bytes(payload[at + 2 : at + 4], "little"),
        )

    def _words(self) -> bytes:
        return self.angle_deg.to_bytes(2, "little") + self.resolution_cdeg.to_bytes(2, "little")

    def serialise_request(self) -> bytes:
        """Payload of 3Bh."""
        return bytes((Command.VARIANT,)) + self._words()

    def serialise_answer(self, accepted: bool, status: int = STATUS_OK) -> bytes:
        """Payload of BBh."""
        return bytes((Command.VARIANT.answer, accepted)) + self._words() + bytes((status,))


VARIANTS = tuple(Variant(angle, res) for angle, res in ((180, 100), (180, 50), (100, 100), (100, 50), (100, 25)))
"""What 3Bh accepts: 180 degrees at 0.25 exists only as interlaced partial scans."""
