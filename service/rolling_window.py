"""Which tiles leave memory: those farthest from the robot, once they are on the disk.

Without a store nothing leaves, unless the owner wants a rolling map: then the farthest are forgotten, and counted.
"""

from collections import Counter

import numpy as np

from estimator.bounded_pose import BoundedPose
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.grid import TILE_SIDE
from service.map_keeper import MapKeeper, Unkept
from service.messages import TileId

FULL, ROOMY = 0.75, 0.625
"""Shares of max_tiles: tiles leave when more than the first are in memory, until the second are. The rest is room
for what is mapped until the disk has the next ones."""


class RollingWindow:
    """Keeps the map below its memory cap. Called by the thread that owns the map."""

    def __init__(self, config: MapConfig, keeper: MapKeeper | Unkept) -> None:
        self.counts: Counter[str] = Counter()
        """Tiles that left memory for the store, or were forgotten."""
        self._full, self._roomy = int(FULL * config.max_tiles), int(ROOMY * config.max_tiles)
        self._tile_m = TILE_SIDE * config.resolution_m
        self._keeper = keeper
        self._forgets = config.rolling and isinstance(keeper, Unkept)

    def is_full(self, terrain: ElevationMap) -> bool:
        """Is it time to `roll`?"""
        return terrain.tile_count > self._full

    def roll(self, terrain: ElevationMap, pose: BoundedPose | None) -> list[TileId]:
        """Make room if need be. Returns the tiles that are forgotten: in no store, and in the map no more."""
        if not self.is_full(terrain) or pose is None:
            return []
        number = terrain.submap
        places = terrain.places(changed=None if self._forgets else False)
        middle = (pose.low[:2] + pose.high[:2]) / (2 * self._tile_m)
        farthest_first = np.argsort(-np.hypot(*(places + 0.5 - middle).T), kind="stable")
        leaving: list[TileId] = []
        for ix, iy in places[farthest_first].tolist():
            if terrain.tile_count - len(leaving) <= self._roomy:
                break
            if self._forgets or self._keeper.is_saved((number, ix, iy)):
                leaving.append(TileId(number, ix, iy))
        terrain.evict([(place.ix, place.iy) for place in leaving])
        self.counts["tiles_forgotten" if self._forgets else "tiles_left_memory"] += len(leaving)
        if self._forgets:
            return leaving
        self._keeper.left_memory(leaving)
        return []
