"""A saved map for other programs: `.ply` (mesh), `.png` (picture), `.npz` (a copy)."""

from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from mapper.saved_map import MapFileError, SavedMap, save, write_whole


def export_map(saved: SavedMap, output: Path) -> None:
    """Write `output` in the format that its suffix names."""
    writers = {".ply": write_ply, ".png": write_png, ".npz": save}
    writer = writers.get(output.suffix.lower())
    if writer is None:
        raise MapFileError(
            f"{output}: don't know how to write {output.suffix or 'a file without suffix'}; "
            f"use one of {', '.join(writers)}"
        )
    writer(saved, output)


def write_ply(saved: SavedMap, path: Path) -> None:
    """Mesh of the middle surface, map frame, metres.

    A vertex for every seen cell's centre: x, y, z (middle), low, high. Two triangles between four seen neighbours.
    """
    seen = ~np.isnan(saved.low)
    rows, columns = np.nonzero(seen)
    kind = [(name, "<f4") for name in ("x", "y", "z", "low", "high")]
    vertices = np.empty(rows.size, kind)
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
            *(f"property float {name}" for name, _ in kind),
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


def write_png(saved: SavedMap, path: Path) -> None:
    """Picture: the middle of each interval, and its width. Needs matplotlib (the extra `plots`)."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MapFileError(f"{path}: pictures need matplotlib: pip install 'terrabound[plots]'") from None
    height, width = saved.low.shape
    x, y = saved.origin_m
    extent = (x, x + width * saved.resolution_m, y, y + height * saved.resolution_m)
    figure = Figure(figsize=(12, 5.5), layout="constrained")
    panels = (
        ("middle of the interval", _middle(saved), "terrain"),
        ("width of the interval", saved.high - saved.low, "viridis"),
    )
    for axes, (title, layer, colours) in zip(figure.subplots(1, 2), panels, strict=True):
        axes.set_facecolor("white")
        if layer.size:
            image = axes.imshow(layer, origin="lower", extent=extent, cmap=colours, interpolation="nearest")
            figure.colorbar(image, ax=axes, label="m", shrink=0.8)
        axes.set(title=title, xlabel=f"x in {saved.frame} (m)", ylabel="y (m)")
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=120))


def _middle(saved: SavedMap) -> NDArray[np.float32]:
    middle: NDArray[np.float32] = saved.low + (saved.high - saved.low) * np.float32(0.5)
    return middle
