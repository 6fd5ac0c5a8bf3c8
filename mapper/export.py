"""A map for other programs: `.tif` (GDAL, QGIS), `.ply` (mesh), `.png` (picture), `.npz` (numpy).

What is exported is a layer: the elevations themselves, or bounds of step, slope and roughness, or what is certainly
passable (mapper/traversability.py).
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mapper.geotiff import write_geotiff
from mapper.map_picture import write_png, write_verdicts
from mapper.saved_map import MapFileError, SavedMap, save, save_layers, write_whole
from mapper.traversability import RobotLimits, Traversability, Verdict, assess

LayerName: TypeAlias = Literal["elevation", "step", "slope", "roughness", "passable"]
UNITS = {"elevation": "m", "step": "m", "slope": "m/m", "roughness": "m"}


def export_map(
    saved: SavedMap, output: Path, layer: LayerName = "elevation", limits: RobotLimits | None = None
) -> None:
    """Write a layer in the format that the suffix of `output` names. Layers but the elevation need `limits`."""
    suffix = output.suffix.lower()
    if layer == "elevation":
        writers: dict[str, Callable[[], None]] = {
            ".tif": lambda: _write_elevations(cropped(saved), output),
            ".ply": lambda: write_ply(saved, output),
            ".png": lambda: write_png(cropped(saved), output),
            ".npz": lambda: save(saved, output),
        }
    else:
        if limits is None:
            raise MapFileError(f"the layer {layer} depends on the robot: its length is needed")
        part = cropped(saved)
        found = assess(part, limits)
        writers = _passable_writers(part, found, output) if layer == "passable" else _bounds(part, found, layer, output)
    if suffix not in writers:
        raise MapFileError(
            f"{output}: don't know how to write {output.suffix or 'a file without suffix'}; "
            f"use one of {', '.join(writers)}"
        )
    writers[suffix]()


def _bounds(saved: SavedMap, found: Traversability, layer: str, output: Path) -> dict[str, Callable[[], None]]:
    """Writers of the bounds of step, slope or roughness."""
    low, high = getattr(found, f"{layer}_low"), getattr(found, f"{layer}_high")
    bounds = replace(saved, low=low, high=high, settled_low=None, settled_high=None)
    bands = {f"{layer}_min": low, f"{layer}_max": high}
    return {
        ".tif": lambda: write_geotiff(saved, bands, output, UNITS[layer]),
        ".png": lambda: write_png(bounds, output, layer, UNITS[layer]),
        ".npz": lambda: save_layers(saved, {f"{layer}_low": low, f"{layer}_high": high}, output),
    }


def _passable_writers(saved: SavedMap, found: Traversability, output: Path) -> dict[str, Callable[[], None]]:
    """Writers of verdicts: 1 certainly passable, 0 certainly not, NaN not known."""
    values = np.full(saved.low.shape, np.nan, np.float32)
    values[found.verdict == Verdict.PASSABLE] = 1.0
    values[found.verdict == Verdict.IMPASSABLE] = 0.0
    return {
        ".tif": lambda: write_geotiff(saved, {"passable": values}, output),
        ".png": lambda: write_verdicts(saved, found.verdict, output),
        ".npz": lambda: save_layers(saved, {"passable": values}, output),
    }


def _write_elevations(saved: SavedMap, output: Path) -> None:
    bands = {"elevation_min": saved.low, "elevation_max": saved.high}
    if saved.surely_hit is not None:
        bands["surely_hit"] = np.where(np.isnan(saved.low), np.float32(np.nan), saved.surely_hit.astype(np.float32))
    if saved.settled_low is not None and saved.settled_high is not None:
        bands |= {"settled_min": saved.settled_low, "settled_max": saved.settled_high}
    write_geotiff(saved, bands, output)


def cropped(saved: SavedMap) -> SavedMap:
    """Without the unseen rows and columns around it."""
    seen = ~np.isnan(saved.low)
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    if rows.size == 0:
        return saved
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    layers: dict[str, Any] = {
        name: None if (layer := getattr(saved, name)) is None else layer[window]
        for name in ("low", "high", "surely_hit", "settled_low", "settled_high")
    }
    x, y = saved.origin_m
    origin = x + float(columns[0]) * saved.resolution_m, y + float(rows[0]) * saved.resolution_m
    return replace(saved, **layers, origin_m=origin)


def write_ply(saved: SavedMap, path: Path) -> None:
    """Mesh of the middle surface, map frame, metres.

    A vertex for every seen cell's centre: x, y, z (middle), low, high, and surely_hit where it is known. Two triangles
    between four seen neighbours.
    """
    seen = ~np.isnan(saved.low)
    rows, columns = np.nonzero(seen)
    kind = [(name, "<f4") for name in ("x", "y", "z", "low", "high")]
    if saved.surely_hit is not None:
        kind.append(("surely_hit", "u1"))
    vertices = np.empty(rows.size, kind)
    if saved.surely_hit is not None:
        vertices["surely_hit"] = saved.surely_hit[seen]
    vertices["x"] = saved.origin_m[0] + (columns + 0.5) * saved.resolution_m
    vertices["y"] = saved.origin_m[1] + (rows + 0.5) * saved.resolution_m
    vertices["low"], vertices["high"] = saved.low[seen], saved.high[seen]
    vertices["z"] = _middle(saved)[seen]

    number = np.cumsum(seen).reshape(seen.shape) - 1
    quads = seen[:-1, :-1] & seen[:-1, 1:] & seen[1:, :-1] & seen[1:, 1:]
    a, b, c, d = (corner[quads] for corner in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.empty(2 * a.size, [("corners", "u1"), ("vertices", "<i4", 3)])
    faces["corners"] = 3
    faces["vertices"][0::2] = np.stack((a, b, c), axis=-1)
    faces["vertices"][1::2] = np.stack((a, c, d), axis=-1)

    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            f"comment terrain map, frame {saved.frame}, z between low and high".replace("\n", " "),
            f"element vertex {vertices.size}",
            *(f"property {'float' if code == '<f4' else 'uchar'} {name}" for name, code in kind),
            f"element face {faces.size}",
            "property list uchar int vertex_indices",
            "end_header\n",
        ]
    )

    def write(file: IO[bytes]) -> None:
        file.write(header.encode("ascii", "replace"))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())

    write_whole(path, write)


def _middle(saved: SavedMap) -> NDArray[np.float32]:
    middle: NDArray[np.float32] = saved.low + (saved.high - saved.low) * np.float32(0.5)
    return middle
