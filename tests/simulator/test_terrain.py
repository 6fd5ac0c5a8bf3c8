"""The scenes."""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.errors import ErrorLaw
from simulator.robot import RobotModel, plan_drive
from simulator.terrain import build_terrain, read_elevation_model

DATA = Path(os.environ.get("TERRABOUND_DATA", Path(__file__).parents[2] / "../shared/data")) / "terrain"
MODELS = (
    "jacksboro_fault_dem.npz",
    "landlab_hugo_site.asc",
    "landlab_west_bijou_gully.asc",
    "landlab_bijou_gully_subset_5m_edit_dx_filled.asc",
)
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no recorded data in {DATA}; set TERRABOUND_DATA")


@pytest.mark.parametrize("scene", ["flat", "ramp", "stairs", "rough", "yard"])
def test_every_scene_has_ground_wherever_the_robot_drives(scene: str) -> None:
    """In a drive of 90 s the robot stays on the scene, never more than a step's height from its top surface."""
    terrain = build_terrain(scene)
    drive = plan_drive(RobotModel(), terrain, ErrorLaw(), 90.0)
    top = terrain.height(drive.pose[:, 0], drive.pose[:, 1])
    assert np.abs(top - drive.pose[:, 2]).max() < 0.14


@pytest.mark.parametrize("scene", ["flat", "ramp", "stairs", "rough", "yard"])
def test_a_scene_repeats_by_its_seed(scene: str) -> None:
    """The same name and seed give the same ground."""
    one, two = build_terrain(scene, 7), build_terrain(scene, 7)
    np.testing.assert_array_equal(one.heights, two.heights)
    np.testing.assert_array_equal(one.boxes, two.boxes)


def test_stairs_have_treads_of_34_cm_and_rise_14_cm_each() -> None:
    """The top surface climbs step by step to the landing."""
    x = np.linspace(3.67, 3.67 + 7 * 0.34, 8)
    steps = build_terrain("stairs").height(x, np.zeros(8))
    np.testing.assert_allclose(steps, 0.14 * np.array([1, 2, 3, 4, 5, 6, 6, 6]), atol=1e-12)


def test_off_the_grid_there_is_no_height() -> None:
    """NaN outside the scene."""
    assert np.isnan(build_terrain("flat").height(np.array([1e3]), np.array([0.0]))).all()


def test_the_rough_scene_has_a_ditch_and_walls() -> None:
    """The ditch is about half a metre deep, the walls stand well above the ground."""
    terrain = build_terrain("rough")
    y = np.linspace(0.0, 10.0, 50)
    beside, within = terrain.height(np.full(50, 7.4), y), terrain.height(np.full(50, 8.3), y)
    assert np.mean(beside - within) == pytest.approx(0.5, abs=0.1)
    assert terrain.height(np.array([0.0]), np.array([4.1]))[0] == 1.2


def test_an_unknown_scene_is_refused() -> None:
    """The message lists the scenes there are; dem asks for its file."""
    with pytest.raises(ValueError, match="flat, ramp, stairs"):
        build_terrain("moon")
    with pytest.raises(ValueError, match="file"):
        build_terrain("dem")


def test_an_ascii_grid_is_read_south_up(tmp_path: Path) -> None:
    """Rows come north first in the file and south first in memory; missing cells are NaN."""
    path = tmp_path / "model.asc"
    path.write_text("ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 10\nNODATA_value -9999\n1 2 3\n4 -9999 6\n")
    np.testing.assert_array_equal(read_elevation_model(path), [[4, np.nan, 6], [1, 2, 3]])


@needs_data
@pytest.mark.parametrize("model", MODELS)
def test_the_robot_drives_on_a_real_elevation_model(model: str) -> None:
    """Each recorded model becomes a patch that is hilly, finite and drivable within all limits."""
    terrain = build_terrain("dem", source=DATA / model)
    assert np.isfinite(terrain.heights).all()
    drive = plan_drive(RobotModel(), terrain, ErrorLaw(), 60.0)
    assert np.degrees(np.abs(drive.pose[:, 3:5]).max()) < 25.0
    assert np.ptp(drive.pose[:, 2]) > 0.2


@pytest.mark.parametrize(
    "heights", [np.full((9, 9), np.nan), np.full((9, 9), 1e308), np.zeros((1, 9)), np.zeros((9, 9, 3))]
)
def test_a_model_without_ground_is_refused(heights: NDArray[np.float64], tmp_path: Path) -> None:
    """Nothing but holes, a file's sign for "no data", a single row, a picture: said at once, not while driving."""
    np.savez(tmp_path / "model.npz", elevation=heights)
    with pytest.raises(ValueError, match=r"no height in it|at least \[2, 2\]"):
        build_terrain("dem", 1, tmp_path / "model.npz")
