"""The paper's set-valued map as written (doi 10.5772/57293), over one horizontal dimension: no remainder, no rounding.

A measurement is an interval of place and one of elevation; every cell that the first meets takes the hull of its
interval with the second. Reconstructed from the stated model: the first-order form is (3) of our reference without its
remainder, the natural form evaluates (1) in interval arithmetic. Intersection in the place of the hull, which the paper
argues against, is here to show what it would do.
"""

from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from bench.baselines.beam_1d import LANES, Scratch, end_of_beam, sine_cosine
from drivers.compiled import compiled, compiled_unlocked
from mapper.fused import fused

Floats = NDArray[np.float64]
Cells = NDArray[np.float32]
Spans = NDArray[np.int32]

FIRST_ORDER, NATURAL = 1, 2
"""Forms of a measurement's interval."""
INTERSECT, INTERSECT_UNTIL_EMPTY = 1, 2
"""Rules: the intersection, or the hull where it is empty; the same, but the hull ever after."""


def unseen_cells(count: int) -> Cells:
    """[count, 2] low and high of cells that no measurement met."""
    return np.tile(np.array([np.inf, -np.inf], np.float32), (count, 1))


@compiled_unlocked
def insert_set_valued(
    x: Floats,
    pitch: Floats,
    ranges: Floats,
    bounds: Floats,
    height_m: float,
    width_m: float,
    first_cell: int,
    cells: Cells,
    form: int,
    scratch: Scratch,
) -> None:
    """Take measurements: x [m], pitch [rad], ranges [m], all [n]; bounds [3] of their errors, cells [m, 2] ends.

    A measurement that may lie outside the cells is left out.
    """
    size = np.uint64(len(cells))
    for first in range(0, x.size, LANES):
        count = min(LANES, x.size - first)
        here = slice(first, first + count)
        if form == NATURAL:
            _natural(x[here], pitch[here], ranges[here], bounds, height_m, 1.0 / width_m, scratch.cells, scratch.ends)
        else:
            _first_order(
                x[here], pitch[here], ranges[here], bounds, height_m, 1.0 / width_m, scratch.cells, scratch.ends
            )
        for n in range(count):
            low, high = scratch.ends[n], scratch.ends[LANES + n]
            i, last = np.uint64(scratch.cells[n] - first_cell), np.uint64(scratch.cells[LANES + n] - first_cell)
            while i <= last < size:
                cell = cells[i]
                cell[0] = low if low < cell[0] else cell[0]
                cell[1] = high if high > cell[1] else cell[1]
                i += np.uint64(1)


@compiled_unlocked
def insert_intersecting(
    x: Floats,
    pitch: Floats,
    ranges: Floats,
    bounds: Floats,
    height_m: float,
    width_m: float,
    first_cell: int,
    cells: Cells,
    levels: NDArray[np.bool_],
    rule: int,
    scratch: Scratch,
) -> None:
    """The first-order form with a rule that intersects. levels [m]: cells whose intersection was empty once."""
    size = np.uint64(len(cells))
    for first in range(0, x.size, LANES):
        count = min(LANES, x.size - first)
        here = slice(first, first + count)
        _first_order(x[here], pitch[here], ranges[here], bounds, height_m, 1.0 / width_m, scratch.cells, scratch.ends)
        for n in range(count):
            low, high = scratch.ends[n], scratch.ends[LANES + n]
            i, last = np.uint64(scratch.cells[n] - first_cell), np.uint64(scratch.cells[LANES + n] - first_cell)
            while i <= last < size:
                cell, unseen = cells[i], cells[i, 0] > cells[i, 1]
                meets = max(cell[0], low) <= min(cell[1], high)
                if meets and not (levels[i] and rule == INTERSECT_UNTIL_EMPTY):
                    cell[0], cell[1] = max(cell[0], low), min(cell[1], high)
                else:
                    levels[i] |= not unseen
                    cell[0], cell[1] = min(cell[0], low), max(cell[1], high)
                i += np.uint64(1)


@compiled
def _first_order(
    x: Floats, pitch: Floats, ranges: Floats, bounds: Floats, height_m: float, per_m: float, spans: Spans, ends: Cells
) -> None:
    """Each measurement's cells and interval by (1) and (3), without the remainder."""
    b_x, b_pitch, b_range = bounds[0], bounds[1], bounds[2]
    for n in range(x.size):
        ahead, up, c, s = end_of_beam(pitch[n], ranges[n])
        X, Z = x[n] + ahead, height_m + up
        dX = fused(abs(c), b_range, fused(abs(up), b_pitch, b_x))
        dZ = fused(abs(s), b_range, abs(ahead) * b_pitch)
        ends[n], ends[LANES + n] = np.float32(Z - dZ), np.float32(Z + dZ)
        spans[n] = np.int32(np.floor(fused(X - dX, per_m, 0.5)))
        spans[LANES + n] = np.int32(np.floor(fused(X + dX, per_m, 0.5)))


@compiled
def _natural(
    x: Floats, pitch: Floats, ranges: Floats, bounds: Floats, height_m: float, per_m: float, spans: Spans, ends: Cells
) -> None:
    """The same by [X] = [x] + [r] cos [pitch], [Z] = h + [r] sin [pitch]."""
    b_x, b_pitch, b_range = bounds[0], bounds[1], bounds[2]
    cb, sb = cos(b_pitch), sin(b_pitch)
    for n in range(x.size):
        r_low, r_high = max(ranges[n] - b_range, 0.0), ranges[n] + b_range
        s, c = sine_cosine(pitch[n])
        # At both ends of [pitch], by the sines and cosines of a sum; the sine rises from end to end.
        c_down, c_up = fused(c, cb, s * sb), fused(c, cb, -s * sb)
        s_low, s_high = fused(s, cb, -c * sb), fused(s, cb, c * sb)
        c_high = 1.0 if abs(pitch[n]) <= b_pitch else max(c_down, c_up)
        X_low = fused(r_low, min(c_down, c_up), x[n] - b_x)
        X_high = fused(r_high, c_high, x[n] + b_x)
        ends[n] = np.float32(fused(r_high if s_low < 0.0 else r_low, s_low, height_m))
        ends[LANES + n] = np.float32(fused(r_low if s_high < 0.0 else r_high, s_high, height_m))
        spans[n] = np.int32(np.floor(fused(X_low, per_m, 0.5)))
        spans[LANES + n] = np.int32(np.floor(fused(X_high, per_m, 0.5)))


def ends(cells: Cells) -> tuple[Floats, Floats]:
    """Low and high, each [m], NaN where nothing was measured."""
    low, high = cells[:, 0].astype(np.float64), cells[:, 1].astype(np.float64)
    seen = low <= high
    return np.where(seen, low, np.nan), np.where(seen, high, np.nan)
