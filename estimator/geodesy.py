"""From WGS-84 to the plane tangent at an origin: east, north, up, with bounds."""

from dataclasses import dataclass
from math import hypot

import numpy as np
import pymap3d
from numpy.typing import NDArray

from drivers.samples import Fix

CONVERSION_SLACK_M = 1e-6
"""Rounding of the conversion through earth-centred coordinates: below 16 ulp of 6.4e6 m, a hundredth of this."""
SMALLEST_EARTH_RADIUS_M = 6.33e6
"""No radius of curvature of the ellipsoid is smaller."""


@dataclass(frozen=True, slots=True)
class TangentPlane:
    """Local east, north, up at one point of the WGS-84 ellipsoid."""

    lat_deg: float
    lon_deg: float
    alt_m: float

    def antenna(self, fix: Fix) -> NDArray[np.float64]:
        """[3, 2] the box (east, north, up) in metres that holds the antenna of a fix.

        The fix declares its bound along its own local axes; between them and the origin's lies an angle of about
        distance / radius (the azimuth turns by tan(lat) times that), by which the bounds of the axes mix.
        """
        centre = np.array(
            pymap3d.geodetic2enu(fix.lat_deg, fix.lon_deg, fix.alt_m, self.lat_deg, self.lon_deg, self.alt_m),
            dtype=np.float64,
        )
        steepness = abs(np.tan(np.radians(min(max(abs(fix.lat_deg), abs(self.lat_deg)), 89.99))))
        angle = hypot(centre[0], centre[1]) / SMALLEST_EARTH_RADIUS_M * (1.0 + steepness)
        bound = np.array(fix.bound_m) + sum(fix.bound_m) * 1.01 * angle + CONVERSION_SLACK_M
        return np.stack([centre - bound, centre + bound], axis=1)
