"""The map: an interval of elevation for every cell that a beam may have hit. One owner, no locks.

For every point that a beam really hit, the interval of the cell that contains the point contains its elevation, as
long as the pose boxes and the laser's declared bounds hold. Cells only ever grow, by hull.
"""

import mmap
from collections import Counter
from collections.abc import Iterable
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import only_as_compiled
from drivers.config import LaserConfig
from drivers.samples import Scan
from estimator.config import RobotConfig
from mapper import kernel, tile_layers
from mapper.beam_order import BeamOrder, plain, rising
from mapper.bound_arrays import bind
from mapper.config import MapConfig
from mapper.contact import insert_patches, track_patches
from mapper.footprints import FATES
from mapper.grid import TILE_SIDE, tile_indices, tile_key
from mapper.laser_geometry import G_SIZE, Floats, laser_geometry
from mapper.pose_terms import P_SIZE
from mapper.projection import B_SIZE, BOXES_SIZE, LANES
from mapper.tile import NO_CELL, NOWHERE, Tile, sealed_tile, unseen_tile

_MAP_NORESERVE = 0x4000
"""Linux's; Python names it from 3.13 on."""
_FLOAT64 = np.dtype(np.float64)
_new_tuple = tuple.__new__
"""Twice as fast as InsertResult's own, which goes through Python."""
_TILES_AT_A_TIME = 64
"""So many tiles (2 MiB) are made ready together ..."""
_TILES_SPARE = 16
"""... and as soon as fewer than this are left: no scan waits for memory, unless it needs more than these at once."""


