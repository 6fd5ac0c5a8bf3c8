"""One scan into the map in one compiled call: boxes, cells, tiles found or added, hull of every touched cell.

A cell is two float32: (-low, high), both rounded up, so that its hull with an interval is one maximum of both; -inf
where nothing was seen. Tiles of 64 x 64 cells lie in one pool, found by an open-addressing hash. Nothing is allocated:
when no tile is ready for use the call returns early; the caller makes more ready and calls again from that beam (a
hull taken twice changes nothing).
"""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_into_callers, compiled_without_heap
from mapper.beam_order import put_in_order
from mapper.cell_blocks import ALIGNED_CELLS, BLOCK_BYTES, BLOCK_CELLS, CELL_BYTES, ROW_BYTES, hull_blocks
from mapper.grid import CELL_LIMIT, TILE_CELLS, TILE_SHIFT, TILE_SIDE, tile_key
from mapper.laser_geometry import Floats, usable_range
from mapper.pose_terms import P_USABLE, W_ROWS, prepare_pose
from mapper.projection import B_X0, B_X1, B_Y0, B_Y1, B_Z0, B_Z1, LANES, box_block, run_length

WORK_SIZE = 4 * W_ROWS

Cells = NDArray[np.float32]
"""The pool: [tiles, planes, TILE_FLOATS]. One plane, or one for tiles joined and one for each time slot."""
Indices = NDArray[np.int32]
Counts = NDArray[np.int64]
Keys = NDArray[np.uint64]
Flags = NDArray[np.bool_]
Bits = NDArray[np.uint64]
"""[tiles, 64]: a word a row of cells, bit c for column c."""

TILE_FLOATS = 2 * TILE_CELLS
TILE_BYTES = TILE_CELLS * CELL_BYTES
BAD_POSES = -1
"""In place of a beam's number: the pose boxes have the wrong shape."""
FREE = 0
"""In the hash table: no tile here; a tile stands as its number + 1."""
UNSEEN = np.float32(-np.inf)
LEFT_OUT = np.int64(-1)
"""In place of a tile's number: the map has max_tiles already."""
POOL_FULL = np.int64(-2)
"""In place of a tile's number: more tiles must be made ready first."""

# The numbers that the kernel and its caller share: one row of int64. First what became of this call's beams, then of
# all beams so far.
USED = 0
NO_RANGE = 1
NO_POSE = 2
TOO_WIDE = 3
TOO_FAR = 4
BEYOND_CAP = 5
FATES = 6
N_TILES = FATES  # in use
N_READY = FATES + 1  # in use, or unseen everywhere and for use
N_MOST = FATES + 2  # the memory cap
N_TOTALS = FATES + 3
N_SIZE = N_TOTALS + FATES

# Where the beams of a block end in the grid: rows of LANES int32. First the cells, ...
S_FATE, S_I0, S_I1, S_J0, S_J1 = (row * LANES for row in range(5))
# ... then, for what lies in one tile, which (else NOWHERE), the first block's place in it in bytes, how many rows, and
# from there the first and last column; of a footprint in one block, too, which window of it (cell_blocks.py).
S_IX, S_IY, S_PLACE, S_ROWS, S_FIRST, S_LAST, S_WINDOW = (row * LANES for row in range(5, 12))
S_SIZE = 12 * LANES
NOWHERE = np.int32(-(1 << 31))
_INDEX_LIMIT = float(CELL_LIMIT)
_IN_TILE = TILE_SIDE - 1
"""The bits of a cell's number that say where in its tile it is."""

# Rounding to float32 errs by at most 2^-24 of the value, so twice that, added first, makes it round up. The constant
# does it near zero (and is no subnormal, which some processors flush to zero).
_UP = 2.0**-23
_UP_NEAR_ZERO = 2.0**-100


@compiled_into_callers
def round_up(value: float) -> np.float32:
    """A float32 not below `value`."""
    return np.float32(value + abs(value) * _UP + _UP_NEAR_ZERO)


@compiled_into_callers
def find_slot(key: np.uint64, table: Indices, keys: Keys) -> np.uint64:
    """Where in the hash table `key` is, or the free place where it belongs. The table is never full."""
    mask = np.uint64(table.size - 1)
    mixed = key * np.uint64(0x9E3779B97F4A7C15)
    place = (mixed ^ (mixed >> np.uint64(32))) & mask
    while table[place] != FREE and keys[np.uint64(table[place] - 1)] != key:
        place = (place + np.uint64(1)) & mask
    return place


