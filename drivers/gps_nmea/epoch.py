"""One epoch of a receiver: the sentences that belong to one instant, and the bounded position that they make."""

from collections import Counter
from dataclasses import dataclass, field
from datetime import date
from math import cos, inf, isfinite, nan, nextafter, radians
from typing import TypeAlias

from drivers.config import GpsConfig
from drivers.gps_nmea.codec import Dilution, ErrorEstimate, Minimum, Position, Velocity
from drivers.gps_nmea.fields import TimeOfDay
from drivers.samples import Fix, Stamp, Vector3

_MEASURED = (1, 2, 3, 4, 5)
"""Qualities of positions from satellites. Not 6: dead reckoning has no bound that could be known."""
_INVENTED = (7, 8)
"""Typed in, simulated: no measurements at all."""
_RTK_FIXED = 4
_LEAST_SATELLITES = 4
"""With fewer the height is not measured but held."""
_GEOID_LIMIT_M = 110.0
"""The geoid is nowhere further from the ellipsoid."""
_METRES_PER_DEGREE = 112_000.0
"""More than a degree of latitude anywhere, or of longitude at the equator, up to 10 km above the ellipsoid."""
_UNBOUNDED: Vector3 = (inf, inf, inf)

EpochSentence: TypeAlias = Position | Minimum | ErrorEstimate | Dilution | Velocity
"""What belongs to an instant."""


@dataclass(slots=True)
class Epoch:
    """The sentences of one instant."""

    time: TimeOfDay
    stamp: Stamp
    """When its first sentence was read."""
    position: Position | None = None
    """GGA or GNS."""
    minimum: Minimum | None = None
    errors: ErrorEstimate | None = None
    former_dilution: Dilution | None = None
    """The last that was told before: many receivers send GSA more rarely than the rest."""
    own_dilution: Dilution | None = None
    velocity: Velocity | None = None
    sentences: Counter[str] = field(default_factory=Counter)
    """Addresses that have come."""
    delivered: bool = False

    @property
    def dilution(self) -> Dilution | None:
        """As told last."""
        return self.own_dilution or self.former_dilution

    def attach(self, sentence: EpochSentence) -> None:
        """Take what a sentence says; of two positions (one a satellite system) the first with a fix stays."""
        match sentence:
            case Position():
                if self.position is None or self.position.quality == 0:
                    self.position = sentence
            case Minimum():
                if self.minimum is None or self.minimum.position.quality == 0:
                    self.minimum = sentence
            case ErrorEstimate():
                self.errors = sentence
            case Velocity():
                self.velocity = sentence
            case Dilution():
                self.own_dilution = worst(sentence, self.own_dilution)

    def outcome(self, config: GpsConfig, day: date | None) -> "Fix | str":
        """The fix; or the name of the count of why there is none: `no_position`, `no_fix`, `not_measured`.

        RMC's status is the receiver's last word: a position that it calls void is none. A position that nothing bounds
        is a fix with infinite half-widths, which a filter can't use and a person may want to see.
        """
        at, minimum = self.position, self.minimum
        if at is None and minimum is not None:
            at = minimum.position
        if at is None:
            return "no_position"
        if at.quality == 0 or at.lat is None or at.lon is None or (minimum and minimum.position.quality == 0):
            return "no_fix"
        if at.quality in _INVENTED:
            return "not_measured"
        velocity_mps = minimum.velocity_mps if minimum else None
        if velocity_mps is None and self.velocity is not None:
            velocity_mps = self.velocity.velocity_mps
        hdop = self._hdop(at)
        return Fix(
            stamp=self.stamp,
            utc=f"{day}T{self.time}Z" if day else None,
            lat_deg=at.lat.deg,
            lon_deg=at.lon.deg,
            alt_m=nan if at.altitude_m is None else at.altitude_m + (at.separation_m or 0.0),
            quality=at.quality,
            hdop=nan if hdop is None else hdop,
            bound_m=self._bound(at, at.lat.deg, config),
            ground_velocity_mps=velocity_mps,
        )

    def _hdop(self, at: Position) -> float | None:
        return at.hdop if at.hdop is not None or self.dilution is None else self.dilution.hdop

    def _bound(self, at: Position, lat_deg: float, config: GpsConfig) -> Vector3:
        """Half-widths (east, north, up): what the receiver and the owner vouch for, and half a step of the digits sent.

        From an RTK fixed solution's declared figure, else GST, else HDOP (and VDOP, where it is told). A zero from the
        receiver tells nothing. Where the height is held, its error is anything, and enters the others: only GST knows.
        """
        if at.quality not in _MEASURED:
            return _UNBOUNDED
        east = north = up = inf
        if (dop := self._hdop(at)) and self._is_measured_in_height(at):
            vdop = self.dilution.vdop if self.dilution is not None else None
            east = north = dop * config.range_error_m + config.floor_horizontal_m
            up = max(dop, vdop or 0.0) * config.range_error_m + config.floor_vertical_m
        errors = self.errors
        if errors is not None and errors.east_m and errors.north_m and errors.up_m:
            east = config.gst_factor * errors.east_m + config.floor_horizontal_m
            north = config.gst_factor * errors.north_m + config.floor_horizontal_m
            up = config.gst_factor * errors.up_m + config.floor_vertical_m
        if at.quality == _RTK_FIXED and config.rtk_fixed_horizontal_m is not None:
            east = north = config.rtk_fixed_horizontal_m
        if at.quality == _RTK_FIXED and config.rtk_fixed_vertical_m is not None:
            up = config.rtk_fixed_vertical_m
        if at.altitude_m is None:
            up = inf
        elif at.separation_m is None:
            up += _GEOID_LIMIT_M
        lat_step, lon_step = (angle.half_step_deg if angle else 0.0 for angle in (at.lat, at.lon))
        east += lon_step * _METRES_PER_DEGREE * cos(radians(max(abs(lat_deg) - lat_step, 0.0)))
        north += lat_step * _METRES_PER_DEGREE
        up += at.height_half_step_m
        return _outward(east), _outward(north), _outward(up)

    def _is_measured_in_height(self, at: Position) -> bool:
        if at.satellites is not None and at.satellites < _LEAST_SATELLITES:
            return False
        return self.dilution is None or self.dilution.dimension == 3


def worst(one: Dilution, other: Dilution | None) -> Dilution:
    """Of the GSA sentences of several satellite systems: the least that all of them vouch for."""
    if other is None:
        return one
    hdops = [value for value in (one.hdop, other.hdop) if value is not None]
    vdops = [value for value in (one.vdop, other.vdop) if value is not None]
    return Dilution(min(one.dimension, other.dimension), max(hdops, default=None), max(vdops, default=None))


def _outward(half_width: float) -> float:
    """Above what the sum of a few products and terms, each rounded to nearest, can have lost."""
    return nextafter(half_width * (1.0 + 2.0**-49), inf) if isfinite(half_width) else inf
