"""A robot that nobody has built, drawn from a seed: its body, its ground and way, its sensors, and what is declared.

What the motion's limits are is declared after the drive (`declared`), as tight as the truth allows or wider: who
declares more than that has a wider set, never a wrong one.
"""

from dataclasses import dataclass, replace
from math import cos, inf, pi, radians, sin, tan
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.config import DevicesConfig, EncodersConfig, GpsConfig, ImuConfig
from estimator.config import FilterConfig, RobotConfig
from service.config import load
from service.shipped import shipped_config
from simulator.errors import LAWS, ErrorLaw
from simulator.robot import Drive, RobotModel
from simulator.terrain import Course, Manoeuvre, Terrain, smoothed

Array = NDArray[np.float64]
Clock = Literal["HIGHRES_IMU", "ATTITUDE", "none"]

CELL_M = 0.25
FIRST_REST_S = 2.0
"""Every simulated drive begins with so long a rest (simulator/robot.py)."""
DELAY_S = 0.5
LIMIT_FACTORS = (1.02, 1.2, 3.0)
"""What is declared of a limit, in what the drive attains."""


@dataclass(frozen=True, slots=True)
class Timing:
    """When a sensor reads, and how well the host knows it."""

    period_s: float
    jitter: float
    """Of the period, either way."""
    width_s: float
    """Of its stamps."""
    where: str
    """In its stamp the true time lies."""
    lost: float
    """Share of the readings."""
    silent_s: tuple[float, float]
    """From when to when it says nothing, after the beginning."""
    late_reads: bool
    """Are stamps now and then wider?"""


@dataclass(frozen=True, slots=True)
class Behaviour:
    """How the sensors are read, and what they do that the configuration doesn't tell."""

    begin_s: float
    """When the filter is switched on, after the drive's beginning."""
    start_ns: int
    """Host time then."""
    gyro: Timing
    tilt: Timing | None
    """None: in the gyroscope's packets, if at all."""
    ticks: Timing
    fixes: Timing
    clock: Clock
    clock_rate: float
    """Of the board's, in the host's."""
    clock_offset_us: int
    axes: tuple[bool, bool, bool]
    """Which of them the gyroscope measures;"""
    tells_tilt: tuple[bool, bool]
    tells_accel: tuple[bool, bool]
    counter_resets_s: float
    """When the counters begin anew;"""
    board_reboots_s: float
    """... and the inertial board."""
    fix_scales: float
    """The bounds of fixes vary up to so many times."""
    wrong_share: float
    gravity_mps2: float
    by_arrival: bool
    """Are readings handed over by the middles of their stamps, not by their ends?"""
    delayed: float
    """Share of the readings that are handed over late, by up to DELAY_S."""


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """All there is to one drive."""

    seed: int
    law: ErrorLaw
    model: RobotModel
    terrain: Terrain
    duration_s: float
    origin: tuple[float, float, float]
    devices: DevicesConfig
    filter: FilterConfig
    turning_gauge_m: tuple[float, float] | None
    tilt_rate_declared: bool
    behaviour: Behaviour


def random_robot(seed: int) -> Robot:
    """The robot of this seed."""
    random = np.random.default_rng(seed)
    law = ErrorLaw(LAWS[seed % len(LAWS)], seed)
    model = _body(random)
    duration_s = float(random.uniform(6.0, 18.0) if random.random() < 0.96 else random.uniform(40.0, 80.0))
    terrain = _ground(random, seed, model, duration_s)
    turning = model.turning_gauge_m
    if turning is None and random.random() < 0.4:
        turning = model.track_gauge_m, model.track_gauge_m
    latitude = float(random.choice([random.uniform(-70, 70), random.uniform(-89, 89), 0.0, -33.9, 85.0]))
    longitude = float(random.choice([random.uniform(-180, 180), 180.0, -180.0, 0.0]))
    origin = latitude, longitude, float(random.choice([0.0, -420.0, 520.0, 4800.0]))
    base = load(shipped_config("demo.toml")).config.devices
    gps = _gps(random) if random.random() < 0.75 else None
    devices = replace(base, encoders=_encoders(random, base.encoders), imu=_imu(random, base.imu), gps=gps)
    return Robot(
        seed, law, model, terrain, duration_s, origin, devices, _filter(random), turning, bool(random.random() < 0.4),
        _behaviour(random, duration_s),
    )  # fmt: skip


