"""NMEA 0183 sentences: read strictly, and written.

    $<talker><kind>,<field>,...*<checksum>        the checksum is the XOR of everything between $ and *

Any talker is read (GP, GL, GA, GB, BD, GQ, QZ, GI, GN, II, IN...) but those of P, which are proprietary. A sentence
with a field outside its pattern or range (fields.py) is refused whole.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from functools import reduce
from operator import xor

from drivers.gps_nmea.fields import (
    Angle,
    BadField,
    TimeOfDay,
    expect,
    half_step,
    latitude,
    latitude_text,
    long_date,
    longitude,
    longitude_text,
    number,
    number_text,
    short_date,
    time_of_day,
    time_text,
    velocity,
    velocity_text,
    whole,
)

_CONTENT_BYTES = 400
"""The standard allows 82 characters; receivers with many decimals, and proprietary sentences above all, need more."""
SENTENCE = re.compile(rb"\$([^$*\r\n]{6,%d})\*([0-9A-Fa-f]{2})" % _CONTENT_BYTES)
"""A whole sentence."""
UNSUMMED = re.compile(rb"\$[A-OQ-Z][A-Z]{4},[^$*\r\n]{0,%d}(?=[\r\n])" % _CONTENT_BYTES)
"""A sentence as old receivers send it, without a checksum: nothing tells whether it arrived as it was sent."""
SENTENCE_BYTES = 1 + _CONTENT_BYTES + 3

_ADDRESS = re.compile(r"[A-OQ-Z][A-Z0-9]([A-Z]{3})")

_MODE_QUALITY = {"N": 0, "A": 1, "D": 2, "P": 3, "R": 4, "F": 5, "E": 6, "M": 7, "S": 8}
"""Position modes of GNS and RMC as GGA qualities."""
_WEAKEST_FIRST = (8, 7, 6, 1, 2, 3, 5, 4)


@dataclass(frozen=True, slots=True)
class Position:
    """GGA, GNS, or what RMC tells of it: where the antenna is. None: the receiver doesn't say."""

    time: TimeOfDay | None
    lat: Angle | None
    lon: Angle | None
    quality: int
    """As in GGA; 0: no position."""
    hdop: float | None = None
    altitude_m: float | None = None
    """Above the geoid."""
    separation_m: float | None = None
    """Geoid above the ellipsoid."""
    height_half_step_m: float = 0.0
    """Half steps of altitude and separation together."""
    satellites: int | None = None


@dataclass(frozen=True, slots=True)
class Minimum:
    """RMC: the recommended minimum. A void one has quality 0 in its position, whatever else it tells."""

    position: Position
    date: date | None
    velocity_mps: tuple[float, float] | None = None
    """East, north."""

    @property
    def time(self) -> TimeOfDay | None:
        """Its epoch."""
        return self.position.time


@dataclass(frozen=True, slots=True)
class ErrorEstimate:
    """GST: the receiver's own standard deviations, in metres."""

    time: TimeOfDay | None
    east_m: float | None
    north_m: float | None
    up_m: float | None


@dataclass(frozen=True, slots=True)
class Calendar:
    """ZDA: the date that belongs to a time of day. Some receivers tell that of the second to come."""

    time: TimeOfDay | None
    date: date | None


@dataclass(frozen=True, slots=True)
class Dilution:
    """GSA: of the epoch that it stands in; it has no time of its own."""

    dimension: int
    """1: no fix, 2: the height is held, 3: all is measured."""
    hdop: float | None
    vdop: float | None


@dataclass(frozen=True, slots=True)
class Velocity:
    """VTG: east and north, in m/s; it has no time of its own."""

    velocity_mps: tuple[float, float] | None


Sentence = Position | Minimum | ErrorEstimate | Calendar | Dilution | Velocity


def checksum(content: bytes) -> int:
    """XOR of all bytes between $ and *."""
    return reduce(xor, content, 0)


def parse_content(content: bytes) -> tuple[str, Sentence | None] | None:
    """Address of a sentence whose checksum was right, and what it says; None where a field is bad.

    (address, None): a kind that isn't read, or an address that isn't of the standard's form.
    """
    address, *fields = content.decode("latin-1").split(",")
    match = _ADDRESS.fullmatch(address)
    reader = _READERS.get(match.group(1)) if match else None
    if reader is None:
        return address, None
    try:
        return address, reader(fields)
    except BadField:
        return None


def serialise(content: str) -> bytes:
    """A sentence from what stands between $ and *."""
    return f"${content}*{checksum(content.encode()):02X}\r\n".encode()


def serialise_gga(at: Position, *, talker: str = "GN") -> bytes:
    """GGA, minutes with 7 decimals, heights with 4."""
    place = f"{latitude_text(at.lat)},{longitude_text(at.lon)}"
    used = "" if at.satellites is None else f"{at.satellites:02d}"
    heights = f"{number_text(at.altitude_m, 4)},M,{number_text(at.separation_m, 4)},M"
    return serialise(
        f"{talker}GGA,{time_text(at.time)},{place},{at.quality},{used},{number_text(at.hdop, 2)},{heights},,"
    )


def serialise_rmc(minimum: Minimum, *, talker: str = "GN") -> bytes:
    """RMC without magnetic variation."""
    at = minimum.position
    mode = next(letter for letter, quality in _MODE_QUALITY.items() if quality == at.quality)
    place = f"{latitude_text(at.lat)},{longitude_text(at.lon)}"
    speed, course = velocity_text(minimum.velocity_mps)
    day = minimum.date.strftime("%d%m%y") if minimum.date else ""
    status = "A" if at.quality else "V"
    return serialise(f"{talker}RMC,{time_text(at.time)},{status},{place},{speed},{course},{day},,,{mode}")


