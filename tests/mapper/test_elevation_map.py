"""The map contains every point that was hit, whatever the order, the repetition and the dirt."""

from dataclasses import replace
from math import floor

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.config import LaserConfig
from drivers.samples import Scan, Stamp
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.grid import cell_index, tile_indices, tile_key
from mapper.projection import project
from mapper.tile import Tile, join, unseen_tile

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
CONFIG = MapConfig(resolution_m=0.05, max_tiles=1000)
BEAMS = 181
HALF = np.array([0.05, 0.04, 0.03, *np.radians([0.5, 0.6, 0.8])])


class Sweep:
    """A scan of 181 beams over rough ground, with a pose box for every run of 20 beams."""

    def __init__(self, seed: int, far: float = 3.0) -> None:
        random = np.random.default_rng(seed)
        ranges = random.uniform(0.5, 6.0, BEAMS)
        self.scan = Scan(Stamp(0, 0), np.zeros(BEAMS, np.int64), -np.pi / 2, np.pi / 180, ranges, 0)
        poses = BEAMS // 20 + 1
        start = np.concatenate([random.uniform(-far, far, 3), random.uniform(-0.2, 0.2, 2), random.uniform(-4, 4, 1)])
        middle = start + np.arange(poses)[:, None] * [0.02, 0.01, 0.0, 0.001, 0.001, 0.01]
        self.low, self.high = middle - HALF, middle + HALF
        self.pose_index = (np.arange(BEAMS) // 20).astype(np.int32)

    def into(self, terrain: ElevationMap, beams: slice = slice(None)) -> None:
        """Insert only these beams (the others' ranges blanked)."""
        ranges = np.full(BEAMS, np.nan)
        ranges[beams] = self.scan.ranges_m[beams]
        terrain.insert(replace(self.scan, ranges_m=ranges), self.low, self.high, self.pose_index)


def by_place(tiles: tuple[Tile, ...]) -> dict[tuple[int, int], Tile]:
    return {(tile.ix, tile.iy): tile for tile in tiles}


def interval(tiles: dict[tuple[int, int], Tile], x: float, y: float, resolution: float) -> tuple[float, float]:
    i, j = cell_index(x, resolution), cell_index(y, resolution)
    tile = tiles[i // 64, j // 64]
    return float(tile.low[j % 64, i % 64]), float(tile.high[j % 64, i % 64])


def rotation(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    out: NDArray[np.float64] = about_z @ about_y @ about_x
    return out


@pytest.mark.parametrize("resolution", [0.05, 0.03, 1.0])
def test_every_hit_is_inside_the_interval_of_its_cell(resolution: float) -> None:
    """With errors at the corners of their bounds, over 30 scans, the hit's own cell always contains its elevation."""
    random = np.random.default_rng(4)
    terrain = ElevationMap(replace(CONFIG, resolution_m=resolution), LASER)
    hits = []
    for seed in range(30):
        sweep = Sweep(seed)
        sweep.into(terrain)
        for n in range(BEAMS):
            sign = random.choice([-1.0, 1.0], 14)
            low, high = sweep.low[sweep.pose_index[n]], sweep.high[sweep.pose_index[n]]
            pose = np.where(sign[:6] < 0, low, high)
            r = sweep.scan.ranges_m[n] + sign[6] * LASER.range_bound_m
            th = np.radians(-90.0 + n) + sign[7] * np.radians(LASER.angle_bound_deg)
            askew = sign[8:11] * np.radians(LASER.mount_angle_bound_deg)
            lever = np.array([0.2, 0.0, 0.468]) + sign[11:] * LASER.mount_position_bound_m
            mount = rotation(askew[0], np.radians(10.0) + askew[1], askew[2])
            hits.append(pose[:3] + rotation(*pose[3:]) @ (lever + mount @ [r * np.cos(th), r * np.sin(th), 0.0]))
    tiles = by_place(terrain.tiles())
    wrong = 0
    for x, y, z in hits:
        low_z, high_z = interval(tiles, x, y, resolution)
        wrong += not low_z <= z <= high_z
    assert len(hits) == 30 * BEAMS
    assert wrong == 0


def test_the_kernel_touches_exactly_the_cells_of_the_boxes() -> None:
    """The map equals a plain loop over the projected boxes: same cells, same bounds, up to a few micrometres."""
    terrain, sweep = ElevationMap(CONFIG, LASER), Sweep(1)
    result = terrain.insert(sweep.scan, sweep.low, sweep.high, sweep.pose_index)
    boxes = project(sweep.scan, LASER, sweep.low, sweep.high, sweep.pose_index)
    assert result.used == BEAMS

    def joined(more: float) -> dict[tuple[int, int], tuple[float, float]]:
        cells: dict[tuple[int, int], tuple[float, float]] = {}
        for (x0, y0, z0), (x1, y1, z1) in zip(boxes.low - more, boxes.high + more, strict=True):
            for i in range(floor(x0 * 20.0), floor(x1 * 20.0) + 1):
                for j in range(floor(y0 * 20.0), floor(y1 * 20.0) + 1):
                    low, high = cells.get((i, j), (np.inf, -np.inf))
                    cells[i, j] = min(low, z0), max(high, z1)
        return cells

    least, most = joined(0.0), joined(3e-6)
    assert least.keys() == most.keys(), "a box that ends on a border: no case for this test"
    assert terrain.cells_seen == len(least)
    tiles = by_place(terrain.tiles())
    for (i, j), (low, high) in least.items():
        tile, (lowest, highest) = tiles[i // 64, j // 64], most[i, j]
        assert lowest <= tile.low[j % 64, i % 64] <= low
        assert high <= tile.high[j % 64, i % 64] <= highest
    widths = [high - low for low, high in least.values()]
    assert terrain.mean_width_m == pytest.approx(np.mean(widths), abs=6e-6)


def test_cells_are_surely_hit_where_a_footprint_fits_in_them() -> None:
    """At 40 cm cells, exactly the cells that some beam's whole footprint lies in; with corner errors none is wrong."""
    terrain = ElevationMap(replace(CONFIG, resolution_m=0.4), LASER)
    expected = set()
    for seed in range(5):
        sweep = Sweep(seed)
        sweep.into(terrain)
        boxes = project(sweep.scan, LASER, sweep.low, sweep.high, sweep.pose_index)
        for low, high in zip(boxes.low, boxes.high, strict=True):
            first, last = np.floor(low[:2] / 0.4), np.floor(high[:2] / 0.4)
            if np.array_equal(first, last):
                expected.add((int(first[0]), int(first[1])))
    found = {
        (tile.ix * 64 + int(col), tile.iy * 64 + int(row))
        for tile in terrain.tiles()
        for row, col in np.argwhere(tile.surely_hit)
    }
    assert found == expected
    assert 80 < len(found) < terrain.cells_seen / 2


def test_order_repetition_and_splitting_change_no_bit() -> None:
    """Scans in any order, twice, or beam by beam in pieces: the same map, bit for bit."""
    sweeps = [Sweep(seed) for seed in range(6)]
    plain, mixed = ElevationMap(CONFIG, LASER), ElevationMap(CONFIG, LASER)
    for sweep in sweeps:
        sweep.into(plain)
    for sweep in [*reversed(sweeps), *sweeps[::2]]:
        for part in (slice(100, None), slice(0, 40), slice(30, 110)):
            sweep.into(mixed, part)
    assert by_place(plain.tiles()) == by_place(mixed.tiles())
    assert plain.cells_seen > 5000
    random = np.random.default_rng(9)
    for _ in range(4):
        shuffled = ElevationMap(CONFIG, LASER)
        for n in random.permutation(np.repeat(np.arange(6), random.integers(1, 3, 6))):
            ends = [0, *sorted(random.integers(0, BEAMS, 3)), BEAMS]
            for k in random.permutation(len(ends) - 1):
                sweeps[n].into(shuffled, slice(ends[k], ends[k + 1]))
        assert by_place(plain.tiles()) == by_place(shuffled.tiles())


def test_the_pool_grows_in_the_middle_of_a_scan() -> None:
    """A scan that needs many more tiles than were there gives the map that beams one by one give; none counts twice."""
    fine = replace(CONFIG, resolution_m=0.005)
    terrain, sweep = ElevationMap(fine, LASER), Sweep(2)
    result = terrain.insert(sweep.scan, sweep.low, sweep.high, sweep.pose_index)
    assert terrain.tile_count > 200
    assert result.used == result.beams == BEAMS
    piecewise = ElevationMap(fine, LASER)
    for n in range(BEAMS):
        sweep.into(piecewise, slice(n, n + 1))
    assert by_place(terrain.tiles()) == by_place(piecewise.tiles())


def test_beyond_the_memory_cap_beams_are_counted_and_the_rest_stands() -> None:
    """With room for 16 tiles, cells in them equal the roomy map's, and every beam that lost a cell is counted."""
    sweep = Sweep(2)
    fine = replace(CONFIG, resolution_m=0.005)
    small, roomy = ElevationMap(replace(fine, max_tiles=16), LASER), ElevationMap(fine, LASER)
    result = small.insert(sweep.scan, sweep.low, sweep.high, sweep.pose_index)
    sweep.into(roomy)
    assert small.tile_count == 16
    assert result.beyond_cap > 100
    assert result.used + result.beyond_cap == BEAMS
    assert small.counts["beyond_cap"] == result.beyond_cap
    everywhere = by_place(roomy.tiles())
    assert all(tile == everywhere[tile.ix, tile.iy] for tile in small.tiles())
    assert not small.join(unseen_tile(0, 1000, 1000, 0.005))
    assert small.counts["tiles_left_out"] == 1


def test_negative_tiles_are_where_they_belong() -> None:
    """A map around the origin has tiles on all four sides; far in the negative corner the same tiles are touched."""
    terrain = ElevationMap(CONFIG, LASER)
    for seed in range(8):
        Sweep(seed).into(terrain)
    signs = {(tile.ix < 0, tile.iy < 0) for tile in terrain.tiles()}
    assert len(signs) == 4
    far = ElevationMap(CONFIG, LASER)
    sweep = Sweep(1)
    shift = np.array([-1000 * 64 * 0.05, -2000 * 64 * 0.05, 0, 0, 0, 0])
    far.insert(sweep.scan, sweep.low + shift, sweep.high + shift, sweep.pose_index)
    near = ElevationMap(CONFIG, LASER)
    sweep.into(near)
    shifted = {(tile.ix + 1000, tile.iy + 2000) for tile in far.tiles()}
    assert shifted == {(tile.ix, tile.iy) for tile in near.tiles()}
    assert all(
        tile_indices(int(tile_key(*pair))) == pair for pair in [(-1, -1), (-(2**31), 2**31 - 1), (0, -5), (7, 0)]
    )


@pytest.mark.parametrize(("resolution", "away_km"), [(0.05, 1_000.0), (0.05, 40_000.0), (0.005, 5_000.0)])
def test_far_from_the_origin_hits_are_inside_too(resolution: float, away_km: float) -> None:
    """A thousand kilometres out and more, on all sides: corner hits are in their cell's interval, none is lost."""
    random = np.random.default_rng(7)
    config = replace(CONFIG, resolution_m=resolution, max_tiles=4000)
    for sign_x, sign_y in ((1, -1), (-1, 1)):
        terrain, sweep = ElevationMap(config, LASER), Sweep(5)
        shift = 1e3 * away_km * np.array([sign_x, sign_y, 0, 0, 0, 0])
        low, high = sweep.low + shift, sweep.high + shift
        assert terrain.insert(sweep.scan, low, high, sweep.pose_index).used == BEAMS
        tiles = by_place(terrain.tiles())
        for n in range(BEAMS):
            pose = np.where(random.random(6) < 0.5, low[sweep.pose_index[n]], high[sweep.pose_index[n]])
            r, th = sweep.scan.ranges_m[n] + random.choice([-0.03, 0.03]), np.radians(-90.0 + n)
            beam = rotation(0.0, np.radians(10.0), 0.0) @ [r * np.cos(th), r * np.sin(th), 0.0]
            x, y, z = pose[:3] + rotation(*pose[3:]) @ (np.array([0.2, 0.0, 0.468]) + beam)
            low_z, high_z = interval(tiles, x, y, resolution)
            assert low_z <= z <= high_z
        assert all(tile.ix * sign_x > 0 for tile in tiles.values())


def test_bad_ranges_and_poses_are_counted_and_harm_nothing() -> None:
    """Unusable ranges, missing and broken poses: each is counted once, and the others' map is unchanged."""
    terrain, clean = ElevationMap(CONFIG, LASER), ElevationMap(CONFIG, LASER)
    sweep = Sweep(3)
    ranges = sweep.scan.ranges_m.copy()
    ranges[:7] = [np.nan, np.inf, -np.inf, 1e308, -5.0, 0.0, 30.1]
    index = sweep.pose_index.copy()
    index[7:9] = [-1, 1000]
    low, high = sweep.low.copy(), sweep.high.copy()
    low[9, 0], low[8, 5], high[7, 2] = np.nan, -np.inf, low[7, 2] - 1.0
    result = terrain.insert(replace(sweep.scan, ranges_m=ranges), low, high, index)
    assert (result.no_range, result.no_pose) == (7, 2 + 41)
    assert result.used == BEAMS - 50
    sweep.into(clean, slice(9, 140))
    assert by_place(terrain.tiles()) == by_place(clean.tiles())


def test_wide_and_far_beams_are_counted() -> None:
    """A footprint wider than allowed, and a pose beyond the numbered cells, touch no cell."""
    terrain, sweep = ElevationMap(CONFIG, LASER), Sweep(3)
    wide = sweep.low.copy()
    wide[:, 0] -= 6.0
    assert terrain.insert(sweep.scan, wide, sweep.high, sweep.pose_index).too_wide == BEAMS
    away = np.array([1e12, 0, 0, 0, 0, 0])
    assert terrain.insert(sweep.scan, sweep.low + away, sweep.high + away, sweep.pose_index).too_far == BEAMS
    up = np.array([0, 0, 1e300, 0, 0, 0])
    result = terrain.insert(sweep.scan, sweep.low + up, sweep.high + up, sweep.pose_index)
    assert result.too_far + result.too_wide == BEAMS
    assert terrain.tile_count == 0
    assert np.isnan(terrain.mean_width_m)


def test_only_changed_tiles_are_taken_and_each_once() -> None:
    """take_dirty gives a changed tile once; a scan that tells nothing new makes no tile dirty."""
    terrain, sweep = ElevationMap(CONFIG, LASER), Sweep(1)
    sweep.into(terrain)
    assert by_place(terrain.take_dirty()) == by_place(terrain.tiles())
    assert terrain.take_dirty() == ()
    sweep.into(terrain)
    assert terrain.take_dirty() == ()
    sweep.high[0] += 0.001
    sweep.into(terrain, slice(0, 1))
    taken = terrain.take_dirty()
    assert 0 < len(taken) < terrain.tile_count
    assert all(tile == by_place(terrain.tiles())[tile.ix, tile.iy] for tile in taken)


def test_a_map_joins_another_maps_tiles() -> None:
    """Joining a second map's tiles equals inserting its scans; what changed is dirty; foreign tiles are refused."""
    a, b, both = (ElevationMap(CONFIG, LASER) for _ in range(3))
    for seed in range(3):
        Sweep(seed).into(a)
        Sweep(seed).into(both)
        Sweep(seed + 3).into(b)
        Sweep(seed + 3).into(both)
    a.take_dirty()
    for tile in b.tiles():
        assert a.join(tile)
    assert by_place(a.tiles()) == by_place(both.tiles())
    assert {(tile.ix, tile.iy) for tile in a.take_dirty()} <= {(tile.ix, tile.iy) for tile in b.tiles()}
    for tile in b.tiles():
        a.join(tile)
    assert a.take_dirty() == ()
    joined = by_place(a.tiles())
    assert all(join(joined[tile.ix, tile.iy], tile) == joined[tile.ix, tile.iy] for tile in b.tiles())
    with pytest.raises(ValueError, match="submap 7"):
        a.join(unseen_tile(7, 0, 0, 0.05))
    with pytest.raises(ValueError, match=r"0\.1 m"):
        a.join(unseen_tile(0, 0, 0, 0.1))


def test_joining_more_tiles_than_the_pool_holds_grows_it() -> None:
    """Two hundred tiles joined into an empty map are all found again."""
    terrain = ElevationMap(CONFIG, LASER)
    layer = np.zeros((64, 64), np.float32)
    tiles = {(k - 100, -k * k): Tile(0, k - 100, -k * k, 0.05, layer - k, layer + k) for k in range(200)}
    for tile in tiles.values():
        assert terrain.join(tile)
    assert by_place(terrain.tiles()) == tiles


def test_arrays_that_others_hand_over_need_no_special_layout() -> None:
    """Read-only, strided and other integer types are taken as they come; wrong shapes are refused with both shapes."""
    terrain, plain, sweep = ElevationMap(CONFIG, LASER), ElevationMap(CONFIG, LASER), Sweep(1)
    ranges = np.repeat(sweep.scan.ranges_m, 2)[::2]
    ranges.flags.writeable = False
    low = np.asfortranarray(sweep.low)
    terrain.insert(replace(sweep.scan, ranges_m=ranges), low, sweep.high, sweep.pose_index.astype(np.int64))
    sweep.into(plain)
    assert by_place(terrain.tiles()) == by_place(plain.tiles())
    with pytest.raises(ValueError, match=r"\[181\].*\[180\]"):
        terrain.insert(sweep.scan, sweep.low, sweep.high, sweep.pose_index[1:])
    with pytest.raises(ValueError, match=r"\[10, 6\].*\[9, 6\]"):
        terrain.insert(sweep.scan, sweep.low, sweep.high[1:], sweep.pose_index)
    with pytest.raises(ValueError, match=r"\[10, 5\].*\[10, 5\]"):
        terrain.insert(sweep.scan, sweep.low[:, 1:].copy(), sweep.high[:, 1:].copy(), sweep.pose_index)


def test_the_pool_takes_eight_bytes_a_cell_on_cache_lines() -> None:
    """A tile is 32 KiB, and the pool begins on a 64-byte boundary; the flags take one bit a cell."""
    terrain = ElevationMap(CONFIG, LASER)
    assert terrain._pool.ctypes.data % 64 == 0
    assert terrain._pool.strides[0] == 64 * 64 * 8
    assert terrain._sure.strides[0] == 64 * 64 // 8
