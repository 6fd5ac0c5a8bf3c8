"""A map on disk: whole or not at all, the same bytes for the same map, readable by others."""

import os
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapper.export import export_map
from mapper.saved_map import MapFileError, SavedMap, assemble, load, save
from mapper.tile import Tile, join


def a_tile(ix: int, iy: int, seed: int = 0) -> Tile:
    random = np.random.default_rng([seed, ix + 100, iy + 100])
    low = random.uniform(-1, 1, (64, 64)).astype(np.float32)
    high = low + np.float32(0.25)
    unseen = random.random((64, 64)) < 0.3
    low[unseen], high[unseen] = np.nan, np.nan
    return Tile(0, ix, iy, 0.1, low, high)


LAYERS = ("low", "high", "settled_low", "settled_high")
TILES = (a_tile(-2, 1), a_tile(0, 0), a_tile(1, -1))


def a_map() -> SavedMap:
    return assemble(TILES, 0.1, "map", '{"origin_lat_deg": 48.0}')


def test_every_tile_is_where_it_belongs() -> None:
    """Row = y, column = x from the low corner of all tiles; cells without a tile are unseen; twins are joined."""
    saved = a_map()
    assert saved.low.shape == saved.high.shape == (3 * 64, 4 * 64)
    assert saved.origin_m == (-2 * 6.4, -6.4)
    for tile in TILES:
        y, x = (tile.iy + 1) * 64, (tile.ix + 2) * 64
        assert np.array_equal(saved.low[y : y + 64, x : x + 64], tile.low, equal_nan=True)
        assert np.array_equal(saved.high[y : y + 64, x : x + 64], tile.high, equal_nan=True)
    assert np.count_nonzero(~np.isnan(saved.low)) == sum(tile.cells_seen for tile in TILES)
    twin = a_tile(0, 0, seed=1)
    both = assemble(iter([a_tile(0, 0), twin]), 0.1, "map")
    assert np.array_equal(both.high, join(a_tile(0, 0), twin).high, equal_nan=True)


def test_a_saved_map_comes_back_and_equal_maps_are_equal_files(tmp_path: Path) -> None:
    """All entries survive; tiles in another order give the same bytes; nothing else is left behind."""
    save(a_map(), tmp_path / "a.npz")
    save(assemble(reversed(TILES), 0.1, "map", '{"origin_lat_deg": 48.0}'), tmp_path / "b.npz")
    back = load(tmp_path / "a.npz")
    assert np.array_equal(back.low, a_map().low, equal_nan=True)
    assert np.array_equal(back.high, a_map().high, equal_nan=True)
    assert (back.resolution_m, back.origin_m, back.frame) == (0.1, a_map().origin_m, "map")
    assert back.anchor == '{"origin_lat_deg": 48.0}'
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def test_what_is_known_of_the_bounds_comes_back(tmp_path: Path) -> None:
    """The guarantee at the time of saving stands in the file, and goes on to whatever is made of it."""
    save(replace(a_map(), guarantee='{"intact": false}'), tmp_path / "a.npz")
    assert load(tmp_path / "a.npz").guarantee == '{"intact": false}'
    save(a_map(), tmp_path / "b.npz")
    assert load(tmp_path / "b.npz").guarantee == ""


