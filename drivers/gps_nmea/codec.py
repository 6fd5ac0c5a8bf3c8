"""NMEA 0183 sentences: read strictly, and written.

    $<talker><kind>,<field>,...*<checksum>        the checksum is the XOR of everything between $ and *

`float` would take nan, 1e400 and 4_8.0, so every field that is used has a pattern and a range of its own; a sentence
with a field outside them is refused whole. An empty field means that the receiver doesn't know.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from math import floor

SENTENCE = re.compile(rb"\$([^$*\r\n]{6,120})\*([0-9A-Fa-f]{2})")
"""A whole sentence; longer ones than the standard's 82 characters are in use."""
SENTENCE_BYTES = 1 + 120 + 3

_ADDRESS = re.compile(r"([A-Z]{2})([A-Z]{3})")
_TIME = re.compile(r"([01][0-9]|2[0-3])([0-5][0-9])([0-5][0-9]|60)(?:\.([0-9]{1,9}))?", re.ASCII)
_DATE = re.compile(r"([0-9]{2})([0-9]{2})([0-9]{2})", re.ASCII)
_LATITUDE = re.compile(r"([0-9]{2})([0-5][0-9](?:\.[0-9]{1,12})?)", re.ASCII)
_LONGITUDE = re.compile(r"([01][0-9]{2})([0-5][0-9](?:\.[0-9]{1,12})?)", re.ASCII)
_NUMBER = re.compile(r"-?[0-9]{1,8}(?:\.[0-9]{1,12})?", re.ASCII)

_MODE_QUALITY = {"N": 0, "A": 1, "D": 2, "P": 3, "R": 4, "F": 5, "E": 6, "M": 7, "S": 8}
"""GNS position modes as GGA qualities."""
_MINUTE_STEPS = 10**7
"""Seven decimals of a minute: 0.2 mm."""


class _BadField(ValueError):
    """A field that isn't what the standard says; never leaves this file."""


@dataclass(frozen=True, slots=True)
class TimeOfDay:
    """UTC; second 60 is a leap second."""

    hour: int
    minute: int
    second: int
    nanosecond: int

    def __str__(self) -> str:
        return f"{self.hour:02d}:{self.minute:02d}:{self.second:02d}.{self.nanosecond // 1_000_000:03d}"


@dataclass(frozen=True, slots=True)
class Position:
    """GGA or GNS: where the antenna is. None: the receiver doesn't say."""

    time: TimeOfDay | None
    lat_deg: float | None
    lon_deg: float | None
    quality: int
    hdop: float | None
    altitude_m: float | None
    """Above the geoid."""
    separation_m: float | None
    """Geoid above the ellipsoid."""


@dataclass(frozen=True, slots=True)
class ErrorEstimate:
    """GST: the receiver's own standard deviations, in metres."""

    time: TimeOfDay | None
    east_m: float | None
    north_m: float | None
    up_m: float | None


@dataclass(frozen=True, slots=True)
class Calendar:
    """RMC: the date that belongs to a time of day."""

    time: TimeOfDay | None
    date: date | None


@dataclass(frozen=True, slots=True)
class Dilution:
    """GSA: of the epoch that it stands in; it has no time of its own."""

    vdop: float | None


Sentence = Position | ErrorEstimate | Calendar | Dilution


def checksum(content: bytes) -> int:
    """XOR of all bytes between $ and *."""
    result = 0
    for byte in content:
        result ^= byte
    return result


def parse_content(content: bytes) -> tuple[str, Sentence | None] | None:
    """The kind of a sentence whose checksum was right, and what it says; None where a field is bad.

    (kind, None): a kind that isn't read, or an address that isn't of the standard's form.
    """
    address, *fields = content.decode("latin-1").split(",")
    match = _ADDRESS.fullmatch(address)
    kind = match.group(2) if match else ""
    reader = _READERS.get(kind)
    if reader is None:
        return kind, None
    try:
        return kind, reader(fields)
    except _BadField:
        return None


def serialise(content: str) -> bytes:
    """A sentence from what stands between $ and *."""
    return f"${content}*{checksum(content.encode()):02X}\r\n".encode()


def serialise_gga(position: Position, *, talker: str = "GN", satellites: int = 12) -> bytes:
    """GGA, minutes with 7 decimals, heights with 4."""
    lat, lon = _angle_text(position.lat_deg, 2, "NS"), _angle_text(position.lon_deg, 3, "EW")
    hdop, altitude = _number_text(position.hdop, 2), _number_text(position.altitude_m, 4)
    separation = _number_text(position.separation_m, 4)
    fix = f"{lat},{lon},{position.quality},{satellites:02d},{hdop}"
    return serialise(f"{talker}GGA,{_time_text(position.time)},{fix},{altitude},M,{separation},M,,")


def serialise_gst(errors: ErrorEstimate, *, talker: str = "GN") -> bytes:
    """GST; the error ellipse is left empty."""
    sigmas = ",".join(_number_text(sigma, 4) for sigma in (errors.north_m, errors.east_m, errors.up_m))
    return serialise(f"{talker}GST,{_time_text(errors.time)},,,,,{sigmas}")