@compiled_into_callers
def tile_at(key: np.uint64, numbers: Counts, table: Indices, keys: Keys) -> np.int64:
    """Number of the tile `key`, added if it is new; LEFT_OUT or POOL_FULL if there is no room."""
    place = find_slot(key, table, keys)
    tile = np.int64(table[place]) - 1
    if tile < 0:
        tile = numbers[N_TILES]
        if tile >= numbers[N_MOST]:
            return LEFT_OUT
        if tile >= numbers[N_READY]:
            return POOL_FULL
        numbers[N_TILES] = tile + 1
        table[place] = tile + 1
        keys[tile] = key
    return tile


@compiled
def rebuild_table(tiles: int, table: Indices, keys: Keys) -> None:
    """Enter the first `tiles` keys into an empty table."""
    for tile in range(tiles):
        table[find_slot(keys[tile], table, keys)] = tile + 1


@compiled_without_heap
def locate_block(
    count: int, inverse: float, max_footprint_m: float, block: Floats, spans: Indices, heights: Cells
) -> None:
    """Each beam's fate, its cells (first and last column i and row j) and its interval: -low, high, as cells have them.

    What is not USED has cells too, somewhere: no conversion to integers is undefined, and nobody reads them.
    """
    widest = max_footprint_m * inverse
    for n in range(count):
        x0, y0, z0 = block[B_X0 + n] * inverse, block[B_Y0 + n] * inverse, block[B_Z0 + n]
        x1, y1, z1 = block[B_X1 + n] * inverse, block[B_Y1 + n] * inverse, block[B_Z1 + n]
        near = (x0 > -_INDEX_LIMIT) & (x1 < _INDEX_LIMIT) & (y0 > -_INDEX_LIMIT) & (y1 < _INDEX_LIMIT)
        near &= (z0 * inverse > -_INDEX_LIMIT) & (z1 * inverse < _INDEX_LIMIT)
        fate = USED if near else TOO_FAR
        fate = fate if (x1 - x0 <= widest) & (y1 - y0 <= widest) else TOO_WIDE
        fate = fate if x0 == x0 else NO_RANGE
        heights[2 * n], heights[2 * n + 1] = round_up(-z0), round_up(z1)
        i0, i1 = np.int32(np.floor(x0 if near else 0.0)), np.int32(np.floor(x1 if near else 0.0))
        j0, j1 = np.int32(np.floor(y0 if near else 0.0)), np.int32(np.floor(y1 if near else 0.0))
        spans[S_FATE + n], spans[S_I0 + n], spans[S_I1 + n] = fate, i0, i1
        spans[S_J0 + n], spans[S_J1 + n] = j0, j1
        one_tile = (((i0 ^ i1) | (j0 ^ j1)) >> TILE_SHIFT == 0) & (fate == USED)
        spans[S_IX + n], spans[S_IY + n] = i0 >> TILE_SHIFT if one_tile else NOWHERE, j0 >> TILE_SHIFT
        block_column = i0 & -ALIGNED_CELLS
        spans[S_PLACE + n] = (j0 & _IN_TILE) * ROW_BYTES + (block_column & _IN_TILE) * CELL_BYTES
        spans[S_ROWS + n], spans[S_FIRST + n], spans[S_LAST + n] = j1 - j0 + 1, i0 - block_column, i1 - block_column
        spans[S_WINDOW + n] = BLOCK_BYTES * (BLOCK_CELLS * (i0 - block_column) + (i1 - block_column))


@compiled_into_callers
def hull_cells(address: np.uint64, rows: int, first: int, last: int, interval: np.uint64) -> bool:
    """Hull of `rows` rows of cells `first`..`last`, counted from the block at `address`; did any cell change?"""
    changed = False
    while last >= 0:
        window = np.uint64(BLOCK_BYTES * (BLOCK_CELLS * max(first, 0) + min(last, BLOCK_CELLS - 1)))
        changed |= hull_blocks(address, rows, interval, window)
        address += np.uint64(BLOCK_BYTES)
        first, last = first - BLOCK_CELLS, last - BLOCK_CELLS
    return changed


