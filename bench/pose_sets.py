"""Pose sets side by side, on SMF section 13's scenario: how wide, how dear, and do they hold the truth?

    python -m bench.pose_sets [--seconds S] [--seeds K ...] [--laws ...] [--methods ...]

Two boxes are measured of each of our filters:

    map       the pose in the map frame, as it goes into the cells
    Earth     the pose in ENU at the first fix (`pose_on_earth`), the reference's world frame
"""

import argparse
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import cos, pi, remainder, sin
from pathlib import Path
from typing import Protocol

import numpy as np
import pymap3d
from numpy.typing import NDArray

from bench.baselines.ekf import ExtendedKalmanFilter
from bench.baselines.pure_box import without_window
from bench.machine import heading
from bench.pose_scenario import (
    FILTER,
    GPS_CLASSES,
    IMU,
    NEVER_STILL,
    ROBOT,
    WITH_VELOCITY,
    GpsClass,
    devices,
    reference_world,
)
from drivers.samples import Fix, InertialSample, WheelTicks
from estimator.config import FilterConfig
from estimator.filter import Filter
from simulator.sample_stream import sample_stream
from simulator.world import World

Array = NDArray[np.float64]
Reading = InertialSample | WheelTicks | Fix

STEPS_PER_CHECK = 10
SETTLING_S = 30.0
"""Widths count from here on: by then every method has found its yaw, if it can."""
FULL_TURN = pi
WARMING_S = 5.0
"""A drive that only makes the machine code."""
LAWS = ("constant", "uniform")
BALANCED = (1, 5)
"""Seeds: roll's constant errors have the same sign in the first drive, pitch's in the second."""

REFERENCE = {
    ("RTK", "constant"): (0.094, 0.11, 6.2),
    ("RTK", "uniform"): (0.089, 0.07, 5.4),
    ("DGPS", "constant"): (0.69, 1.21, 15.4),
    ("DGPS", "uniform"): (0.42, 0.28, 9.7),
    ("SPS", "constant"): (2.66, 5.0, 29.8),
    ("SPS", "uniform"): (0.97, 0.59, 13.5),
    ("DGPS + velocity", "constant"): (0.67, 1.21, 11.4),
    ("DGPS + velocity", "uniform"): (0.40, 0.28, 8.8),
    ("SPS + velocity", "constant"): (2.59, 5.0, 16.7),
    ("SPS + velocity", "uniform"): (0.91, 0.59, 11.3),
}
"""R+: xy and z in m, yaw in degrees (SMF section 13; z for DGPS and SPS without velocity from the rows with it)."""

PAGE = Path(__file__).with_name("POSE_SETS.md")
PAGE_TEXT = """Long drives over open ground by SMF section 13's robot, with its declared bounds: slip 5 %, lateral 2 %
and 0.10 m of turning centre, normal 2 %, gyroscope bias 0.3 deg/s (every axis), noise 0.1 deg/s, scale 0.5 %, tilt 1
degree, accelerometers 0.07 g; 50 Hz, tilt at 10 Hz, GPS at 1 Hz, no latency; `+ velocity`: that of the antenna too, to
within 0.1 m/s an axis.
Half-widths are means over time, from 30 s on. `map` is the pose in the map frame, as it goes into the cells (its x, y,
z and yaw are zero where the drive began, so a place is known against the start); `Earth` is the pose in ENU at the
first fix, the like of the reference's world frame. `outside`: true poses outside their
box, of those checked. CPU time of one step (inertial packet, counts, a fifth of a tilt reading, a fiftieth of a
fix), in one thread of a machine with other work.

The drives: legs of 0.4 to 1 m/s, 8 to 30 s long, between them a spin in place (three of five), a stop of 4 s, or a leg
in reverse. What the accelerometers feel beside gravity is drawn as the reference draws it, up to 0.07 g. `default` is
the filter as shipped: like the reference's (SMF 6.3) it learns the gyroscope's bias where the robot stands.
Constant roll and pitch hang on signs: a tilt sensor and an accelerometer that err to opposite sides leave next to
nothing between them, to the same side the whole degree. So the drives are a pair: of either axis one errs to opposite
sides, one to the same (twelve drives as they are drawn come to 0.50 too, the reference to 0.5).
What differs from the reference: starts and stops take 3.3 s; slip here is a motion, smooth over a second, which a
Kalman filter takes for white.

"""


class Contender(Protocol):
    """A filter in the race."""

    def step(self, now_ns: int, readings: list[Reading]) -> None:
        """All readings of one moment."""

    def boxes(self, now_ns: int) -> "dict[str, tuple[Array, Array]] | None":
        """low and high [6] by frame, `map` and `Earth` (world ENU)."""

    @property
    def voided(self) -> bool:
        """Has it declared its own bounds broken?"""