def declared(robot: Robot, drive: Drive) -> RobotConfig:
    """What the owner declares of the robot once it has driven so: nothing that the drive broke."""
    random = np.random.default_rng([robot.seed, 1])
    step = 1e-3
    own = drive.specific_force - _gravity(drive)

    def limit(attained: float, least: float) -> float:
        return max(float(random.choice(LIMIT_FACTORS)) * attained, least)

    rates = np.abs(drive.rate)
    model = robot.model
    return RobotConfig(
        name=f"robot{robot.seed}",
        track_length_m=model.track_length_m,
        track_gauge_m=model.track_gauge_m,
        max_speed_mps=limit(float(np.linalg.norm(drive.velocity, axis=1).max()), 0.01),
        max_acceleration_mps2=limit(float(max(np.abs(np.diff(drive.speed)).max() / step, np.abs(own).max())), 0.01),
        max_turn_rate_dps=limit(float(np.degrees(rates.max())), 0.1),
        max_turn_acceleration_dps2=limit(float(np.degrees(np.abs(np.diff(drive.rate, axis=0)).max()) / step), 0.1),
        slip_ratio=model.slip_ratio,
        lateral_slip_ratio=model.lateral_slip_ratio,
        turning_centre_m=model.turning_centre_m,
        turning_gauge_m=robot.turning_gauge_m,
        max_tilt_rate_dps=limit(float(np.degrees(rates[:, :2].max())), 0.1) if robot.tilt_rate_declared else None,
        normal_slip_ratio=model.normal_slip_ratio,
    )


def _gravity(drive: Drive) -> Array:
    """[N, 3] what a standing accelerometer would feel in place of the robot's own acceleration."""
    roll, pitch = drive.pose[:, 3], drive.pose[:, 4]
    return 9.80665 * np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])


def spread(random: np.random.Generator, least: float, most: float) -> float:
    """A positive number of any size between the two."""
    return float(np.exp(random.uniform(np.log(least), np.log(most))))


def _or_none(random: np.random.Generator, least: float, most: float, share: float = 0.25) -> float:
    """`spread`, or now and then 0."""
    return 0.0 if random.random() < share else spread(random, least, most)


def _body(random: np.random.Generator) -> RobotModel:
    gauge = spread(random, 0.2, 2.0)
    turning = None
    if random.random() < 0.6:
        least = gauge * float(random.choice([1.0, random.uniform(1.0, 1.5)]))
        turning = least, least * float(random.choice([1.0, random.uniform(1.0, 1.6)]))
    return RobotModel(
        track_length_m=gauge * float(random.uniform(1.0, 2.0)),
        track_gauge_m=gauge,
        max_speed_mps=inf,
        max_acceleration_mps2=inf,
        max_turn_rate_dps=inf,
        max_turn_acceleration_dps2=inf,
        slip_ratio=0.9 if random.random() < 0.03 else _or_none(random, 1e-3, 0.5),
        lateral_slip_ratio=_or_none(random, 1e-3, 0.5),
        turning_centre_m=_or_none(random, 1e-3, 0.5) * gauge,
        normal_slip_ratio=_or_none(random, 1e-3, 0.3),
        turning_gauge_m=turning,
        pulled=bool(random.random() < 0.5),
        sinks=bool(random.random() < 0.5),
    )


