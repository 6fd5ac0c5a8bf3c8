"""Lasers mounted in any way, over cells of any size: every true hit held against its cell.

    python -m bench.prove_mounts [--drives N] [--points N] [--jobs N] [--first-seed N] [--page]

Drives of the emulated robot, a laser drawn for each seed: its place and angles, its variant, unit, bounds and reach,
and the map's cells. And points of the measurement model (prove_boxes.py) with poses anywhere up to 100 km from the
map's origin. Exit code 1 on a violation, on a voided guarantee, and on anything raised.
"""

import argparse
import os
import sys
import traceback
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np

from bench import prove_boxes
from bench.machine import heading
from bench.random_robot import spread
from drivers.config import LaserConfig
from mapper.config import MapConfig
from service.commands.virtual_drive import drive_virtually
from service.config import LoadedConfig, load
from service.shipped import shipped_config
from simulator.errors import LAWS

DRIVES, POINTS = 300, 10_000_000
SCENES = ("stairs", "rough", "ramp", "yard", "flat")
VARIANTS: tuple[tuple[Literal[90, 100, 180], float], ...] = (
    (90, 0.5),
    (100, 0.25),
    (100, 0.5),
    (100, 1.0),
    (180, 0.25),
    (180, 0.5),
    (180, 1.0),
)
"""Scan angle and resolution, degrees."""
SECONDS = 7.0
ROUNDS = 24
"""Points of each beam of a case."""
FARTHEST_M = 1e5
PAGE = Path(__file__).with_name("PROVED_MOUNTS.md")


@dataclass(slots=True)
class Score:
    """What seeds came to, added up."""

    seeds: int = 0
    poses: int = 0
    hits: int = 0
    """True hits of drives, or points."""
    poses_outside: int = 0
    hits_outside: int = 0
    voided: int = 0
    raised: int = 0
    notes: list[str] = field(default_factory=list)

    def add(self, other: "Score") -> None:
        """Add another score to this one."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def sound(self) -> bool:
        """Did everything hold?"""
        return self.poses_outside == self.hits_outside == self.voided == self.raised == 0


def random_laser(random: np.random.Generator, base: LaserConfig) -> LaserConfig:
    """A laser mounted somewhere on the robot, looking down and anywhere around."""
    angle, resolution = VARIANTS[random.integers(len(VARIANTS))]
    rolled = float(random.choice([0.0, random.uniform(-30, 30), 90.0, -90.0, 180.0, random.uniform(-180, 180)]))
    return replace(
        base,
        scan_angle_deg=angle,
        resolution_deg=resolution,
        unit=("mm", "cm")[random.integers(2)],
        range_bound_m=spread(random, 0.006, 0.3),
        angle_bound_deg=spread(random, 0.01, 1.0),
        across_bound_deg=spread(random, 0.01, 1.0) if random.random() < 0.5 else None,
        range_min_m=float(random.choice([0.0, 0.3, 1.0])),
        range_max_m=spread(random, 2.0, 30.0),
        mount_x_m=float(random.uniform(-1.0, 1.0)),
        mount_y_m=float(random.uniform(-1.0, 1.0)),
        mount_z_m=float(random.uniform(0.2, 2.0)),
        mount_roll_deg=rolled,
        mount_pitch_deg=float(random.uniform(-60.0, -5.0)),
        mount_yaw_deg=float(random.choice([0.0, 180.0, random.uniform(-180, 180)])),
        mount_position_bound_m=float(random.choice([0.0, spread(random, 1e-4, 0.05)])),
        mount_angle_bound_deg=float(random.choice([0.0, spread(random, 1e-3, 2.0)])),
    )


def loaded_with(seed: int) -> LoadedConfig:
    """The demo's robot with another laser and another map."""
    random = np.random.default_rng([seed, 11])
    loaded = load(shipped_config("demo.toml"))
    laser = random_laser(random, loaded.config.devices.laser)
    resolution_m = spread(random, 0.02, 1.0)
    # Beams that tell too little are left out; none shall be.
    cells = MapConfig(resolution_m=resolution_m, max_tiles=65536, max_footprint_m=min(1900.0 * resolution_m, 40.0))
    config = replace(loaded.config, devices=replace(loaded.config.devices, laser=laser), map=cells)
    return replace(loaded, config=config)


