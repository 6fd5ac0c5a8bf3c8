"""Where beams end in the grid: of each box its fate, its cells and its interval, as the kernel's hull takes them.

Cells are counted in float32 from the one that holds the pose (docs/rounding.md, Lemma 4); what is stored is rounded up
(Lemma 5).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_into_callers, compiled_without_heap
from mapper.beam_order import STEP
from mapper.cell_blocks import (
    ALIGNED_CELLS,
    BLOCK_CELLS,
    CELL_BYTES,
    ROW_BYTES,
    WIDE_CELLS,
    WIDE_WINDOW_BYTES,
    WINDOW_BYTES,
)
from mapper.fused import fused
from mapper.grid import CELL_LIMIT, TILE_SHIFT, TILE_SIDE
from mapper.laser_geometry import Floats
from mapper.pose_terms import P_HIGH, P_LOW, Singles
from mapper.projection import B_X0, B_X1, B_Y0, B_Y1, B_Z0, B_Z1, LANES

Indices = NDArray[np.int32]

USED, NO_RANGE, NO_POSE, TOO_WIDE, TOO_FAR, BEYOND_CAP = range(6)
"""What becomes of a beam, as elevation_map.InsertResult says it."""
FATES = 6

# Where the beams of a block end in the grid: rows of LANES int32. First the cells, ...
S_FATE, S_I0, S_I1, S_J0, S_J1 = (row * LANES for row in range(5))
# ... then, for what lies in one tile, which (else NOWHERE), the first block's place in it in bytes, how many rows, and
# from there the first and last column; of a footprint in one block, too, which window of it (cell_blocks.py).
S_IX, S_IY, S_PLACE, S_ROWS, S_FIRST, S_LAST, S_WINDOW = (row * LANES for row in range(5, 12))
S_ONE_CELL = 12 * LANES
"""1 for a footprint that is used and reaches but one cell."""
SPANS_SIZE = 13 * LANES
NOWHERE = np.int32(-(1 << 31))
_INDEX_LIMIT = float(CELL_LIMIT)
IN_TILE = TILE_SIDE - 1
"""The bits of a cell's number that say where in its tile it is."""

# Rounding to float32 errs by at most 2^-24 of the value, so twice that, added first, makes it round up. The constant
# does it near zero (and is no subnormal, which some processors flush to zero).
_UP = 2.0**-23
_UP_NEAR_ZERO = 2.0**-100
# The same of a float32 sum, which has erred by 2^-24 before, and again in each of two steps.
_STEP_UP: Any = np.float32(2.0**-22)
_UP_NEAR_ZERO_SINGLE: Any = np.float32(_UP_NEAR_ZERO)
_OUTWARD = 2.0**-21
_FARTHEST, _FARTHEST_REACH = CELL_LIMIT - (1 << 24), np.float32(1 << 24)
"""Cells from the map's origin to the pose, and from the pose to where a beam hits: together fewer than CELL_LIMIT."""
_FARTHEST_UP_M = 1e9
_ZERO: Any = np.float32(0.0)
_USED, _NO_RANGE, _TOO_WIDE, _TOO_FAR = (np.int32(fate) for fate in (USED, NO_RANGE, TOO_WIDE, TOO_FAR))
_NOTHING, _ONE_CELL = np.int32(0), np.int32(1)


@compiled_into_callers
def round_up(value: float) -> np.float32:
    """A float32 not below `value`."""
    return np.float32(value + abs(value) * _UP + _UP_NEAR_ZERO)


@compiled_without_heap
def place_block(
    pose: Floats,
    count: int,
    boxes: Singles,
    inverse: float,
    max_footprint_m: float,
    spans: Indices,
    heights: Singles,
) -> None:
    """Where the boxes that `box_block` left lie in the grid: counted in float32 from the cell that holds the pose.

    Each beam's fate, its cells (first and last column i and row j) and its interval: -low, high, as cells have them.
    What is not USED has cells too, somewhere: no conversion to integers is undefined, and nobody reads them.
    """
    column, x_low, x_high = from_its_cell(pose[P_LOW], pose[P_HIGH], inverse)
    row, y_low, y_high = from_its_cell(pose[P_LOW + 1], pose[P_HIGH + 1], inverse)
    z_low, z_high = round_up(-pose[P_LOW + 2]), round_up(pose[P_HIGH + 2])
    singles_of_all: Any = np.float32(inverse), np.float32(max_footprint_m * inverse)
    in_cells, widest = singles_of_all
    far = _USED
    level = pose[P_LOW + 2] > -_FARTHEST_UP_M and pose[P_HIGH + 2] < _FARTHEST_UP_M
    if abs(column) >= _FARTHEST or abs(row) >= _FARTHEST or not level:
        far = _TOO_FAR
    for n in range((count + STEP - 1) & -STEP):
        x0, x1 = fused(boxes[B_X0 + n], in_cells, x_low), fused(boxes[B_X1 + n], in_cells, x_high)
        y0, y1 = fused(boxes[B_Y0 + n], in_cells, y_low), fused(boxes[B_Y1 + n], in_cells, y_high)
        z0, z1 = boxes[B_Z0 + n], boxes[B_Z1 + n]
        near = (x0 > -_FARTHEST_REACH) & (x1 < _FARTHEST_REACH) & (y0 > -_FARTHEST_REACH) & (y1 < _FARTHEST_REACH)
        near &= (z0 > -_FARTHEST_REACH) & (z1 < _FARTHEST_REACH)
        fate = far if near else _TOO_FAR
        fate = fate if (x1 - x0 <= widest) & (y1 - y0 <= widest) else _TOO_WIDE
        fate = fate if x0 == x0 else _NO_RANGE
        heights[2 * n], heights[2 * n + 1] = sum_up(z_low, -z0), sum_up(z_high, z1)
        i0, i1 = np.int32(np.floor(x0 if near else _ZERO)), np.int32(np.floor(x1 if near else _ZERO))
        j0, j1 = np.int32(np.floor(y0 if near else _ZERO)), np.int32(np.floor(y1 if near else _ZERO))
        i0, i1, j0, j1 = np.int32(column + i0), np.int32(column + i1), np.int32(row + j0), np.int32(row + j1)
        note(n, fate, i0, i1, j0, j1, spans)