def serialise_rmc(calendar: Calendar, position: Position, *, talker: str = "GN") -> bytes:
    """RMC without speed and course."""
    lat, lon = _angle_text(position.lat_deg, 2, "NS"), _angle_text(position.lon_deg, 3, "EW")
    day = calendar.date.strftime("%d%m%y") if calendar.date else ""
    status, mode = ("A", "R" if position.quality == 4 else "A") if position.quality else ("V", "N")
    return serialise(f"{talker}RMC,{_time_text(calendar.time)},{status},{lat},{lon},,,{day},,,{mode}")


def _read_gga(fields: Sequence[str]) -> Position:
    """time, lat, N/S, lon, E/W, quality, satellites, hdop, altitude, M, separation, M, age, station."""
    _expect(
        len(fields) == 14 and fields[5] in tuple("012345678") and fields[9] in ("M", "") and fields[11] in ("M", "")
    )
    return Position(
        time=_time(fields[0]),
        lat_deg=_angle(_LATITUDE, fields[1], fields[2], "NS", 90),
        lon_deg=_angle(_LONGITUDE, fields[3], fields[4], "EW", 180),
        quality=int(fields[5]),
        hdop=_number(fields[7], 0, 1000),
        altitude_m=_number(fields[8], -12_000, 100_000),
        separation_m=_number(fields[10], -200, 200),
    )


def _read_gns(fields: Sequence[str]) -> Position:
    """time, lat, N/S, lon, E/W, one mode letter a system, satellites, hdop, altitude, separation, age, station."""
    _expect(len(fields) in (12, 13) and fields[5] != "" and set(fields[5]) <= set(_MODE_QUALITY))
    return Position(
        time=_time(fields[0]),
        lat_deg=_angle(_LATITUDE, fields[1], fields[2], "NS", 90),
        lon_deg=_angle(_LONGITUDE, fields[3], fields[4], "EW", 180),
        quality=min((_MODE_QUALITY[mode] for mode in fields[5] if mode != "N"), default=0),
        hdop=_number(fields[7], 0, 1000),
        altitude_m=_number(fields[8], -12_000, 100_000),
        separation_m=_number(fields[9], -200, 200),
    )


def _read_gst(fields: Sequence[str]) -> ErrorEstimate:
    """time, rms, three of the error ellipse, sigma of latitude, of longitude, of altitude."""
    _expect(len(fields) == 8)
    north_m, east_m, up_m = (_number(field, 0, 1e6) for field in fields[5:8])
    return ErrorEstimate(_time(fields[0]), east_m, north_m, up_m)


def _read_rmc(fields: Sequence[str]) -> Calendar:
    """time, status, lat, N/S, lon, E/W, speed, course, date, ..."""
    _expect(9 <= len(fields) <= 13)
    return Calendar(_time(fields[0]), _date(fields[8]))


def _read_gsa(fields: Sequence[str]) -> Dilution:
    """mode, dimension, 12 satellites, pdop, hdop, vdop, perhaps the system."""
    _expect(len(fields) in (17, 18))
    return Dilution(_number(fields[16], 0, 1000))


_READERS: dict[str, Callable[[Sequence[str]], Sentence]] = {
    "GGA": _read_gga,
    "GNS": _read_gns,
    "GST": _read_gst,
    "RMC": _read_rmc,
    "GSA": _read_gsa,
}


def _expect(condition: bool) -> None:
    if not condition:
        raise _BadField


def _time(field: str) -> TimeOfDay | None:
    if not field:
        return None
    match = _TIME.fullmatch(field)
    if match is None:
        raise _BadField
    hour, minute, second, fraction = match.groups()
    return TimeOfDay(int(hour), int(minute), int(second), int((fraction or "0").ljust(9, "0")))


def _date(field: str) -> date | None:
    """ddmmyy, of the years 1980 to 2079."""
    if not field:
        return None
    match = _DATE.fullmatch(field)
    if match is None:
        raise _BadField
    day, month, year = map(int, match.groups())
    try:
        return date(year + (1900 if year >= 80 else 2000), month, day)
    except ValueError as error:
        raise _BadField from error


def _angle(pattern: re.Pattern[str], field: str, side: str, sides: str, limit_deg: int) -> float | None:
    if not field and not side:
        return None
    match = pattern.fullmatch(field)
    if match is None or len(side) != 1 or side not in sides:
        raise _BadField
    angle_deg = int(match.group(1)) + float(match.group(2)) / 60
    _expect(angle_deg <= limit_deg)
    return angle_deg if side == sides[0] else -angle_deg


def _number(field: str, low: float, high: float) -> float | None:
    if not field:
        return None
    _expect(_NUMBER.fullmatch(field) is not None)
    value = float(field)
    _expect(low <= value <= high)
    return value


def _time_text(time: TimeOfDay | None) -> str:
    if time is None:
        return ""
    return f"{time.hour:02d}{time.minute:02d}{time.second:02d}.{time.nanosecond // 10_000_000:02d}"


def _angle_text(angle_deg: float | None, degree_digits: int, sides: str) -> str:
    if angle_deg is None:
        return ","
    steps = floor(abs(angle_deg) * 60 * _MINUTE_STEPS + 0.5)
    degrees, steps = divmod(steps, 60 * _MINUTE_STEPS)
    minutes, decimals = divmod(steps, _MINUTE_STEPS)
    return f"{degrees:0{degree_digits}d}{minutes:02d}.{decimals:07d},{sides[angle_deg < 0]}"


def _number_text(value: float | None, decimals: int) -> str:
    return "" if value is None else f"{value:.{decimals}f}"
