"""`terrabound reproduce stairs` and `snow`: the real command in its short form, and what its scores are made of."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.paper.scene_maps import METHODS, MIXTURE, OURS, Layers, MapSet, TrueCells, Window, score, true_cells
from simulator.terrain import build_terrain
from simulator.truth import Truth

MM = 1e-3


@pytest.mark.parametrize("name", ["stairs", "snow"])
def test_the_short_form_leaves_tables_numbers_and_pictures(name: str, tmp_path: Path) -> None:
    """In a second process: it ends well, no true hit and no true pose is outside, and the Gaussians are less sure."""
    command = [sys.executable, "-m", "service.cli", "reproduce", name, "--short", "--output", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert "CPU time of a scan" in done.stdout
    numbers: dict[str, Any] = json.loads((tmp_path / f"{name}.json").read_text())
    settings = {(run["setting"], run["errors"]) for run in numbers["runs"]}
    assert settings == {("device", "white"), ("paper", "white"), ("device", "constant bias")}
    for run in numbers["runs"]:
        assert run["poses_outside"] == 0
        assert run["guarantee_intact"]
        assert set(run["maps"]) == set(METHODS)
        ours = run["maps"][OURS]
        assert ours["hit_cells"] > 100
        assert ours["hit_cells_outside"] == 0
        assert ours["containment"] == 1.0
        if run["errors"] == "constant bias":
            assert run["maps"][MIXTURE]["containment"] < 0.9
    for picture in (f"{name}_maps.png", f"{name}_profiles.png"):
        assert (tmp_path / picture).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        assert picture in (tmp_path / f"{name}.md").read_text()


WINDOW = Window((0.0, 1.0), (-0.5, 0.5), 0.1)


def level_truth() -> Truth:
    """The flat scene, seen from where it is."""
    pose = np.zeros((2, 6))
    nothing = np.zeros(0)
    truth = Truth(np.array([0, 1]), pose, nothing.astype(np.int64), np.zeros((0, 3)), nothing, "flat", 1, "", (0, 0, 0))
    return truth.in_map_frame()


def scored(layer: Layers, true: TrueCells) -> dict[str, float]:
    layers, times = dict.fromkeys(METHODS, layer), dict.fromkeys(METHODS, 1.0)
    return score(OURS, MapSet(layers, times, 1.0, np.zeros(WINDOW.shape, bool), dict.fromkeys(METHODS, 8)), true)


def test_a_hit_outside_its_cells_bounds_is_counted() -> None:
    """One cell of two has a hit 1 mm above its bounds; one without an answer counts for ours, too."""
    hits = np.array([[0.05, 0.05, 0.0], [0.15, 0.05, 0.0], [0.15, 0.05, 6 * MM], [3.0, 0.0, 9.0]])
    true = true_cells(level_truth(), hits, WINDOW)
    assert true.hits.sum() == 3
    bound = np.full(WINDOW.shape, 5 * MM)
    good = Layers(np.zeros(WINDOW.shape), -bound, bound)
    assert scored(good, true)["hit_cells_outside"] == 1
    assert scored(good, true)["containment"] == 0.5
    empty = Layers(*(np.where(true.hits == 1, np.nan, layer) for layer in (good.estimate, good.low, good.high)))
    assert scored(empty, true)["hit_cells_outside"] == 2
    assert scored(empty, true)["hit_cells_filled"] == 0.5


def test_errors_and_roughness_are_measured_against_the_true_ground() -> None:
    """A map 3 mm too high has an RMSE of 3 mm and no roughness; one that alternates has both."""
    true = true_cells(level_truth(), np.array([[0.05, 0.05, 0.0]]), WINDOW)
    assert true.flat.all()
    high = np.full(WINDOW.shape, 3 * MM)
    rows, columns = np.indices(WINDOW.shape)
    alternating = 3 * MM * (-1.0) ** (rows + columns)
    cases: Any = ((high, 0.0), (alternating, 6 * MM))
    for estimate, roughness in cases:
        result = scored(Layers(estimate, estimate - 1.0, estimate + 1.0), true)
        assert result["rmse_m"] == pytest.approx(3 * MM)
        assert result["roughness_m"] == pytest.approx(roughness)


def test_a_window_cuts_layers_wherever_they_begin() -> None:
    """Cells keep their numbers; what lies beyond the layer is unseen."""
    layer = np.arange(12.0).reshape(3, 4)
    cut = WINDOW.cut(layer, (-2, -1))
    assert cut.shape == (10, 10)
    assert np.array_equal(cut[4:7, :2], layer[:, 2:])
    assert np.isfinite(cut).sum() == 6


def test_the_papers_steps_are_14_cm_by_34_cm() -> None:
    """Five of them, a landing, and a robot that comes a few degrees off at 10 cm/s."""
    terrain = build_terrain("paper_stairs")
    x: Any = 3.4 + 0.17 + 0.34 * np.arange(-1, 6)
    assert np.abs(terrain.height(x, np.zeros(7)) - 0.14 * np.array([0, 1, 2, 3, 4, 5, 5])).max() < 1e-12
    assert terrain.course.cruise_mps == 0.1
    assert 0.05 < terrain.course.heading_rad < 0.2


def test_the_snow_has_two_walls_a_way_between_and_beams_that_never_come_back() -> None:
    """0.6 m and more beside the way at both sides, nothing to speak of in its middle but heaps; 15 % are lost."""
    terrain = build_terrain("paper_snow")
    x = np.linspace(3.0, 8.0, 60)
    for side in (-1.5, 1.5):
        assert (terrain.height(x, np.full(60, side)) > 0.6).mean() > 0.9
    assert np.median(terrain.height(x, np.zeros(60))) < 0.15
    assert terrain.lost_echoes == 0.15
