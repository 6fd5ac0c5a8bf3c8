"""The map: an interval of elevation for every cell that a beam may have hit. One owner, no locks.

For every point that a beam really hit, the interval of the cell that contains the point contains its elevation, as
long as the pose boxes and the laser's declared bounds hold. Cells only ever grow, by hull.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.config import LaserConfig
from drivers.samples import Scan
from mapper import kernel
from mapper.config import MapConfig
from mapper.grid import TILE_SIDE, tile_indices, tile_key
from mapper.projection import B_SIZE, P_SIZE, W_ROWS, Floats, beam_table, laser_geometry
from mapper.tile import Tile

_FIRST_TILES = 64
_CACHE_LINE = 64


@dataclass(frozen=True, slots=True)
class InsertResult:
    """What became of a scan's beams; the numbers add up to `beams`."""

    beams: int
    used: int
    """In the map, with every cell of their footprint."""
    no_range: int
    """No echo, or outside the range the owner declared usable."""
    no_pose: int
    """No pose of that number, or one without finite bounds."""
    too_wide: int
    """Footprint wider than max_footprint_m."""
    too_far: int
    """Outside what cells can be numbered."""
    beyond_cap: int
    """Some or all of the footprint lies in tiles that max_tiles left no room for; the rest of it is in the map."""


