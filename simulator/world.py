"""The world as the devices feel it: the true motion over the true terrain, seen through bounded errors.

Its methods are the callbacks that the emulators ask for readings. Every error stays inside the bound that the
configuration declares, less half a step of what the wire can express:

    laser       range_bound_m less half a millimetre (centimetre); scan angle and mount up to their bounds
    gyroscope   noise bound less a step of a float32; bias and scale up to their bounds
    tilt, accel bound less a step of a float32
    GPS         half-widths less half a unit of NMEA's seventh decimal of a minute, and of the altitude's last decimal;
                velocity bound less half a unit of a thousandth of a knot and of a degree
    encoders    slip only (robot.py): the counter's own rounding is the declared quantisation

Times are true nanoseconds on the host's clock; the drive begins when `begin_drive` says so, before that the robot
stands still.
"""

from math import radians

import numpy as np
import pymap3d
from numpy.typing import NDArray

from drivers.compiled import compiled
from drivers.config import DevicesConfig, GpsConfig
from drivers.samples import Vector3
from simulator.errors import ErrorLaw, draw, wander
from simulator.motion_rows import between, hermite
from simulator.robot import STEP_NS, RobotModel, plan_drive, rotations
from simulator.shots import shoot
from simulator.terrain import Terrain
from simulator.truth import Truth

Array = NDArray[np.float64]

BEYOND_MAXIMUM_M = 1.0
"""The scanner sees a little farther than what the host uses."""
RANGE_MARGIN_M = {"mm": 0.0005, "cm": 0.005}
FLOAT32_STEP_GYRO_RPS = 2.0**-24
"""Half a float32 step of rates up to 1 rad/s is a quarter of this."""
FLOAT32_STEP_TILT_RAD = 2.0**-24
FLOAT32_STEP_ACCEL_MPS2 = 2.0**-19
NMEA_STEP_HORIZONTAL_M = 1e-4
"""Half of 1e-7 minutes of a great circle is 0.093 mm."""
NMEA_STEP_VERTICAL_M = 6e-4
"""Half a millimetre, and room for the sum with the geoid separation."""
NMEA_STEP_VELOCITY_MPS = 4e-4
"""Half a thousandth of a knot, and of a degree of course below 10 m/s."""


