"""A pose known as a set: the outer box of all poses the robot may have had during a stretch of time."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Order of the six axes everywhere: metres in the map frame, then radians of R = Rz(yaw) Ry(pitch) Rx(roll)."""


class Status(StrEnum):
    """On whose word the pose set stands."""

    NOMINAL = "NOMINAL"
    """Of all sensors."""
    DEGRADED = "DEGRADED"
    """Each of the suspects in turn is left out."""
    LOST = "LOST"
    """No single sensor explains what was measured: on the declared limits of the robot's motion alone."""


@dataclass(frozen=True, slots=True)
class Guarantee:
    """Do the bounds hold? Intact until measurements contradicted their declared errors.

    The newest Guarantee also tells of all that came before it: a pose or a cell is promised if `covers` says so.
    """

    void_since_ns: int | None = None
    """Nothing that reaches this host time or a later one is promised, not even what was published before: as far back
    as the first fault is taken to have begun (docs/faults.md). None while intact."""
    sensor: str | None = None
    """Who contradicted, as `gps` or `tilt`: the likeliest of the suspects."""
    excess: float | None = None
    """By how much its bound would have to be wider for its measurement to agree."""
    unit: str | None = None
    """Of the excess."""
    status: Status = Status.NOMINAL
    """Now."""
    restored_ns: int | None = None
    """Since when the pose holds again, if the last fault was over by then (docs/faults.md); cells may be older."""
    contradicted_ns: int | None = None
    """Host time of the first measurement that contradicted; None while intact."""

    @property
    def intact(self) -> bool:
        """True while no measurement has contradicted its bound."""
        return self.void_since_ns is None

    def covers(self, earliest_ns: int, latest_ns: int) -> bool:
        """Is a pose of [earliest, latest] promised, whenever it was published?

        All of it before the doubt, or after the pose was restored (the latter if that fault was over by then).
        """
        if self.void_since_ns is None or latest_ns < self.void_since_ns:
            return True
        return self.restored_ns is not None and earliest_ns >= self.restored_ns


INTACT = Guarantee()


@dataclass(frozen=True, slots=True, eq=False)
class PlanarEllipsoid:
    """At the newest encoder reading, some time in [earliest_ns, latest_ns], the true v = (x, y, yaw) satisfies

    (v - centre)ᵀ shape⁻¹ (v - centre) <= 1.
    """

    earliest_ns: int
    latest_ns: int
    centre: NDArray[np.float64]
    """[3] metres, metres, radians (unwrapped)."""
    shape: NDArray[np.float64]
    """[3, 3]"""


@dataclass(frozen=True, slots=True, eq=False)
class BoundedPose:
    """At every instant of [earliest_ns, latest_ns] the true pose of base_link in the map frame is in [low, high].

    Axes as in AXES; yaw is unwrapped; bounds are outward rounded.
    """

    earliest_ns: int
    latest_ns: int
    low: NDArray[np.float64]
    """[6]"""
    high: NDArray[np.float64]
    """[6]"""
    guarantee: Guarantee = INTACT
    ellipsoid: PlanarEllipsoid | None = None
    """With `[filter] set = "ellipsoid"`: the set itself, at a time of its own; None while a fault lasts."""


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """Where the map frame stands on Earth, as a set.

    enu = [east, north, up] + Rz(yaw) map, with ENU tangent at the WGS-84 origin given here.
    """

    origin_lat_deg: float
    origin_lon_deg: float
    origin_alt_m: float
    low: NDArray[np.float64]
    """[4] east, north, up of the map's origin in metres, yaw in radians."""
    high: NDArray[np.float64]
    """[4]"""
    guarantee: Guarantee = INTACT
