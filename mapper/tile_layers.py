"""Between the kernel's memory and a tile's layers: a tile joined into the map, a copy of one, and counts of all.

A map without evidence has one plane of cells. With evidence (docs/ghosts.md) it has a plane for what was joined and
one for each of the time slots; the hull of a cell is that of all planes, and settled is what more than `set_aside`
slots agree on.
"""

import numpy as np

from drivers.compiled import compiled, compiled_unlocked
from mapper.footprints import Indices
from mapper.grid import TILE_CELLS, TILE_SIDE, tile_key
from mapper.kernel import UNSEEN, Bits, Cells, Counts, Flags, Keys, tile_at
from mapper.tile import Layer

NOTHING = np.uint32(0x7FC00000).view(np.float32)
"""What a tile says of an unseen cell."""
ZERO = np.float32(0.0)
"""0 - 0 and -0 + 0 are +0."""


@compiled
def join_tile(
    ix: int,
    iy: int,
    low: Layer,
    high: Layer,
    surely_hit: Flags,
    settled_low: Layer,
    settled_high: Layer,
    numbers: Counts,
    table: Indices,
    keys: Keys,
    dirty: Flags,
    pool: Cells,
    sure: Bits,
) -> np.int64:
    """Join a tile's layers [64, 64] (NaN: nothing) into the map; its number, LEFT_OUT or POOL_FULL.

    Bounds go into the plane of what was joined; settled ones into those of all slots, which leaves every cell's settled
    bounds the hull of both.
    """
    tile = tile_at(tile_key(ix, iy), numbers, table, keys)
    if tile < 0:
        return tile
    changed = hull_plane(low, high, pool[tile, 0])
    for plane in range(1, pool.shape[1]):
        changed |= hull_plane(settled_low, settled_high, pool[tile, plane])
    for row in range(TILE_SIDE):
        word = np.uint64(0)
        for col in range(TILE_SIDE):
            word |= np.uint64(surely_hit[row, col]) << np.uint64(col)
        changed |= word & ~sure[tile, row] != np.uint64(0)
        sure[tile, row] |= word
    if changed:
        dirty[tile] = True
    return tile


@compiled
def hull_plane(low: Layer, high: Layer, cells: Cells) -> bool:
    """Hull of one plane's cells with bounds [64, 64] (NaN: nothing); did any change?"""
    changed = False
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            at = 2 * (row * TILE_SIDE + col)
            if -low[row, col] > cells[at]:  # False for NaN
                cells[at] = -low[row, col]
                changed = True
            if high[row, col] > cells[at + 1]:
                cells[at + 1] = high[row, col]
                changed = True
    return changed


@compiled
def copy_tile(cells: Cells, words: Bits, low: Layer, high: Layer, surely_hit: Flags) -> np.bool_:
    """One tile's low and high [64, 64], NaN where nothing was seen, and its flags; is any set?

    cells: [planes, TILE_FLOATS]. What is written is canonical (mapper/tile.py): no negative zero, one NaN.
    """
    any_hit = np.uint64(0)
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            at = 2 * (row * TILE_SIDE + col)
            neg_low, top = widest(cells, at)
            seen = neg_low > UNSEEN
            low[row, col] = ZERO - neg_low if seen else NOTHING
            high[row, col] = top + ZERO if seen else NOTHING
            surely_hit[row, col] = (words[row] >> np.uint64(col)) & np.uint64(1) != np.uint64(0)
        any_hit |= words[row]
    return np.bool_(any_hit != np.uint64(0))


@compiled
def copy_settled(cells: Cells, set_aside: int, settled_low: Layer, settled_high: Layer) -> np.bool_:
    """One tile's settled bounds [64, 64], NaN where slots are too few or don't agree; is any cell settled?

    cells: [1 + slots, TILE_FLOATS]. What is written is canonical.
    """
    found = 0
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            at = 2 * (row * TILE_SIDE + col)
            neg_low, high = ranked(cells, at, set_aside), ranked(cells, at + 1, set_aside)
            settled = neg_low > UNSEEN and -neg_low <= high
            settled_low[row, col] = ZERO - neg_low if settled else NOTHING
            settled_high[row, col] = high + ZERO if settled else NOTHING
            found += bool(settled)
    return np.bool_(found > 0)


@compiled
def widest(cells: Cells, at: int) -> tuple[np.float32, np.float32]:
    """(-low, high) of one cell over all planes."""
    neg_low, high = cells[0, at], cells[0, at + 1]
    for plane in range(1, cells.shape[0]):
        neg_low = cells[plane, at] if cells[plane, at] > neg_low else neg_low
        high = cells[plane, at + 1] if cells[plane, at + 1] > high else high
    return neg_low, high


@compiled
def ranked(cells: Cells, at: int, set_aside: int) -> np.float32:
    """The largest number that `set_aside` slots' numbers at most exceed, each with its own: equal ones count apart."""
    best = UNSEEN
    for plane in range(1, cells.shape[0]):
        value, above = cells[plane, at], 0
        for other in range(1, cells.shape[0]):
            above += cells[other, at] > value or (cells[other, at] == value and other < plane)
        if above == set_aside:
            best = value
    return best


@compiled_unlocked
def tally(tiles: int, pool: Cells) -> tuple[int, float]:
    """Cells seen in the first `tiles` tiles, and the sum of their widths."""
    seen, width = 0, 0.0
    for tile in range(tiles):
        for at in range(0, 2 * TILE_CELLS, 2):
            neg_low, high = widest(pool[tile], at)
            if neg_low > UNSEEN:
                seen += 1
                width += np.float64(neg_low) + np.float64(high)
    return seen, width
