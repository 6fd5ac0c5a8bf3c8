"""One scan into the map in one compiled call: boxes, cells, tiles found or added, hull of every touched cell.

A cell is two float32: (-low, high), both rounded up, so that its hull with an interval is one maximum of both; -inf
where nothing was seen. Tiles of 64 x 64 cells lie in one pool, found by an open-addressing hash. Nothing is allocated:
when no tile is ready for use the call returns early; the caller makes more ready and calls again from that beam (a
hull taken twice changes nothing).
"""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_into_callers, compiled_without_heap
from mapper.beam_order import BY_BEAM, BY_DIRECTION, BY_ORDER, BY_POSE, put_in_order
from mapper.bound_arrays import Bound, counts, flags, floats, integers, singles, words
from mapper.cell_blocks import (
    ALIGNED_CELLS,
    BLOCK_CELLS,
    CELL_BYTES,
    ROW_BYTES,
    WIDE_CELLS,
    WIDE_WINDOW_BYTES,
    hull_blocks,
    hull_blocks_unseen,
    hull_wide_blocks,
    hull_wide_blocks_unseen,
)
from mapper.footprints import (
    BEYOND_CAP,
    FATES,
    IN_TILE,
    NO_POSE,
    NO_RANGE,
    S_FATE,
    S_FIRST,
    S_I0,
    S_I1,
    S_IX,
    S_IY,
    S_J0,
    S_J1,
    S_LAST,
    S_ONE_CELL,
    S_PLACE,
    S_ROWS,
    S_WINDOW,
    SPANS_SIZE,
    USED,
    Indices,
    place_block,
)
from mapper.grid import TILE_CELLS, TILE_SHIFT, TILE_SIDE, tile_key
from mapper.laser_geometry import Floats, usable_range
from mapper.pose_terms import P_SIZE, P_USABLE, W_ROWS, prepare_pose
from mapper.projection import box_block, run_length

WORK_SIZE = 4 * W_ROWS

Cells = NDArray[np.float32]
"""The pool: [tiles, planes, TILE_FLOATS]. One plane, or one for tiles joined and one for each time slot."""
Counts = NDArray[np.int64]
Keys = NDArray[np.uint64]
Flags = NDArray[np.bool_]
Bits = NDArray[np.uint64]
"""[tiles, 64]: a word a row of cells, bit c for column c."""

TILE_FLOATS = 2 * TILE_CELLS
TILE_BYTES = TILE_CELLS * CELL_BYTES
BAD_POSES = -1
"""In place of a beam's number: the pose boxes have the wrong shape ..."""
MANY_POSES = -2
"""... or there is no room for as many."""
FREE = 0
"""In the hash table: no tile here; a tile stands as its number + 1."""
UNSEEN = np.float32(-np.inf)
LEFT_OUT = np.int64(-1)
"""In place of a tile's number: the map has max_tiles already."""
POOL_FULL = np.int64(-2)
"""In place of a tile's number: more tiles must be made ready first."""

# The numbers that the kernel and its caller share: one row of int64. First what became of this call's beams, then of
# all beams so far.
N_TILES = FATES  # in use
N_READY = FATES + 1  # in use, or unseen everywhere and for use
N_MOST = FATES + 2  # the memory cap
N_TOTALS = FATES + 3
N_SIZE = N_TOTALS + FATES

# Behind the spans of a block (footprints.py): ix, iy and number of four tiles.
S_NEIGHBOURS = SPANS_SIZE
S_SIZE = S_NEIGHBOURS + 12
NO_TILE = np.int32(1 - (1 << 31))
"""In place of a tile's ix, iy; no footprint's, unlike NOWHERE."""


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


@compiled_into_callers
def hull_cells(address: np.uint64, rows: int, first: int, last: int, interval: np.uint64, changed: bool) -> bool:
    """Hull of `rows` rows of cells `first`..`last`, counted from the block at `address`; has any cell changed?"""
    while last >= 0:
        window = np.uint64(WIDE_WINDOW_BYTES * (WIDE_CELLS * max(first, 0) + min(last, WIDE_CELLS - 1)))
        changed = hull_wide(address, rows, interval, window, changed)
        address += np.uint64(WIDE_CELLS * CELL_BYTES)
        first, last = first - WIDE_CELLS, last - WIDE_CELLS
    return changed


