"""A map as a picture: hill-shaded middles, widths of the intervals, scale bar and legend. Needs matplotlib."""

from math import floor, log10
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.saved_map import MapFileError, SavedMap, write_whole
from mapper.traversability import Verdict, Verdicts

Array = NDArray[np.floating[Any]]
UNSEEN = "0.93"
VERDICTS = {
    Verdict.PASSABLE: ("certainly passable", "#3a9a5b"),
    Verdict.IMPASSABLE: ("certainly not passable", "#c0392b"),
    Verdict.UNKNOWN: ("not known", "#e8c468"),
}


def hillshade(elevation: Array, cell_m: float) -> NDArray[np.float64]:
    """Light from the north-west, 45 degrees high; NaN where nothing was seen."""
    if min(elevation.shape) < 2:
        return np.full(elevation.shape, 0.7)
    slope_y, slope_x = np.gradient(elevation.astype(float), cell_m)
    shade: NDArray[np.float64] = (1 + slope_x - slope_y) / np.sqrt(1 + slope_x**2 + slope_y**2) / np.sqrt(3)
    return np.clip(shade, 0, 1)


def write_png(saved: SavedMap, path: Path, quantity: str = "elevation", unit: str = "m") -> None:
    """Two panels: the middle of each interval (hill-shaded, where it is an elevation), and its width."""
    figure, panels = _figure(saved, path, 2)
    middle, width = saved.low + (saved.high - saved.low) * np.float32(0.5), saved.high - saved.low
    if middle.size:
        seen = np.isfinite(middle).any()
        low, high = np.nanpercentile(middle, [1, 99]) if seen else (0.0, 1.0)
        image = panels[0].imshow(
            middle, origin="lower", extent=_extent(saved), cmap="gist_earth", vmin=low - 0.05, vmax=high + 0.05
        )
        if quantity == "elevation":
            shade = hillshade(middle, saved.resolution_m)
            panels[0].imshow(shade, origin="lower", extent=_extent(saved), cmap="gray", alpha=0.4, vmin=0, vmax=1)
        figure.colorbar(image, ax=panels[0], label=f"{quantity}, middle of the bounds [{unit}]", shrink=0.8)
        most = float(np.nanpercentile(width, 98)) if seen else 1.0
        image = panels[1].imshow(
            width, origin="lower", extent=_extent(saved), cmap="magma_r", vmin=0, vmax=max(most, 1e-3)
        )
        figure.colorbar(image, ax=panels[1], label=f"upper bound - lower bound [{unit}]", shrink=0.8, extend="max")
    _finish(saved, path, figure, panels, (quantity.capitalize(), "How far apart the bounds are"))


def write_verdicts(saved: SavedMap, verdict: Verdicts, path: Path) -> None:
    """One panel: what is certainly passable, certainly not, and not known, over the shaded terrain."""
    figure, panels = _figure(saved, path, 1)
    if verdict.size:
        from matplotlib.colors import to_rgba
        from matplotlib.patches import Patch

        colours = np.zeros((*verdict.shape, 4))
        for value, (_, colour) in VERDICTS.items():
            colours[verdict == value] = to_rgba(colour)
        shade = np.nan_to_num(hillshade((saved.low + saved.high) / 2, saved.resolution_m), nan=0.7)
        colours[..., :3] *= (0.6 + 0.4 * shade / max(float(shade.max()), 1e-9))[..., None]
        colours[np.isnan(saved.low)] = to_rgba(UNSEEN)
        panels[0].imshow(colours, origin="lower", extent=_extent(saved), interpolation="nearest")
        counts = {value: int(((verdict == value) & ~np.isnan(saved.low)).sum()) for value in VERDICTS}
        patches = [Patch(color=colour, label=f"{name} ({counts[v]} cells)") for v, (name, colour) in VERDICTS.items()]
        panels[0].legend(handles=patches, loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
    _finish(saved, path, figure, panels, ("What is certain of the measured points",))


def _figure(saved: SavedMap, path: Path, panels: int) -> tuple[Any, list[Any]]:
    """Panels beside each other, each with room for its legend, as wide or high as the map is."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MapFileError(f"{path}: pictures need matplotlib: pip install 'terrabound[plots]'") from None
    rows, columns = saved.low.shape
    aspect = min(max(columns / rows if rows else 1.0, 0.3), 3.0)
    height = 6.0 if aspect < 1.5 else 4.5
    figure = Figure(figsize=(panels * (height * aspect + 2.6), height + 0.8), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(1, panels)))


def _finish(saved: SavedMap, path: Path, figure: Any, panels: list[Any], titles: tuple[str, ...]) -> None:
    """Axes, titles, scale bar; and the file."""
    for axes, title in zip(panels, titles, strict=True):
        axes.set_facecolor(UNSEEN)
        axes.set(title=title, xlabel=f"x in the frame {saved.frame!r} [m]", ylabel="y [m]", aspect="equal")
        if saved.low.size:
            _scale_bar(axes, saved)
    seen = int((~np.isnan(saved.low)).sum())
    sure = "" if saved.surely_hit is None else f", {int(saved.surely_hit.sum())} surely hit"
    figure.suptitle(f"Terrain map: {seen} cells of {100 * saved.resolution_m:g} cm{sure}; grey: unseen")
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=120))


def _scale_bar(axes: Any, saved: SavedMap) -> None:
    """A round number of metres, a fifth of the map's width at most."""
    west, east, south, north = _extent(saved)
    reach = max((east - west) / 5, min(east - west, 0.1 * (north - south)) / 2)
    power = 10.0 ** floor(log10(reach))
    length = max(step * power for step in (1, 2, 5) if step * power <= reach)
    x, y = west + 0.04 * (east - west), south + 0.04 * (north - south)
    axes.plot([x, x + length], [y, y], color="black", linewidth=3, solid_capstyle="butt")
    axes.annotate(f"{length:g} m", (x, y), (0, 4), textcoords="offset points", fontsize=9)


def _extent(saved: SavedMap) -> tuple[float, float, float, float]:
    x, y = saved.origin_m
    rows, columns = saved.low.shape
    return x, x + columns * saved.resolution_m, y, y + rows * saved.resolution_m