@compiled_into_callers
def from_its_cell(low: float, high: float, inverse: float) -> tuple[Any, Any, Any]:
    """The cell that holds `low`; from that cell's border to `low` and to `high`, in cells, as float32 outward."""
    if not (low * inverse > -_INDEX_LIMIT and high * inverse < _INDEX_LIMIT):
        return np.int32(CELL_LIMIT), _ZERO, _ZERO
    cell = np.floor(low * inverse)
    return (
        np.int32(cell),
        np.float32(low * inverse - cell - _OUTWARD),
        np.float32((high * inverse - cell) * (1.0 + _OUTWARD) + _OUTWARD),
    )


@compiled_into_callers
def sum_up(a: Any, b: Any) -> Any:
    """A float32 not below the sum of two."""
    total = a + b
    return fused(abs(total), _STEP_UP, total) + _UP_NEAR_ZERO_SINGLE


@compiled_without_heap
def locate_block(
    count: int, inverse: float, max_footprint_m: float, block: Floats, spans: Indices, heights: Singles
) -> None:
    """The same of `count` boxes in the map frame, in float64: least and most x, y, z, rows of LANES [B_SIZE]."""
    widest = max_footprint_m * inverse
    for n in range(count):
        x0, y0, z0 = block[B_X0 + n] * inverse, block[B_Y0 + n] * inverse, block[B_Z0 + n]
        x1, y1, z1 = block[B_X1 + n] * inverse, block[B_Y1 + n] * inverse, block[B_Z1 + n]
        near = (x0 > -_INDEX_LIMIT) & (x1 < _INDEX_LIMIT) & (y0 > -_INDEX_LIMIT) & (y1 < _INDEX_LIMIT)
        near &= (z0 * inverse > -_INDEX_LIMIT) & (z1 * inverse < _INDEX_LIMIT)
        fate = _USED if near else _TOO_FAR
        fate = fate if (x1 - x0 <= widest) & (y1 - y0 <= widest) else _TOO_WIDE
        fate = fate if x0 == x0 else _NO_RANGE
        heights[2 * n], heights[2 * n + 1] = round_up(-z0), round_up(z1)
        i0, i1 = np.int32(np.floor(x0 if near else 0.0)), np.int32(np.floor(x1 if near else 0.0))
        j0, j1 = np.int32(np.floor(y0 if near else 0.0)), np.int32(np.floor(y1 if near else 0.0))
        note(n, fate, i0, i1, j0, j1, spans)


@compiled_into_callers
def note(n: int, fate: np.int32, i0: np.int32, i1: np.int32, j0: np.int32, j1: np.int32, spans: Indices) -> None:
    """A beam's fate and cells, and what follows from them. Each step ends in an int32, or vectors would be of int64."""
    spans[S_FATE + n], spans[S_I0 + n], spans[S_I1 + n] = fate, i0, i1
    spans[S_J0 + n], spans[S_J1 + n] = j0, j1
    ix, iy = np.int32(i0 >> TILE_SHIFT), np.int32(j0 >> TILE_SHIFT)
    elsewhere = np.int32(np.int32(np.int32(i0 ^ i1) | np.int32(j0 ^ j1)) & ~IN_TILE)
    spans[S_IX + n], spans[S_IY + n] = ix if np.int32(elsewhere | fate) == _NOTHING else NOWHERE, iy
    first = np.int32(i0 & (ALIGNED_CELLS - 1))
    last = np.int32(np.int32(i1 - i0) + first)
    column = np.int32(np.int32(i0 & IN_TILE) - first)
    spans[S_PLACE + n] = np.int32(np.int32(j0 & IN_TILE) * ROW_BYTES) + np.int32(column * CELL_BYTES)
    spans[S_ROWS + n], spans[S_FIRST + n], spans[S_LAST + n] = np.int32(j1 - j0) + 1, first, last
    window = np.int32(np.int32(np.int32(first * BLOCK_CELLS) + last) * WINDOW_BYTES)
    wide_window = np.int32(np.int32(np.int32(first * WIDE_CELLS) + last) * WIDE_WINDOW_BYTES)
    spans[S_WINDOW + n] = window if last < BLOCK_CELLS else wide_window
    several = np.int32(np.int32(i1 - i0) | np.int32(j1 - j0))
    spans[S_ONE_CELL + n] = _ONE_CELL if np.int32(several | fate) == _NOTHING else _NOTHING
