"""Robots that nobody has built, each driven once, and every pose held against the truth.

    python -m bench.prove_robots [--drives N] [--jobs N] [--first-seed N] [--page]

Each seed draws another robot, other sensors, another ground and way, and another manner of being read
(random_robot.py, uneven_readings.py). Exit code 1 on a violation, on a guarantee that was voided although every bound
held, and on anything raised.
"""

import argparse
import os
import sys
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from math import radians, sin
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pymap3d
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from bench.machine import heading
from bench.prove_poses import holds, in_frame
from bench.random_robot import Robot, declared, random_robot
from bench.uneven_readings import Reading, readings_of, standing
from drivers.samples import WheelTicks
from estimator.config import FilterConfig
from estimator.filter import Filter
from simulator.robot import STEP_NS
from simulator.world import World

Array = NDArray[np.float64]

DRIVES = 2000
CHECK_EVERY = 29
"""Readings from one comparison with the truth to the next; a prime, so that it falls on all sensors."""
STRETCHES_MS = (0, 3, 50, 1000)
REHEARSED = range(1, 13)
"""Seeds with which a process compiles what it needs, before anything is measured."""
PAGE = Path(__file__).with_name("PROVED_ROBOTS.md")


@dataclass(slots=True)
class Score:
    """What one drive came to."""

    seed: int
    kind: tuple[str, str] = "-", "-"
    """Law of the errors, and set."""
    steps: int = 0
    checks: int = 0
    """Comparisons of six or four coordinates with the truth."""
    outside: int = 0
    voided: int = 0
    raised: int = 0
    slowest_s: float = 0.0
    cpu_s: float = 0.0
    nearest: float = 0.0
    """How near the truth came to an end of its interval: 1 is at the end, 0 in the middle."""
    notes: list[str] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        """Did everything hold?"""
        return self.outside == self.voided == self.raised == 0


def prove_robot(seed: int) -> Score:
    """Draw the robot, drive it once, and hold what comes out against the truth."""
    score = Score(seed)
    try:
        prove(random_robot(seed), score)
    except Exception:  # whatever it is, it is what is looked for
        score.raised = 1
        score.notes.append(traceback.format_exc(limit=-4))
    return score


def prove(robot: Robot, score: Score) -> None:
    """The same with a robot at hand."""
    how = robot.behaviour
    score.kind = robot.law.name, robot.filter.set
    world = World(robot.terrain, robot.model, robot.devices, robot.law, how.start_ns, robot.duration_s, robot.origin)
    world.begin_drive(world.start_ns)
    readings = readings_of(robot, world)
    devices, owner_says = robot.devices, declared(robot, world.drive)
    poses = Filter(owner_says, _filter_config(robot, world, readings), devices.encoders, devices.imu, devices.gps)
    random = np.random.default_rng([robot.seed, 2])
    counted_ns: list[int] = []
    begun_ns: int | None = None
    for k, (true_ns, reading) in enumerate(readings):
        dropped = poses.counts["encoders_out_of_order"]
        began = time.thread_time()
        poses.accept(reading)
        took = time.thread_time() - began
        score.cpu_s += took
        score.slowest_s = max(score.slowest_s, took)
        if isinstance(reading, WheelTicks) and poses.counts["encoders_out_of_order"] == dropped:
            counted_ns.append(true_ns)
        if begun_ns is None and poses.horizon_ns is not None:
            # The map begins at the first count but for those that came before any attitude.
            begun_ns = counted_ns[poses.counts["encoders_before_attitude"]]
        if k % CHECK_EVERY == 0 and begun_ns is not None:
            _compare(poses, robot, world, begun_ns, random, score)
        if not poses.guarantee.intact:
            break
    score.steps = len(readings)
    score.voided = int(not poses.guarantee.intact)
    if score.voided:
        score.notes.append(f"voided: {poses.faults[0]}")


def _filter_config(robot: Robot, world: World, readings: list[tuple[int, Reading]]) -> FilterConfig:
    """What is declared of a standing robot is what this one does."""
    if robot.filter.standstill_s is None:
        return robot.filter
    rate_dps, way_m = standing(robot, world, readings)
    return replace(
        robot.filter,
        standstill_rate_dps=rate_dps * 1.0001 + 1e-6,
        standstill_way_m=way_m * 1.0001 + 1e-9 if robot.seed % 3 else None,
    )