@compiled_without_heap
def touch_block(
    count: int,
    plane: int,
    hits: bool,
    spans: Indices,
    heights: Cells,
    numbers: Counts,
    table: Indices,
    keys: Keys,
    dirty: Flags,
    pool: Cells,
    sure: Bits,
) -> int:
    """Hull of the cells of `count` footprints with their intervals; how many were done before tiles ran out.

    hits: each footprint holds a point that was measured.
    """
    plane_address, stride = np.uint64(pool.ctypes.data) + np.uint64(plane * TILE_BYTES), pool.shape[1] * TILE_BYTES
    intervals = np.uint64(heights.ctypes.data)
    last_ix, last_iy, last_tile, tile_address = NOWHERE, NOWHERE, LEFT_OUT, plane_address
    for lane in range(count):
        fate = spans[S_FATE + lane]
        interval = intervals + np.uint64(CELL_BYTES * lane)
        if last_tile >= 0 and spans[S_IX + lane] == last_ix and spans[S_IY + lane] == last_iy:
            # The rule: one tile, the same as that of the beam before.
            rows, last, window = int(spans[S_ROWS + lane]), int(spans[S_LAST + lane]), spans[S_WINDOW + lane]
            address = tile_address + np.uint64(spans[S_PLACE + lane])
            if last < BLOCK_CELLS:
                dirty[last_tile] |= hull_blocks(address, rows, interval, np.uint64(window))
            elif hull_cells(address, rows, int(spans[S_FIRST + lane]), last, interval):
                dirty[last_tile] = True
        elif fate == USED:
            i0, i1 = int(spans[S_I0 + lane]), int(spans[S_I1 + lane])
            j, j1 = int(spans[S_J0 + lane]), int(spans[S_J1 + lane])
            while j <= j1:
                j_last, i = min(j1, j | _IN_TILE), i0
                while i <= i1:
                    i_last, ix, iy = min(i1, i | _IN_TILE), i >> TILE_SHIFT, j >> TILE_SHIFT
                    if last_tile < 0 or ix != last_ix or iy != last_iy:
                        tile = tile_at(tile_key(ix, iy), numbers, table, keys)
                        if tile == POOL_FULL:
                            return lane
                        if tile == LEFT_OUT:
                            fate, i = BEYOND_CAP, i_last + 1
                            continue
                        last_ix, last_iy, last_tile = np.int32(ix), np.int32(iy), tile
                        tile_address = plane_address + np.uint64(tile * stride)
                    row, block = j & _IN_TILE, i & -ALIGNED_CELLS
                    place = np.uint64(row * ROW_BYTES + (block & _IN_TILE) * CELL_BYTES)
                    if hull_cells(tile_address + place, j_last - j + 1, i - block, i_last - block, interval):
                        dirty[last_tile] = True
                    i = i_last + 1
                j = j_last + 1
        if hits and fate == USED and spans[S_ROWS + lane] == 1 and spans[S_FIRST + lane] == spans[S_LAST + lane]:
            # The hit is in this cell: the footprint reaches no other.
            row, bit = spans[S_J0 + lane] & _IN_TILE, np.uint64(1) << np.uint64(spans[S_I0 + lane] & _IN_TILE)
            if sure[last_tile, row] & bit == np.uint64(0):
                sure[last_tile, row] |= bit
                dirty[last_tile] = True
        numbers[fate] += 1
    return count


@compiled_without_heap
def insert_beams(
    first: int,
    plane: int,
    ranges: Floats,
    pose_low: Floats,
    pose_high: Floats,
    order: NDArray[np.uint32],
    pose_index: Indices,
    beams: Floats,
    geometry: Floats,
    resolution_m: float,
    max_footprint_m: float,
    poses: Floats,
    scratch: Floats,
    spans: Indices,
    heights: Cells,
    numbers: Counts,
    table: Indices,
    keys: Keys,
    dirty: Flags,
    pool: Cells,
    sure: Bits,
) -> int:
    """Take beams from `first` on into a plane; return the beam that needs more tiles ready, or n when all are done.

    ranges [n]; pose_low, pose_high [m, 6] (BAD_POSES if they are not); order, pose_index, beams: BeamOrder's; poses
    [>= m, P_SIZE], scratch, spans, heights: scratch; numbers [N_SIZE]; table the hash; keys, dirty, pool, sure one row
    a tile.
    """
    if pose_low.shape != pose_high.shape or pose_low.shape[1] != 6:
        return BAD_POSES
    count_all, inverse = ranges.size, 1.0 / resolution_m
    cosines, sines, ordered = beams[0], beams[1], beams[2]
    put_in_order(ranges, order, ordered)
    work, block = scratch[:WORK_SIZE].reshape(W_ROWS, 4), scratch[WORK_SIZE:]
    for m in range(pose_low.shape[0]):
        prepare_pose(pose_low[m], pose_high[m], geometry, work, poses[m])
    if first == 0:
        for fate in range(FATES):
            numbers[fate] = 0

    n = first
    while n < count_all:
        m, count = pose_index[n], run_length(n, pose_index)
        if m < 0 or m >= pose_low.shape[0] or poses[m, P_USABLE] != 1.0:
            for k in range(n, n + count):
                numbers[NO_POSE if usable_range(ordered[k], geometry) else NO_RANGE] += 1
        else:
            box_block(poses[m], geometry, n, count, ordered, cosines, sines, block)
            locate_block(count, inverse, max_footprint_m, block, spans, heights)
            done = touch_block(count, plane, True, spans, heights, numbers, table, keys, dirty, pool, sure)
            if done < count:
                return n + done
        n += count
    for fate in range(FATES):
        numbers[N_TOTALS + fate] += numbers[fate]
    return count_all
