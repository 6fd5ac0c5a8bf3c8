"""One drive with a sensor that breaks its bound: the demo's robot over open ground, every pose held against the truth.

RTK fixes of 5 cm at 10 Hz, 50 Hz inertial packets and counts, tilt at 10 Hz; all else stays within its bounds.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import cos, inf, pi, remainder, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.config import DevicesConfig
from drivers.samples import Fix, InertialSample, WheelTicks
from estimator.bounded_pose import BoundedPose
from estimator.config import FilterConfig, RobotConfig
from estimator.filter import Filter
from service.config import load
from service.robot_model import robot_model
from service.shipped import shipped_config
from simulator.errors import ErrorLaw
from simulator.open_ground import open_ground
from simulator.robot import STEP_NS
from simulator.sample_stream import Rates, sample_stream
from simulator.world import World

Array = NDArray[np.float64]
Reading = InertialSample | WheelTicks | Fix
Meddle = Callable[[Reading, float], Reading]
"""What becomes of a reading at a time of the drive (s)."""

START_NS = 1_000_000_000_000
RTK = (0.05, 0.05, 0.08)
RATES = Rates(steps_per_fix=5)


@dataclass(slots=True)
class FaultDrive:
    """What became of one drive."""

    filter: Filter
    world: World
    checks: int = 0
    false_ns: list[int] = field(default_factory=list)
    """Where the true pose was outside of the set, told or not."""
    untold: int = 0
    """... of sets that were called intact at the time;"""
    told: int = 0
    """... and that were called void."""
    told_ns: int | None = None
    """The newest reading when the filter first called its guarantee void;"""
    named: str | None = None
    """... and in whose name."""
    widths: list[Array] = field(default_factory=list)
    """[6] half-widths on Earth, in the second half of the drive."""
    on_earth: BoundedPose | None = None
    """The last."""

    @property
    def not_taken_back(self) -> int:
        """True poses outside of sets that the filter's last word still promises."""
        return sum(self.filter.guarantee.covers(time_ns, time_ns) for time_ns in self.false_ns)


def declared(bound_m: tuple[float, float, float] = RTK) -> tuple[RobotConfig, DevicesConfig]:
    """The demo's robot and sensors, with fixes of that bound."""
    config = load(shipped_config("demo.toml")).config
    gps = config.devices.gps
    assert gps is not None
    gps = replace(gps, rtk_fixed_horizontal_m=bound_m[0], rtk_fixed_vertical_m=bound_m[2])
    return replace(config.robot, max_speed_mps=1.2), replace(config.devices, gps=gps)


def settings(**changes: Any) -> FilterConfig:
    """The demo's, changed."""
    return replace(load(shipped_config("demo.toml")).config.filter, **changes)


@lru_cache(maxsize=8)
def world_of(law: str, seed: int, seconds: float, bound_m: tuple[float, float, float] = RTK) -> World:
    """A drive over open ground, errors by that law; it can be driven again and again, and making it takes seconds."""
    robot, devices = declared(bound_m)
    ground = open_ground(seed, 5.0, seconds)
    return World(ground, robot_model(robot), devices, ErrorLaw(law, seed), START_NS, seconds)


def drive(
    meddle: Meddle,
    config: FilterConfig,
    world: World,
    bound_m: tuple[float, float, float] = RTK,
    rates: Rates = RATES,
    until_s: float = inf,
) -> FaultDrive:
    """Drive with readings meddled with; a pose is asked for and held against the truth ten times a second.

    Not farther than `until_s` of the drive.
    """
    robot, devices = declared(bound_m)
    out = FaultDrive(Filter(robot, config, devices.encoders, devices.imu, devices.gps), world)
    start = world.pose(world.start_ns)
    for k, (now_ns, readings) in enumerate(sample_stream(world, bound_m, rates)):
        t_s = (now_ns - world.start_ns) * 1e-9
        if t_s > until_s:
            break
        for reading in readings:
            out.filter.accept(meddle(reading, t_s))
        guarantee = out.filter.guarantee
        if not guarantee.intact and out.told_ns is None:
            out.told_ns, out.named = now_ns, guarantee.sensor
        pose = out.filter.pose_over(now_ns, now_ns) if k % 5 == 4 else None
        if pose is None:
            continue
        out.checks += 1
        if not inside(world.pose(now_ns), start, pose.low, pose.high):
            out.false_ns.append(now_ns)
            out.untold += guarantee.intact
            out.told += not guarantee.intact
        if 2 * k * rates.step_ns > len(world.drive.pose) * STEP_NS:
            out.on_earth = out.filter.pose_on_earth(now_ns, now_ns) or out.on_earth
            if out.on_earth is not None:
                out.widths.append(0.5 * (out.on_earth.high - out.on_earth.low))
    return out


def inside(world_pose: Array, start: Array, low: Array, high: Array) -> bool:
    """Is the true pose, seen from the map frame, in the box? Yaw modulo a turn."""
    x, y, z = world_pose[:3] - start[:3]
    c, s = cos(start[5]), sin(start[5])
    middle = 0.5 * (low[5] + high[5])
    yaw = middle + remainder(world_pose[5] - start[5] - middle, 2 * pi)
    seen = np.array([c * x + s * y, c * y - s * x, z, world_pose[3], world_pose[4], yaw])
    return bool(np.all((low <= seen) & (seen <= high)))
