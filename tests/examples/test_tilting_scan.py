"""The floor of a real room, seen by a real tilting SICK, is where its map says."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]


def test_the_floor_of_a_real_scan_is_inside_its_bounds(recordings: Path, tmp_path: Path) -> None:
    """Every cell of the floor has the plane fitted to it inside its bounds, centimetres wide; a picture is drawn."""
    points = recordings / "laser" / "octomap_tilting_sick_scan.dat.bz2"
    if not points.is_file():
        pytest.skip(f"no {points}")
    picture = tmp_path / "floor.png"
    command = [sys.executable, str(PROJECT / "examples" / "tilting_scan.py"), str(points), "--picture", str(picture)]
    result = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert result["floor_cells"] > 5000
    assert result["plane_inside"] == result["floor_cells"]
    assert result["floor_rms_m"] < 0.01
    assert result["median_width_m"] < 0.1
    assert picture.read_bytes().startswith(b"\x89PNG")