def prove_drive(seed: int) -> Score:
    """Drive once, and hold poses and map against the truth."""
    loaded, scene = loaded_with(seed), SCENES[seed // len(LAWS) % len(SCENES)]
    drive = drive_virtually(loaded, scene=scene, law=LAWS[seed % len(LAWS)], seed=seed, duration_s=SECONDS)
    poses_outside, hits_outside, hits = drive.violations()
    return Score(
        seeds=1,
        poses=len(drive.poses.earliest_ns),
        hits=hits,
        poses_outside=poses_outside,
        hits_outside=hits_outside,
        voided=int(not drive.pipeline.filter.guarantee.intact),
    )


def prove_points(seed: int) -> Score:
    """Points of one scan, with poses somewhere far away."""
    random = np.random.default_rng([seed, 12])
    laser = random_laser(random, prove_boxes.LASER)
    metres, degrees = spread(random, 1e-3, 0.5), spread(random, 0.01, 5.0)
    away = random.uniform(-1.0, 1.0, 3) * spread(random, 1.0, FARTHEST_M) * [1.0, 1.0, 0.05]
    case = prove_boxes.a_case(metres, degrees, seed, laser, away)
    resolution_m = spread(random, 0.026, 1.0)  # of less, check's footprint is too many
    score, total = prove_boxes.Score(), Score(seeds=1)
    for draw in (prove_boxes.corners, prove_boxes.uniform):
        prove_boxes.check(case, draw(case, ROUNDS, seed), score, laser, resolution_m)
    total.hits, total.hits_outside = score.points, score.outside_box + score.outside_cell
    return total


def guarded(prove: object, seed: int) -> Score:
    """The score; what is raised counts."""
    assert callable(prove)
    try:
        score: Score = prove(seed)
    except Exception:  # whatever it is, it is what is looked for
        score = Score(seeds=1, raised=1, notes=[traceback.format_exc(limit=-4)])
    if not score.sound:
        score.notes.append(f"seed {seed}")
        print(f"broken: {getattr(prove, '__name__', prove)}: {score}", file=sys.stderr, flush=True)
    return score


def main() -> int:
    """Prove; 0 if everything held."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.prove_mounts", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--drives", type=int, default=DRIVES)
    parser.add_argument("--points", type=int, default=POINTS)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--page", action="store_true", help="rewrite bench/PROVED_MOUNTS.md")
    options = parser.parse_args()
    scans = -(-options.points // (2 * ROUNDS * prove_boxes.BEAMS))
    rows = {"drives": Score(), "points": Score()}
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for name, prove, many in (("points", prove_points, scans), ("drives", prove_drive, options.drives)):
            seeds = range(options.first_seed, options.first_seed + many)
            for score in pool.map(partial(guarded, prove), seeds):
                rows[name].add(score)
    text = page(rows)
    print(text)
    if options.page:
        PAGE.write_text(heading("Lasers mounted in any way", "make prove") + text, encoding="utf-8")
    return 0 if all(score.sound for score in rows.values()) else 1


PAGE_TEXT = """Each seed is another laser: up to a metre off the robot's middle, pitched down by 5 to 60 degrees,
rolled and yawed anywhere, all variants of scan angle and resolution, either unit, range bounds of 6 mm to 30 cm,
angles' of 0.01 to 1 degree, mounts known to 0 to 5 cm and 0 to 2 degrees; cells of 2 cm to 1 m. Drives: the
emulated robot through drivers, filter and mapper, over every scene and error law. Points: of the measurement model
with all errors at corners of their bounds or uniform, poses up to 100 km from the map's origin and known to 1 mm to
0.5 m and 0.01 to 5 degrees, against box and cell (`bench/prove_mounts.py`).

| | seeds | poses | hits | poses outside | hits outside | voided | raised |
|---|---|---|---|---|---|---|---|
"""


def page(rows: dict[str, Score]) -> str:
    """The table."""
    lines = [
        f"| {name} | {s.seeds:,} | {s.poses:,} | {s.hits:,} | {s.poses_outside} | {s.hits_outside} | {s.voided} "
        f"| {s.raised} |"
        for name, s in rows.items()
    ]
    return PAGE_TEXT + "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
