"""Settled bounds: what was seen only for a moment is set aside, what was seen several times is kept."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.config import LaserConfig
from drivers.samples import Scan, Stamp
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.grid import cell_index
from mapper.tile import Tile, join

LASER = LaserConfig(
    port="none",
    latency_ms=(0.0, 1.0),
    range_bound_m=0.02,
    angle_bound_deg=0.1,
    mount_x_m=0.0,
    mount_y_m=0.0,
    mount_z_m=1.0,
    mount_pitch_deg=-45.0,
    mount_position_bound_m=0.0,
    mount_angle_bound_deg=0.0,
)
CONFIG = MapConfig(resolution_m=0.2, max_tiles=100, evidence_slots=4, evidence_slot_ms=1000.0, evidence_set_aside=1)
BEAMS = 91
HALF = np.array([0.02, 0.02, 0.01, 0.002, 0.002, 0.002])


def a_scan(second: int, short: float = 0.0, seed: int = 0) -> Scan:
    """Rough ground seen from 1 m above at an instant of that second; the middle beams cut short by `short`."""
    random = np.random.default_rng([seed, second])
    ranges = np.sqrt(2.0) / np.cos(np.radians(np.arange(BEAMS) - 45.0)) + random.uniform(-0.1, 0.1, BEAMS)
    ranges[40:50] -= short
    at = second * 1_000_000_000 + 300_000_000
    return Scan(Stamp(at, at + 1), np.zeros(BEAMS, np.int64), -np.pi / 4, np.radians(1.0), ranges, 0)


def insert(terrain: ElevationMap, scan: Scan, x: float = 0.0) -> None:
    middle = np.array([[x, 0.0, 0.0, 0.0, 0.0, 0.0]])
    terrain.insert(scan, middle - HALF, middle + HALF, np.zeros(BEAMS, np.int32))


def by_place(terrain: ElevationMap) -> dict[tuple[int, int], Tile]:
    return {(tile.ix, tile.iy): tile for tile in terrain.tiles()}


def layer(terrain: ElevationMap, name: str) -> NDArray[np.float32]:
    """[128, 128] one layer over the four tiles at the origin, NaN elsewhere."""
    whole = np.full((128, 128), np.nan, np.float32)
    for tile in terrain.tiles():
        y, x = (tile.iy + 1) * 64, (tile.ix + 1) * 64
        whole[y : y + 64, x : x + 64] = getattr(tile, name)
    return whole


def test_a_ghost_of_one_moment_leaves_no_trace_in_settled_bounds() -> None:
    """Someone stands before ten beams within one second: settled bounds are inside the map that never saw him."""
    clean, haunted = ElevationMap(CONFIG, LASER), ElevationMap(CONFIG, LASER)
    for second in range(4):
        for terrain in (clean, haunted):
            insert(terrain, a_scan(second, seed=1))
            insert(terrain, a_scan(second, seed=2))
    for _ in range(5):
        insert(haunted, a_scan(2, short=0.5, seed=3))
    ghost = layer(haunted, "high") > np.nan_to_num(layer(clean, "high"), nan=-9.0) + 0.1
    assert np.count_nonzero(ghost) > 3
    settled = ~np.isnan(layer(haunted, "settled_high"))
    assert np.all(layer(haunted, "settled_high")[settled] <= layer(clean, "high")[settled])
    assert np.all(layer(haunted, "settled_low")[settled] >= layer(clean, "low")[settled])
    assert np.count_nonzero(settled) > 0.8 * np.count_nonzero(~np.isnan(layer(clean, "high")))


def test_what_two_slots_saw_is_inside_settled_bounds() -> None:
    """With errors at their corners: the level that true hits of two slots reach in a cell is inside, up and down."""
    random = np.random.default_rng(3)
    terrain, highest, lowest = ElevationMap(CONFIG, LASER), defaultdict(dict), defaultdict(dict)  # type: ignore[var-annotated]
    for second in range(12):
        scan = a_scan(second)
        insert(terrain, scan)
        for n in range(BEAMS):
            sign = random.choice([-1.0, 1.0], 6)
            pose, r = sign * HALF, scan.ranges_m[n] + random.choice([-0.02, 0.02])
            th = np.radians(n - 45.0) + random.choice([-1.0, 1.0]) * np.radians(0.1)
            down = np.radians(45.0)
            point = np.array([r * np.cos(th) * np.cos(down), r * np.sin(th), 1.0 - r * np.cos(th) * np.sin(down)])
            for axis, angle in ((0, pose[3]), (1, pose[4]), (2, pose[5])):
                a, b = (axis + 1) % 3, (axis + 2) % 3
                c, s = np.cos(angle), np.sin(angle)
                point[a], point[b] = c * point[a] - s * point[b], s * point[a] + c * point[b]
            x, y, z = point + pose[:3]
            place, slot = (cell_index(y, 0.2), cell_index(x, 0.2)), second % 4
            highest[place][slot] = max(highest[place].get(slot, -9.0), z)
            lowest[place][slot] = min(lowest[place].get(slot, 9.0), z)
    low, high = layer(terrain, "settled_low"), layer(terrain, "settled_high")
    checked = 0
    for (row, column), tops in highest.items():
        place = row + 64, column + 64
        if len(tops) >= 2 and not np.isnan(high[place]):
            assert sorted(tops.values())[-2] <= high[place]
            assert sorted(lowest[row, column].values())[1] >= low[place]
            checked += 1
    assert checked > 20


def test_order_repetition_and_joining_change_no_bit_of_settled_bounds() -> None:
    """Any order, twice, and out of a map's own tiles after a restart: the same tiles, all layers."""
    scans = [(a_scan(second, seed=seed), 0.1 * seed) for second in range(6) for seed in range(2)]
    plain, mixed, restarted = (ElevationMap(CONFIG, LASER) for _ in range(3))
    for scan, x in scans:
        insert(plain, scan, x)
    for scan, x in [*reversed(scans), *scans[::3]]:
        insert(mixed, scan, x)
    assert by_place(mixed) == by_place(plain)
    for tile in plain.tiles():
        restarted.join(tile)
    assert by_place(restarted) == by_place(plain)
    for scan, x in scans[3:]:
        insert(restarted, scan, x)
    assert by_place(restarted) == by_place(plain)
    assert any(tile.has_settled for tile in plain.tiles())


