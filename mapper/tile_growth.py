"""What a tile gains by more of it, in one go for each message: the new state, and which of its cells differ."""

from typing import NamedTuple

import numpy as np

from drivers.compiled import compiled
from mapper.grid import TILE_SIDE
from mapper.tile import (
    NO_CELL,
    Flags,
    Layer,
    Tile,
    changed,
    join,
    sealed_tile,
    snap_outward,
    snapped_down,
    snapped_up,
    unseen_tile,
)


class Growth(NamedTuple):
    """A tile after more of it has come."""

    tile: Tile
    """join(old, snap_outward(more))"""
    differs: Flags
    """[64, 64] the cells of it that are not as they were: those of changed(old, tile)."""
    cells_changed: int
    cells_seen: int


def grown(old: Tile, more: Tile) -> Growth:
    """A snapped tile joined with more of it, snapped."""
    if old.has_settled or more.has_settled:
        new = join(old, snap_outward(more))
        delta = changed(old, new)
        return Growth(new, ~np.isnan(delta.low), delta.cells_seen, new.cells_seen)
    place = old.submap, old.ix, old.iy, old.resolution_m
    if place != (more.submap, more.ix, more.iy, more.resolution_m):
        raise ValueError(f"can't join {more.submap}/{more.ix}/{more.iy} with {place[0]}/{place[1]}/{place[2]}")
    shape = TILE_SIDE, TILE_SIDE
    low, high, differs = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.bool_)
    unhit = old.surely_hit is NO_CELL and more.surely_hit is NO_CELL
    hit = differs if unhit else np.empty(shape, np.bool_)
    cells_changed, cells_seen = _grow(
        old.low, old.high, old.surely_hit, more.low, more.high, more.surely_hit, low, high, hit, differs
    )
    new = sealed_tile(*place, low, high, NO_CELL if unhit else hit)
    return Growth(new, differs, cells_changed, cells_seen)


def compile_growth() -> None:
    """Have the machine code made now, so that no message waits for it."""
    nothing = unseen_tile(0, 0, 0, 1.0)
    grown(nothing, nothing)


@compiled
def _grow(
    old_low: Layer,
    old_high: Layer,
    old_hit: Flags,
    more_low: Layer,
    more_high: Layer,
    more_hit: Flags,
    low: Layer,
    high: Layer,
    hit: Flags,
    differs: Flags,
) -> tuple[int, int]:
    """How many cells differ, and are seen. Comparisons with NaN are false; each loop is short enough to be vectorised.

    `hit` may be `differs` itself, where no cell is hit.
    """
    changed_cells = seen_cells = 0
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            a, b = snapped_down(more_low[row, col]), old_low[row, col]
            low[row, col] = a if (a < b) | (b != b) else b
        for col in range(TILE_SIDE):
            a, b = snapped_up(more_high[row, col]), old_high[row, col]
            high[row, col] = a if (a > b) | (b != b) else b
        for col in range(TILE_SIDE):
            hit[row, col] = old_hit[row, col] | more_hit[row, col]
        for col in range(TILE_SIDE):
            differs[row, col] = hit[row, col] & ~old_hit[row, col]
        for col in range(TILE_SIDE):
            a, b = low[row, col], old_low[row, col]
            differs[row, col] |= (a != b) & (a == a)
        for col in range(TILE_SIDE):
            a, b = high[row, col], old_high[row, col]
            differs[row, col] |= (a != b) & (a == a)
        for col in range(TILE_SIDE):
            changed_cells += differs[row, col]
        for col in range(TILE_SIDE):
            seen_cells += low[row, col] == low[row, col]
    return changed_cells, seen_cells
