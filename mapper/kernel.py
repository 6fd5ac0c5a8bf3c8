"""One scan into the map in one compiled call: boxes, tiles found or added, hull of every touched cell. No allocation.

A cell is two float32: (-low, high), both rounded up, so that its hull with an interval is one `max` on both; -inf
where nothing was seen. Tiles of 64 x 64 cells lie in one pool, found by an open-addressing hash. When the pool is full
the call returns early; the caller makes it larger and calls again from that beam (a hull taken twice changes nothing).
"""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_unlocked
from mapper.grid import CELL_LIMIT, TILE_CELLS, TILE_SHIFT, TILE_SIDE, tile_key
from mapper.projection import (
    B_CENTRE,
    B_HALF,
    LANES,
    P_USABLE,
    Floats,
    box_block,
    prepare_pose,
    run_length,
    usable_range,
)

B_X, B_Y, B_Z = B_CENTRE, B_CENTRE + LANES, B_CENTRE + 2 * LANES
B_DX, B_DY, B_DZ = B_HALF, B_HALF + LANES, B_HALF + 2 * LANES

Cells = NDArray[np.float32]
Indices = NDArray[np.int32]
Counts = NDArray[np.int64]
Keys = NDArray[np.uint64]
Flags = NDArray[np.bool_]
Bits = NDArray[np.uint64]
"""[tiles, 64]: a word a row of cells, bit c for column c."""

TILE_FLOATS = 2 * TILE_CELLS
FREE = -1
"""In the hash table: no tile here."""
UNSEEN = np.float32(-np.inf)
NOTHING = np.uint32(0x7FC00000).view(np.float32)
"""What a tile says of an unseen cell."""
LEFT_OUT = np.int64(-1)
"""In place of a tile's number: the map has max_tiles already."""
POOL_FULL = np.int64(-2)
"""In place of a tile's number: the pool must grow first."""

# What became of the beams: numbers of the `counts` array.
USED = 0
NO_RANGE = 1
NO_POSE = 2
TOO_WIDE = 3
TOO_FAR = 4
BEYOND_CAP = 5
COUNTS = 6

# Rounding to float32 errs by at most 2^-24 of the value, so twice that, added first, makes it round up. The constant
# does it near zero (and is no subnormal, which some processors flush to zero).
_UP = 2.0**-23
_UP_NEAR_ZERO = 2.0**-100


@compiled
def round_up(value: float) -> np.float32:
    """A float32 not below `value`."""
    return np.float32(value + abs(value) * _UP + _UP_NEAR_ZERO)


@compiled
def find_slot(key: np.uint64, table: Indices, keys: Keys) -> np.uint64:
    """Where in the hash table `key` is, or the free place where it belongs. The table is never full."""
    mask = np.uint64(table.size - 1)
    mixed = key * np.uint64(0x9E3779B97F4A7C15)
    place = (mixed ^ (mixed >> np.uint64(32))) & mask
    while table[place] != FREE and keys[table[place]] != key:
        place = (place + np.uint64(1)) & mask
    return place


@compiled
def tile_at(
    key: np.uint64,
    max_tiles: int,
    count: Counts,
    table: Indices,
    keys: Keys,
    pool: Cells,
    sure: Bits,
) -> np.int64:
    """Number of the tile `key`, added (unseen everywhere) if it is new; LEFT_OUT or POOL_FULL if there is no room."""
    place = find_slot(key, table, keys)
    tile = np.int64(table[place])
    if tile == FREE:
        if count[0] >= max_tiles:
            return LEFT_OUT
        if count[0] >= keys.size:
            return POOL_FULL
        tile = count[0]
        count[0] = tile + 1
        table[place] = tile
        keys[tile] = key
        pool[tile] = UNSEEN
        sure[tile] = np.uint64(0)
    return tile


@compiled
def rebuild_table(tiles: int, table: Indices, keys: Keys) -> None:
    """Enter the first `tiles` keys into an empty table."""
    for tile in range(tiles):
        table[find_slot(keys[tile], table, keys)] = tile


@compiled
def hull_rows(cells: Cells, row0: int, row1: int, col0: int, col1: int, neg_low: np.float32, high: np.float32) -> bool:
    """Hull of one tile's cells [row0..row1, col0..col1] with an interval; did any cell change?"""
    changed = False
    for row in range(row0, row1 + 1):
        begin = np.uint64(2 * (row * TILE_SIDE + col0))
        end = np.uint64(2 * (row * TILE_SIDE + col1 + 1))
        for at in range(begin, end, np.uint64(2)):
            old_low, old_high = cells[at], cells[at + np.uint64(1)]
            changed |= (neg_low > old_low) | (high > old_high)
            cells[at] = neg_low if neg_low > old_low else old_low
            cells[at + np.uint64(1)] = high if high > old_high else old_high
    return changed


