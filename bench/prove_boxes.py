"""Points against their boxes and cells: errors at the corners of their bounds, and uniform ones, at four pose levels.

    python -m bench.prove_boxes [--points 10000000]

`--points` of each kind. A point is that of the measurement model with every error drawn anew: written down here a
second time, in numpy. Of the corners, half are at or near those that move the point farthest along an axis (the signs
of the Jacobian's row), half are random. Against mpmath.iv: both boxes hold the farthest corners, and how their widths
compare.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mpmath
import numpy as np
from numpy.typing import NDArray

from bench.attained import attained, jacobian_signs
from bench.machine import heading
from drivers.config import LaserConfig
from drivers.samples import Scan, Stamp
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.projection import project
from mapper.saved_map import assemble

Array = NDArray[np.float64]

PAGE = Path(__file__).with_name("PROVED_BOXES.md")
LEVELS = ((0.01, 0.2), (0.05, 0.5), (0.2, 1.0), (0.5, 3.0))
ERRORS = 15
"""x, y, z, roll, pitch, yaw | lever x, y, z | mount roll, pitch, yaw | along the scan, range, across the scan."""
ANGLES = (3, 4, 5, 9, 10, 11, 12, 14)
BEAMS, POSES = 2500, 50
RESOLUTION_M = 0.1
LASER = LaserConfig(
    port="none",
    latency_ms=(0.0, 1.0),
    range_bound_m=0.02,
    angle_bound_deg=0.1,
    range_min_m=0.2,
    mount_x_m=0.3,
    mount_y_m=-0.1,
    mount_z_m=0.468,
    mount_roll_deg=2.0,
    mount_pitch_deg=-10.0,
    mount_yaw_deg=15.0,
    mount_position_bound_m=0.005,
    mount_angle_bound_deg=0.1,
)


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A scan with a pose box for each run of beams; errors' middles and half-ranges [BEAMS, ERRORS]."""

    scan: Scan
    low: Array
    high: Array
    index: NDArray[np.int32]
    middle: Array
    half: Array