class InsertResult(NamedTuple):
    """What became of a scan's beams; the numbers add up to `beams`. (A tuple: made 75 times a second and more.)"""

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

    def __init__(
        self, config: MapConfig, laser: LaserConfig, submap: int = 0, robot: RobotConfig | None = None
    ) -> None:
        """Start empty. Compiles the kernel now (seconds at first, then cached), so that no scan waits for it."""
        self.config = config
        self.submap = submap
        self._geometry = laser_geometry(laser)
        self._limits = np.array([config.resolution_m, config.max_footprint_m])
        self._order = BeamOrder()
        self._scratch = np.zeros(kernel.WORK_SIZE + B_SIZE)
        self._boxes = np.zeros(BOXES_SIZE, np.float32)
        self._spans = np.zeros(kernel.S_SIZE, np.int32)
        self._heights = np.zeros(2 * LANES, np.float32)
        self._tiles_left_out = 0
        self._patches = np.empty((0, G_SIZE))
        if config.contact is not None:
            if robot is None:
                raise ValueError("contact needs the robot's tracks")
            self._patches = track_patches(
                config.contact, robot.track_length_m, robot.track_gauge_m, config.resolution_m
            )
        self._slot_ns = round(config.evidence_slot_ms * 1e6) if config.evidence_slots else 0
        # Room for all tiles there may ever be: memory that nobody has touched costs nothing.
        most = config.max_tiles
        self._numbers = np.zeros(kernel.N_SIZE, np.int64)
        self._numbers[kernel.N_MOST] = most
        self._outcome = self._numbers[: kernel.N_READY + 1]
        self._table = np.zeros(1 << (2 * most - 1).bit_length(), np.int32)
        self._keys = np.zeros(most, np.uint64)
        self._dirty = np.zeros(most, np.bool_)
        self._sure = np.zeros((most, TILE_SIDE), np.uint64)
        self._pool = _untouched_pool(most, 1 + config.evidence_slots if config.evidence_slots else 1)
        self._make_ready()
        self._make_room(1)
        self._compile()

    def insert(self, scan: Scan, low: Floats, high: Floats, pose_index: NDArray[np.int32]) -> InsertResult:
        """Take a scan in whose beam i was shot from somewhere in the pose box [low, high][pose_index[i]].

        low, high: [m, 6] in the map frame, axes as estimator.bounded_pose.AXES. pose_index: [n], n = beams; a number
        outside 0..m-1 means that the beam has no pose.
        """
        ranges, order = scan.ranges_m, self._order
        order.arrange(scan, pose_index)
        plane = self._plane(scan.stamp.earliest_ns) if self._slot_ns else 0
        try:
            done = kernel.insert_beams(0, plane, ranges, low, high, order.bound, self._bound)
        except TypeError:
            # Not as the kernel was compiled for: another layout, another type, or read-only.
            ranges, low, high = (plain(array, _FLOAT64) for array in (ranges, low, high))
            done = kernel.insert_beams(0, plane, ranges, low, high, order.bound, self._bound)
        if done != ranges.size:
            self._go_on(done, plane, ranges, low, high)
        used, no_range, no_pose, too_wide, too_far, beyond_cap, tiles, ready = self._outcome.tolist()
        if ready - tiles < _TILES_SPARE:
            self._make_ready()
        return _new_tuple(InsertResult, (ranges.size, used, no_range, no_pose, too_wide, too_far, beyond_cap))

    def insert_contact(self, time_ns: int, low: Floats, high: Floats) -> None:
        """Take what the tracks touched when base_link was somewhere in the pose box [low, high], both [6].

        Nothing where the configuration has no contact, or where the box has no finite bounds.
        """
        done, patches = 0, len(self._patches)
        while done < patches:
            # fmt: off
            done = insert_patches(
                done, self._patches, low, high,
                self.config.resolution_m, self.config.max_footprint_m, self._plane(time_ns),
                self._scratch, self._poses[0], self._narrow[0], self._spans, self._heights,
                self._numbers, self._table, self._keys, self._dirty, self._pool, self._sure,
            )
            # fmt: on
            if done < patches:
                self._make_ready()

    @property
    def counts(self) -> Counter[str]:
        """Beams by fate since the start, named as in InsertResult; `tiles_left_out` by `join`."""
        fates = self._numbers[kernel.N_TOTALS :][:FATES]
        totals = InsertResult(int(fates.sum()), *fates.tolist())
        return Counter(totals._asdict() | {"tiles_left_out": self._tiles_left_out})

    def join(self, tile: Tile) -> bool:
        """Hull a tile into the map; False if max_tiles leaves no room for it."""
        if (tile.submap, tile.resolution_m) != (self.submap, self.config.resolution_m):
            raise ValueError(
                f"the map is submap {self.submap} at {self.config.resolution_m} m; "
                f"the tile is of submap {tile.submap} at {tile.resolution_m} m"
            )
        while True:
            # fmt: off
            found = tile_layers.join_tile(
                tile.ix, tile.iy, *tile.layers,
                self._numbers, self._table, self._keys, self._dirty, self._pool, self._sure,
            )
            # fmt: on
            if found != kernel.POOL_FULL:
                break
            self._make_ready()
        if found == kernel.LEFT_OUT:
            self._tiles_left_out += 1
        return bool(found != kernel.LEFT_OUT)

    @property
    def has_changed(self) -> bool:
        """Has any cell since the last `take_dirty`?"""
        return bool(self._dirty[: self.tile_count].any())

    def take_dirty(self) -> tuple[Tile, ...]:
        """Copies of the tiles in which any cell has changed since the last call."""
        (indices,) = self._dirty[: self.tile_count].nonzero()
        if not indices.size:
            return ()
        self._dirty[indices] = False
        return tuple([self._tile(index) for index in indices.tolist()])

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
        self._pool[kept:before], self._sure[kept:before], self._dirty[kept:before] = kernel.UNSEEN, 0, False
        self._numbers[kernel.N_TILES] = kept
        self._table.fill(kernel.FREE)
        kernel.rebuild_table(kept, self._table, self._keys)
        return before - kept

    @property
    def tile_count(self) -> int:
        """Tiles in use; each takes 32 KiB."""
        return int(self._numbers[kernel.N_TILES])

    @property
    def cells_seen(self) -> int:
        """Cells that hold an interval. Reads the whole map."""
        return tile_layers.tally(self.tile_count, self._pool)[0]

    @property
    def mean_width_m(self) -> float:
        """Mean width of those intervals; NaN while the map is empty. Reads the whole map."""
        seen, width = tile_layers.tally(self.tile_count, self._pool)
        return width / seen if seen else float("nan")

    def _compile(self) -> None:
        """Do everything once with nothing, so that the machine code is there: no scan and no tile waits for it."""
        rising(self._order.pose_index)
        none = np.zeros((1, 6))
        kernel.insert_beams(0, 0, np.empty(0), none, none, self._order.bound, self._bound)
        only_as_compiled(kernel.insert_beams)
        self.insert_contact(0, np.full(6, np.nan), np.full(6, np.nan))
        self._layers(0)
        nothing, no_room = unseen_tile(self.submap, 0, 0, 1.0), np.zeros(kernel.N_SIZE, np.int64)
        tile_layers.join_tile(
            0, 0, *nothing.layers, no_room, self._table, self._keys, self._dirty, self._pool, self._sure
        )
        kernel.rebuild_table(0, self._table, self._keys)
        tile_layers.tally(0, self._pool)

    def _plane(self, time_ns: int) -> int:
        """Where in the pool a scan of that time goes."""
        slots = self.config.evidence_slots
        return 1 + time_ns // self._slot_ns % slots if slots else 0

    def _go_on(self, done: int, plane: int, ranges: Floats, low: Floats, high: Floats) -> None:
        """From the beam on that wanted more room."""
        while done != ranges.size:
            if done == kernel.BAD_POSES:
                raise ValueError(f"need low, high [m, 6]; got {list(low.shape)}, {list(high.shape)}")
            if done == kernel.MANY_POSES:
                self._make_room(len(low))
            else:
                self._make_ready()
            done = kernel.insert_beams(max(done, 0), plane, ranges, low, high, self._order.bound, self._bound)

    def _make_room(self, poses: int) -> None:
        """For scans with so many poses."""
        self._poses, self._narrow = np.empty((poses, P_SIZE)), np.empty((poses, P_SIZE), np.float32)
        self._bound = bind(
            *(self._limits, self._geometry, self._scratch, self._poses, self._narrow),
            *(self._boxes, self._spans, self._heights),
            *(self._numbers, self._table, self._keys, self._dirty, self._pool, self._sure),
        )

    def _tile(self, index: int) -> Tile:
        ix, iy = tile_indices(int(self._keys[index]))
        return sealed_tile(self.submap, ix, iy, self.config.resolution_m, *self._layers(index))

    def _layers(self, index: int) -> list[NDArray[Any]]:
        """The layers of a tile, as `sealed_tile` takes them; none of settled cells where no evidence is kept."""
        shape = TILE_SIDE, TILE_SIDE
        low, high, surely_hit = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.bool_)
        if not tile_layers.copy_tile(self._pool[index], self._sure[index], low, high, surely_hit):
            surely_hit = NO_CELL
        settled_low = settled_high = NOWHERE
        if self.config.evidence_slots:
            settled = np.empty(shape, np.float32), np.empty(shape, np.float32)
            if tile_layers.copy_settled(self._pool[index], self.config.evidence_set_aside, *settled):
                settled_low, settled_high = settled
        return [low, high, surely_hit, settled_low, settled_high]

    def _make_ready(self) -> None:
        """Touch the memory of the next tiles, all of them unseen: the kernel never waits for a page."""
        ready = int(self._numbers[kernel.N_READY])
        more = min(ready + _TILES_AT_A_TIME, self.config.max_tiles)
        if ready == more:
            return
        self._pool[ready:more] = kernel.UNSEEN
        self._sure[ready:more] = 0
        self._numbers[kernel.N_READY] = more


def _untouched_pool(tiles: int, planes: int) -> kernel.Cells:
    """[tiles, planes, TILE_FLOATS] float32 that begins on a page and takes memory only where it is written to."""
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_NORESERVE
    shape = tiles, planes, kernel.TILE_FLOATS
    # The last block of the last row may reach beyond.
    memory = mmap.mmap(-1, tiles * planes * kernel.TILE_BYTES + mmap.PAGESIZE, flags=flags)
    memory.madvise(mmap.MADV_HUGEPAGE)
    return np.frombuffer(memory, np.float32, prod(shape)).reshape(shape)
