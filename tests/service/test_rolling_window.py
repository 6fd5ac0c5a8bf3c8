"""A map larger than memory: what is stored, published and saved is the same as if all had stayed in memory."""

import time
from collections.abc import Iterator
from functools import reduce
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from drivers.config import LaserConfig
from drivers.samples import Scan, Stamp
from estimator.bounded_pose import INTACT, BoundedPose
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.tile import Tile, join, snap_outward
from mapper.tile_codec import decode, encode
from service.health import Health
from service.map_keeper import MapKeeper, Unkept
from service.messages import TileId
from service.published_map import PublishedMap
from service.rolling_window import RollingWindow

LASER = LaserConfig(
    port="none",
    latency_ms=(0.0, 1.0),
    range_bound_m=0.02,
    angle_bound_deg=0.1,
    mount_x_m=0.2,
    mount_y_m=0.0,
    mount_z_m=0.468,
    mount_pitch_deg=-10.0,
    mount_position_bound_m=0.002,
    mount_angle_bound_deg=0.1,
)
HALF = np.array([0.01, 0.01, 0.01, *np.radians([0.1, 0.1, 0.2])])
PATIENCE_S = 30.0
CAP = 40


def drive(x: float, number: int) -> tuple[Scan, BoundedPose]:
    """A scan taken at x metres along the way, and where it was taken."""
    chance = np.random.default_rng(number)
    scan = Scan(Stamp(0, 0), np.zeros(181, np.int64), -np.pi / 2, np.pi / 180, chance.uniform(0.5, 8.0, 181), 0)
    middle = np.array([x, 0.3 * number % 2, 0.0, 0.0, 0.0, number % 6 - 3.0])
    return scan, BoundedPose(number, number, middle - HALF, middle + HALF)


def insert(terrain: ElevationMap, scan: Scan, pose: BoundedPose) -> None:
    """One scan from one pose."""
    terrain.insert(scan, pose.low[None], pose.high[None], np.zeros(181, np.int32))


def there_and_back(steps: int = 45) -> Iterator[tuple[Scan, BoundedPose]]:
    """A drive that comes back over tiles that have left memory."""
    for number in range(2 * steps):
        yield drive(2.0 * (number if number < steps else 2 * steps - number), number)


@pytest.fixture
def keeper(tmp_path: Path) -> Iterator[MapKeeper]:
    """A keeper whose disk is quick."""
    keeper = MapKeeper(tmp_path / "map.db", 0.02, 0.1, "map", Health())
    assert keeper.start() == 0
    yield keeper
    keeper.close()


def wait_until_saved(keeper: MapKeeper) -> None:
    """As in a drive that is slower than the disk."""
    deadline = time.monotonic() + PATIENCE_S
    while keeper.state()["tiles_unsaved"]:
        assert time.monotonic() < deadline, keeper.state()
        time.sleep(0.01)


