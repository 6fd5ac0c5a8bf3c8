"""What a driven map says of step, slope and roughness, held against where the beams truly hit."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from mapper.saved_map import SavedMap
from mapper.traversability import RobotLimits, Traversability, Verdict, assess, reach_of
from service.commands.virtual_drive import drive_virtually
from service.config import load
from service.shipped import shipped_config

CELL = 0.25
LIMITS = RobotLimits(max_step_m=0.12, max_slope_deg=35.0, max_roughness_m=0.3, length_m=0.65)
Hits = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Driven:
    """A map, what it says, and the true hits of each cell."""

    saved: SavedMap
    says: Traversability
    hits: dict[tuple[int, int], Hits]
    """(row, column): [n, 3]"""


@cache
def up_the_stairs() -> Driven:
    """The demo's robot, errors at the corners of their bounds, cells large enough to be surely hit."""
    demo = load(shipped_config("demo.toml"))
    coarse = replace(demo, config=replace(demo.config, map=replace(demo.config.map, resolution_m=CELL)))
    done = drive_virtually(coarse, scene="stairs", law="corners", seed=3, duration_s=14.0)
    saved, truth = done.saved, done.truth.in_map_frame()
    mapped = done.poses.cover(truth.hit_time_ns) & (truth.hit_range_m >= done.laser.range_min_m)
    mapped &= truth.hit_range_m <= done.laser.range_max_m
    hit = truth.hit[mapped]
    col, row = (np.floor((hit[:, k] - saved.origin_m[k]) / CELL).astype(int) for k in (0, 1))
    order = np.lexsort((col, row))
    cells, begins = np.unique(np.stack((row, col))[:, order], axis=1, return_index=True)
    groups = np.split(hit[order], begins[1:])
    hits = {(int(i), int(j)): group for (i, j), group in zip(cells.T, groups, strict=True)}
    return Driven(saved, assess(saved, LIMITS), hits)


def test_steps_hold_for_true_hits() -> None:
    """Up the stairs: true hits of a cell and its neighbours differ by no more than the bound, and by the least."""
    driven = up_the_stairs()
    largest = 0.0
    for (row, col), here in driven.hits.items():
        around = np.concatenate(
            [driven.hits.get((row + i, col + j), here)[:, 2] for i in (-1, 0, 1) for j in (-1, 0, 1)]
        )
        step = max(around.max() - here[:, 2].min(), here[:, 2].max() - around.min())
        assert driven.says.step_low[row, col] <= step <= driven.says.step_high[row, col]
        if driven.says.verdict[row, col] == Verdict.PASSABLE:
            assert step <= LIMITS.max_step_m
        largest = max(largest, step)
    assert len(driven.hits) > 200
    assert largest > 0.1, "there are stairs"
    assert np.count_nonzero(driven.says.verdict == Verdict.PASSABLE) > 5


def test_slopes_hold_for_true_hits() -> None:
    """The steepest pair of true hits at the ends of a baseline is within the bounds of the cell between."""
    driven, reach, pairs, steepest, certain = up_the_stairs(), reach_of(LIMITS, CELL), 0, 0.0, 0
    rows, columns = driven.saved.low.shape
    for row in range(rows):
        for col in range(columns):
            slope = 0.0
            for i, j in ((0, 1), (1, 0), (1, 1), (-1, 1)):
                ends = [driven.hits.get((row + way * reach * i, col + way * reach * j)) for way in (-1, 1)]
                if np.isnan(driven.saved.low[row, col]) or ends[0] is None or ends[1] is None:
                    continue
                apart = ends[0][:, None] - ends[1]
                slope = max(slope, float(np.max(np.abs(apart[..., 2]) / np.hypot(apart[..., 0], apart[..., 1]))))
                pairs += 1
            if slope > 0.0:
                assert driven.says.slope_low[row, col] <= slope <= driven.says.slope_high[row, col]
                certain += bool(driven.says.slope_low[row, col] > 0.0)
                steepest = max(steepest, slope)
    assert pairs > 200
    assert certain > 0
    assert steepest > 0.3


def test_roughness_holds_for_true_hits() -> None:
    """The range of true hits above the plane that fits the window's middles, found by least squares, is within."""
    driven, reach, rough = up_the_stairs(), reach_of(LIMITS, CELL), []
    middles = (driven.saved.low.astype(float) + driven.saved.high) / 2
    for row, col in list(driven.hits)[::3]:
        if np.isnan(middles[row, col]):
            continue
        top, left = max(row - reach, 0), max(col - reach, 0)
        window = np.s_[top : row + reach + 1, left : col + reach + 1]
        i, j = np.nonzero(np.isfinite(middles[window]))
        x, y = left + j + 0.5, top + i + 0.5
        level = np.linalg.matrix_rank(np.stack((x - x.mean(), y - y.mean()))) < 2
        columns = [np.ones(len(x))] if level else [np.ones(len(x)), x, y]
        plane = np.linalg.lstsq(np.stack(columns, axis=-1), middles[window][i, j], rcond=None)[0]
        some = np.concatenate(
            [driven.hits.get((int(top + n), int(left + m)), np.empty((0, 3))) for n, m in zip(i, j, strict=True)]
        )
        u, v = ((some[:, k] - driven.saved.origin_m[k]) / CELL for k in (0, 1))
        above = some[:, 2] - plane[0] - (0.0 if level else plane[1] * u + plane[2] * v)
        low, high = driven.says.roughness_low[row, col], driven.says.roughness_high[row, col]
        assert low - 1e-9 <= np.ptp(above) <= high + 1e-9
        rough.append(np.ptp(above))
    assert len(rough) > 60
    assert max(rough) > 0.1
