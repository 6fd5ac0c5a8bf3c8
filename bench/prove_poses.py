"""The filter alone, held against the truth: every law of errors, every scene, every seed another drive.

    python -m bench.prove_poses [--steps N] [--seeds N] [--jobs N] [--page]

Each drive disturbs its readings in its own way: stamps as wide as the declared latency with the truth at one of their
ends (all at one, or now here, now there), readings lost, readings that come late. The pose in the map, the pose on
Earth and the anchor are compared with the truth as soon as they are out. Exit code 1 on a violation, or where a
guarantee was voided although every bound held.
"""

import argparse
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count, islice
from math import ceil, cos, pi, sin
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np
import pymap3d
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from bench.machine import heading
from drivers.config import DevicesConfig
from drivers.samples import Fix, InertialSample, Stamp, WheelTicks
from estimator.config import FilterConfig, RobotConfig
from estimator.filter import Filter
from service.config import load
from service.robot_model import robot_model
from service.shipped import shipped_config
from simulator.errors import ErrorLaw
from simulator.open_ground import open_ground
from simulator.sample_stream import Rates, sample_stream
from simulator.terrain import build_terrain
from simulator.world import World

Array = NDArray[np.float64]
Reading = InertialSample | WheelTicks | Fix
Kind = Literal["box", "ellipsoid"]

LAWS = ("uniform", "corners", "constant", "drift", "switching")
SCENES = ("flat", "ramp", "stairs", "rough", "yard", "open")
STAMPS = ("exact", "first end", "last end", "either end")
"""Where in its stamp the true time lies."""
LOSSES = ("none", "a tenth lost", "half of the fixes late")
STAMP_NS = 11_000_000
LATE_NS = 300_000_000
FIX_BOUND_M = (0.05, 0.05, 0.08)
VELOCITY_BOUND_MPS = 0.03
"""Every other receiver's; the rest tell none."""
CHECK_EVERY = 7
"""Steps from one comparison with the truth to the next."""
STEPS, SEEDS = 1_000_000, 200
PAGE = Path(__file__).with_name("PROVED_POSES.md")
START_NS = 1_000_000_000_000


@dataclass(frozen=True, slots=True)
class Case:
    """One drive."""

    law: str
    scene: str
    seed: int
    stamps: str
    losses: str
    poses: Kind = "box"
    seconds: float = 24.0


@dataclass(slots=True)
class Score:
    """What drives came to, added up."""

    drives: int = 0
    steps: int = 0
    """Readings that the filter was given."""
    checks: int = 0
    """Comparisons of six or more coordinates with the truth."""
    outside: int = 0
    voided: int = 0
    cpu_s: float = 0.0

    def add(self, other: "Score") -> None:
        """Add another score to this one."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))


Rows = dict[tuple[str, str], Score]
"""By law, and by stamps and losses; ("all", "all") is the sum."""


def cases(first_seed: int = 1, poses: Kind = "box") -> Iterator[Case]:
    """Without end: the laws in turn, each with every scene, and with each a disturbance of its own."""
    for seed in count(first_seed):
        law, scene = LAWS[seed % len(LAWS)], SCENES[seed // len(LAWS) % len(SCENES)]
        yield Case(law, scene, seed, STAMPS[seed % len(STAMPS)], LOSSES[seed // 7 % len(LOSSES)], poses)


def prove_poses(case: Case) -> Score:
    """Drive once, and hold what comes out against the truth."""
    config = load(shipped_config("demo.toml")).config
    width_ms = (0.0, 0.0) if case.stamps == "exact" else (0.0, STAMP_NS * 1e-6)
    encoders = replace(config.devices.encoders, latency_ms=width_ms)
    imu = replace(config.devices.imu, latency_ms=width_ms)
    assert config.devices.gps is not None
    gps = replace(config.devices.gps, velocity_bound_mps=VELOCITY_BOUND_MPS if case.seed % 2 else None)
    devices = replace(config.devices, encoders=encoders, imu=imu, gps=gps)
    world = _world(case, config.robot, devices)
    poses = Filter(
        config.robot,
        FilterConfig(set=case.poses, standstill_s=0.5, standstill_rate_dps=0.02),
        encoders,
        imu,
        devices.gps,
    )
    score = Score(drives=1)
    for k, readings in enumerate(_disturbed(world, case)):
        began = time.thread_time()
        for reading in readings:
            poses.accept(reading)
        score.cpu_s += time.thread_time() - began
        score.steps += len(readings)
        if k % CHECK_EVERY == 0:
            checked, outside = compare(poses, world)
            score.checks += checked
            score.outside += outside
    score.voided = int(not poses.guarantee.intact)
    return score


def _world(case: Case, robot: RobotConfig, devices: DevicesConfig) -> World:
    """The case's drive; on open ground, the first that the robot can drive within its limits."""
    model, law = robot_model(robot), ErrorLaw(case.law, case.seed)
    if case.scene != "open":
        return World(build_terrain(case.scene, case.seed), model, devices, law, START_NS, case.seconds)
    for attempt in range(8):
        ground = open_ground(case.seed + 1000 * attempt, 5.0 if attempt == 0 else 2.0, case.seconds)
        with suppress(ValueError):
            return World(ground, model, devices, law, START_NS, case.seconds)
    raise ValueError(f"no open ground can be driven: {case}")