class SetFilter:
    """Ours, in one of its settings."""

    def __init__(self, gps: GpsClass, world: World, config: FilterConfig) -> None:
        declared = devices(gps)
        self.filter = Filter(ROBOT, config, declared.encoders, declared.imu, declared.gps)
        self._origin = world.origin

    def step(self, now_ns: int, readings: list[Reading]) -> None:
        """Give each to the filter."""
        for reading in readings:
            self.filter.accept(reading)

    def boxes(self, now_ns: int) -> dict[str, tuple[Array, Array]] | None:
        """In the map frame, and on Earth."""
        pose, anchor = self.filter.pose_over(now_ns, now_ns), self.filter.anchor
        if pose is None:
            return None
        boxes = {"map": (pose.low, pose.high)}
        placed = self.filter.pose_on_earth(now_ns, now_ns)
        if anchor is not None and placed is not None:
            first_fix = anchor.origin_lat_deg, anchor.origin_lon_deg, anchor.origin_alt_m
            shift = np.append(pymap3d.geodetic2enu(*first_fix, *self._origin), np.zeros(3))
            boxes["Earth"] = placed.low + shift, placed.high + shift
        return boxes

    @property
    def voided(self) -> bool:
        """Called its guarantee void."""
        return not self.filter.guarantee.intact


class Ekf:
    """The extended Kalman filter and its three sigma; it starts at the truth, to within 10 degrees of yaw."""

    def __init__(self, gps: GpsClass, world: World) -> None:
        encoders = devices(gps).encoders
        start = world.pose(world.start_ns)
        covariance = np.diag(
            np.array([*(np.array(gps.bound_m) / 3), *np.radians([1.0, 1.0, 10.0 / 3]), 0.0, 0.0, 0.0]) ** 2
        )
        self.ekf = ExtendedKalmanFilter(
            ROBOT, IMU, np.append(start, np.zeros(3)), covariance, encoders.left_metres_per_tick
        )
        self._metres = encoders.left_metres_per_tick, encoders.right_metres_per_tick
        self._origin = world.origin
        self._last: tuple[int, WheelTicks] | None = None

    def step(self, now_ns: int, readings: list[Reading]) -> None:
        """Predict once, then correct with all there is."""
        inertial = next(r for r in readings if isinstance(r, InertialSample))
        ticks = next(r for r in readings if isinstance(r, WheelTicks))
        if self._last is not None:
            then_ns, last = self._last
            left = (ticks.left - last.left) * self._metres[0]
            right = (ticks.right - last.right) * self._metres[1]
            self.ekf.predict(left, right, inertial.gyro_rps, (now_ns - then_ns) * 1e-9)
        self._last = now_ns, ticks
        self.ekf.correct_tilt(*inertial.tilt_rad)
        self.ekf.correct_accelerometers(*inertial.accel_mps2[:2])
        for reading in readings:
            if isinstance(reading, Fix):
                enu = pymap3d.geodetic2enu(reading.lat_deg, reading.lon_deg, reading.alt_m, *self._origin)
                self.ekf.correct_position(np.array(enu, float), reading.bound_m)

    def boxes(self, now_ns: int) -> dict[str, tuple[Array, Array]] | None:
        """Three sigma, on Earth alone."""
        reach = self.ekf.three_sigma()
        return {"Earth": (self.ekf.state[:6] - reach, self.ekf.state[:6] + reach)}

    @property
    def voided(self) -> bool:
        """It never knows."""
        return False


def _pure_box(gps: GpsClass, world: World) -> Contender:
    with without_window():
        return SetFilter(gps, world, FILTER)


METHODS: dict[str, Callable[[GpsClass, World], Contender]] = {
    "default": lambda gps, world: SetFilter(gps, world, FILTER),
    "without standstill": lambda gps, world: SetFilter(gps, world, NEVER_STILL),
    "ellipsoid": lambda gps, world: SetFilter(gps, world, replace(FILTER, set="ellipsoid")),
    "pure box": _pure_box,
    "EKF 3 sigma": Ekf,
}


@dataclass(slots=True, eq=False)
class Score:
    """What drives of one method came to."""

    half_widths: dict[str, list[Array]] = field(default_factory=dict)
    """[6] a check, by frame."""
    checks: dict[str, int] = field(default_factory=dict)
    violations: dict[str, int] = field(default_factory=dict)
    missing: int = 0
    """Checks without a pose."""
    voided: int = 0
    step_us: list[float] = field(default_factory=list)

    def check(self, frame: str, low: Array, high: Array, truth: Array) -> None:
        """Does the box hold the truth? Yaw modulo a turn."""
        truth = truth.copy()
        middle = 0.5 * (low[5] + high[5])
        truth[5] = middle + remainder(truth[5] - middle, 2 * pi)
        inside = bool(np.all((low <= truth) & (truth <= high)))
        self.checks[frame] = self.checks.get(frame, 0) + 1
        self.violations[frame] = self.violations.get(frame, 0) + (not inside)

    def widths(self, frame: str) -> Array:
        """[4] mean half-widths: xy and z in m, roll and pitch and yaw in degrees."""
        if not self.half_widths.get(frame):
            return np.full(4, np.nan)
        mean = np.mean(self.half_widths[frame], axis=0)
        tilt, yaw = np.degrees(mean[3:5].mean()), np.degrees(mean[5])
        return np.array([mean[:2].mean(), mean[2], tilt, yaw])