def test_numpy_alone_reads_it(tmp_path: Path) -> None:
    """The entries, with the types that the format promises; the settled ones where any cell is settled."""
    save(a_map(), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        assert sorted(file) == ["anchor", "frame", "high", "low", "origin_m", "resolution_m", "surely_hit"]
        assert file["surely_hit"].dtype == np.bool_
        assert file["low"].dtype == file["high"].dtype == np.float32
        assert file["origin_m"].shape == (2,)
        assert float(file["resolution_m"]) == 0.1


def test_flags_and_settled_bounds_are_saved_and_older_files_still_read(tmp_path: Path) -> None:
    """Each layer comes back where it was; twins are joined; a file without the later entries is a map without them."""
    low, high = np.zeros((64, 64), np.float32), np.ones((64, 64), np.float32)
    hit, settled = np.zeros((64, 64), np.bool_), np.full((64, 64), np.nan, np.float32)
    hit[3, 4], settled[5, 6] = True, 0.5
    twin = np.roll(hit, 1)
    tiles = [Tile(0, 2, -1, 0.1, low, high, hit, settled, settled), Tile(0, 2, -1, 0.1, low, high, twin)]
    save(assemble([*tiles, a_tile(1, -1)], 0.1, "map"), tmp_path / "a.npz")
    back = load(tmp_path / "a.npz")
    assert back.surely_hit is not None
    assert back.settled_low is not None
    assert back.settled_high is not None
    assert np.array_equal(np.argwhere(back.surely_hit), [[3, 64 + 4], [3, 64 + 5]])
    assert np.array_equal(np.argwhere(~np.isnan(back.settled_low)), [[5, 64 + 6]])
    assert back.settled_low[5, 64 + 6] == back.settled_high[5, 64 + 6] == 0.5
    save(SavedMap(low, high, 0.1, (0.0, 0.0), "map", ""), tmp_path / "old.npz")
    old = load(tmp_path / "old.npz")
    assert (old.surely_hit, old.settled_low, old.settled_high) == (None, None, None)
    np.savez(tmp_path / "odd.npz", **{**np.load(tmp_path / "a.npz"), "surely_hit": np.zeros((1, 1), np.bool_)})
    with pytest.raises(MapFileError, match="surely_hit"):
        load(tmp_path / "odd.npz")


def test_an_empty_map_is_a_map(tmp_path: Path) -> None:
    """No tiles: zero cells, saved and read, and exported to every format."""
    save(assemble([], 0.1, "map"), tmp_path / "a.npz")
    back = load(tmp_path / "a.npz")
    assert back.low.shape == (0, 0)
    assert back.anchor == ""
    for suffix in ("ply", "png", "npz"):
        export_map(back, tmp_path / f"out.{suffix}")


def test_a_failed_save_leaves_the_old_file(tmp_path: Path) -> None:
    """A map that can't be written raises, says which file, and the one before stands untouched."""
    save(a_map(), tmp_path / "a.npz")
    before = (tmp_path / "a.npz").read_bytes()
    broken = SavedMap(np.array([[object()]]), a_map().high, 0.1, (0.0, 0.0), "map", "")
    with pytest.raises(ValueError, match="pickle"):
        save(broken, tmp_path / "a.npz")
    assert (tmp_path / "a.npz").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]
    with pytest.raises(MapFileError, match="nowhere"):
        save(a_map(), tmp_path / "nowhere" / "a.npz")


def test_what_killed_processes_left_is_removed_by_the_next_save(tmp_path: Path) -> None:
    """Each kill -9 in a save leaves a part; those of processes that still write, and of others' maps, stay."""
    dead = subprocess.run(["sh", "-c", "echo $$"], capture_output=True, text=True, check=True).stdout.strip()
    stays = [f".b.npz.{dead}.part", f".a.npz.{os.getppid()}.part", ".a.npz.old.part"]
    for name in (f".a.npz.{dead}.part", *stays):
        (tmp_path / name).touch()
    save(a_map(), tmp_path / "a.npz")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["a.npz", *stays])


def test_files_that_are_no_map_are_named(tmp_path: Path) -> None:
    """Absent, empty, foreign, incomplete and cut files: one error type that names the file."""
    save(a_map(), tmp_path / "good.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "good.npz").read_bytes()[:-500])
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "other.npz", low=np.zeros((2, 2), np.float32))
    with (tmp_path / "plain.npz").open("wb") as file:
        np.save(file, np.zeros(3))
    rest = {"resolution_m": np.array(0.1), "origin_m": np.zeros(2), "frame": np.array("map"), "anchor": np.array("")}
    layers = {"low": np.zeros((2, 2), np.float32), "high": np.zeros((2, 3), np.float32)}
    np.savez(tmp_path / "odd.npz", **layers, **rest)  # type: ignore[arg-type]  # no key is `allow_pickle`
    for name in ("absent", "cut", "empty", "text", "other", "plain", "odd"):
        with pytest.raises(MapFileError, match=rf"{name}\.npz"):
            load(tmp_path / f"{name}.npz")


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"resolution_m": 0.0}, "cells of 0.0 m"),
        ({"resolution_m": float("nan")}, "cells of nan m"),
        ({"origin_m": (float("inf"), 0.0)}, "(inf, 0.0)"),
        ({"low": 2.0}, r"1 cells are no intervals, as [2, 1]: low 2.0, high 1.0"),
        ({"low": float("nan")}, "low nan, high 1.0"),
        ({"high": float("inf")}, "high inf"),
        ({"settled_high": -1.0}, "settled_low 0.0, settled_high -1.0"),
        ({"settled_high": None}, "one of settled_low and settled_high is missing"),
    ],
)
def test_numbers_that_are_no_map_are_told(tmp_path: Path, wrong: dict[str, Any], told: str) -> None:
    """Somebody else's file may hold anything: the first cell that can't be is named, no program stumbles over it."""
    bounds = {
        name: np.full((4, 3), value, np.float32) for name, value in zip(LAYERS, (0.0, 1.0, 0.0, 1.0), strict=True)
    }
    for name, value in wrong.items():
        if name in bounds and value is not None:
            bounds[name][2, 1] = value
    numbers = {name: value for name, value in wrong.items() if name not in bounds or value is None}
    about = {"resolution_m": 0.1, "origin_m": (0.0, 0.0), "frame": "map", "anchor": ""}
    save(SavedMap(**{**bounds, **about, **numbers}), tmp_path / "m.npz")
    with pytest.raises(MapFileError) as caught:
        load(tmp_path / "m.npz")
    assert told in str(caught.value)