def serialise_gst(errors: ErrorEstimate, *, talker: str = "GN") -> bytes:
    """GST; the error ellipse is left empty."""
    sigmas = ",".join(number_text(sigma, 4) for sigma in (errors.north_m, errors.east_m, errors.up_m))
    return serialise(f"{talker}GST,{time_text(errors.time)},,,,,{sigmas}")


def serialise_gsa(dilution: Dilution, *, talker: str = "GN") -> bytes:
    """GSA without the satellites' numbers; position dilution as the two others give it."""
    both = (dilution.hdop, dilution.vdop)
    pdop = None if None in both else sum((value or 0.0) ** 2 for value in both) ** 0.5
    dops = ",".join(number_text(value, 2) for value in (pdop, *both))
    return serialise(f"{talker}GSA,A,{dilution.dimension}{',' * 12},{dops}")


def serialise_vtg(velocity_mps: tuple[float, float] | None, *, talker: str = "GN") -> bytes:
    """VTG; the speed in km/h is left empty."""
    speed, course = velocity_text(velocity_mps)
    return serialise(f"{talker}VTG,{course},T,,M,{speed},N,,K,A")


def serialise_zda(calendar: Calendar, *, talker: str = "GN") -> bytes:
    """ZDA, of the zone UTC."""
    day = calendar.date.strftime("%d,%m,%Y") if calendar.date else ",,"
    return serialise(f"{talker}ZDA,{time_text(calendar.time)},{day},00,00")


def _read_gga(fields: Sequence[str]) -> Position:
    """time, lat, N/S, lon, E/W, quality, satellites, hdop, altitude, M, separation, M, age, station."""
    expect(len(fields) == 14 and fields[5] in tuple("012345678") and fields[9] in ("M", "") and fields[11] in ("M", ""))
    return _position(fields[:5], int(fields[5]), (*fields[6:9], fields[10]))


def _read_gns(fields: Sequence[str]) -> Position:
    """time, lat, N/S, lon, E/W, one mode letter a system, satellites, hdop, altitude, separation, age, station, status.

    The weakest system's mode counts, of those that take part.
    """
    expect(len(fields) in (12, 13) and fields[5] != "" and set(fields[5]) <= set(_MODE_QUALITY))
    modes = {_MODE_QUALITY[mode] for mode in fields[5]}
    quality = next((quality for quality in _WEAKEST_FIRST if quality in modes), 0)
    return _position(fields[:5], quality, fields[6:10])


def _read_rmc(fields: Sequence[str]) -> Minimum:
    """time, status, lat, N/S, lon, E/W, speed, course, date, variation, E/W, perhaps mode, perhaps integrity.

    Since NMEA 2.3 a mode is told, before that any position was autonomous or differential.
    """
    expect(9 <= len(fields) <= 13 and fields[1] in ("A", "V"))
    mode = fields[11] if len(fields) > 11 else ""
    expect(mode == "" or mode in _MODE_QUALITY or mode == "V")
    quality = _MODE_QUALITY.get(mode, 1) if fields[1] == "A" else 0
    at = _position([fields[0], *fields[2:6]], quality)
    return Minimum(at, short_date(fields[8]), velocity(fields[6], fields[7]))


def _read_gst(fields: Sequence[str]) -> ErrorEstimate:
    """time, rms, three of the error ellipse, sigma of latitude, of longitude, of altitude."""
    expect(len(fields) == 8)
    north_m, east_m, up_m = (number(field, 0, 1e6) for field in fields[5:8])
    return ErrorEstimate(time_of_day(fields[0]), east_m, north_m, up_m)


def _read_gsa(fields: Sequence[str]) -> Dilution:
    """mode, dimension, 12 satellites, pdop, hdop, vdop, perhaps the system."""
    expect(len(fields) in (17, 18) and fields[1] in ("1", "2", "3"))
    return Dilution(int(fields[1]), number(fields[15], 0, 1000), number(fields[16], 0, 1000))


def _read_vtg(fields: Sequence[str]) -> Velocity:
    """true course, T, magnetic course, M, speed, N, speed, K, perhaps the mode."""
    expect(len(fields) in (8, 9) and fields[1] in ("T", "") and fields[5] in ("N", ""))
    return Velocity(velocity(fields[4], fields[0]))


def _read_zda(fields: Sequence[str]) -> Calendar:
    """time, day, month, year, hours and minutes of the local zone."""
    expect(4 <= len(fields) <= 6)
    return Calendar(time_of_day(fields[0]), long_date(*fields[1:4]))


def _position(place: Sequence[str], quality: int, rest: Sequence[str] = ("", "", "", "")) -> Position:
    """`place`: time, lat, N/S, lon, E/W; `rest`: satellites, hdop, altitude, separation."""
    satellites, hdop, altitude, separation = rest
    lat, lon = latitude(place[1], place[2]), longitude(place[3], place[4])
    # A receiver writes both with the same decimals. Two equal bytes that went missing from one don't change the XOR.
    expect(lat is None or lon is None or lat.half_step_deg == lon.half_step_deg)
    return Position(
        time=time_of_day(place[0]),
        lat=lat,
        lon=lon,
        quality=quality,
        hdop=number(hdop, 0, 1000),
        altitude_m=number(altitude, -12_000, 100_000),
        separation_m=number(separation, -200, 200),
        height_half_step_m=half_step(altitude) + half_step(separation),
        satellites=whole(satellites),
    )


_READERS: dict[str, Callable[[Sequence[str]], Sentence]] = {
    "GGA": _read_gga,
    "GNS": _read_gns,
    "RMC": _read_rmc,
    "GST": _read_gst,
    "GSA": _read_gsa,
    "VTG": _read_vtg,
    "ZDA": _read_zda,
}