def _ground(random: np.random.Generator, seed: int, model: RobotModel, duration_s: float) -> Terrain:
    """A slope of up to 42 degrees with hills on it, and random moves."""
    cruise = spread(random, 0.15, 4.0) * model.track_length_m
    reach = cruise * duration_s + 2.0 * model.track_length_m + 2.0
    half = reach + 1.0
    count = round(2.0 * half / CELL_M) + 1
    heights: Array = np.zeros((count, count))
    if random.random() < 0.8:
        for wavelength_m, share in ((6.0, 1.0), (2.0, 0.3)):
            wavelength_m *= max(model.track_length_m, 0.5)
            hills = smoothed(random.standard_normal((count, count)), 0.25 * wavelength_m / CELL_M)
            heights += share * hills / max(float(hills.std()), 1e-9)
        slopes = np.gradient(heights, CELL_M)
        rough = tan(radians(spread(random, 0.5, 12.0)))
        heights *= rough / np.sqrt(np.mean(slopes[0] ** 2 + slopes[1] ** 2))
    if random.random() < 0.5:
        steep, to = tan(radians(float(random.uniform(0.0, 42.0)))), float(random.uniform(-pi, pi))
        line = -half + CELL_M * np.arange(count)
        heights = heights + steep * (cos(to) * line[np.newaxis, :] + sin(to) * line[:, np.newaxis])
    course = Course(
        0.0,
        0.0,
        float(random.choice([random.uniform(-pi, pi), pi, -0.5 * pi])),
        straight_m=1e9,
        circle_radius_m=1.0,
        weave_rad=float(random.choice([0.0, random.uniform(0.0, 0.6)])),
        weave_length_m=model.track_length_m * float(random.uniform(4.0, 15.0)),
        cruise_mps=cruise,
        manoeuvres=tuple(_moves(random, duration_s, cruise, (model.turning_gauge_m or (model.track_gauge_m,))[-1])),
        manoeuvre_ramp_s=spread(random, 0.15, 1.5),
        reach_m=reach,
    )
    return Terrain("random", seed, heights, -half, -half, CELL_M, np.zeros((0, 6)), course)


def _moves(random: np.random.Generator, duration_s: float, cruise_mps: float, gauge_m: float) -> list[Manoeuvre]:
    """Forward, back, round on the spot or about a track, both at once, or nothing."""
    moves, elapsed = [], 0.0
    while elapsed < duration_s:
        lasts_s = float(random.uniform(0.5, 6.0))
        kind = random.random()
        speed = float(random.choice([-1.0, 1.0, 1.0]) * random.uniform(0.1, 1.0)) if kind < 0.7 else 0.0
        spin = float(random.choice([-1.0, 1.0])) * spread(random, 0.03, 4.0) if 0.4 < kind < 0.9 else 0.0
        if speed and random.random() < 0.15:  # about a track, which then goes to and fro
            spin = 2.0 * speed * cruise_mps / gauge_m * float(random.choice([-1.0, 1.0]) * random.uniform(0.8, 1.0))
        moves.append(Manoeuvre(lasts_s, speed, spin))
        elapsed += lasts_s
    return moves


def _encoders(random: np.random.Generator, base: EncodersConfig) -> EncodersConfig:
    metres = spread(random, 1e-4, 0.1)
    return replace(
        base,
        left_metres_per_tick=metres * float(random.choice([-1.0, 1.0])),
        right_metres_per_tick=metres * float(random.choice([-1.0, 1.0])) * float(random.uniform(0.8, 1.2)),
        quantisation_ticks=float(random.choice([1.0, 1.0, random.uniform(1.0, 4.0)])),
    )


def _imu(random: np.random.Generator, base: ImuConfig) -> ImuConfig:
    return replace(
        base,
        clock_drift_ppm=_or_none(random, 1.0, 100_000.0, 0.1),
        gyro_bias_bound_dps=_or_none(random, 1e-3, 3.0, 0.1),
        gyro_bias_drift_dps2=_or_none(random, 1e-6, 0.05),
        gyro_noise_bound_dps=spread(random, 1e-3, 1.0),
        gyro_scale_bound=_or_none(random, 1e-5, 0.5),
        tilt_bound_deg=spread(random, 0.05, 5.0),
        accel_bound_mps2=spread(random, 0.01, 3.0),
    )


