"""The telegrams of a SICK LMS2xx beside the measured values: frame, requests and answers, both ways.

Command numbers and positions are those of LMS2XX sections 2, 4 and 5. A *payload* is what stands between LEN and the
checksum: command, data and, from the scanner, the status byte at its end.
"""

from dataclasses import dataclass
from enum import IntEnum

from drivers.checksums import lms_crc

STX = 0x02
ACK = 0x06
NAK = 0x15
FROM_SCANNER = 0x80
"""Added to address and command of everything the scanner sends."""

OVERHEAD = 6
"""Bytes of a frame beside its payload: STX, address, LEN, checksum."""
LONGEST_PAYLOAD = 808
LONGEST_REFLECTIVITY = 1640
"""F5h alone has two words a value: 401 of them, in five sub-ranges, and indices."""
HEADER = 7
"""Bytes that tell a frame's beginning (plausibility.py); no frame is shorter than 8."""

STATUS_OK = 0x10
SOURCE = 0x18
"""Status bits that tell which kind of scanner speaks; they never change."""


class Command(IntEnum):
    """Requests (section 4); the answer to each is its number + 80h."""

    RESET = 0x10
    MODE = 0x20
    SCAN = 0x30
    STATUS = 0x31
    ERRORS = 0x32
    COUNTERS = 0x35
    MEAN = 0x36
    SUB_RANGE = 0x37
    TYPE = 0x3A
    VARIANT = 0x3B
    SUB_RANGE_FIELDS = 0x3E
    SUB_RANGE_MEAN = 0x3F
    FAST_REFLECTIVITY = 0x44
    POWER_ON_RATE = 0x66
    READ_CONFIGURATION = 0x74
    REFLECTIVITY = 0x75
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
    STREAM_MEAN = 0x26
    STREAM_SUB_RANGE = 0x27
    STREAM_SUB_RANGE_MEAN = 0x28
    STREAM_SUB_RANGE_FIELDS = 0x29
    STREAM_PARTIAL = 0x2A
    STREAM_REFLECTIVITY = 0x2B
    TEST_PASSWORD = 0x30
    BAUD_38400 = 0x40
    BAUD_19200 = 0x41
    BAUD_9600 = 0x42
    BAUD_500000 = 0x48
    STREAM_FAST_REFLECTIVITY = 0x50


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
    return lms_crc(body, 0, len(body))


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

    @property
    def is_fast(self) -> bool:
        """Is it an LMS Fast (S14): 90 degrees at 0.5 degree, always?"""
        return "S14" in self.model

    @property
    def counts_hours(self) -> bool:
        """Does it know 35h, its operating hours?"""
        return self.model.startswith(("LMS211", "LMS221", "LMS291"))

    @property
    def power_on_variant(self) -> "Variant":
        """What it scans after it was switched on (section 5.2)."""
        if self.is_fast:
            return FAST
        return Variant(100 if self.model.startswith("LMS211") else 180, 50)


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """The parts of status telegram B1h that matter here (section 5.3)."""

    firmware: str
    serial: str
    operating_mode: int
    measuring_mode: int
    """Block D of the configuration."""
    angle_deg: int
    resolution_cdeg: int
    """1/100 degree."""
    baud: int | None
    """None for a word that the manual does not list."""
    unit: int
    """0 cm, 1 mm."""
    defective: bool = False
    """The scanner says so of itself."""

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
            defective=payload[9] > 0,
        )

    def serialise(self, status: int = STATUS_OK) -> bytes:
        """A B1h payload; what is not held here is that of a healthy scanner."""
        payload = bytearray(154)
        payload[0] = Command.STATUS.answer
        payload[1:8] = self.firmware.encode("ascii").ljust(7)[:7]
        payload[8] = self.operating_mode
        payload[9] = self.defective
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

    @classmethod
    def named(cls, name: str) -> "Variant":
        """From degrees as `180/0.5`."""
        angle, resolution = name.split("/")
        return cls(int(angle), round(100 * float(resolution)))

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
FAST = Variant(90, 50)
"""The only one of the LMS Fast, which does not know 3Bh."""
