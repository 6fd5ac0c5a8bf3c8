"""SMF section 13's scenario: its robot, its declared bounds, its three classes of GPS; long drives over open ground."""

from dataclasses import dataclass, replace
from functools import lru_cache

from drivers.config import DevicesConfig, GpsConfig, ImuConfig
from estimator.config import FilterConfig, RobotConfig
from service.config import load
from service.robot_model import robot_model
from service.shipped import shipped_config
from simulator.errors import ErrorLaw
from simulator.open_ground import open_ground
from simulator.robot import GRAVITY_MPS2, rotations
from simulator.world import World

START_NS = 1_000_000_000_000

ROBOT = RobotConfig(
    name="reference",
    track_length_m=0.65,
    track_gauge_m=0.35,
    max_speed_mps=1.2,
    max_acceleration_mps2=0.65,
    max_turn_rate_dps=90.0,
    max_turn_acceleration_dps2=60.0,
    slip_ratio=0.05,
    lateral_slip_ratio=0.02,
    turning_centre_m=0.10,
    normal_slip_ratio=0.02,
)
IMU = ImuConfig(
    port="",
    latency_ms=(0.0, 0.0),
    clock_drift_ppm=0.0,
    gyro_bias_bound_dps=0.3,
    gyro_bias_drift_dps2=0.0001,
    gyro_noise_bound_dps=0.1,
    gyro_scale_bound=0.005,
    tilt_bound_deg=1.0,
    accel_bound_mps2=0.037,  # with the robot's own acceleration: 0.07 g
)
FILTER = FilterConfig(standstill_s=0.5, standstill_rate_dps=0.02)
"""As shipped; like the reference's (SMF 6.3) it learns the gyroscope's bias where the robot stands."""
NEVER_STILL = FilterConfig()


@dataclass(frozen=True, slots=True)
class GpsClass:
    """One of the reference's three receivers: half-widths, without and with velocity."""

    name: str
    horizontal_m: float
    vertical_m: float
    velocity_mps: float | None = None

    @property
    def bound_m(self) -> tuple[float, float, float]:
        """East, north, up."""
        return self.horizontal_m, self.horizontal_m, self.vertical_m

    @property
    def config(self) -> GpsConfig:
        """As the owner declares it; the antenna stands in base_link."""
        return GpsConfig(
            port="",
            latency_ms=(0.0, 0.0),
            gst_factor=5.0,
            range_error_m=5.0,
            floor_horizontal_m=0.0,
            floor_vertical_m=0.0,
            rtk_fixed_horizontal_m=self.horizontal_m,
            rtk_fixed_vertical_m=self.vertical_m,
            velocity_bound_mps=self.velocity_mps,
        )


GPS_CLASSES = (GpsClass("RTK", 0.05, 0.10), GpsClass("DGPS", 0.6, 1.2), GpsClass("SPS", 2.5, 5.0))
WITH_VELOCITY = (GpsClass("DGPS + velocity", 0.6, 1.2, 0.1), GpsClass("SPS + velocity", 2.5, 5.0, 0.1))
"""The reference doesn't tell its bound of the velocity; this is ours, east and north each."""


def devices(gps: GpsClass) -> DevicesConfig:
    """The reference's sensors; encoders of 0.2 mm a tick."""
    demo = load(shipped_config("demo.toml")).config.devices
    encoders = replace(demo.encoders, latency_ms=(0.0, 0.0))
    return DevicesConfig(laser=demo.laser, encoders=encoders, imu=IMU, gps=gps.config)


@lru_cache(maxsize=4)
def reference_world(gps: GpsClass, law: str, seed: int, seconds: float) -> World:
    """One drive. What an accelerometer feels beside gravity is drawn as the reference draws it: all of 0.07 g.

    Kept for the next filter that drives it.
    """
    slope_deg = (5.0, 7.0, 9.0)[seed % 3]
    ground, declared = open_ground(seed, slope_deg, seconds), devices(gps)
    felt = replace(declared.imu, accel_bound_mps2=IMU.accel_bound_mps2 + ROBOT.max_acceleration_mps2)
    world = World(ground, robot_model(ROBOT), replace(declared, imu=felt), ErrorLaw(law, seed), START_NS, seconds)
    world.drive = replace(world.drive, specific_force=GRAVITY_MPS2 * rotations(world.drive.pose)[:, 2, :])
    return world
