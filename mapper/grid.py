"""How the plane is cut: square cells, and tiles of 64 x 64 cells.

Cell i of an axis covers [i, i + 1) * resolution; tile i covers cells 64 i to 64 i + 63. Indices may be negative; the
map frame's origin is the low corner of cell 0 and of tile 0.
"""

from math import floor

import numpy as np

from drivers.compiled import compiled

TILE_SHIFT = 6
TILE_SIDE = 1 << TILE_SHIFT
"""Cells along a tile's side."""
TILE_CELLS = TILE_SIDE * TILE_SIDE
CELL_LIMIT = 1 << 30
"""Cells are numbered from -CELL_LIMIT to CELL_LIMIT; what lies farther out is not mapped."""


def cell_index(position_m: float, resolution_m: float) -> int:
    """Number of the cell that holds `position_m`."""
    return floor(position_m / resolution_m)


def tile_corner_m(ix: int, iy: int, resolution_m: float) -> tuple[float, float]:
    """Low corner (x, y) of a tile."""
    return ix * (TILE_SIDE * resolution_m), iy * (TILE_SIDE * resolution_m)


@compiled
def tile_key(ix: int, iy: int) -> np.uint64:
    """One 64-bit number for a pair of (32-bit, signed) tile indices."""
    return (np.uint64(ix) << np.uint64(32)) | (np.uint64(iy) & np.uint64(0xFFFFFFFF))


def tile_indices(key: int) -> tuple[int, int]:
    """The pair of tile indices that `tile_key` packed."""
    return _signed(key >> 32), _signed(key & 0xFFFFFFFF)


def _signed(word: int) -> int:
    return word - (1 << 32) if word >= 1 << 31 else word