def race(method: str, gps: GpsClass, law: str, seed: int, seconds: float, score: Score) -> None:
    """One drive; the truth is asked at the time of the newest readings, as soon as they are in."""
    world = reference_world(gps, law, seed, seconds)
    contender = METHODS[method](gps, world)
    start = world.pose(world.start_ns)
    for k, (now_ns, readings) in enumerate(sample_stream(world, gps.bound_m)):
        began = time.thread_time_ns()
        contender.step(now_ns, readings)
        score.step_us.append((time.thread_time_ns() - began) * 1e-3)
        if k % STEPS_PER_CHECK or k == 0:
            continue
        boxes = contender.boxes(now_ns)
        if boxes is None:
            score.missing += 1
            continue
        pose = world.pose(now_ns)
        for frame, (low, high) in boxes.items():
            score.check(frame, low, high, pose if frame == "Earth" else in_map(pose, start))
            if (now_ns - world.start_ns) * 1e-9 >= SETTLING_S:
                half = 0.5 * (high - low)
                half[5] = min(half[5], FULL_TURN)
                score.half_widths.setdefault(frame, []).append(half)
    score.voided += contender.voided


def in_map(pose: Array, start: Array) -> Array:
    """A world pose seen from the map frame that began at `start`."""
    x, y, z = pose[:3] - start[:3]
    c, s = cos(start[5]), sin(start[5])
    return np.array([c * x + s * y, c * y - s * x, z, pose[3], pose[4], pose[5] - start[5]])


def table(
    methods: Sequence[str],
    laws: Iterable[str],
    seeds: Sequence[int],
    seconds: float,
    classes: Iterable[GpsClass] = (*GPS_CLASSES, *WITH_VELOCITY),
) -> Iterator[str]:
    """Markdown, line by line as the drives come in."""
    yield "| GPS | errors | method | frame | xy m | z m | roll, pitch deg | yaw deg | outside | us a step: mean, p50 |"
    yield "|---" * 10 + "|"
    for method in methods:
        race(method, GPS_CLASSES[0], "uniform", 0, WARMING_S, Score())
    for gps in classes:
        for law in laws:
            if (gps.name, law) in REFERENCE:
                xy, z, yaw = REFERENCE[gps.name, law]
                figures = f"{xy:.3f} | {z:.2f} | 0.3-0.5 | {yaw:.1f} | 0 | 1"
                yield f"| {gps.name} | {law} | *reference R+* | Earth | {figures} |"
            for method in methods[:1] if gps in WITH_VELOCITY else methods:
                score = Score()
                for seed in seeds:
                    race(method, gps, law, seed, seconds, score)
                for frame in sorted(score.checks):
                    yield f"| {gps.name} | {law} | {method} | {frame} | {_row(score, frame)} |"


def _row(score: Score, frame: str) -> str:
    xy, z, tilt, yaw = score.widths(frame)
    out = f"{score.violations[frame]:,} of {score.checks[frame]:,}" + (", voided" if score.voided else "")
    out += f", {score.missing} missing" if score.missing else ""
    mean, middle = np.mean(score.step_us), np.median(score.step_us)
    return f"{xy:.3f} | {z:.2f} | {tilt:.2f} | {yaw:.1f} | {out} | {mean:.0f}, {middle:.0f}"


def main() -> None:
    """The table, as asked for."""
    parser = argparse.ArgumentParser(prog="python -m bench.pose_sets", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(BALANCED))
    parser.add_argument("--laws", nargs="+", default=list(LAWS))
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--gps", nargs="+", default=[gps.name for gps in (*GPS_CLASSES, *WITH_VELOCITY)])
    parser.add_argument("--page", action="store_true", help="rewrite bench/POSE_SETS.md")
    options = parser.parse_args()
    classes = [gps for gps in (*GPS_CLASSES, *WITH_VELOCITY) if gps.name in options.gps]
    lines = []
    for line in table(tuple(options.methods), options.laws, options.seeds, options.seconds, classes):
        lines.append(line)
        print(line, flush=True)
    if options.page:
        drives = f"{len(options.seeds)} drives of {options.seconds:g} s a row.\n\n"
        text = heading("Pose sets side by side", "python -m bench.pose_sets --page") + PAGE_TEXT + drives
        PAGE.write_text(text + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