def test_two_maps_settled_bounds_join_by_hull() -> None:
    """A map that joins another's tiles holds at least what each had settled."""
    one, two, both = (ElevationMap(CONFIG, LASER) for _ in range(3))
    for second in range(4):
        insert(one, a_scan(second))
        insert(two, a_scan(second, seed=5), 0.2)
    for tile in (*one.tiles(), *two.tiles()):
        both.join(tile)
    for place, tile in by_place(one).items():
        assert by_place(both)[place] == join(tile, by_place(two)[place])


def test_without_evidence_nothing_is_settled_and_nothing_is_kept() -> None:
    """Off as shipped: one plane of eight bytes a cell; the bounds are the same to the bit."""
    off, on = ElevationMap(replace(CONFIG, evidence_slots=0), LASER), ElevationMap(CONFIG, LASER)
    for second in range(4):
        insert(off, a_scan(second))
        insert(on, a_scan(second))
    assert MapConfig(resolution_m=0.05).evidence_slots == 0
    assert off._pool.shape[1] == 1
    assert on._pool.shape[1] == 5
    assert not any(tile.has_settled for tile in off.tiles())
    for place, tile in by_place(off).items():
        same = by_place(on)[place]
        assert tile.low.tobytes() + tile.high.tobytes() == same.low.tobytes() + same.high.tobytes()
        assert np.array_equal(tile.surely_hit, same.surely_hit)
    assert off.cells_seen == on.cells_seen
    assert off.mean_width_m == on.mean_width_m


def test_more_to_set_aside_than_slots_can_outvote_is_refused() -> None:
    """Two slots can't tell which of them saw the ghost."""
    with pytest.raises(ValueError, match="at least 3 slots"):
        MapConfig(resolution_m=0.05, evidence_slots=2)
    with pytest.raises(ValueError, match="at least 5 slots"):
        MapConfig(resolution_m=0.05, evidence_slots=4, evidence_set_aside=2)
