"""`terrabound export`: every format that it offers, and what it does not; other people's readers of what it writes."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio

from mapper.saved_map import SavedMap, load, save
from mapper.store import Submap
from mapper.store_check import open_store
from mapper.tile import Tile
from mapper.tile_codec import encode
from service.cli import run_command

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"

LOW = np.array([[0.0, 0.1, 0.2], [0.0, np.nan, 0.2]], np.float32)


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    """A small map with a hole."""
    save(SavedMap(LOW, LOW + np.float32(0.05), 0.05, (1.0, 2.0), "map", ""), tmp_path / "map.npz")
    return tmp_path / "map.npz"


@pytest.mark.parametrize(
    ("suffix", "begins"),
    [(".tif", b"II*\0"), (".ply", b"ply\nformat binary"), (".png", b"\x89PNG\r\n"), (".npz", b"PK")],
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


@pytest.mark.parametrize(
    ("layer", "suffix"),
    [("step", ".tif"), ("slope", ".png"), ("roughness", ".tif"), ("passable", ".tif"), ("passable", ".png")],
)
def test_layers_for_planners_are_exported(layer: str, suffix: str, map_file: Path) -> None:
    """Each as a raster and as a picture, for a robot of given limits."""
    output = map_file.with_name(f"out{suffix}")
    limits = ["--max-step-m", "0.2", "--max-slope-deg", "30", "--max-roughness-m", "0.2", "--length-m", "0.1"]
    assert run_command(["export", str(map_file), str(output), "--layer", layer, *limits]) == 0
    assert output.stat().st_size > 200


@pytest.mark.parametrize(
    ("layer", "names"), [("step", {"step_low", "step_high"}), ("slope", {"slope_low", "slope_high"}),
                         ("roughness", {"roughness_low", "roughness_high"}), ("passable", {"passable"})],
)  # fmt: skip
def test_a_layer_as_npz_bears_its_own_names(
    layer: str, names: set[str], map_file: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Nobody takes steps for elevations: they have the names of the layer, and are no map to be exported again."""
    output = map_file.with_name("out.npz")
    assert run_command(["export", str(map_file), str(output), "--layer", layer, "--length-m", "0.1"]) == 0
    with np.load(output, allow_pickle=False) as file:
        assert set(file) == names | {"resolution_m", "origin_m", "frame", "anchor"}
        assert all(file[name].shape == LOW.shape for name in names)
    assert run_command(["export", str(output), str(output.with_suffix(".ply"))]) == 1
    assert "out.npz: no terrain map: it holds" in capfd.readouterr().err


