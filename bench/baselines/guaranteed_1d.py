"""Our map over one horizontal dimension: the mapper's rules (docs/rounding.md) with the place a number, not a plane.

The first-order interval with a remainder that covers what the first order leaves out, rounded outward; hull of every
cell that it meets. Certified cells: a run of measurements between which the beam can't have moved by a cell visits
every cell between its ends (section 2.5 of our reference; ours takes the step between two hits from the bounds, so
that the true pitch may change, too).

Rounding. Where |x| + |h| + r is less than B = 2^16 m, the computed X and Z err by less than 12 u B (u = 2^-53; a sine
by 8 u), the division into cells by 3 u B: PAD is more. The half-widths, sums of products of positive numbers, err by
less than 20 u of themselves: the bounds, made larger by GROW first, hold more than that. Stored as float32 an end moves
by 2^-24 of itself at most, and it is no more than |h| + r + dZ: SINGLE of those, part of dZ, is more than twice that.
"""

from math import inf

import numpy as np
from numpy.typing import NDArray

from bench.baselines.beam_1d import LANES, Scratch, end_of_beam
from bench.baselines.cell_pair import PAIR_BYTES, hull_pair
from drivers.compiled import compiled, compiled_unlocked
from mapper.fused import fused

Floats = NDArray[np.float64]
Cells = NDArray[np.float32]
Flags = NDArray[np.bool_]
PAD = 2.0**-32
"""m: 15 u B is less than 2^-33."""
SINGLE = 2.0**-22
GROW = 1.0 + 2.0**-46
AHEAD = 0  # r cos pitch
SLACK = LANES  # how far the true beam's length along the ground can be from that
X_LOW = 2 * LANES
X_HIGH = 3 * LANES


def unseen_cells(count: int) -> Cells:
    """[count, 2] -low and high of cells that no measurement met."""
    return np.full((count, 2), -np.inf, np.float32)


@compiled_unlocked
def insert_guaranteed(
    x: Floats,
    pitch: Floats,
    ranges: Floats,
    bounds: Floats,
    height_m: float,
    width_m: float,
    first_cell: int,
    cells: Cells,
    certified: Flags,
    most_step_m: float,
    scratch: Scratch,
) -> None:
    """Take measurements in the order of a drive: x, pitch, ranges, all [n]; bounds [3] of their errors.

    cells [m, 2]: -low, high, both rounded up (one maximum takes the hull); certified [m]; most_step_m: the farthest the
    robot can drive between two measurements; infinity: no cell is to be certified. Pitch lies within STEEPEST_RAD. A
    measurement that may lie outside the cells is left out.
    """
    per_m = 1.0 / width_m
    run_low, run_high = inf, -inf  # the least upper and the greatest lower end of the run's places
    ahead, slack = inf, 0.0  # of the measurement before
    for first in range(0, x.size, LANES):
        count = min(LANES, x.size - first)
        _bound_block(first, count, x, pitch, ranges, bounds, height_m, per_m, scratch.rows, scratch.cells, scratch.ends)
        _hull_block(count, first_cell, scratch.cells, scratch.ends, cells)
        rows = scratch.rows
        if most_step_m == inf:
            continue
        if _unbroken(count, ahead, slack, width_m - most_step_m, rows):
            for n in range(count):
                run_low, run_high = min(run_low, rows[X_HIGH + n]), max(run_high, rows[X_LOW + n])
            ahead, slack = rows[AHEAD + count - 1], rows[SLACK + count - 1]
        else:
            for n in range(count):
                if not abs(rows[AHEAD + n] - ahead) + rows[SLACK + n] + slack < width_m - most_step_m:
                    _certify(run_low, run_high, per_m, first_cell, certified)
                    run_low, run_high = inf, -inf
                run_low, run_high = min(run_low, rows[X_HIGH + n]), max(run_high, rows[X_LOW + n])
                ahead, slack = rows[AHEAD + n], rows[SLACK + n]
    _certify(run_low, run_high, per_m, first_cell, certified)