def _disturbed(world: World, case: Case) -> Iterator[list[Reading]]:
    """The readings, step by step, with uncertain stamps, losses and delays."""
    random = np.random.default_rng(case.seed)
    delayed: list[tuple[int, Reading]] = []
    rates = Rates(step_ns=10_000_000, steps_per_tilt=2, steps_per_fix=(10, 25, 100)[case.seed % 3])
    newest: dict[type, int] = {}
    for now_ns, readings in sample_stream(world, FIX_BOUND_M, rates):
        out: list[Reading] = [reading for due_ns, reading in delayed if due_ns <= now_ns]
        delayed = [(due_ns, reading) for due_ns, reading in delayed if due_ns > now_ns]
        for exact in readings:
            reading = _stamped(exact, case.stamps, random, newest)
            if case.losses == LOSSES[1] and random.random() < 0.1:
                continue
            if case.losses == LOSSES[2] and isinstance(reading, Fix) and random.random() < 0.5:
                delayed.append((now_ns + LATE_NS, reading))
            else:
                out.append(reading)
        yield out


def _stamped(reading: Reading, stamps: str, random: np.random.Generator, newest: dict[type, int]) -> Reading:
    """The true time is at the first or at the last end of the stamp. What one sensor says, is read in its order."""
    if stamps == "exact":
        return reading
    now_ns = reading.stamp.earliest_ns
    late = stamps == "last end" or (stamps == "either end" and random.random() < 0.5)
    read_ns = max(now_ns + (0 if late else STAMP_NS), newest.get(type(reading), 0))
    newest[type(reading)] = read_ns
    return replace(reading, stamp=Stamp(read_ns - STAMP_NS, read_ns))


def compare(poses: Filter, world: World) -> tuple[int, int]:
    """(comparisons, those that the truth is outside of): newest pose in the map and on Earth, and the anchor."""
    now_ns, oldest_ns = poses.horizon_ns, poses.oldest_ns
    if now_ns is None or oldest_ns is None or now_ns < oldest_ns:
        return 0, 0
    start, true = world.pose(world.start_ns), world.pose(now_ns)
    pose, on_earth, anchor = poses.pose_over(now_ns, now_ns), poses.pose_on_earth(now_ns, now_ns), poses.anchor
    assert pose is not None
    checks = [holds(pose.low, pose.high, in_frame(true, start))]
    if on_earth is not None and anchor is not None:
        origin = anchor.origin_lat_deg, anchor.origin_lon_deg, anchor.origin_alt_m
        checks.append(holds(on_earth.low, on_earth.high, np.append(_moved(true[:3], world, origin), true[3:])))
        checks.append(holds(anchor.low, anchor.high, np.append(_moved(start[:3], world, origin), start[5])))
    return len(checks), checks.count(False)