def test_a_map_without_a_place_says_so(map_file: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A GeoTIFF of it is no lie about the Earth, and the person is told."""
    assert run_command(["export", str(map_file), str(map_file.with_name("out.tif"))]) == 0
    assert "no place on Earth" in capfd.readouterr().err


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store with two runs."""
    store, _ = open_store(tmp_path / "map.db")
    for number in (0, 1):
        low = np.full((64, 64), float(number), np.float32)
        store.save(Submap(number, 0.1, "map"), [Tile(number, number, 0, 0.1, low, low)], 0)
    store.close()
    return tmp_path / "map.db"


def test_any_run_in_a_store_is_exported(store: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The newest, or the one that is named; one that is not there is said, with those that are."""
    output = store.with_name("out.npz")
    assert run_command(["export", str(store), str(output)]) == 0
    assert (load(output).low == 1.0).all()
    assert run_command(["export", str(store), str(output), "--submap", "0"]) == 0
    assert (load(output).low == 0.0).all()
    assert load(output).origin_m == (0.0, 0.0)
    assert run_command(["export", str(store), str(output), "--submap", "7"]) == 1
    assert "no submap 7; there are 0, 1" in capfd.readouterr().err


def test_what_is_damaged_in_a_store_is_said_and_the_file_is_left_as_it_is(
    store: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Export mends nothing."""
    broken = bytearray(store.read_bytes())
    broken[broken.index(b"\x28\xb5\x2f\xfd") + 30] ^= 1  # in a zstd frame: the body of a tile
    store.write_bytes(broken)
    assert run_command(["export", str(store), str(store.with_name("out.npz"))]) == 0
    assert "1 damaged" in capfd.readouterr().err
    assert store.read_bytes()[100:] == broken[100:]


def test_a_store_in_use_is_left_alone(store: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The running service has it."""
    owner, _ = open_store(store)
    assert run_command(["export", str(store), str(store.with_name("out.npz"))]) == 1
    assert "in use by another process" in capfd.readouterr().err
    owner.close()


def test_a_run_in_doubt_is_exported_in_doubt(store: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What the store says of the bounds goes into the file; a run whose bounds held says that too."""
    void = '{"intact":false,"void_since_ns":7,"sensor":"gps"}'
    opened, _ = open_store(store)
    opened.save(Submap(0, 0.1, "map", guarantee=void), [], 0)
    opened.close()
    output = store.with_name("out.npz")
    assert run_command(["export", str(store), str(output), "--submap", "0"]) == 0
    assert load(output).guarantee == void
    assert "in doubt, contradicted by gps" in capfd.readouterr().err
    raster = store.with_name("out.tif")
    assert run_command(["export", str(output), str(raster), "--layer", "step"]) == 0
    assert "in doubt, contradicted by gps" in capfd.readouterr().err
    with rasterio.open(raster) as file:
        assert json.loads(file.tags()["GUARANTEE"])["void_since_ns"] == 7
    assert run_command(["export", str(store), str(output)]) == 0
    assert json.loads(load(output).guarantee)["intact"] is True
    assert "in doubt" not in capfd.readouterr().err


@pytest.fixture
def backup(store: Path, tmp_path: Path) -> Iterator[Path]:
    """The store as a crash left it, its log not yet folded in, on a disk that can't be written."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if os.getuid() != 0 or subprocess.run(["mount", "-t", "tmpfs", "tmpfs", disk], capture_output=True).returncode != 0:
        pytest.skip("no disk can be mounted here")
    opened, _ = open_store(store)
    low = np.full((64, 64), 2.0, np.float32)
    opened.save(Submap(2, 0.1, "map"), [Tile(2, 0, 0, 0.1, low, low)], 0)
    for suffix in ("", "-wal"):
        shutil.copy(f"{store}{suffix}", disk)
    opened.close()
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    yield disk / store.name
    subprocess.run(["umount", "-l", disk], check=True)


def test_a_backup_that_cannot_be_written_is_exported_whole(backup: Path, tmp_path: Path) -> None:
    """From a read-only disk, or where only reading is allowed: with what stands in the log alone."""
    assert Path(f"{backup}-wal").stat().st_size > 0
    output = tmp_path / "out.npz"
    assert run_command(["export", str(backup), str(output)]) == 0
    assert (load(output).low == 2.0).all()
    assert run_command(["export", str(backup), str(output), "--submap", "1"]) == 0
    assert (load(output).low == 1.0).all()


def test_a_store_that_only_another_user_may_write_is_left_alone_while_in_use(
    backup: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Reading alone needs no permission to write, but still a store that stands still."""
    holder = "import fcntl, sys; file = open(sys.argv[1], 'r+b'); fcntl.lockf(file, fcntl.LOCK_EX, 510, 0x40000002);"
    command = [sys.executable, "-c", f"{holder} print(flush=True); sys.stdin.read()", str(backup)]
    subprocess.run(["mount", "-o", "remount,rw", backup.parent], check=True)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as service:
        assert service.stdout is not None
        service.stdout.readline()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "access", lambda path, mode: mode != os.W_OK or "disk" not in str(path))
            assert run_command(["export", str(backup), str(backup.parents[1] / "out.npz")]) == 1
        service.communicate()
    assert f"{backup}: in use by another process" in capfd.readouterr().err


def run_example(name: str, *arguments: object) -> str:
    """What an example prints; it knows nothing of this project's code."""
    path = EXAMPLES / name
    assert not re.search(r"^(from|import) (drivers|estimator|mapper|service|simulator)\b", path.read_text(), re.M)
    done = subprocess.run([sys.executable, path, *map(str, arguments)], capture_output=True, text=True, check=True)
    return done.stdout


def test_the_example_reads_a_saved_map_with_numpy_alone(map_file: Path) -> None:
    """Cells, widths, and the bounds at a place."""
    assert "5 cells of 5 cm" in run_example("read_saved_map.py", map_file)
    assert "between 0.100 and 0.150 m" in run_example("read_saved_map.py", map_file, 1.07, 2.01)
    assert "nothing was seen" in run_example("read_saved_map.py", map_file, 99, 99)


def test_the_example_decodes_a_tile_by_its_description_alone(tmp_path: Path) -> None:
    """A payload as it is published, and as it lies in the store."""
    low = np.full((64, 64), np.nan, np.float32)
    low[2, 1] = 0.5
    flags = ~np.isnan(low)
    (tmp_path / "tile.bin").write_bytes(encode(Tile(0, -1, 2, 0.1, low, low + np.float32(0.25), flags), "map", 0))
    said = run_example("decode_tile.py", tmp_path / "tile.bin")
    assert "low corner (-6.4, 12.8) m, cells of 0.1 m: 1 seen" in said
    assert "2 1 elevation_min 0.5 elevation_max 0.75 surely_hit 1" in said