def _gps(random: np.random.Generator) -> GpsConfig:
    arm = random.uniform(-3.0, 3.0, 3) * float(random.choice([0.0, 0.1, 1.0]))
    return GpsConfig(
        port="ports/gps",
        latency_ms=(0.0, 50.0),
        gst_factor=5.0,
        range_error_m=5.0,
        floor_horizontal_m=0.02,
        floor_vertical_m=0.04,
        rtk_fixed_horizontal_m=spread(random, 0.01, 10.0),
        rtk_fixed_vertical_m=spread(random, 0.02, 20.0),
        velocity_bound_mps=spread(random, 0.01, 1.0) if random.random() < 0.5 else None,
        antenna_x_m=float(arm[0]),
        antenna_y_m=float(arm[1]),
        antenna_z_m=float(arm[2]),
    )


def _filter(random: np.random.Generator) -> FilterConfig:
    wrong = int(random.choice([0, 0, 0, 1, 2, 3]))
    stands = bool(random.random() < 0.6)
    return FilterConfig(
        set="ellipsoid" if random.random() < 0.2 else "box",
        standstill_s=spread(random, 0.1, 2.0) if stands else None,
        standstill_rate_dps=0.0 if stands else None,  # replaced by what the drive allows
        wrong_fixes=wrong,
        wrong_fixes_of=int(random.integers(max(4 * wrong + 4, 8), 31)),
        history_s=spread(random, 0.3, 6.0),
    )


def _timing(random: np.random.Generator, least_hz: float, most_hz: float, most_width_s: float) -> Timing:
    silent = inf, inf
    chance = random.random()
    if chance < 0.1:
        silent = 0.0, float(random.uniform(0.0, 4.0))
    elif chance < 0.3:
        begin = float(random.uniform(0.5, 10.0))
        silent = begin, begin + spread(random, 0.2, 20.0)
    return Timing(
        period_s=1.0 / spread(random, least_hz, most_hz),
        jitter=float(random.choice([0.0, 0.05])),
        width_s=_or_none(random, 1e-3, most_width_s, 0.3),
        where=str(random.choice(["first", "last", "either", "anywhere"])),
        lost=float(random.choice([0.0, 0.0, 0.02, 0.1])),
        silent_s=silent,
        late_reads=bool(random.random() < 0.3),
    )


def _behaviour(random: np.random.Generator, duration_s: float) -> Behaviour:
    rests = random.random() < 0.5
    axes = [(True, True, True)] * 3 + [(False, False, True)]
    kinds = [(True, True)] * 3 + [(False, False)]
    tells_tilt = kinds[random.integers(4)]
    tells_accel = kinds[random.integers(4)] if any(tells_tilt) else (True, True)
    return Behaviour(
        begin_s=float(random.uniform(0.0, FIRST_REST_S) if rests else random.uniform(FIRST_REST_S, 4.5)),
        start_ns=int(random.choice([20_000_000, 1_000_000_000_000, 2**62, 1_790_000_000_000_000_000])),
        gyro=_timing(random, 20.0, 400.0, 0.05),
        tilt=_timing(random, 2.0, 200.0, 0.1) if random.random() < 0.6 else None,
        ticks=_timing(random, 5.0, 100.0, 0.15),
        fixes=_timing(random, 0.2, 10.0, 0.4),
        clock=("HIGHRES_IMU", "HIGHRES_IMU", "ATTITUDE", "none")[random.integers(4)],
        clock_rate=float(random.choice([-1.0, 0.0, 1.0])),
        clock_offset_us=int(random.choice([0, 2**40, 123_456])),
        axes=axes[random.integers(4)],
        tells_tilt=tells_tilt,
        tells_accel=tells_accel,
        counter_resets_s=float(random.uniform(1.0, duration_s)) if random.random() < 0.2 else inf,
        board_reboots_s=float(random.uniform(1.0, duration_s)) if random.random() < 0.15 else inf,
        fix_scales=float(random.choice([1.0, 1.0, 5.0, 50.0])),
        wrong_share=float(random.choice([0.0, 0.05, 0.3])),
        gravity_mps2=float(random.choice([9.7601, 9.80665, 9.8399])),
        by_arrival=bool(random.random() < 0.1),
        delayed=float(random.choice([0.0, 0.0, 0.0, 0.1])),
    )
