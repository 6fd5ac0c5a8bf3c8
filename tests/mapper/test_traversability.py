"""Step, slope and roughness of a map against the points that made it, by brute force."""

from itertools import product
from math import hypot, tan
from math import radians as to_radians

import numpy as np
import pytest
from numpy.typing import NDArray

from mapper.saved_map import SavedMap
from mapper.traversability import RobotLimits, Verdict, assess, reach_of

CELL = 0.25
Points = dict[tuple[int, int], NDArray[np.float64]]
"""[n, 3] measured points by (row, column)."""


def some_map(seed: int, seen: float = 0.9, sure: float = 0.8, side: int = 12, spread: float = 0.2) -> SavedMap:
    """Rough ground with holes, cells of any width, some of them surely hit; far from the origin and high up."""
    chance = np.random.default_rng(seed)
    middle = chance.normal(0, spread, (side, side)) + 800.0 + 0.1 * np.arange(side)
    width = chance.choice([0.0, 0.01, 0.1], (side, side))
    low, high = (middle - width).astype(np.float32), (middle + width).astype(np.float32)
    unseen = chance.random((side, side)) > seen
    low[unseen], high[unseen] = np.nan, np.nan
    flags = (chance.random((side, side)) < sure) & ~unseen
    return SavedMap(low, high, CELL, (100.0, -50.0), "map", "", flags)


def hits(saved: SavedMap, seed: int) -> Points:
    """Points as could have been measured: at the corners of cells and intervals; at least one where surely hit."""
    chance = np.random.default_rng(seed)
    assert saved.surely_hit is not None
    points: Points = {}
    for row, col in zip(*np.nonzero(~np.isnan(saved.low)), strict=True):
        count = int(chance.integers(int(saved.surely_hit[row, col]), 4))
        corner = np.array([saved.origin_m[0] + col * CELL, saved.origin_m[1] + row * CELL])
        xy = corner + CELL * chance.choice([0.0, 0.5, 1.0 - 1e-9], (count, 2))
        z = chance.choice([saved.low[row, col], saved.high[row, col]], count)
        points[int(row), int(col)] = np.column_stack((xy, z.astype(float)))
    return points


def true_step(points: Points, row: int, col: int) -> float:
    """Largest difference between a point of the cell and one of it or its neighbours."""
    around = [points.get((row + i, col + j), np.empty((0, 3))) for i, j in product((-1, 0, 1), repeat=2)]
    pairs = [abs(p[2] - q[2]) for p in points[row, col] for cell in around for q in cell]
    return max(pairs, default=0.0)


def true_slope(points: Points, row: int, col: int, reach: int) -> float:
    """Steepest line between points of opposite ends, in four directions."""
    steepest = 0.0
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):
        ends = (points.get((row + s * reach * j, col + s * reach * i), np.empty((0, 3))) for s in (-1, 1))
        for p, q in product(*ends):
            steepest = max(steepest, abs(p[2] - q[2]) / hypot(p[0] - q[0], p[1] - q[1]))
    return steepest


def true_roughness(saved: SavedMap, points: Points, row: int, col: int, reach: int) -> float:
    """Range of the heights above the plane that fits the middles best, by numpy's least squares."""
    rows, columns = saved.low.shape
    window = [
        (i, j)
        for i in range(max(row - reach, 0), min(row + reach, rows - 1) + 1)
        for j in range(max(col - reach, 0), min(col + reach, columns - 1) + 1)
        if not np.isnan(saved.low[i, j])
    ]
    x = np.array([(j - col + 0.5) * CELL for _, j in window])
    y = np.array([(i - row + 0.5) * CELL for i, _ in window])
    z = np.array([(float(saved.low[c]) + float(saved.high[c])) / 2 for c in window])
    equations = np.column_stack((x, y, np.ones(len(x))))
    planes = np.array([0.0, 0.0, (z - 800).mean()])
    if np.linalg.matrix_rank(equations) == 3:
        planes = np.linalg.lstsq(equations, z - 800, rcond=None)[0]
    there = [points[c] for c in window if len(points[c])]
    if not there:
        return 0.0
    all_points = np.concatenate(there) - [saved.origin_m[0] + col * CELL, saved.origin_m[1] + row * CELL, 800]
    heights = all_points[:, 2] - all_points[:, :2] @ planes[:2] - planes[2]
    return float(heights.max() - heights.min())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("length", [0.5, 1.0])
