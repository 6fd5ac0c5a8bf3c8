"""Where a saved map stands on Earth: the anchor's text, read; and the plane in which map programs can draw it.

The anchor is a set (docs/wire.md): ENU = (east, north, up) + Rz(yaw) map, tangent at a WGS-84 origin. A raster can have
one place only: the middle of the set. Its half-widths say by how much all of it may be shifted and turned.
"""

import json
from dataclasses import dataclass
from math import cos, isfinite, pi, radians, sin, sqrt

from mapper.saved_map import MapFileError, SavedMap

_A, _F = 6378137.0, 1 / 298.257223563
"""WGS-84: semi-major axis in metres, flattening."""


@dataclass(frozen=True, slots=True)
class Place:
    """The middle of an anchor, and how far it may be off."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    """Of the ENU origin, above the ellipsoid."""
    east_m: float
    north_m: float
    up_m: float
    yaw_rad: float
    half_widths: tuple[float, float, float, float]
    """east, north, up in metres, yaw in radians."""

    @property
    def scale(self) -> float:
        """Of the transverse Mercator plane at the origin that ENU metres fit: the plane lies `alt_m` above sea level.

        Distances in it are those in ENU but for d^3 / 6 R^2 (4 um at 1 km, 4 mm at 10 km), and 0.4 % of alt / R.
        """
        e2 = _F * (2 - _F)
        curvature = 1 - e2 * sin(radians(self.lat_deg)) ** 2
        gaussian_radius = _A * sqrt(1 - e2) / curvature
        return 1 + self.alt_m / gaussian_radius


def place_of(saved: SavedMap) -> Place | None:
    """The map's place; None where the anchor is unknown or unbounded. Raises MapFileError where it is no anchor."""
    if not saved.anchor:
        return None
    try:
        anchor = json.loads(saved.anchor)
        origin = [float(anchor[f"origin_{name}"]) for name in ("lat_deg", "lon_deg", "alt_m")]
        bounds = [*anchor["low"], *anchor["high"]]
        if len(anchor["low"]) != 4 or len(anchor["high"]) != 4:
            raise ValueError("low and high need four numbers each")
        if None in bounds:
            return None
        low, high = [float(b) for b in bounds[:4]], [float(b) for b in bounds[4:]]
        if not all(map(isfinite, origin + low + high)) or abs(origin[0]) > 90 or abs(origin[1]) > 360:
            raise ValueError("a number is out of range")
    except (ValueError, TypeError, KeyError) as error:
        raise MapFileError(f"the map's anchor can't be read ({error!r}): {saved.anchor[:200]}") from None
    middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    half = [(b - a) / 2 for a, b in zip(low, high, strict=True)]
    if half[3] > pi / 2:
        return None
    lat, lon, alt = origin
    return Place(lat, lon, alt, middle[0], middle[1], middle[2], middle[3], (half[0], half[1], half[2], half[3]))


def affine(saved: SavedMap, place: Place | None) -> tuple[float, float, float, float, float, float]:
    """(a, b, c, d, e, f): column and row from the top left corner to X = a col + b row + c, Y = d col + e row + f.

    X and Y are east and north of the ENU origin, or the map frame's x and y where the place is unknown. The raster's
    rows run downward from the map's last.
    """
    cell, (x, y) = saved.resolution_m, saved.origin_m
    top = y + cell * saved.low.shape[0]
    east, north, yaw = (0.0, 0.0, 0.0) if place is None else (place.east_m, place.north_m, place.yaw_rad)
    c, s = cos(yaw), sin(yaw)
    return c * cell, s * cell, east + c * x - s * top, s * cell, -c * cell, north + s * x + c * top
