"""`terrabound export`: every format that it offers, and what it does not."""

from pathlib import Path

import numpy as np
import pytest

from mapper.saved_map import SavedMap, load, save
from service.cli import run_command

LOW = np.array([[0.0, 0.1, 0.2], [0.0, np.nan, 0.2]], np.float32)


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    """A small map with a hole."""
    save(SavedMap(LOW, LOW + np.float32(0.05), 0.05, (1.0, 2.0), "map", ""), tmp_path / "map.npz")
    return tmp_path / "map.npz"


@pytest.mark.parametrize(
    ("suffix", "begins"), [(".ply", b"ply\nformat binary"), (".png", b"\x89PNG\r\n"), (".npz", b"PK")]
)
def test_a_map_becomes_another_programs_file(
    suffix: str, begins: bytes, map_file: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The file is of its kind, and its name is printed."""
    output = map_file.with_name(f"out{suffix}")
    assert run_command(["export", str(map_file), str(output)]) == 0
    assert output.read_bytes().startswith(begins)
    assert capfd.readouterr().out == f"{output}\n"


def test_a_copy_equals_its_original(map_file: Path) -> None:
    """Layers, resolution and place."""
    assert run_command(["export", str(map_file), str(map_file.with_name("copy.npz"))]) == 0
    copy = load(map_file.with_name("copy.npz"))
    np.testing.assert_array_equal(copy.low, LOW)
    assert (copy.resolution_m, copy.origin_m, copy.frame) == (0.05, (1.0, 2.0), "map")


@pytest.mark.parametrize(
    ("output", "told"), [("out.doc", "don't know how to write .doc"), ("none/out.ply", "can't be written")]
)
def test_what_cannot_be_written_is_said(
    output: str, told: str, map_file: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """An unknown ending, a folder that is not there."""
    assert run_command(["export", str(map_file), str(map_file.with_name("x").parent / output)]) == 1
    assert told in capfd.readouterr().err
