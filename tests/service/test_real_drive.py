"""A real drive, sent again as the devices would have sent it, goes through ports and service whole."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from mapper.saved_map import load as load_map

EXAMPLE = Path(__file__).parents[2] / "examples" / "real_drive.py"
SECONDS = 5.0


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("real_drive", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["real_drive"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def recording(example: ModuleType, recordings: Path) -> Any:
    if not (recordings / example.ODOMETRY).exists():
        pytest.skip(f"no recorded drive in {recordings}: set TERRABOUND_DATA to the folder that holds it")
    return example.read_recording(recordings)


def test_the_mended_recording_keeps_its_counts_and_orders_its_times(
    example: ModuleType, recordings: Path, recording: Any
) -> None:
    """Outside the three gaps every recorded tick is still there, and no count is later than its stamp."""
    raw = np.loadtxt(recordings / example.ODOMETRY, comments="%")
    stamp_ns = (raw[:, 0] - raw[0, 0]) * 1e9
    gaps = np.diff(stamp_ns) > 0.2e9
    assert gaps.sum() == 3
    for counts, increments in ((recording.left, raw[:, 5]), (recording.right, raw[:, 6])):
        added = np.diff(counts) - increments[1:]
        assert np.abs(added[~gaps]).max() <= 1
        lost_m = np.abs(added[gaps]) * 1.29e-4
        assert lost_m.min() > 0.8
        assert lost_m.max() < 1.3
    count_ns = recording.count_ns
    assert np.all(np.diff(count_ns) >= 0)
    assert np.all(count_ns <= stamp_ns + 1)


@pytest.mark.timeout(120)
def test_a_real_drive_is_mapped_through_the_ports_with_nothing_lost(
    example: ModuleType, recording: Any, tmp_path: Path
) -> None:
    """Every recorded scan and count of five seconds arrives; the scans are mapped; no bound is contradicted."""
    result = example.drive(recording, example.configuration(tmp_path), SECONDS)
    onboard = result.onboard
    encoders, inertia, laser = (reader.protocol.counts for reader in onboard.readers)
    assert result.scans_sent > 85
    assert result.frames_sent > 400
    assert encoders["ticks"] == result.frames_sent
    assert inertia["lost"] == inertia["skipped_bytes"] == 0
    assert result.scans_sent - laser["scans"] <= 1  # the last may still be on the line
    pipeline = onboard.pipeline
    # Scans of before the first count have no pose, nor has one whose poses the recording's end cut off.
    assert pipeline.counts["scans"] >= laser["scans"] - 6
    assert pipeline.filter.guarantee.intact
    assert not onboard.queue.dropped
    assert not pipeline.late
    assert pipeline.map.counts["too_wide"] == pipeline.map.counts["beyond_cap"] == 0

    onboard.save_map(tmp_path / "map.npz")
    saved = load_map(tmp_path / "map.npz")
    seen = np.isfinite(saved.low)
    assert seen.sum() == pipeline.map.cells_seen > 3000
    mount_z_m = onboard.laser.mount_z_m
    assert np.all(saved.low[seen] < mount_z_m)  # a level laser on level ground: its height is in every cell
    assert np.all(saved.high[seen] > mount_z_m)


@pytest.mark.timeout(60)
def test_without_the_recording_the_example_says_what_to_do(tmp_path: Path) -> None:
    """One line that names the missing file and the variable, and exit code 1."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLE), "--output", str(tmp_path / "out")],
        env={"TERRABOUND_DATA": str(tmp_path), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=50,
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "ual_first_half_odometry.txt.gz" in done.stderr
    assert "TERRABOUND_DATA" in done.stderr
    assert not (tmp_path / "out").exists()