def test_a_drive_larger_than_memory_is_kept_published_and_saved_whole(keeper: MapKeeper) -> None:
    """Tiles leave for the store and come back when touched: memory keeps its cap, and the map is the whole drive's."""
    config = MapConfig(resolution_m=0.1, max_tiles=CAP)
    whole, rolling = ElevationMap(MapConfig(resolution_m=0.1), LASER), ElevationMap(config, LASER)
    window = RollingWindow(config, keeper)
    all_published, published = PublishedMap(), PublishedMap(keeper.recall, CAP // 2)
    came_back = 0
    for scan, pose in there_and_back():
        insert(whole, scan, pose)
        insert(rolling, scan, pose)
        changes = rolling.take_dirty()
        keeper.offer(changes, None, INTACT, pose.latest_ns)
        for tile in changes:
            published.update(tile)
        for tile in whole.take_dirty():
            all_published.update(tile)
        if rolling.tile_count > CAP // 2:
            wait_until_saved(keeper)
        assert window.roll(rolling, pose) == []
        returned = keeper.returned()
        came_back += len(returned)
        for tile in returned:
            assert rolling.join(tile)
    assert whole.tile_count > 1.5 * CAP
    assert rolling.tile_count <= CAP
    assert window.counts["tiles_left_memory"] > CAP
    assert rolling.counts["beyond_cap"] == rolling.counts["tiles_left_out"] == 0
    assert came_back > CAP // 2

    # What subscribers are told, and what they get on asking.
    assert published.entries() == all_published.entries()
    assert len(published) == whole.tile_count
    for place in published:
        ours, wholes = published.get(place), all_published.get(place)
        assert ours is not None
        assert wholes is not None
        assert ours.tile == wholes.tile

    # What a saved file holds.
    kept: dict[tuple[int, int], list[Tile]] = {}
    for tile in [*rolling.tiles(), *keeper.kept()]:
        kept.setdefault((tile.ix, tile.iy), []).append(snap_outward(tile))
    assert {place: reduce(join, tiles) for place, tiles in kept.items()} == {
        (tile.ix, tile.iy): snap_outward(tile) for tile in whole.tiles()
    }


def test_versions_only_rise_and_a_delta_joins_to_what_is_listed(keeper: MapKeeper) -> None:
    """Who joins every message that is sent holds, in the end, what the digest lists, wherever the robot's tiles lie."""
    config = MapConfig(resolution_m=0.1, max_tiles=CAP)
    rolling, published = ElevationMap(config, LASER), PublishedMap(keeper.recall, 8)
    window = RollingWindow(config, keeper)
    copy: dict[TileId, Tile] = {}
    versions: dict[TileId, list[int]] = {}
    for scan, pose in there_and_back(30):
        insert(rolling, scan, pose)
        changes = rolling.take_dirty()
        keeper.offer(changes, None, INTACT, pose.latest_ns)
        wait_until_saved(keeper)
        for tile in changes:
            if (news := published.update(tile)) is not None:
                place = TileId(tile.submap, tile.ix, tile.iy)
                cells = decode(encode(news.tile, "map", 0, news.cells), tile.submap).tile
                copy[place] = join(copy[place], cells) if place in copy else cells
                versions.setdefault(place, []).append(news.version)
        window.roll(rolling, pose)
    for place, tile in copy.items():
        ours = published.get(place)
        assert ours is not None
        assert ours.tile == tile
    assert all(a < b for numbers in versions.values() for a, b in pairwise(numbers))
    assert window.counts["tiles_left_memory"] > 10


def test_without_a_store_a_rolling_map_forgets_the_farthest_and_counts_them() -> None:
    """Memory keeps its cap, nothing near is left out, and what is forgotten is told to the publisher."""
    config = MapConfig(resolution_m=0.1, max_tiles=CAP, rolling=True)
    terrain, window = ElevationMap(config, LASER), RollingWindow(config, Unkept())
    forgotten: list[TileId] = []
    for number in range(60):
        scan, pose = drive(2.0 * number, number)
        insert(terrain, scan, pose)
        forgotten += window.roll(terrain, pose)
    assert terrain.tile_count <= CAP
    assert terrain.counts["beyond_cap"] == 0
    assert window.counts["tiles_forgotten"] == len(forgotten) > CAP
    reach = max(abs(6.4 * (tile.ix + 0.5) - 118.0) for tile in terrain.tiles())
    assert reach < 80.0
    published = PublishedMap()
    for tile in terrain.tiles():
        published.update(tile)
    gone = next(iter(published))
    published.forget([gone, *forgotten])
    assert gone not in {entry.tile for entry in published.entries()}
    assert len(published) == terrain.tile_count - 1


def test_without_store_or_rolling_what_lies_beyond_the_cap_is_counted() -> None:
    """As ever: the map stops growing, says how many beams that cost, and forgets nothing."""
    config = MapConfig(resolution_m=0.1, max_tiles=16)
    terrain, window = ElevationMap(config, LASER), RollingWindow(config, Unkept())
    for number in range(20):
        scan, pose = drive(2.0 * number, number)
        insert(terrain, scan, pose)
        assert window.roll(terrain, pose) == []
    assert terrain.tile_count == 16
    assert terrain.counts["beyond_cap"] > 100