class ElevationMap:
    """Elevation intervals over a plane that grows by tiles."""

    def __init__(self, config: MapConfig, laser: LaserConfig, submap: int = 0) -> None:
        """Start empty. Compiles the kernel now (seconds at first, then cached), so that no scan waits for it."""
        self.config = config
        self.submap = submap
        self.counts: Counter[str] = Counter()
        """Beams by fate since the start, named as in InsertResult; `tiles_left_out` by `join`."""
        self._geometry = laser_geometry(laser)
        self._count = np.zeros(1, np.int64)
        self._fates = np.zeros(kernel.COUNTS, np.int64)
        self._work = np.zeros((W_ROWS, 4))
        self._poses = np.empty((0, P_SIZE))
        self._block = np.empty(B_SIZE)
        self._beam_angles = (0, 0.0, 0.0)
        self._cosines, self._sines = np.empty(0), np.empty(0)
        self._pool = _unseen_pool(0)
        self._keys = np.empty(0, np.uint64)
        self._dirty = np.empty(0, np.bool_)
        self._sure = np.empty((0, TILE_SIDE), np.uint64)
        self._table = np.empty(0, np.int32)
        self._grow(min(_FIRST_TILES, config.max_tiles))
        self._insert(np.empty(0), np.empty(0, np.int32), np.zeros((1, 6)), np.zeros((1, 6)))
        low, high = np.empty((2, TILE_SIDE, TILE_SIDE), np.float32)
        kernel.copy_tile(0, self._pool, self._sure, low, high, np.empty((TILE_SIDE, TILE_SIDE), np.bool_))

    def insert(self, scan: Scan, low: Floats, high: Floats, pose_index: NDArray[np.int32]) -> InsertResult:
        """Take a scan in whose beam i was shot from somewhere in the pose box [low, high][pose_index[i]].

        low, high: [m, 6] in the map frame, axes as estimator.bounded_pose.AXES. pose_index: [n], n = beams; a number
        outside 0..m-1 means that the beam has no pose.
        """
        self._turn_to(scan)
        self._fates[:] = 0
        self._insert(
            _plain(scan.ranges_m, np.float64),
            _plain(pose_index, np.int32),
            _plain(low, np.float64),
            _plain(high, np.float64),
        )
        used, no_range, no_pose, too_wide, too_far, beyond_cap = self._fates.tolist()
        result = InsertResult(scan.ranges_m.size, used, no_range, no_pose, too_wide, too_far, beyond_cap)
        counts = self.counts
        counts["beams"] += result.beams
        counts["used"] += used
        counts["no_range"] += no_range
        counts["no_pose"] += no_pose
        counts["too_wide"] += too_wide
        counts["too_far"] += too_far
        counts["beyond_cap"] += beyond_cap
        return result

    def join(self, tile: Tile) -> bool:
        """Hull a tile into the map; False if max_tiles leaves no room for it."""
        if (tile.submap, tile.resolution_m) != (self.submap, self.config.resolution_m):
            raise ValueError(
                f"the map is submap {self.submap} at {self.config.resolution_m} m; "
                f"the tile is of submap {tile.submap} at {tile.resolution_m} m"
            )
        while True:
            # fmt: off
            found = kernel.join_tile(
                tile.ix, tile.iy, tile.low, tile.high, tile.surely_hit, self.config.max_tiles,
                self._count, self._table, self._keys, self._dirty, self._pool, self._sure,
            )
            # fmt: on
            if found != kernel.POOL_FULL:
                break
            self._grow_further()
        if found == kernel.LEFT_OUT:
            self.counts["tiles_left_out"] += 1
        return bool(found != kernel.LEFT_OUT)

    def take_dirty(self) -> tuple[Tile, ...]:
        """Copies of the tiles in which any cell has changed since the last call."""
        indices = np.flatnonzero(self._dirty[: self.tile_count])
        self._dirty[indices] = False
        return tuple(self._tile(int(index)) for index in indices)

    def tiles(self) -> tuple[Tile, ...]:
        """Copies of all tiles, in the order in which they were first touched."""
        return tuple(self._tile(index) for index in range(self.tile_count))

    def places(self, changed: bool | None = None) -> NDArray[np.int64]:
        """[n, 2] ix, iy of the tiles; `changed` since the last take_dirty or not: only those."""
        keys = self._keys[: self.tile_count]
        if changed is not None:
            keys = keys[self._dirty[: self.tile_count] == changed]
        pairs = np.stack((keys >> np.uint64(32), keys & np.uint64(0xFFFFFFFF)), axis=-1)
        return pairs.astype(np.uint32).view(np.int32).astype(np.int64)

    def evict(self, places: Iterable[tuple[int, int]]) -> int:
        """Forget tiles (ix, iy): their room is used again. How many there were."""
        before, leaving = self.tile_count, np.array([int(tile_key(*place)) for place in places], np.uint64)
        stays = ~np.isin(self._keys[:before], leaving)
        kept = int(np.count_nonzero(stays))
        # The last tiles move into the holes.
        holes, movers = np.flatnonzero(~stays[:kept]), kept + np.flatnonzero(stays[kept:])
        for rows in (self._keys, self._dirty, self._pool, self._sure):
            rows[holes] = rows[movers]
        self._count[0] = kept
        self._table.fill(kernel.FREE)
        kernel.rebuild_table(kept, self._table, self._keys)
        return before - kept

    @property
    def tile_count(self) -> int:
        """Tiles in use; each takes 32 KiB."""
        return int(self._count[0])

    @property
    def cells_seen(self) -> int:
        """Cells that hold an interval. Reads the whole map."""
        return kernel.tally(self.tile_count, self._pool)[0]

    @property
    def mean_width_m(self) -> float:
        """Mean width of those intervals; NaN while the map is empty. Reads the whole map."""
        seen, width = kernel.tally(self.tile_count, self._pool)
        return width / seen if seen else float("nan")

    def _insert(self, ranges: Floats, pose_index: NDArray[np.int32], low: Floats, high: Floats) -> None:
        if pose_index.shape != ranges.shape or low.shape != high.shape or low.shape[1:] != (6,):
            raise ValueError(
                f"need pose_index [{ranges.size}] and low, high [m, 6]; "
                f"got {list(pose_index.shape)}, {list(low.shape)}, {list(high.shape)}"
            )
        if len(low) > len(self._poses):
            self._poses = np.empty((len(low), P_SIZE))
        done = 0
        while True:
            # fmt: off
            done = kernel.insert_beams(
                done, ranges, self._cosines, self._sines, pose_index, low, high,
                self._geometry, self.config.resolution_m, self.config.max_footprint_m, self.config.max_tiles,
                self._work, self._poses, self._block,
                self._count, self._table, self._keys, self._dirty, self._pool, self._sure, self._fates,
            )
            # fmt: on
            if done == ranges.size:
                return
            self._grow_further()

    def _turn_to(self, scan: Scan) -> None:
        """Have the sines and cosines of this scan's beams (the scanner rarely changes its angles)."""
        beam_angles = (scan.ranges_m.size, scan.angle_min_rad, scan.angle_increment_rad)
        if beam_angles != self._beam_angles:
            self._cosines, self._sines = np.empty(beam_angles[0]), np.empty(beam_angles[0])
            beam_table(scan.angle_min_rad, scan.angle_increment_rad, self._cosines, self._sines)
            self._beam_angles = beam_angles

    def _tile(self, index: int) -> Tile:
        ix, iy = tile_indices(int(self._keys[index]))
        low, high = np.empty((2, TILE_SIDE, TILE_SIDE), np.float32)
        surely_hit = np.empty((TILE_SIDE, TILE_SIDE), np.bool_)
        kernel.copy_tile(index, self._pool, self._sure, low, high, surely_hit)
        return Tile(self.submap, ix, iy, self.config.resolution_m, low, high, surely_hit)

    def _grow_further(self) -> None:
        self._grow(min(2 * self._keys.size, self.config.max_tiles))

    def _grow(self, capacity: int) -> None:
        """Make room for `capacity` tiles."""
        tiles = self.tile_count
        pool, keys, dirty = _unseen_pool(capacity), np.zeros(capacity, np.uint64), np.zeros(capacity, np.bool_)
        sure = np.zeros((capacity, TILE_SIDE), np.uint64)
        pool[:tiles], keys[:tiles], dirty[:tiles] = self._pool[:tiles], self._keys[:tiles], self._dirty[:tiles]
        sure[:tiles] = self._sure[:tiles]
        table = np.full(1 << (2 * capacity - 1).bit_length(), kernel.FREE, np.int32)
        kernel.rebuild_table(tiles, table, keys)
        self._pool, self._keys, self._dirty, self._sure, self._table = pool, keys, dirty, sure, table


def _unseen_pool(capacity: int) -> kernel.Cells:
    """[capacity, TILE_FLOATS] float32 that begins on a cache line; not filled (add_tile does it, tile by tile)."""
    wanted = capacity * kernel.TILE_FLOATS * 4
    raw = np.empty(wanted + _CACHE_LINE, np.uint8)
    skip = -raw.ctypes.data % _CACHE_LINE
    return raw[skip : skip + wanted].view(np.float32).reshape(capacity, kernel.TILE_FLOATS)


def _plain(array: NDArray[Any], dtype: type) -> NDArray[Any]:
    """The array as the compiled code knows it: another layout, type or a read-only one would compile again, live."""
    if array.dtype == dtype and array.flags.c_contiguous and array.flags.writeable:
        return array
    return np.array(array, dtype=dtype, order="C")