def a_case(metres: float, degrees: float, seed: int, laser: LaserConfig = LASER, away_m: Array | None = None) -> Case:
    """Poses within 20 m of somewhere, tilted by up to 20 degrees; ranges from 0.5 to 12 m, as far as they are used."""
    random = np.random.default_rng(seed)
    ranges = random.uniform(max(0.5, laser.range_min_m), min(12.0, laser.range_max_m), BEAMS)
    scan = Scan(Stamp(0, 0), np.zeros(BEAMS, np.int64), -np.pi / 2, np.pi / (BEAMS - 1), ranges, 0)
    poses = np.column_stack(
        [
            random.uniform(-20, 20, (POSES, 3)) + (0.0 if away_m is None else away_m),
            random.uniform(-0.35, 0.35, (POSES, 2)),
            random.uniform(-9, 9, POSES),
        ]
    )
    widths = np.array([metres] * 3 + [np.radians(degrees)] * 3)
    low, high = poses - widths, poses + widths
    index = (np.arange(BEAMS) * POSES // BEAMS).astype(np.int32)
    middle, half = np.empty((BEAMS, ERRORS)), np.empty((BEAMS, ERRORS))
    middle[:, :6], half[:, :6] = ((low + high) / 2)[index], ((high - low) / 2)[index]
    # What a half-range loses by rounding must not be drawn: 1e-12 of it.
    mount = np.radians([laser.mount_roll_deg, -laser.mount_pitch_deg, laser.mount_yaw_deg])
    middle[:, 6:9], half[:, 6:9] = (laser.mount_x_m, laser.mount_y_m, laser.mount_z_m), laser.mount_position_bound_m
    middle[:, 9:12], half[:, 9:12] = mount, np.radians(laser.mount_angle_bound_deg)
    middle[:, 12] = scan.angle_min_rad + np.arange(BEAMS) * scan.angle_increment_rad
    middle[:, 13], middle[:, 14] = ranges, 0.0
    across = laser.angle_bound_deg if laser.across_bound_deg is None else laser.across_bound_deg
    half[:, 12:] = np.radians(laser.angle_bound_deg), laser.range_bound_m, np.radians(across)
    return Case(scan, low, high, index, middle, half * (1 - 1e-12))


def hits(e: Array) -> Array:
    """[n, 3] where beams with the parameters [n, ERRORS] hit."""
    flat = e[:, 13] * np.cos(e[:, 14])
    x, y, z = flat * np.cos(e[:, 12]), flat * np.sin(e[:, 12]), e[:, 13] * np.sin(e[:, 14])
    for first, shift in ((9, 6), (3, 0)):
        for axis in range(3):
            c, s = np.cos(e[:, first + axis]), np.sin(e[:, first + axis])
            if axis == 0:
                y, z = c * y - s * z, s * y + c * z
            elif axis == 1:
                z, x = c * z - s * x, s * z + c * x
            else:
                x, y = c * x - s * y, s * x + c * y
        x, y, z = x + e[:, shift], y + e[:, shift + 1], z + e[:, shift + 2]
    return np.stack((x, y, z), axis=-1)


def corners(case: Case, rounds: int, seed: int) -> Iterator[Array]:
    """Points with all errors at the ends of their bounds."""
    random, farthest = np.random.default_rng(seed), jacobian_signs(hits, case.middle)
    for n in range(rounds):
        if n % 2:
            sign = random.choice([-1.0, 1.0], case.half.shape)
        else:
            # The farthest corner along an axis, and those a few flips from it.
            sign = farthest[n // 2 % 3] * (1 if n // 6 % 2 else -1)
            sign = np.where(random.random(sign.shape) < (0.0 if n < 12 else 0.1), -sign, sign)
        yield hits(case.middle + sign * case.half)


def uniform(case: Case, rounds: int, seed: int) -> Iterator[Array]:
    """Points with uniform errors."""
    random = np.random.default_rng(seed)
    for _ in range(rounds):
        yield hits(case.middle + random.uniform(-1.0, 1.0, case.half.shape) * case.half)


@dataclass(slots=True)
class Score:
    """Points checked, and those outside."""

    points: int = 0
    outside_box: int = 0
    outside_cell: int = 0
    outside_first_order: int = 0
    """Outside the paper's first-order box, which has no remainder."""
    farthest_m: float = 0.0
    """How far outside that."""


def check(
    case: Case,
    points: Iterator[Array],
    score: Score,
    laser: LaserConfig = LASER,
    resolution_m: float = RESOLUTION_M,
) -> None:
    """Hold points against the case's boxes and its map."""
    boxes = project(case.scan, laser, case.low, case.high, case.index)
    terrain = ElevationMap(MapConfig(resolution_m=resolution_m, max_footprint_m=50.0), laser)
    terrain.insert(case.scan, case.low, case.high, case.index)
    saved = assemble(terrain.tiles(), resolution_m, "map")
    first = first_order(case)
    centre = hits(case.middle)
    for some in points:
        score.points += len(some)
        score.outside_box += int(np.count_nonzero(~np.all((boxes.low <= some) & (some <= boxes.high), axis=1)))
        cell = np.floor(some[:, :2] / resolution_m).astype(np.int64) - np.round(
            np.array(saved.origin_m) / resolution_m
        ).astype(np.int64)
        low, high = saved.low[cell[:, 1], cell[:, 0]], saved.high[cell[:, 1], cell[:, 0]]
        score.outside_cell += int(np.count_nonzero(~((low <= some[:, 2]) & (some[:, 2] <= high))))
        beyond = np.max(np.abs(some - centre) - first, axis=1)
        score.outside_first_order += int(np.count_nonzero(beyond > 0))
        score.farthest_m = max(score.farthest_m, float(beyond.max()))


def first_order(case: Case) -> Array:
    """[BEAMS, 3] |J| d, the half-widths of the paper's first-order form."""
    total = np.zeros((BEAMS, 3))
    for k in range(ERRORS):
        step = np.zeros(ERRORS)
        step[k] = 1e-6
        total += np.abs(hits(case.middle + step) - hits(case.middle - step)) / 2e-6 * case.half[:, k : k + 1]
    return total


def natural(e: list[mpmath.mpf]) -> list[mpmath.mpf]:
    """The point of the parameters [ERRORS] in interval arithmetic: the paper's natural extension."""
    iv = mpmath.iv
    flat = e[13] * iv.cos(e[14])
    point = [flat * iv.cos(e[12]), flat * iv.sin(e[12]), e[13] * iv.sin(e[14])]
    for first, shift in ((9, 6), (3, 0)):
        for axis in range(3):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            c, s = iv.cos(e[first + axis]), iv.sin(e[first + axis])
            point[a], point[b] = c * point[a] - s * point[b], s * point[a] + c * point[b]
        point = [point[i] + e[shift + i] for i in range(3)]
    return point


def against_interval_arithmetic(case: Case, beams: int) -> tuple[int, int, float]:
    """(boxes compared, boxes that don't meet interval arithmetic's or miss a corner of it, mean width against its)."""
    boxes = project(case.scan, LASER, case.low, case.high, case.index)
    wrong, ratios = 0, []
    mpmath.iv.dps = 25
    some = np.linspace(0, BEAMS - 1, beams).astype(int)
    farthest = jacobian_signs(hits, case.middle)
    extremes = [hits(case.middle + way * farthest[axis] * case.half) for axis in range(3) for way in (-1.0, 1.0)]
    for n in some:
        ends = zip((case.middle - case.half)[n].tolist(), (case.middle + case.half)[n].tolist(), strict=True)
        enclosure = natural([mpmath.iv.mpf([a, b]) for a, b in ends])
        for i, interval in enumerate(enclosure):
            a, b = float(interval.a), float(interval.b)
            ours_low, ours_high = boxes.low[n, i], boxes.high[n, i]
            # Both contain every attained point: they meet, and each holds the extremes.
            found = [points[n, i] for points in extremes]
            wrong += not (ours_low <= b and a <= ours_high and ours_low <= min(found) and max(found) <= ours_high)
            wrong += not (a - 1e-12 <= min(found) and max(found) <= b + 1e-12)
            ratios.append((ours_high - ours_low) / (b - a))
    return len(some), wrong, float(np.mean(ratios))


def prove(points: int, boxes: int) -> tuple[str, bool]:
    """The tables as Markdown, and whether everything held."""
    rows, tight, sound = [], [], True
    for level, (metres, degrees) in enumerate(LEVELS):
        for name, draw in (("corners", corners), ("uniform", uniform)):
            score, seed = Score(), 0
            while score.points < points / len(LEVELS):
                seed += 1
                case = a_case(metres, degrees, 100 * level + seed)
                rounds = min(500, -(-(points // len(LEVELS) - score.points) // BEAMS))
                check(case, draw(case, rounds, seed), score)
            sound &= score.outside_box == score.outside_cell == 0
            rows.append(
                f"| {metres} m, {degrees} deg | {name} | {score.points:,} | {score.outside_box} | {score.outside_cell} "
                f"| {100 * score.outside_first_order / score.points:.2f} % | {1e3 * score.farthest_m:.1f} mm |"
            )
        case = a_case(metres, degrees, level)
        ours = project(case.scan, LASER, case.low, case.high, case.index)
        least, most = attained(hits, case.middle, case.half, ANGLES)
        excess = 100 * ((ours.high - ours.low) / (most - least) - 1)
        missed = int(np.count_nonzero((least < ours.low) | (most > ours.high)))
        count, wrong, ratio = against_interval_arithmetic(case, boxes // len(LEVELS))
        sound &= wrong == missed == 0
        tight.append(
            f"| {metres} m, {degrees} deg | {missed} | {' / '.join(f'{e:.2f}' for e in excess.mean(axis=0))} % "
            f"| {' / '.join(f'{e:.2f}' for e in excess.max(axis=0))} % | {100 * np.mean(excess > 1.5):.2f} % "
            f"| {count:,} | {wrong} | {100 * ratio:.1f} % |"
        )
    return TEXT + "\n".join(rows) + "\n" + TIGHT + "\n".join(tight) + "\n", sound


TEXT = """Points of the measurement model with errors inside their bounds, held against the box of their beam and the
interval of their cell (10 cm). Last two columns: the same points against the paper's first-order box, |J| d, which has
no remainder.

| pose | errors | points | outside their box | outside their cell | outside first order | by at most |
|---|---|---|---|---|---|---|
"""
TIGHT = """
How wide the boxes are: against the range that errors attain (the farthest points that a climb over all errors finds,
`bench/attained.py`, each of which must be inside: *missed*), and against interval arithmetic along the chain
(mpmath.iv, 25 digits), the paper's natural extension, which must hold the same extremes.

| pose | missed | wider, mean: x / y / z | largest | above 1.5 % | against mpmath.iv | wrong | width against its |
|---|---|---|---|---|---|---|---|
"""


def main() -> int:
    """Print the tables, write the page after a full run; 0 if everything held."""
    parser = argparse.ArgumentParser(prog="python -m bench.prove_boxes", description="points against boxes and cells")
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--boxes", type=int, default=4 * BEAMS)
    options = parser.parse_args()
    text, sound = prove(options.points, options.boxes)
    print(text)
    if options.points >= 10_000_000:
        PAGE.write_text(heading("Boxes and cells", "python -m bench.prove_boxes") + text, encoding="utf-8")
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
