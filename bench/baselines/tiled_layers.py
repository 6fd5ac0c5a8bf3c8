"""Where the baselines keep their cells: the map's own tiles of 64 x 64 and its hash, several numbers a cell.

Each tile is `planes` layers of float32, one behind the other. All of the pool is there and touched from the start, so
that no scan waits for memory; what falls into tiles beyond the pool is counted in `numbers`, as in the map's kernel.
"""

import numpy as np
from numpy.typing import NDArray

from mapper import footprints, kernel
from mapper.grid import TILE_CELLS, TILE_SIDE, tile_indices

Floats = NDArray[np.float64]
_SLACK = 64
"""Vector instructions write (nothing) a little beyond the last cell."""
_LINE = 64
"""Bytes of a cache line, where the pool begins."""


class TiledLayers:
    """A pool of tiles, their keys and the hash that finds them."""

    def __init__(self, planes: int, unseen: float, tiles: int) -> None:
        self.planes = planes
        size = tiles * planes * TILE_CELLS
        memory = np.empty(4 * (size + _SLACK) + _LINE, np.uint8)
        start = -memory.ctypes.data % _LINE
        self.flat = memory[start : start + 4 * (size + _SLACK)].view(np.float32)
        self.flat.fill(unseen)
        self.pool = self.flat[:size].reshape(tiles, planes, TILE_CELLS)
        self.numbers = np.zeros(kernel.N_SIZE, np.int64)
        self.numbers[kernel.N_MOST] = self.numbers[kernel.N_READY] = tiles
        self.table = np.zeros(1 << (2 * tiles - 1).bit_length(), np.int32)
        self.keys = np.zeros(tiles, np.uint64)

    @property
    def fates(self) -> NDArray[np.int64]:
        """How many beams met which fate so far, as the map's kernel counts them."""
        return self.numbers[: footprints.FATES]

    def dense(self) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """[planes, ny, nx] of all tiles in use, unseen between, and the number (i, j) of the first cell."""
        used = int(self.numbers[kernel.N_TILES])
        places = np.array([tile_indices(int(key)) for key in self.keys[:used]]).reshape(-1, 2)
        low = places.min(axis=0)
        columns, rows = places.max(axis=0) - low + 1
        layers = np.full((self.planes, rows * TILE_SIDE, columns * TILE_SIDE), self.flat[-1], np.float32)
        for (ix, iy), tile in zip(places - low, self.pool[:used], strict=True):
            window = np.s_[:, iy * TILE_SIDE : (iy + 1) * TILE_SIDE, ix * TILE_SIDE : (ix + 1) * TILE_SIDE]
            layers[window] = tile.reshape(self.planes, TILE_SIDE, TILE_SIDE)
        return layers, (int(low[0]) * TILE_SIDE, int(low[1]) * TILE_SIDE)