def _compare(
    poses: Filter, robot: Robot, world: World, begun_ns: int, random: np.random.Generator, score: Score
) -> None:
    """The newest pose, one of a stretch of the past, both in the map and on Earth, and the anchor."""
    horizon, oldest = poses.horizon_ns, poses.oldest_ns
    if horizon is None or oldest is None:
        return
    last, first = (horizon - world.start_ns) // STEP_NS, -((world.start_ns - oldest) // STEP_NS)
    if first > last:
        return
    i = int(random.integers(first, last + 1))
    j = min(last, i + int(random.choice(STRETCHES_MS)))
    start = world.pose(begun_ns)
    for a, b in ((last, last), (i, j)):
        stretch = world.start_ns + a * STEP_NS, world.start_ns + b * STEP_NS
        pose, on_earth = poses.pose_over(*stretch), poses.pose_on_earth(*stretch)
        assert pose is not None, "a pose within [oldest, horizon] was refused"
        for row in sorted({a, (a + b) // 2, b}):
            true = world.pose(world.start_ns + row * STEP_NS)
            _check(score, f"map at {row} ms", pose.low, pose.high, in_frame(true, start))
            if on_earth is not None:
                _check(score, f"earth at {row} ms", on_earth.low, on_earth.high, _on_earth(true, poses, robot))
    anchor = poses.anchor
    if anchor is not None:
        true = _on_earth(start, poses, robot)
        _check(score, "anchor", anchor.low, anchor.high, np.append(true[:3], true[5]))


def _check(score: Score, what: str, low: Array, high: Array, true: Array) -> None:
    score.checks += 1
    half = np.maximum(0.5 * (high - low)[:-1], 1e-3)
    score.nearest = max(score.nearest, float((np.abs(true - 0.5 * (low + high))[:-1] / half).max()))
    if not holds(low, high, true):
        score.outside += 1
        if len(score.notes) < 3:
            off = np.maximum(low - true, true - high)
            score.notes.append(f"{what} off {np.round(off, 9).tolist()} true {true.tolist()}")


def _on_earth(true: Array, poses: Filter, robot: Robot) -> Array:
    """A world pose as seen from the anchor's origin: place and yaw; roll and pitch are those to the vertical."""
    anchor = poses.anchor
    assert anchor is not None
    origin = anchor.origin_lat_deg, anchor.origin_lon_deg, anchor.origin_alt_m
    place = pymap3d.geodetic2enu(*pymap3d.enu2geodetic(*true[:3], *robot.origin), *origin)
    # East turns by the difference of longitudes times sin(latitude).
    turned = radians((robot.origin[1] - origin[1] + 180.0) % 360.0 - 180.0) * sin(radians(origin[0]))
    return np.array([*place, true[3], true[4], true[5] - turned])


def _rehearse() -> None:
    """Compile, so that the slowest step is a step's."""
    for seed in REHEARSED:
        prove_robot(seed)


def campaign(drives: int, jobs: int, first_seed: int) -> list[Score]:
    """The scores of so many robots; what is broken is told at once."""
    scores, console = [], Console(stderr=True)
    seeds = range(first_seed, first_seed + drives)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_rehearse) as pool:
        quiet = not console.is_terminal
        for score in track(pool.map(prove_robot, seeds), "robots", drives, console=console, disable=quiet):
            scores.append(score)
            if not score.sound:
                console.print(f"broken: {score}")
    return scores


PAGE_TEXT = """Every seed is another robot on another drive of 6 to 18 s (one in 25 longer): gauges of 0.2 to 2 m, slips
up to 90 %, turning centres that jump about, antennas up to 3 m off, ticks of 0.1 mm to 10 cm, gyroscopes of one axis or
three at 20 to 400 Hz with biases up to 3 degrees a second and scale errors up to 50 %, tilt bounds of 0.05 to 5
degrees, board clocks that are up to 10 % off or none, fixes of 1 cm to 500 m, with velocities or none, any latitude,
slopes up to 42 degrees with hills on them; started standing or at full speed, read late, out of order, with losses,
silences, resets and reboots, at host times near 0 and near 2^62 ns. Limits of the motion are declared after the drive,
as tight as 2 % (`bench/random_robot.py`, `bench/uneven_readings.py`).

`steps` are readings given to the filter; a check compares a pose in the map or on Earth, newest or past, or the anchor
with the truth, all coordinates. `voided`: guarantees lost although every bound held. `nearest`: how near the truth came
to an end of its interval in half of the drives (100 %: at the end; in the middle it is 0).

| law | set | robots | steps | checks | outside | voided | raised | nearest |
|---|---|---|---|---|---|---|---|---|
"""


def page(scores: list[Score]) -> str:
    """The table."""
    kinds = sorted({score.kind for score in scores})
    lines = [_row(*kind, [score for score in scores if score.kind == kind]) for kind in kinds]
    return PAGE_TEXT + "\n".join([*lines, _row("all", "all", scores)]) + "\n"


def _row(law: str, kept: str, scores: list[Score]) -> str:
    numbers = [sum(getattr(score, name) for score in scores) for name in ("steps", "checks", "outside")]
    rest = [sum(getattr(score, name) for score in scores) for name in ("voided", "raised")]
    nearest = 100.0 * float(np.median([score.nearest for score in scores]))
    cells = [law, kept, f"{len(scores):,}", *(f"{n:,}" for n in [*numbers, *rest]), f"{nearest:.1f} %"]
    return f"| {' | '.join(cells)} |"


def main() -> int:
    """Drive so many robots; 0 if everything held."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.prove_robots", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--drives", type=int, default=DRIVES)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--page", action="store_true", help="rewrite bench/PROVED_ROBOTS.md")
    options = parser.parse_args()
    scores = campaign(options.drives, options.jobs, options.first_seed)
    text = page(scores)
    print(text)
    cpu_us = 1e6 * sum(score.cpu_s for score in scores) / max(sum(score.steps for score in scores), 1)
    slowest = max(scores, key=lambda score: score.slowest_s)
    print(f"{cpu_us:.0f} us of CPU a step; the slowest {1e3 * slowest.slowest_s:.0f} ms (seed {slowest.seed})")
    if options.page:
        PAGE.write_text(heading("Robots that nobody has built", "make prove") + text, encoding="utf-8")
    return 0 if all(score.sound for score in scores) else 1


if __name__ == "__main__":
    sys.exit(main())