class World:
    """One robot driving over one terrain, from `start_ns` on."""

    def __init__(
        self,
        terrain: Terrain,
        robot: RobotModel,
        devices: DevicesConfig,
        law: ErrorLaw,
        start_ns: int,
        duration_s: float,
        origin: tuple[float, float, float] = (48.2, 11.6, 520.0),
    ) -> None:
        """Plan the drive of `duration_s`, standstill included; `origin` is the WGS-84 place of the world's origin."""
        self.terrain = terrain
        self.devices = devices
        self.law = law
        self.start_ns = start_ns
        self.origin = origin
        self.drive = plan_drive(robot, terrain, law, duration_s)
        self._drive_start_ns: int | None = None
        self._hit_times: list[NDArray[np.int64]] = []
        self._hits: list[Array] = []
        self._ranges: list[Array] = []
        self._prepare_laser()
        imu = devices.imu
        # Written so that the error is within gyro_scale_bound of both the true and the measured rate.
        scale = imu.gyro_scale_bound / (1.0 + imu.gyro_scale_bound)
        self._gyro_gain = np.array([1.0 + scale * law.channel(f"gyro.{a}.scale").level for a in "xyz"])
        self._gyro_bounds = (
            radians(imu.gyro_bias_bound_dps),
            radians(imu.gyro_bias_drift_dps2),
            max(radians(imu.gyro_noise_bound_dps) - FLOAT32_STEP_GYRO_RPS, 0.0),
        )
        self._gyro_keys = np.array([[law.channel(f"gyro.{a}{n}").key for n in (".bias", "")] for a in "xyz"])
        self._tilt_keys = law.channel("tilt.roll").key, law.channel("tilt.pitch").key
        self._accel_keys = [(law.channel(f"accel.{i}.x").key, law.channel(f"accel.{i}.y").key) for i in range(4)]
        self._law = law.channel("law").law
        self._gps = [law.channel(f"gps.{a}") for a in ("east", "north", "up")]
        self._course = [law.channel(f"gps.velocity.{a}") for a in ("east", "north")]
        self.rtk = devices.gps is not None and devices.gps.rtk_fixed_horizontal_m is not None
        """Does the receiver have an RTK fix? It has, if the owner vouches for one."""
        self.gst_sigma_m = (0.01, 0.01, 0.02) if self.rtk else (0.6, 0.6, 1.2)
        """What the receiver says of its errors (east, north, up)."""
        self._gps_bound = _fix_bound(devices.gps, self.gst_sigma_m) if devices.gps else (0.0, 0.0, 0.0)
        self._compile()

    def _compile(self) -> None:
        """Let all machine code be made now, not at the first reading."""
        t = self.start_ns
        self.measure(np.full(1, t), np.zeros(1))
        self.gyro(t - STEP_NS, t)
        self.tilt(t)
        self.accel(t, 0)
        self._hit_times, self._hits, self._ranges = [], [], []

    def _prepare_laser(self) -> None:
        laser = self.devices.laser
        shift = [self.law.channel(f"mount.{a}").level * laser.mount_position_bound_m for a in "xyz"]
        turn = [
            self.law.channel(f"mount.{a}").level * radians(laser.mount_angle_bound_deg)
            for a in ("roll", "pitch", "yaw")
        ]
        self.true_mount = np.array(
            [
                laser.mount_x_m + shift[0],
                laser.mount_y_m + shift[1],
                laser.mount_z_m + shift[2],
                radians(laser.mount_roll_deg) + turn[0],
                -radians(laser.mount_pitch_deg) + turn[1],  # the configuration's sign: negative looks down
                radians(laser.mount_yaw_deg) + turn[2],
            ]
        )
        """[6] the laser's true pose in base_link, within the mount bounds of the nominal one."""
        self._mount_rotation = np.ascontiguousarray(rotations(self.true_mount[np.newaxis])[0])
        self._range_channel = self.law.channel("laser.range")
        self._angle_channel = self.law.channel("laser.angle")
        self._across_channel = self.law.channel("laser.across")
        self._echo_channel = self.law.channel("laser.echo")
        self._range_bound = max(laser.range_bound_m - RANGE_MARGIN_M[laser.unit], 0.0)
        across_deg = laser.angle_bound_deg if laser.across_bound_deg is None else laser.across_bound_deg
        self._angle_bound, self._across_bound = radians(laser.angle_bound_deg), radians(across_deg)

    def begin_drive(self, t_ns: int) -> None:
        """The two seconds of standstill begin at `t_ns`; before, the robot has been standing at the same place."""
        self._drive_start_ns = t_ns

    @property
    def drive_end_ns(self) -> int | None:
        """When the drive is over; None until it has begun."""
        return None if self._drive_start_ns is None else self._drive_start_ns + self.drive.duration_ns

    def _into_drive(self, t_ns: int) -> int:
        """Nanoseconds since the drive began; 0 before."""
        return max(t_ns - self._drive_start_ns, 0) if self._drive_start_ns is not None else 0

    def pose(self, t_ns: int) -> Array:
        """[6] true pose in the world frame."""
        return between(self.drive.pose, self._into_drive(t_ns))

    # What the devices ask for.

    def measure(self, shot_times_ns: NDArray[np.int64], angles_rad: Array) -> Array:
        """Distances [n] of the beams, never NaN; +inf where nothing is within the configured maximum or little more."""
        times = np.ascontiguousarray(shot_times_ns, np.int64)
        ranges = np.empty(times.size)
        hits = np.empty((times.size, 3))
        terrain, laser = self.terrain, self.devices.laser
        drive_start = self._drive_start_ns if self._drive_start_ns is not None else int(times.max())
        shoot(
            self.drive.pose,
            times - drive_start,
            times - self.start_ns,
            np.ascontiguousarray(angles_rad, np.float64),
            self.true_mount,
            self._mount_rotation,
            terrain.heights,
            terrain.x0_m,
            terrain.y0_m,
            terrain.cell_m,
            terrain.boxes,
            laser.range_max_m + BEYOND_MAXIMUM_M,
            self._range_channel.law,
            self._range_channel.key,
            self._range_bound,
            self._angle_channel.key,
            self._angle_bound,
            self._across_channel.key,
            self._across_bound,
            terrain.lost_echoes,
            self._echo_channel.key,
            ranges,
            hits,
        )
        seen = np.isfinite(ranges)
        self._hit_times.append(times[seen])
        self._hits.append(hits[seen])
        self._ranges.append(ranges[seen])
        return ranges

    def count(self, t_ns: int) -> tuple[float, float]:
        """Fractional ticks of the left and right track counters."""
        left, right = between(self.drive.tracks, self._into_drive(t_ns))
        encoders = self.devices.encoders
        return float(left) / encoders.left_metres_per_tick, float(right) / encoders.right_metres_per_tick

    def gyro(self, t0_ns: int, t1_ns: int) -> Vector3:
        """Mean body rate between two times, rad/s, with bias, scale error and noise."""
        # Integrals of the body rates, by cubic Hermite interpolation (linear would cost a few 0.001 deg/s).
        return _mean_rates(
            self.drive.turned,
            self.drive.rate,
            self._into_drive(t0_ns),
            self._into_drive(t1_ns),
            (t1_ns - t0_ns) * 1e-9,
            t1_ns - self.start_ns,
            self._law,
            self._gyro_keys,
            self._gyro_gain,
            *self._gyro_bounds,
        )

    def tilt(self, t_ns: int) -> tuple[float, float]:
        """Roll and pitch, rad; pitch positive nose down."""
        bound = radians(self.devices.imu.tilt_bound_deg) - FLOAT32_STEP_TILT_RAD
        since = t_ns - self.start_ns
        return _two_readings(self.drive.pose, 3, self._into_drive(t_ns), since, self._law, *self._tilt_keys, bound)

    def accel(self, t_ns: int, sensor_id: int) -> tuple[float, float]:
        """Specific force along body x and y as the dual-axis accelerometer `sensor_id` gives it, m/s^2."""
        bound = self.devices.imu.accel_bound_mps2 - FLOAT32_STEP_ACCEL_MPS2
        force, since, keys = self.drive.specific_force, t_ns - self.start_ns, self._accel_keys[sensor_id]
        return _two_readings(force, 0, self._into_drive(t_ns), since, self._law, *keys, bound)

    def position(self, t_ns: int) -> tuple[float, float, float]:
        """WGS-84 latitude, longitude (degrees) and ellipsoidal height (m) of the antenna."""
        gps = self.devices.gps
        lever = np.array([gps.antenna_x_m, gps.antenna_y_m, gps.antenna_z_m]) if gps else np.zeros(3)
        pose, since = self.pose(t_ns), t_ns - self.start_ns
        antenna = pose[:3] + rotations(pose[np.newaxis])[0] @ lever
        shares = (channel.at(since) for channel in self._gps)
        east, north, up = (
            float(true + bound * share) for true, bound, share in zip(antenna, self._gps_bound, shares, strict=True)
        )
        lat, lon, alt = pymap3d.enu2geodetic(east, north, up, *self.origin)
        return float(lat), float(lon), float(alt)

    def ground_velocity(self, t_ns: int) -> tuple[float, float] | None:
        """The antenna's velocity east and north, m/s; None where the receiver's owner declares no bound for it."""
        gps = self.devices.gps
        if gps is None or gps.velocity_bound_mps is None:
            return None
        into, since = self._into_drive(t_ns), t_ns - self.start_ns
        lever = np.array([gps.antenna_x_m, gps.antenna_y_m, gps.antenna_z_m])
        swing = rotations(self.pose(t_ns)[np.newaxis])[0] @ np.cross(between(self.drive.rate, into), lever)
        east, north = (between(self.drive.velocity, into) + swing)[:2]
        bound = max(gps.velocity_bound_mps - NMEA_STEP_VELOCITY_MPS, 0.0)
        return float(east + bound * self._course[0].at(since)), float(north + bound * self._course[1].at(since))

    # What is true.

    def truth(self, end_ns: int) -> Truth:
        """Everything that was true from `start_ns` to `end_ns`, in the world frame."""
        drive_start = self._drive_start_ns if self._drive_start_ns is not None else end_ns
        before = max(-(-(drive_start - self.start_ns) // STEP_NS), 0)
        count = max(-(-(end_ns - drive_start) // STEP_NS) + 1, 2)
        rows = np.clip(np.arange(-before, count), 0, len(self.drive.pose) - 1)
        return Truth(
            pose_time_ns=drive_start + np.arange(-before, count, dtype=np.int64) * STEP_NS,
            pose=self.drive.pose[rows],
            hit_time_ns=np.concatenate([np.zeros(0, np.int64), *self._hit_times]),
            hit=np.concatenate([np.zeros((0, 3)), *self._hits]),
            hit_range_m=np.concatenate([np.zeros(0), *self._ranges]),
            scene=self.terrain.name,
            seed=self.terrain.seed,
            source=self.terrain.source,
            origin=self.origin,
        )


def _fix_bound(gps: GpsConfig, sigma_m: tuple[float, float, float]) -> tuple[float, float, float]:
    """Half-widths (east, north, up) of a fix, less what NMEA rounds away."""
    if gps.rtk_fixed_horizontal_m is not None:
        east = north = gps.rtk_fixed_horizontal_m
    else:
        east, north = (gps.gst_factor * sigma + gps.floor_horizontal_m for sigma in sigma_m[:2])
    if gps.rtk_fixed_vertical_m is not None:
        up = gps.rtk_fixed_vertical_m
    else:
        up = gps.gst_factor * sigma_m[2] + gps.floor_vertical_m
    return (
        max(east - NMEA_STEP_HORIZONTAL_M, 0.0),
        max(north - NMEA_STEP_HORIZONTAL_M, 0.0),
        max(up - NMEA_STEP_VERTICAL_M, 0.0),
    )


@compiled
def _two_readings(
    rows: Array, column: int, t_ns: int, since_ns: int, law: int, first_key: int, second_key: int, bound: float
) -> tuple[float, float]:
    """Two neighbouring columns of a 1 kHz table, each with an error within `bound`."""
    row = between(rows, t_ns)
    first, second = draw(law, first_key, since_ns), draw(law, second_key, since_ns)
    return row[column] + bound * first, row[column + 1] + bound * second


@compiled
def _mean_rates(
    turned: Array,
    rates: Array,
    t0_ns: int,
    t1_ns: int,
    seconds: float,
    since_ns: int,
    law: int,
    keys: NDArray[np.int64],
    gain: Array,
    bias_bound: float,
    bias_drift: float,
    noise: float,
) -> Vector3:
    """Mean body rates between two times of the drive; keys [3, 2] of bias and noise, gain [3] is 1 + scale error."""
    angles = hermite(turned, rates, t1_ns) - hermite(turned, rates, t0_ns)
    for axis in range(3):
        bias = wander(law, keys[axis, 0], since_ns, bias_bound, bias_drift)
        jitter = noise * draw(law, keys[axis, 1], since_ns)
        angles[axis] = angles[axis] / seconds * gain[axis] + bias + jitter
    return angles[0], angles[1], angles[2]
