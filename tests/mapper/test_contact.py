"""Where a track touches the ground, the cell's interval contains the ground's elevation."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.config import LaserConfig
from estimator.config import RobotConfig
from mapper.config import ContactConfig, MapConfig
from mapper.contact import track_patches
from mapper.elevation_map import ElevationMap
from mapper.grid import cell_index

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
ROBOT = RobotConfig(
    name="tracks",
    track_length_m=0.65,
    track_gauge_m=0.35,
    max_speed_mps=1.0,
    max_acceleration_mps2=2.0,
    max_turn_rate_dps=90.0,
    max_turn_acceleration_dps2=1000.0,
    slip_ratio=0.05,
    lateral_slip_ratio=0.02,
    turning_centre_m=0.05,
    normal_slip_ratio=0.02,
)
CONTACT = ContactConfig(track_width_m=0.1, bound_m=0.02)
CONFIG = MapConfig(resolution_m=0.05, max_tiles=100, contact=CONTACT)
MIDDLE = np.array([3.21, -0.77, 0.4, 0.1, -0.2, 2.2])
HALF = np.array([0.05, 0.04, 0.03, *np.radians([1.0, 2.0, 3.0])])


def rotation(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    out: NDArray[np.float64] = about_z @ about_y @ about_x
    return out


@pytest.mark.parametrize("resolution", [0.05, 0.03, 0.4, 2.0])
def test_wherever_a_track_touches_the_ground_is_inside(resolution: float) -> None:
    """Any pose of the box, corners first, and any point of either track's underside, its borders too: 0 outside."""
    random = np.random.default_rng(1)
    terrain = ElevationMap(replace(CONFIG, resolution_m=resolution), LASER, robot=ROBOT)
    terrain.insert_contact(0, MIDDLE - HALF, MIDDLE + HALF)
    tiles = {(tile.ix, tile.iy): tile for tile in terrain.tiles()}
    for _ in range(400):
        pose = MIDDLE + random.choice([-1.0, 0.3, 1.0], 6) * HALF
        body = np.array(
            [
                random.choice([-0.325, 0.325, random.uniform(-0.325, 0.325)]),
                random.choice([-0.175, 0.175]) + random.choice([-0.05, 0.05, random.uniform(-0.05, 0.05)]),
                random.choice([-0.02, 0.02]),
            ]
        )
        x, y, z = pose[:3] + rotation(*pose[3:]) @ body
        i, j = cell_index(x, resolution), cell_index(y, resolution)
        tile = tiles[i // 64, j // 64]
        assert tile.low[j % 64, i % 64] <= z <= tile.high[j % 64, i % 64]


def test_contact_says_nothing_of_where_no_track_can_be() -> None:
    """The ground between the tracks stays unseen where the pose is well known, and no cell is surely hit."""
    terrain = ElevationMap(CONFIG, LASER, robot=ROBOT)
    level = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    terrain.insert_contact(0, level - 1e-4, level + 1e-4)
    seen = {
        (tile.ix * 64 + int(col), tile.iy * 64 + int(row))
        for tile in terrain.tiles()
        for row, col in np.argwhere(~np.isnan(tile.low))
    }
    # Tracks from 12.5 to 22.5 cm on both sides, 65 cm long: cells 2 to 4 and -5 to -3, of which the borders are grazed.
    assert {j for _, j in seen} == {-5, -4, -3, 2, 3, 4}
    assert {i for i, _ in seen} == set(range(-7, 7))
    assert not any(tile.surely_hit.any() for tile in terrain.tiles())
    assert terrain.mean_width_m == pytest.approx(2 * (0.02 + 1e-4), abs=2e-4)
    assert terrain.counts["used"] == 0


def test_contact_is_off_unless_declared_and_needs_finite_poses() -> None:
    """Without the table, or with an unbounded pose, the map stays empty; without the robot it is refused."""
    off = ElevationMap(replace(CONFIG, contact=None), LASER)
    off.insert_contact(0, MIDDLE - HALF, MIDDLE + HALF)
    on = ElevationMap(CONFIG, LASER, robot=ROBOT)
    on.insert_contact(0, MIDDLE - HALF, np.array([np.inf, 0, 0, 0, 0, 0]))
    assert off.tile_count == on.tile_count == 0
    with pytest.raises(ValueError, match="tracks"):
        ElevationMap(CONFIG, LASER)


def test_patches_cover_both_tracks() -> None:
    """Side by side without a gap, none longer or wider than a cell."""
    patches = track_patches(CONTACT, 0.65, 0.35, 0.05)
    assert len(patches) == 2 * 13 * 2
    assert patches[:, 14].max() * 2 <= 0.05 + 1e-9
    area = np.prod(2 * patches[:, 14:16], axis=1).sum()
    assert area == pytest.approx(2 * 0.65 * 0.1, rel=1e-9)
