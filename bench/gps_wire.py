"""The receiver's wire for the benches: NMEA sentences, and the driver that reads them."""

import functools
import operator
import re
from collections.abc import Callable, Hashable, Mapping
from datetime import datetime, timedelta
from random import Random

from drivers.config import GpsConfig
from drivers.gps_nmea.codec import (
    Dilution,
    ErrorEstimate,
    Minimum,
    Position,
    serialise,
    serialise_gga,
    serialise_gsa,
    serialise_gst,
    serialise_rmc,
    serialise_vtg,
)
from drivers.gps_nmea.fields import Angle, TimeOfDay
from drivers.gps_nmea.protocol import GpsProtocol
from drivers.samples import Fix

MS = 1_000_000
_SUMMED = re.compile(rb"\$([^$*\r\n]+)\*([0-9A-Fa-f]{2})")
_BEGIN = datetime(2024, 5, 1, 12)


def sentences(seed: int, count: int) -> list[tuple[bytes, Hashable]]:
    """GGA at 10 Hz, each an epoch of its own, with its place."""
    random = Random(seed)
    frames: list[tuple[bytes, Hashable]] = []
    for i in range(count):
        at = _position(i, random)
        frames.append((serialise_gga(at), _place(at)))
    return frames


def full_epochs(seed: int, count: int) -> bytes:
    """All that a receiver of four systems sends in each of `count` epochs."""
    random = Random(seed)
    stream = b""
    for i in range(count):
        at = _position(i, random)
        stream += serialise_rmc(Minimum(at, _BEGIN.date(), (0.3, 0.4))) + serialise_vtg((0.3, 0.4)) + serialise_gga(at)
        for talker in ("GP", "GL", "GA", "GB"):
            stream += serialise_gsa(Dilution(3, 0.7, 1.1), talker="GN")
            for part in (1, 2, 3):
                seen = ",".join(f"{random.randint(1, 99):02d},{random.randint(0, 90):02d},120,40" for _ in range(4))
                stream += serialise(f"{talker}GSV,3,{part},12,{seen},1")
        stream += serialise_gst(ErrorEstimate(at.time, 0.2, 0.2, 0.4))
    return stream


def protocol() -> GpsProtocol:
    """A driver."""
    return GpsProtocol(
        GpsConfig(
            port="",
            latency_ms=(0.0, 100.0),
            gst_factor=5.0,
            range_error_m=5.0,
            floor_horizontal_m=0.5,
            floor_vertical_m=1.0,
        )
    )


def driver() -> Callable[[bytes], list[Hashable]]:
    """A new one: bytes of a read in, the places that they complete out; b"" at the end."""
    host = protocol()
    return lambda data: [_place_of(fix) for fix in (host.receive_data(data, 0) if data else host.finish())]


def unseen(stream: bytes, sent: Mapping[bytes, Hashable]) -> set[Hashable]:
    """What sentences with a right checksum say that were never sent: an XOR can't tell."""
    known = {line.strip() for line in sent}
    passing = (
        match.group(0)
        for match in _SUMMED.finditer(stream)
        if match.group(0) not in known and functools.reduce(operator.xor, match.group(1), 0) == int(match.group(2), 16)
    )
    return {key for sentence in passing for key in _alone(sentence)}


def _alone(sentence: bytes) -> list[Hashable]:
    """What a sentence says by itself."""
    receive = driver()
    return [*receive(sentence + b"\r\n"), *receive(b"")]


def _position(i: int, random: Random) -> Position:
    utc = _BEGIN + timedelta(milliseconds=100 * i)
    time = TimeOfDay(utc.hour, utc.minute, utc.second, utc.microsecond * 1000)
    lat, lon = random.randint(-90 * 600_000, 90 * 600_000), random.randint(-180 * 600_000, 180 * 600_000)
    return Position(
        time,
        Angle(lat / 600_000),
        Angle(lon / 600_000),
        random.choice((1, 2, 4, 5)),
        round(random.uniform(0.5, 3.0), 2),
        random.randint(-4000, 90_000) / 10,
        random.randint(-1000, 800) / 10,
        satellites=random.randint(4, 30),
    )


def _place(at: Position) -> Hashable:
    assert at.lat is not None
    assert at.lon is not None
    assert at.altitude_m is not None
    assert at.separation_m is not None
    height_m = at.altitude_m + at.separation_m
    return round(at.lat.deg, 7), round(at.lon.deg, 7), round(height_m, 3), at.quality, at.hdop


def _place_of(fix: Fix) -> Hashable:
    return round(fix.lat_deg, 7), round(fix.lon_deg, 7), round(fix.alt_m, 3), fix.quality, fix.hdop
