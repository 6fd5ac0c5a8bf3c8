"""Tiles that leave memory: the rest stands, their room is used again, and joined back it is as if they had stayed."""

import random

import numpy as np
import pytest

from drivers.config import LaserConfig
from drivers.samples import Scan, Stamp
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.tile import Tile, join

LASER = LaserConfig(
    port="none",
    latency_ms=(0.0, 1.0),
    range_bound_m=0.03,
    angle_bound_deg=0.3,
    mount_x_m=0.2,
    mount_y_m=0.0,
    mount_z_m=0.468,
    mount_pitch_deg=-10.0,
    mount_position_bound_m=0.003,
    mount_angle_bound_deg=0.2,
)
HALF = np.array([0.005, 0.004, 0.003, *np.radians([0.05, 0.06, 0.08])])
"""Tight, so that in cells of 0.2 m many hits are sure."""
Place = tuple[int, int]


def sweep_into(terrain: ElevationMap, seed: int) -> None:
    """A scan of 181 beams from somewhere within 40 m."""
    chance = np.random.default_rng(seed)
    ranges = chance.uniform(0.5, 6.0, 181)
    scan = Scan(Stamp(0, 0), np.zeros(181, np.int64), -np.pi / 2, np.pi / 180, ranges, 0)
    pose = np.concatenate([chance.uniform(-40, 40, 2), np.zeros(3), chance.uniform(-3, 3, 1)])[None, :]
    terrain.insert(scan, pose - HALF, pose + HALF, np.zeros(181, np.int32))


def by_place(terrain: ElevationMap) -> dict[Place, Tile]:
    """Every tile in memory."""
    return {(tile.ix, tile.iy): tile for tile in terrain.tiles()}


@pytest.mark.parametrize("seed", range(4))
def test_a_map_whose_tiles_leave_and_come_back_is_the_same_map(seed: int) -> None:
    """Whatever leaves, and when: memory joined with what left equals, bit for bit, the map that kept everything."""
    config, chance = MapConfig(resolution_m=0.2, max_tiles=100), random.Random(seed)
    whole, rolling = ElevationMap(config, LASER), ElevationMap(config, LASER)
    left: dict[Place, Tile] = {}
    for number in range(30):
        sweep_into(whole, 100 * seed + number)
        sweep_into(rolling, 100 * seed + number)
        before = by_place(rolling)
        leaving = chance.sample(sorted(before), len(before) // 2)
        for place in leaving:
            left[place] = join(left[place], before[place]) if place in left else before[place]
        assert rolling.evict([*leaving, (1000, 1000)]) == len(leaving)
        after = by_place(rolling)
        assert after == {place: tile for place, tile in before.items() if place not in leaving}
    assert whole.counts["beyond_cap"] == rolling.counts["beyond_cap"] == 0
    for tile in left.values():
        assert rolling.join(tile)
    assert by_place(rolling) == by_place(whole)
    assert sum(int(tile.surely_hit.sum()) for tile in whole.tiles()) > 100


def test_room_that_tiles_leave_is_used_again() -> None:
    """A map at its cap takes new tiles once others have left; nothing is left out."""
    terrain = ElevationMap(MapConfig(resolution_m=0.2, max_tiles=16), LASER)
    for step in range(60):
        if terrain.tile_count == 16:
            assert terrain.evict(list(by_place(terrain))[:8]) == 8
        level = np.full((64, 64), float(step), np.float32)
        assert terrain.join(Tile(0, step, -step, 0.2, level, level))
    assert terrain.counts["tiles_left_out"] == 0
    assert (59, -59) in by_place(terrain)


def test_which_tiles_changed_is_known_by_place() -> None:
    """places(changed=...) tells what take_dirty would bring, and what it would not, also after others have left."""
    terrain = ElevationMap(MapConfig(resolution_m=0.2, max_tiles=100), LASER)
    sweep_into(terrain, 1)
    places = {tuple(place) for place in terrain.places().tolist()}
    assert places == set(by_place(terrain)) == {tuple(place) for place in terrain.places(changed=True).tolist()}
    assert len(terrain.places(changed=False)) == 0
    terrain.take_dirty()
    level = np.full((64, 64), 1.0, np.float32)
    terrain.join(Tile(0, -2000, 3000, 0.2, level, level))
    terrain.evict(sorted(places)[::2])
    assert terrain.places(changed=True).tolist() == [[-2000, 3000]]
    assert {tuple(place) for place in terrain.places(changed=False).tolist()} == set(sorted(places)[1::2])
    assert [(tile.ix, tile.iy) for tile in terrain.take_dirty()] == [(-2000, 3000)]