@compiled_unlocked
def insert_beams(
    first: int,
    ranges: Floats,
    cosines: Floats,
    sines: Floats,
    pose_index: Indices,
    pose_low: Floats,
    pose_high: Floats,
    geometry: Floats,
    resolution_m: float,
    max_footprint_m: float,
    max_tiles: int,
    work: Floats,
    poses: Floats,
    block: Floats,
    count: Counts,
    table: Indices,
    keys: Keys,
    dirty: Flags,
    pool: Cells,
    sure: Bits,
    counts: Counts,
) -> int:
    """Take beams from `first` on; return the number of the beam that needs a larger pool, or n when all are done.

    ranges, cosines, sines, pose_index [n]; pose_low, pose_high [m, 6]; poses [>= m, P_SIZE], work, block: scratch;
    count [1] tiles in use; table the hash; keys, dirty, pool, sure one row a tile; counts [COUNTS] is added to.
    """
    beams, inverse = ranges.size, 1.0 / resolution_m
    for m in range(pose_low.shape[0]):
        prepare_pose(pose_low[m], pose_high[m], geometry, work, poses[m])
    last_key, last_tile = np.uint64(0), np.int64(-1)

    block_first, block_end = first, first
    for n in range(first, beams):
        if not usable_range(ranges[n], geometry):
            counts[NO_RANGE] += 1
            continue
        m = pose_index[n]
        if m < 0 or m >= pose_low.shape[0] or poses[m, P_USABLE] != 1.0:
            counts[NO_POSE] += 1
            continue
        if n >= block_end:
            block_first, block_end = n, n + run_length(n, pose_index)
            box_block(poses[m], geometry, n, block_end - n, ranges, cosines, sines, block)
        lane = n - block_first
        x, y, z = block[B_X + lane], block[B_Y + lane], block[B_Z + lane]
        dx, dy, dz = block[B_DX + lane], block[B_DY + lane], block[B_DZ + lane]
        if not (2.0 * dx <= max_footprint_m and 2.0 * dy <= max_footprint_m):
            counts[TOO_WIDE] += 1
            continue
        reach = max(abs(x) + dx, abs(y) + dy, abs(z) + dz)
        if not reach * inverse < CELL_LIMIT:
            counts[TOO_FAR] += 1
            continue
        i0, i1 = int(np.floor((x - dx) * inverse)), int(np.floor((x + dx) * inverse))
        j0, j1 = int(np.floor((y - dy) * inverse)), int(np.floor((y + dy) * inverse))
        neg_low, high = round_up(dz - z), round_up(z + dz)

        left_out = False
        for ty in range(j0 >> TILE_SHIFT, (j1 >> TILE_SHIFT) + 1):
            for tx in range(i0 >> TILE_SHIFT, (i1 >> TILE_SHIFT) + 1):
                key = tile_key(tx, ty)
                if last_tile < 0 or key != last_key:
                    tile = tile_at(key, max_tiles, count, table, keys, pool, sure)
                    if tile == POOL_FULL:
                        return n
                    if tile == LEFT_OUT:
                        left_out = True
                        continue
                    last_key, last_tile = key, tile
                row0, row1 = max(j0 - (ty << TILE_SHIFT), 0), min(j1 - (ty << TILE_SHIFT), TILE_SIDE - 1)
                col0, col1 = max(i0 - (tx << TILE_SHIFT), 0), min(i1 - (tx << TILE_SHIFT), TILE_SIDE - 1)
                if hull_rows(pool[last_tile], row0, row1, col0, col1, neg_low, high):
                    dirty[last_tile] = True
                if i0 == i1 and j0 == j1:  # the hit is in this cell, as the footprint reaches no other
                    bit = np.uint64(1) << np.uint64(col0)
                    if sure[last_tile, row0] & bit == np.uint64(0):
                        sure[last_tile, row0] |= bit
                        dirty[last_tile] = True
        counts[BEYOND_CAP if left_out else USED] += 1
    return beams


@compiled
def join_tile(
    ix: int,
    iy: int,
    low: Cells,
    high: Cells,
    surely_hit: Flags,
    max_tiles: int,
    count: Counts,
    table: Indices,
    keys: Keys,
    dirty: Flags,
    pool: Cells,
    sure: Bits,
) -> np.int64:
    """Join a tile's layers [64, 64] (NaN: nothing) into the map; its number, LEFT_OUT or POOL_FULL."""
    tile = tile_at(tile_key(ix, iy), max_tiles, count, table, keys, pool, sure)
    if tile < 0:
        return tile
    for row in range(TILE_SIDE):
        word = np.uint64(0)
        for col in range(TILE_SIDE):
            at = 2 * (row * TILE_SIDE + col)
            if -low[row, col] > pool[tile, at]:  # False for NaN
                pool[tile, at] = -low[row, col]
                dirty[tile] = True
            if high[row, col] > pool[tile, at + 1]:
                pool[tile, at + 1] = high[row, col]
                dirty[tile] = True
            word |= np.uint64(surely_hit[row, col]) << np.uint64(col)
        if word & ~sure[tile, row] != np.uint64(0):
            sure[tile, row] |= word
            dirty[tile] = True
    return tile


@compiled
def copy_tile(tile: int, pool: Cells, sure: Bits, low: Cells, high: Cells, surely_hit: Flags) -> None:
    """A tile's low and high [64, 64], NaN where nothing was seen, and its flags."""
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            at = 2 * (row * TILE_SIDE + col)
            seen = pool[tile, at] > UNSEEN
            low[row, col] = -pool[tile, at] if seen else NOTHING
            high[row, col] = pool[tile, at + 1] if seen else NOTHING
            surely_hit[row, col] = (sure[tile, row] >> np.uint64(col)) & np.uint64(1) != np.uint64(0)


@compiled_unlocked
def tally(tiles: int, pool: Cells) -> tuple[int, float]:
    """Cells seen in the first `tiles` tiles, and the sum of their widths."""
    seen, width = 0, 0.0
    for tile in range(tiles):
        for at in range(0, TILE_FLOATS, 2):
            if pool[tile, at] > UNSEEN:
                seen += 1
                width += np.float64(pool[tile, at]) + np.float64(pool[tile, at + 1])
    return seen, width