def test_tiles_too_far_apart_for_one_rectangle_are_refused() -> None:
    """Two tiles a thousand kilometres apart do not take all memory."""
    with pytest.raises(MapFileError, match="more than one file can hold"):
        assemble([a_tile(0, 0), a_tile(10**6, 10**6)], 0.1, "map")
    with pytest.raises(ValueError, match="one resolution"):
        assemble([a_tile(0, 0)], 0.2, "map")


def test_ply_holds_every_seen_cell_with_its_bounds(tmp_path: Path) -> None:
    """Vertices are the seen cells' centres, z in the middle of [low, high]; triangles join seen neighbours only."""
    low = np.array([[0.0, 1.0, 2.0], [0.5, 1.5, np.nan]], np.float32)
    saved = SavedMap(low, low + np.float32(1.0), 0.5, (-1.0, 3.0), "map", "")
    export_map(saved, tmp_path / "a.ply")
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 5\n" in header
    assert b"element face 2\n" in header
    vertices = np.frombuffer(body, "<f4", 25).reshape(5, 5)
    assert vertices[0].tolist() == [-0.75, 3.25, 0.5, 0.0, 1.0]
    assert vertices[4].tolist() == [-0.25, 3.75, 2.0, 1.5, 2.5]
    faces = [struct.unpack_from("<Biii", body, 100 + 13 * k) for k in range(2)]
    assert faces == [(3, 0, 1, 4), (3, 0, 4, 3)]
    assert len(body) == 100 + 26


def test_a_picture_and_unknown_suffixes(tmp_path: Path) -> None:
    """A PNG is a PNG; a suffix that nothing writes is refused with those that are known."""
    export_map(a_map(), tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(MapFileError, match=r"\.ply, \.png, \.npz"):
        export_map(a_map(), tmp_path / "a.stl")


def test_without_the_plots_extra_only_pictures_are_missing(tmp_path: Path) -> None:
    """Import, save and PLY work without matplotlib; a PNG says which extra to install."""
    code = """
import sys
sys.modules["matplotlib"] = None
import numpy as np
from pathlib import Path
from mapper.export import export_map
from mapper.saved_map import MapFileError, SavedMap
saved = SavedMap(np.zeros((2, 2), np.float32), np.ones((2, 2), np.float32), 1.0, (0.0, 0.0), "map", "")
export_map(saved, Path(sys.argv[1]) / "a.ply")
try:
    export_map(saved, Path(sys.argv[1]) / "a.png")
except MapFileError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert "terrabound[plots]" in done.stdout


def test_a_device_or_a_pipe_is_written_to_and_never_put_away(tmp_path: Path) -> None:
    """`/dev/full` tells, a pipe's reader gets the map: no file takes their place."""
    # Links, so that a mistake here puts a link away and not the machine's device.
    (tmp_path / "full").symlink_to("/dev/full")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = subprocess.Popen(["cat", str(pipe)], stdout=subprocess.PIPE)
    save(a_map(), pipe)
    told, _ = reader.communicate()
    assert pipe.is_fifo()
    (tmp_path / "map.npz").write_bytes(told)
    assert np.array_equal(load(tmp_path / "map.npz").low, a_map().low, equal_nan=True)
    with pytest.raises(MapFileError, match="No space left"):
        save(a_map(), tmp_path / "full")
    assert (tmp_path / "full").is_char_device()


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    """Where the map's name points elsewhere, to another disk say, the map goes there."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "map.npz").symlink_to("disk/map.npz")
    save(a_map(), tmp_path / "map.npz")
    assert (tmp_path / "map.npz").is_symlink()
    assert [path.name for path in (tmp_path / "disk").iterdir()] == ["map.npz"]
    assert np.array_equal(load(tmp_path / "map.npz").low, a_map().low, equal_nan=True)
