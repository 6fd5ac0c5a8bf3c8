"""From WGS-84 to the plane tangent at an origin: east, north, up, with bounds."""

from dataclasses import dataclass
from math import hypot, radians, tan

import numpy as np
import pymap3d
from numpy.typing import NDArray

from drivers.samples import Fix, Frozen

CONVERSION_SLACK_M = 1e-6
"""Rounding of the conversion through earth-centred coordinates: below 16 ulp of 6.4e6 m, a hundredth of this."""
WGS84 = pymap3d.Ellipsoid.from_name("wgs84")
SMALLEST_EARTH_RADIUS_M = 6.33e6
"""No radius of curvature of the ellipsoid is smaller."""


@dataclass(frozen=True, slots=True)
class TangentPlane(Frozen):
    """Local east, north, up at one point of the WGS-84 ellipsoid."""

    lat_deg: float
    lon_deg: float
    alt_m: float

    def antenna(self, fix: Fix) -> NDArray[np.float64]:
        """[3, 2] the box (east, north, up) in metres that holds the antenna of a fix.

        The fix declares its bound along its own local axes; between them and the origin's lies an angle of about
        distance / radius (the azimuth turns by tan(lat) times that), by which the bounds of the axes mix.
        """
        east, north, height = pymap3d.geodetic2enu(
            fix.lat_deg, fix.lon_deg, fix.alt_m, self.lat_deg, self.lon_deg, self.alt_m, WGS84
        )
        steepness = abs(tan(radians(min(max(abs(fix.lat_deg), abs(self.lat_deg)), 89.99))))
        angle = hypot(east, north) / SMALLEST_EARTH_RADIUS_M * (1.0 + steepness)
        mixed = sum(fix.bound_m) * 1.01 * angle + CONVERSION_SLACK_M
        axes = zip((east, north, height), fix.bound_m, strict=True)
        return np.array([(middle - (bound + mixed), middle + (bound + mixed)) for middle, bound in axes])
