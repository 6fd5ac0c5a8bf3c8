"""The nouns: what every driver delivers and everything above it reads.

All are frozen, in SI units, with integer nanoseconds of the host's monotonic clock. A stamp is an interval that
contains the true time of acquisition. Frames: `laser` (x ahead, y left, z up at zero tilt), `base_link` (x ahead,
y left, z up; origin on the ground below the robot's centre).
"""

from dataclasses import dataclass
from math import nan
from typing import Self, TypeAlias

import numpy as np
from numpy.typing import NDArray


class Frozen:
    """What never changes is its own copy."""

    __slots__ = ()

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        return self


@dataclass(frozen=True, slots=True)
class Stamp(Frozen):
    """When something was acquired: surely not before `earliest_ns` and not after `latest_ns` (host monotonic)."""

    earliest_ns: int
    latest_ns: int

    def __post_init__(self) -> None:
        if self.earliest_ns > self.latest_ns:
            raise ValueError(f"stamp begins at {self.earliest_ns} ns, after its end at {self.latest_ns} ns")

    @property
    def mid_ns(self) -> int:
        """Middle of the interval: for ordering and for people, never for bounds."""
        return (self.earliest_ns + self.latest_ns) // 2

    def shifted(self, earlier_ns: int, later_ns: int) -> "Stamp":
        """This stamp with `earlier_ns` added to its beginning and `later_ns` to its end."""
        return Stamp(self.earliest_ns + earlier_ns, self.latest_ns + later_ns)


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One sweep of the laser.

    Beam i points at `angle_min_rad + i * angle_increment_rad` in the laser's x-y plane, counter-clockwise from
    the x axis (ahead), and was shot at `stamp` + `beam_offset_ns[i]`.
    """

    stamp: Stamp
    """Time of offset zero (not of reception)."""
    beam_offset_ns: NDArray[np.int64]
    """[n] time of each shot after the stamp; not always rising (interlaced scans)."""
    angle_min_rad: float
    angle_increment_rad: float
    ranges_m: NDArray[np.float64]
    """[n] distance; +inf where the device said "beyond maximum" (free space), NaN where it said nothing usable."""
    status: int
    """The device's status byte as it came."""


@dataclass(frozen=True, slots=True)
class WheelTicks(Frozen):
    """Track counters, unwrapped: they grow without end while the robot drives forward."""

    stamp: Stamp
    left: int
    right: int
    epoch: int = 0
    """Counts may be subtracted only within one epoch: it rises when the device rebooted or counts were lost."""


Vector3: TypeAlias = tuple[float, float, float]
ABSENT3: Vector3 = (nan, nan, nan)


@dataclass(frozen=True, slots=True)
class InertialSample(Frozen):
    """One inertial packet; axes the device does not measure are NaN. All axes are of base_link."""

    stamp: Stamp
    message: str
    """MAVLink message name, as HIGHRES_IMU or ATTITUDE."""
    sensor_id: int
    device_time_us: int | None
    """The board's own clock, the same one for all of its sensors; None where the message has none."""
    accel_mps2: Vector3 = ABSENT3
    """Specific force: (0, 0, +9.81) at rest on level ground."""
    gyro_rps: Vector3 = ABSENT3
    """Mean body rate since the previous packet of this sensor (the board integrates between packets)."""
    tilt_rad: tuple[float, float] = (nan, nan)
    """Roll and pitch; pitch is positive nose down (rotation about +y), roll positive right side down."""
    epoch: int = 0
    """Rises when the board rebooted: device times may be subtracted only within one epoch."""
    after_loss: bool = False
    """Packets of the board got lost since this sensor's last one: perhaps one of its own."""


@dataclass(frozen=True, slots=True)
class Fix(Frozen):
    """Where the GPS antenna was: WGS-84, with a declared half-width along each local axis."""

    stamp: Stamp
    utc: str | None
    """ISO 8601, for people; never used for bounds."""
    lat_deg: float
    lon_deg: float
    alt_m: float
    """Height above the WGS-84 ellipsoid."""
    quality: int
    """GGA quality: 1 autonomous, 2 differential, 4 RTK fixed, 5 RTK float."""
    hdop: float
    bound_m: Vector3
    """Half-widths (east, north, up): the true antenna is inside. Infinite where nothing tells one."""
    ground_velocity_mps: tuple[float, float] | None = None
    """(east, north) as the receiver states it, from its speed and course; used where the owner declares a bound."""


Sample: TypeAlias = Scan | WheelTicks | InertialSample | Fix
