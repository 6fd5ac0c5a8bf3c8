"""A map as one file: `.npz` of layers, readable with numpy alone.

`low`, `high` float32 [ny, nx] metres (NaN = unseen), `resolution_m`, `origin_m` (x, y of the low corner of cell
[0, 0]), `frame` (name), `anchor` (JSON text that places the map frame on Earth; may be empty), `surely_hit` bool
[ny, nx] (docs/surely-hit.md); where the map keeps evidence, `settled_low`, `settled_high` float32 [ny, nx]
(docs/ghosts.md; NaN = not settled); and `guarantee` (JSON text as in docs/wire.md; empty = not known). Files without
the last four are read too.
"""

import os
import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from glob import escape
from math import inf, isfinite
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import TerraboundError
from mapper.grid import TILE_SIDE
from mapper.tile import Tile

_MOST_CELLS = 1 << 28
_ENTRIES = ("low", "high", "resolution_m", "origin_m", "frame", "anchor")
_BOUNDS = ("low", "high")
_LATER_ENTRIES = ("surely_hit", "settled_low", "settled_high")
"""Layers, not in every file."""
_GUARANTEE = "guarantee"
"""Not in every file."""


class MapFileError(TerraboundError):
    """A saved map can't be read or written."""


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap:
    """A rectangle of cells, as stored."""

    low: NDArray[np.float32]
    """[ny, nx] metres; NaN where unseen. Row = y, column = x."""
    high: NDArray[np.float32]
    resolution_m: float
    origin_m: tuple[float, float]
    frame: str
    anchor: str
    """JSON text; empty if unknown."""
    surely_hit: NDArray[np.bool_] | None = None
    """[ny, nx] did a beam certainly end in the cell? None: not known."""
    settled_low: NDArray[np.float32] | None = None
    """[ny, nx] metres; NaN where not settled. None: the map keeps no evidence."""
    settled_high: NDArray[np.float32] | None = None
    guarantee: str = ""
    """JSON text: did the bounds hold, and if not, since when are cells in doubt? Empty: not known."""


def assemble(tiles: Iterable[Tile], resolution_m: float, frame: str, anchor: str = "") -> SavedMap:
    """The smallest rectangle of whole tiles that holds all tiles; tiles that share a place are joined."""
    tiles = tuple(tiles)
    if any(tile.resolution_m != resolution_m or tile.submap != tiles[0].submap for tile in tiles):
        raise ValueError("a map is of one submap and one resolution")
    columns, rows = [tile.ix for tile in tiles] or [0], [tile.iy for tile in tiles] or [0]
    ix0, iy0 = min(columns), min(rows)
    side = (max(rows) - iy0 + 1) * TILE_SIDE, (max(columns) - ix0 + 1) * TILE_SIDE
    if not tiles:
        side = (0, 0)
    if side[0] * side[1] > _MOST_CELLS:
        raise MapFileError(
            f"the map spans {side[1]} x {side[0]} cells, more than one file can hold; save its submaps or parts apart"
        )
    low, high, settled_low, settled_high = (np.full(side, np.nan, np.float32) for _ in range(4))
    surely_hit = np.zeros(side, np.bool_)
    for tile in tiles:
        x, y = (tile.ix - ix0) * TILE_SIDE, (tile.iy - iy0) * TILE_SIDE
        place = np.s_[y : y + TILE_SIDE, x : x + TILE_SIDE]
        low[place], high[place] = np.fmin(low[place], tile.low), np.fmax(high[place], tile.high)
        surely_hit[place] |= tile.surely_hit
        settled_low[place] = np.fmin(settled_low[place], tile.settled_low)
        settled_high[place] = np.fmax(settled_high[place], tile.settled_high)
    settled = (settled_low, settled_high) if any(tile.has_settled for tile in tiles) else (None, None)
    step = TILE_SIDE * resolution_m
    return SavedMap(low, high, resolution_m, (ix0 * step, iy0 * step), frame, anchor, surely_hit, *settled)


def save(saved: SavedMap, path: Path) -> None:
    """Write the file whole or not at all; the same map gives the same bytes."""
    save_layers(saved, {name: getattr(saved, name) for name in (*_BOUNDS, *_LATER_ENTRIES)}, path)