@compiled_into_callers
def hull_wide(address: np.uint64, rows: int, interval: np.uint64, window: np.uint64, changed: bool) -> bool:
    """Hull of wide blocks; what has changed already is not looked at again."""
    if changed:
        return hull_wide_blocks_unseen(address, rows, interval, window)
    return hull_wide_blocks(address, rows, interval, window)


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
    for number in range(S_NEIGHBOURS, S_SIZE):
        spans[number] = NO_TILE
    ix, iy, tile, tile_address = NO_TILE, NO_TILE, LEFT_OUT, plane_address
    changed, used = False, 0
    for lane in range(count):
        interval = intervals + np.uint64(CELL_BYTES * lane)
        if spans[S_IX + lane] == ix and spans[S_IY + lane] == iy:
            # The rule: one tile, the same as that of the beam before.
            rows, last = int(spans[S_ROWS + lane]), int(spans[S_LAST + lane])
            address = tile_address + np.uint64(spans[S_PLACE + lane])
            window = np.uint64(spans[S_WINDOW + lane])
            if last < BLOCK_CELLS:
                if changed:
                    hull_blocks_unseen(address, rows, interval, window)
                else:
                    changed = hull_blocks(address, rows, interval, window)
            elif last < WIDE_CELLS:
                changed = hull_wide(address, rows, interval, window, changed)
            else:
                changed = hull_cells(address, rows, int(spans[S_FIRST + lane]), last, interval, changed)
            if hits and spans[S_ONE_CELL + lane]:
                changed |= mark_surely_hit(lane, spans, sure[tile])
            used += 1
            continue
        fate = spans[S_FATE + lane]
        if fate == USED:
            i0, i1 = int(spans[S_I0 + lane]), int(spans[S_I1 + lane])
            j, j1 = int(spans[S_J0 + lane]), int(spans[S_J1 + lane])
            while j <= j1:
                j_last, i = min(j1, j | IN_TILE), i0
                while i <= i1:
                    i_last, other_ix, other_iy = min(i1, i | IN_TILE), i >> TILE_SHIFT, j >> TILE_SHIFT
                    if other_ix != ix or other_iy != iy:
                        other = neighbour_at(other_ix, other_iy, spans, numbers, table, keys)
                        if other == LEFT_OUT:
                            fate, i = BEYOND_CAP, i_last + 1
                            continue
                        if tile != LEFT_OUT:
                            dirty[tile] = changed
                        if other == POOL_FULL:
                            numbers[USED] += used
                            return lane
                        ix, iy, tile, changed = np.int32(other_ix), np.int32(other_iy), other, dirty[other]
                        tile_address = plane_address + np.uint64(tile * stride)
                    row, block = j & IN_TILE, i & -ALIGNED_CELLS
                    place = np.uint64(row * ROW_BYTES + (block & IN_TILE) * CELL_BYTES)
                    first, last = i - block, i_last - block
                    changed = hull_cells(tile_address + place, j_last - j + 1, first, last, interval, changed)
                    i = i_last + 1
                j = j_last + 1
            if hits and fate == USED and spans[S_ONE_CELL + lane]:
                changed |= mark_surely_hit(lane, spans, sure[tile])
        numbers[fate] += 1
    if tile != LEFT_OUT:
        dirty[tile] = changed
    numbers[USED] += used
    return count


@compiled_into_callers
def neighbour_at(ix: int, iy: int, spans: Indices, numbers: Counts, table: Indices, keys: Keys) -> np.int64:
    """`tile_at`, which remembers the last tile of either parity: footprints that lie across a border alternate."""
    place = S_NEIGHBOURS + 3 * ((ix & 1) | (iy & 1) << 1)
    if spans[place] != ix or spans[place + 1] != iy:
        tile = tile_at(tile_key(ix, iy), numbers, table, keys)
        if tile < 0:
            return tile
        spans[place], spans[place + 1], spans[place + 2] = ix, iy, tile
    return np.int64(spans[place + 2])