def test_bounds_contain_what_the_points_say(seed: int, length: float) -> None:
    """For points at the corners of cells and intervals: step, slope and roughness lie between their bounds."""
    saved = some_map(seed)
    limits = RobotLimits(0.3, 20.0, 0.5, length)
    reach = reach_of(limits, CELL)
    result = assess(saved, limits)
    for trial in range(3):
        points = hits(saved, 100 * seed + trial)
        for row, col in points:
            step, slope = true_step(points, row, col), true_slope(points, row, col, reach)
            assert result.step_low[row, col] <= step <= result.step_high[row, col]
            if not np.isnan(result.slope_low[row, col]):
                assert result.slope_low[row, col] <= slope <= result.slope_high[row, col]
            else:
                assert slope == 0.0
            # The oracle's plane is the same but for rounding.
            rough = true_roughness(saved, points, row, col, reach)
            assert result.roughness_low[row, col] - 1e-9 <= rough <= result.roughness_high[row, col] + 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_verdicts_hold_for_the_points(seed: int) -> None:
    """Impassable: a limit is surely exceeded. Passable: no limit is, and every cell around holds a point."""
    saved = some_map(seed, seen=0.99, sure=0.99, spread=0.03)
    for layer in (saved.low, saved.high):
        layer[3:5, 3:5] += 1.0
    limits = RobotLimits(0.35, 60.0, 0.9, 0.5)
    reach, slope_limit = reach_of(limits, CELL), tan(to_radians(60.0))
    verdict = assess(saved, limits).verdict
    counts = np.bincount(verdict[~np.isnan(saved.low)], minlength=3)
    assert counts.min() > 0, counts
    for trial in range(4):
        points = hits(saved, 100 * seed + trial)
        for row, col in points:
            worst = (
                true_step(points, row, col) / limits.max_step_m,
                true_slope(points, row, col, reach) / slope_limit,
                true_roughness(saved, points, row, col, reach) / limits.max_roughness_m,
            )
            if verdict[row, col] == Verdict.IMPASSABLE:
                assert max(worst) > 1
            if verdict[row, col] == Verdict.PASSABLE:
                assert max(worst) <= 1
                around = product(range(row - reach, row + reach + 1), range(col - reach, col + reach + 1))
                assert all(len(points.get(cell, ())) for cell in around)


def test_bounds_are_attained_where_they_can_be() -> None:
    """A flat floor of exact cells: no step, no slope, no roughness; and a clean step of 0.2 m is just that."""
    low = np.zeros((9, 9), np.float32)
    everywhere = np.ones((9, 9), np.bool_)
    flat = SavedMap(low, low, CELL, (0.0, 0.0), "map", "", everywhere)
    limits = RobotLimits(0.15, 20.0, 0.25, 0.5)
    result = assess(flat, limits)
    inside = np.s_[1:-1, 1:-1]
    for high in (result.step_high, result.slope_high, result.roughness_high):
        assert np.nanmax(high) < 1e-6
    assert (result.verdict[inside] == Verdict.PASSABLE).all()
    assert (result.verdict[0] == Verdict.UNKNOWN).all(), "a neighbour is missing"
    low = low.copy()
    low[:, 5:] = 0.2
    result = assess(SavedMap(low, low, CELL, (0.0, 0.0), "map", "", everywhere), limits)
    assert result.step_low[4, 4] == pytest.approx(0.2, rel=1e-6)
    assert result.step_high[4, 4] == pytest.approx(0.2, rel=1e-6)
    assert (result.verdict[inside][:, 3:5] == Verdict.IMPASSABLE).all()
    assert (result.verdict[inside][:, :2] == Verdict.PASSABLE).all()


def test_nothing_is_certain_of_cells_that_were_only_possibly_hit() -> None:
    """Without the flag, the same map has bounds, but no verdicts, and no lower bound above zero."""
    saved = some_map(1)
    blind = SavedMap(saved.low, saved.high, CELL, saved.origin_m, "map", "")
    result = assess(blind, RobotLimits(0.1, 10.0, 0.2, 0.5))
    assert (result.verdict == Verdict.UNKNOWN).all()
    for low in (result.step_low, result.slope_low, result.roughness_low):
        assert np.nanmax(low) == 0.0
    assert np.isnan(result.step_high[np.isnan(saved.low)]).all()
    assert not np.isnan(result.step_high[~np.isnan(saved.low)]).any()


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (1, 7)])
def test_small_maps_have_few_neighbours(shape: tuple[int, int]) -> None:
    """No map is too small."""
    low = np.zeros(shape, np.float32)
    result = assess(SavedMap(low, low, 0.05, (0.0, 0.0), "map", "", np.ones(shape, np.bool_)), RobotLimits(1, 45, 1, 1))
    assert result.verdict.shape == shape
    assert (result.verdict == Verdict.UNKNOWN).all()


@pytest.mark.parametrize("wrong", [{"max_step_m": 0.0}, {"max_slope_deg": 90.0}, {"length_m": float("nan")}])
def test_limits_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    """Zero, not a number, a vertical slope: named."""
    good = {"max_step_m": 0.1, "max_slope_deg": 20.0, "max_roughness_m": 0.1, "length_m": 0.65}
    with pytest.raises(ValueError, match=next(iter(wrong))):
        RobotLimits(**good | wrong)