@compiled
def _bound_block(
    first: int,
    count: int,
    x: Floats,
    pitch: Floats,
    ranges: Floats,
    bounds: Floats,
    height_m: float,
    per_m: float,
    rows: Floats,
    spans: NDArray[np.int32],
    ends: Cells,
) -> None:
    """Intervals of place and elevation (3), rounded outward, and the cells that the place's meets."""
    b_x, b_pitch, b_range = GROW * bounds[0], GROW * bounds[1], GROW * bounds[2]
    per_r = 0.5 * b_pitch * b_pitch
    constant = (1.0 + SINGLE) * (b_range * b_pitch + per_r * b_range) + SINGLE * (abs(height_m) + b_range) + PAD
    per_r = (1.0 + SINGLE) * per_r + SINGLE * (1.0 + b_pitch)
    x, pitch, ranges = x[first : first + count], pitch[first : first + count], ranges[first : first + count]
    for n in range(count):
        r = ranges[n]
        ahead, up, c, s = end_of_beam(pitch[n], r)
        X, Z = x[n] + ahead, height_m + up
        rest = fused(per_r, r, constant)
        slack = fused(abs(c), b_range, fused(abs(up), b_pitch, rest))
        dX = b_x + slack
        dZ = fused(abs(s), b_range, fused(abs(ahead), b_pitch, rest))
        rows[AHEAD + n], rows[SLACK + n], rows[X_LOW + n], rows[X_HIGH + n] = ahead, slack, X - dX, X + dX
        ends[2 * n], ends[2 * n + 1] = np.float32(dZ - Z), np.float32(Z + dZ)
        spans[n] = np.int32(np.floor(fused(X - dX, per_m, 0.5)))
        spans[LANES + n] = np.int32(np.floor(fused(X + dX, per_m, 0.5)))


@compiled
def _unbroken(count: int, ahead: float, slack: float, less_than_m: float, rows: Floats) -> bool:
    """Do all measurements of the block carry on the run of the one before, whose AHEAD and SLACK are given?"""
    steps = 0
    for n in range(1, count):
        step = abs(rows[AHEAD + n] - rows[AHEAD + n - 1]) + rows[SLACK + n] + rows[SLACK + n - 1]
        steps += 1 if step < less_than_m else 0
    return steps == count - 1 and abs(rows[AHEAD] - ahead) + rows[SLACK] + slack < less_than_m


@compiled
def _hull_block(count: int, first_cell: int, spans: NDArray[np.int32], ends: Cells, cells: Cells) -> None:
    """Hull of each measurement's cells with its interval."""
    size, first_at, ends_at = np.uint64(len(cells)), np.uint64(cells.ctypes.data), np.uint64(ends.ctypes.data)
    for n in range(count):
        interval = ends_at + np.uint64(PAIR_BYTES * n)
        i, last = np.uint64(spans[n] - first_cell), np.uint64(spans[LANES + n] - first_cell)
        while i <= last < size:
            hull_pair(first_at + np.uint64(PAIR_BYTES) * i, interval)
            i += np.uint64(1)


@compiled
def _certify(run_low: float, run_high: float, per_m: float, first_cell: int, certified: Flags) -> None:
    """Mark the cells that the run surely visited: it was left of run_low once, and right of run_high."""
    if run_low < inf:
        begin, end = int(np.floor(run_low * per_m + 0.5)), int(np.floor(run_high * per_m + 0.5))
        for i in range(max(begin - first_cell, 0), min(end + 1 - first_cell, certified.size)):
            certified[i] = True


def ends(cells: Cells) -> tuple[Floats, Floats]:
    """Low and high, each [m], NaN where nothing was measured."""
    seen = cells[:, 1] > -np.inf
    low, high = -cells[:, 0].astype(np.float64), cells[:, 1].astype(np.float64)
    return np.where(seen, low, np.nan), np.where(seen, high, np.nan)