@compiled_into_callers
def mark_surely_hit(lane: int, spans: Indices, sure: Bits) -> bool:
    """The hit is in this cell: the footprint reaches no other. Is that news?"""
    row, bit = spans[S_J0 + lane] & IN_TILE, np.uint64(1) << np.uint64(spans[S_I0 + lane] & IN_TILE)
    before = sure[row]
    sure[row] = before | bit
    return before & bit == np.uint64(0)  # type: ignore[no-any-return]


# The arrays that `insert_beams` finds bound, in this order; the last ones are the map's own, one row a tile.
A_LIMITS, A_GEOMETRY, A_SCRATCH, A_POSES, A_NARROW, A_BOXES, A_SPANS, A_HEIGHTS = range(8)
A_NUMBERS, A_TABLE, A_KEYS, A_DIRTY, A_POOL, A_SURE = range(8, 14)


@compiled_without_heap
def insert_beams(
    first: int, plane: int, ranges: Floats, pose_low: Floats, pose_high: Floats, order: Bound, arrays: Bound
) -> int:
    """Take beams from `first` on into a plane; return the beam that needs more tiles ready, or n when all are done.

    ranges [n]; pose_low, pose_high [m, 6] (or BAD_POSES; MANY_POSES where there is no room for m); order: BeamOrder's.
    arrays, by A_...: [a cell's side, the widest footprint] in metres, the laser's geometry; scratch: work, both rows of
    `prepare_pose` for each pose, boxes, spans, heights; numbers [N_SIZE], the hash, and one row a tile.
    """
    if pose_low.shape != pose_high.shape or pose_low.shape[1] != 6:
        return BAD_POSES
    beams, directions = floats(order, BY_BEAM).reshape(3, -1), singles(order, BY_DIRECTION).reshape(2, -1)
    pose_index = integers(order, BY_POSE)
    put_in_order(ranges, integers(order, BY_ORDER), beams[2])
    limits, geometry, scratch = floats(arrays, A_LIMITS), floats(arrays, A_GEOMETRY), floats(arrays, A_SCRATCH)
    poses, narrow = floats(arrays, A_POSES).reshape(-1, P_SIZE), singles(arrays, A_NARROW).reshape(-1, P_SIZE)
    boxes, spans, heights = singles(arrays, A_BOXES), integers(arrays, A_SPANS), singles(arrays, A_HEIGHTS)
    numbers, table, keys = counts(arrays, A_NUMBERS), integers(arrays, A_TABLE), words(arrays, A_KEYS)
    dirty, sure = flags(arrays, A_DIRTY), words(arrays, A_SURE).reshape(-1, TILE_SIDE)
    pool = singles(arrays, A_POOL).reshape(keys.size, -1, TILE_FLOATS)
    if pose_low.shape[0] > poses.shape[0]:
        return MANY_POSES
    count_all, inverse = ranges.size, 1.0 / limits[0]
    work = scratch[:WORK_SIZE].reshape(W_ROWS, 4)
    for m in range(pose_low.shape[0]):
        prepare_pose(pose_low[m], pose_high[m], geometry, work, poses[m], narrow[m])
    if first == 0:
        for fate in range(FATES):
            numbers[fate] = 0

    n = first
    while n < count_all:
        m, count = pose_index[n], run_length(n, pose_index)
        if m < 0 or m >= pose_low.shape[0] or poses[m, P_USABLE] != 1.0:
            for k in range(n, n + count):
                numbers[NO_POSE if usable_range(beams[2, k], geometry) else NO_RANGE] += 1
        else:
            box_block(narrow[m], geometry, n, count, beams, directions, boxes)
            place_block(poses[m], count, boxes, inverse, limits[1], spans, heights)
            done = touch_block(count, plane, True, spans, heights, numbers, table, keys, dirty, pool, sure)
            if done < count:
                return n + done
        n += count
    for fate in range(FATES):
        numbers[N_TOTALS + fate] += numbers[fate]
    return count_all