def save_layers(place: SavedMap, layers: Mapping[str, NDArray[Any] | None], path: Path) -> None:
    """`save` with other layers [ny, nx], under names of their own; resolution, origin, frame are those of `place`."""
    values = [*layers.items(), *((name, getattr(place, name)) for name in _ENTRIES if name not in _BOUNDS)]
    values.append((_GUARANTEE, place.guarantee or None))

    def write(file: IO[bytes]) -> None:
        with zipfile.ZipFile(file, "w") as archive:
            for name, value in values:
                if value is None:
                    continue
                # A date of our own: numpy's writer would put the present one into the file.
                entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
                entry.compress_type = zipfile.ZIP_DEFLATED
                with archive.open(entry, "w") as member:
                    np.lib.format.write_array(member, np.asanyarray(value), allow_pickle=False)

    write_whole(path, write)


def load(path: Path) -> SavedMap:
    """Read a file that `save`, or anything that keeps to the format, wrote."""
    if path.is_file() and not zipfile.is_zipfile(path):
        raise MapFileError(f"{path}: no terrain map: not an .npz file")
    try:
        with np.load(path, allow_pickle=False) as file:
            if missing := [name for name in _ENTRIES if name not in file]:
                raise ValueError(f"it holds {', '.join(file) or 'nothing'}; {', '.join(missing)} missing")
            low, high, resolution, origin, frame, anchor = (file[name] for name in _ENTRIES)
            later = [file.get(name) for name in _LATER_ENTRIES]
            guarantee = str(file.get(_GUARANTEE, ""))
        if not (low.ndim == 2 and low.shape == high.shape and low.dtype == high.dtype == np.float32):
            raise ValueError(f"low is {low.dtype} {list(low.shape)}, high is {high.dtype} {list(high.shape)}")
        for name, layer, kind in zip(_LATER_ENTRIES, later, (np.bool_, np.float32, np.float32), strict=True):
            if layer is not None and (layer.shape != low.shape or layer.dtype != kind):
                raise ValueError(f"{name} is {layer.dtype} {list(layer.shape)}")
        x, y = (float(value) for value in origin)
        saved = SavedMap(low, high, float(resolution), (x, y), str(frame), str(anchor), *later)
        saved = replace(saved, guarantee=guarantee)
        _expect_numbers_of_a_map(saved)
        return saved
    except FileNotFoundError:
        raise MapFileError(f"{path}: no such file") from None
    except (OSError, ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise MapFileError(f"{path}: no terrain map: {error}") from error


def _expect_numbers_of_a_map(saved: SavedMap) -> None:
    """Raise ValueError where cells have no size or place, or what is neither unseen nor an interval."""
    if not (0.0 < saved.resolution_m < inf and all(map(isfinite, saved.origin_m))):
        raise ValueError(f"cells of {saved.resolution_m} m from {saved.origin_m} on")
    if (saved.settled_low is None) != (saved.settled_high is None):
        raise ValueError("one of settled_low and settled_high is missing")
    for name, low, high in (("", saved.low, saved.high), ("settled_", saved.settled_low, saved.settled_high)):
        if low is not None and high is not None:
            wrong = ~((-inf < low) & (low <= high) & (high < inf) | np.isnan(low) & np.isnan(high))
            if wrong.any():
                row, column = np.argwhere(wrong)[0].tolist()
                found = f"{name}low {low[row, column]}, {name}high {high[row, column]}"
                raise ValueError(f"{np.count_nonzero(wrong)} cells are no intervals, as [{row}, {column}]: {found}")


def write_whole(path: Path, write: Callable[[IO[bytes]], None]) -> None:
    """Let `write` fill a temporary file beside `path`, bring it to the disk, and rename it: all or nothing.

    A link stays and its target is written; a device or pipe (`/dev/stdout`) is written to, never put away. Raises
    MapFileError.
    """
    target = path.resolve()
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            with path.open("wb") as file:
                write(file)
            return
        _remove_abandoned(target)
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except OSError as error:
        raise MapFileError(f"{path}: can't be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def _remove_abandoned(target: Path) -> None:
    """Remove temporary files of processes that were killed while they wrote: one a crash would fill the disk."""
    for temporary in target.parent.glob(f".{escape(target.name)}.*.part"):
        pid = temporary.name.removesuffix(".part").rpartition(".")[2]
        if pid.isdigit() and not Path("/proc", pid).exists():
            with suppress(OSError):
                temporary.unlink()