def holds(low: Array, high: Array, true: Array) -> bool:
    """Is the truth inside? The last coordinate is a yaw, which counts modulo whole turns. NaN is outside."""
    true = true.copy()
    true[-1] += 2 * pi * ceil((low[-1] - true[-1]) / (2 * pi) - 1e-12)
    return bool(np.all((low - 1e-9 <= true) & (true <= high + 1e-9)))


def in_frame(true: Array, start: Array) -> Array:
    """A world pose as seen from the map, which began at `start`."""
    x, y, z = true[:3] - start[:3]
    c, s = cos(start[5]), sin(start[5])
    return np.array([c * x + s * y, c * y - s * x, z, true[3], true[4], true[5] - start[5]])


def _moved(enu: Array, world: World, origin: tuple[float, float, float]) -> Array:
    """A world point in ENU at another origin."""
    return np.array(pymap3d.geodetic2enu(*pymap3d.enu2geodetic(*enu, *world.origin), *origin), np.float64)


def campaign(steps: int, seeds: int, jobs: int, first_seed: int = 1, poses: Kind = "box") -> Rows:
    """Drives until enough steps and seeds were checked, by (law, stamps and losses)."""
    rows: Rows = {}
    total, supply = Score(), cases(first_seed, poses)
    console = Console(stderr=True)
    with (
        ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool,
        Progress(console=console, disable=not console.is_terminal) as progress,
    ):
        task = progress.add_task(f"filter steps ({poses})", total=steps)
        while total.steps < steps or total.drives < seeds:
            batch = list(islice(supply, 8 * jobs))
            for case, score in zip(batch, pool.map(prove_poses, batch), strict=True):
                total.add(score)
                rows.setdefault((case.law, f"stamps {case.stamps}; {case.losses}"), Score()).add(score)
                if score.outside or score.voided:
                    console.print(f"broken: {case}: {score}")
            progress.update(task, completed=total.steps)
    rows["all", "all"] = total
    return rows


PAGE_TEXT = """Drives of {seconds:g} s over {scenes}, every one with a seed,
a disturbance and a rate of fixes of its own (10, 4 and 1 Hz), every other one with ground velocities; gyroscope and
counts at 100 Hz, tilt at 50. `first end`, `last end`: the true time of a reading is at that end of its stamp of 11 ms;
`late`: 0.3 s after what came later.
`steps` are readings given to the filter; a check compares the pose in the map, the pose on Earth, or the anchor, all
coordinates, with the truth. `voided`: guarantees lost although every bound held.

| law | disturbed | drives | steps | checks | outside | voided |
|---|---|---|---|---|---|---|
"""


def page(rows: Rows) -> str:
    """The table."""
    lines = [
        f"| {law} | {how} | {s.drives} | {s.steps:,} | {s.checks:,} | {s.outside} | {s.voided} |"
        for (law, how), s in sorted(rows.items(), key=lambda row: (row[0][0] == "all", row[0]))
    ]
    text = PAGE_TEXT.format(seconds=Case("", "", 0, "", "").seconds, scenes=", ".join(SCENES))
    return text + "\n".join(lines) + "\n"


def main() -> int:
    """Prove until enough was checked; 0 if everything held."""
    parser = argparse.ArgumentParser(prog="python -m bench.prove_poses", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--set", default="box", choices=["box", "ellipsoid"])
    parser.add_argument("--page", action="store_true", help="rewrite bench/PROVED_POSES.md")
    options = parser.parse_args()
    rows = campaign(options.steps, options.seeds, options.jobs, options.first_seed, options.set)
    text = page(rows)
    print(text)
    total = rows["all", "all"]
    print(f"{1e6 * total.cpu_s / max(total.steps, 1):.0f} us of CPU a step")
    if options.page:
        PAGE.write_text(heading("Poses against the truth", "make prove") + text, encoding="utf-8")
    return 0 if total.outside == total.voided == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
