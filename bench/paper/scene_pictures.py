"""The pictures of a drive: the maps side by side in 3D, and cuts through them with their bounds.

In the paper's axes: x to the right, y ahead, both from where the robot began.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.paper.scene_maps import MIXTURE, OURS, Layers, TrueCells, Window
from simulator.truth import Truth

Array = NDArray[np.float64]
KALMAN = "Kalman, b/3"
NAMES = {OURS: "set-valued map", MIXTURE: "Gaussian mixture map", KALMAN: "Kalman map"}
BOUNDS = {OURS: "guaranteed bounds", MIXTURE: "mean ± 3 sigma", KALMAN: "estimate ± 3 sigma"}
COLOURS = {OURS: "tab:blue", MIXTURE: "tab:orange", KALMAN: "tab:green"}


@dataclass(frozen=True, slots=True)
class Line:
    """A cut along y, through cells at `x_m` to the right."""

    x_m: float


@dataclass(frozen=True, slots=True, eq=False)
class TrueProfile:
    """The truth along a line."""

    y_m: Array
    z_m: Array


def true_profile(truth: Truth, window: Window, line: Line) -> TrueProfile:
    """The true surface every 5 mm."""
    ahead = np.arange(window.x_m[0], window.x_m[1], 0.005)
    return TrueProfile(ahead, truth.surface(ahead, np.full(ahead.shape, -line.x_m)))


def draw_maps(
    path: Path, title: str, where: str, window: Window, true: TrueCells, layers: Mapping[str, Layers]
) -> Path:
    """Truth, set-valued map and mixture map as surfaces, side by side and in the same colours."""
    from matplotlib.ticker import MaxNLocator

    figure = _figure((15.5, 5.4))
    ahead, left = window.centres()
    right, y = np.meshgrid(ahead, -left)[::-1]
    low, high = float(np.nanmin(true.centre)), float(np.nanmax(true.centre))
    shown = [("truth (simulated)", true.centre)]
    shown += [
        (f"{NAMES[name]}, {'middle of the bounds' if name == OURS else 'mean'}", layers[name].estimate)
        for name in (OURS, MIXTURE)
    ]
    axes = []
    for n, (name, surface) in enumerate(shown):
        ax: Any = figure.add_subplot(1, 3, n + 1, projection="3d")
        drawn = ax.plot_surface(
            right,
            y,
            np.ma.masked_invalid(surface),
            cmap="viridis",
            vmin=low,
            vmax=high,
            rcount=200,
            ccount=200,
            linewidth=0,
            antialiased=False,
        )
        filled = 100 * np.isfinite(surface).mean()
        ax.set_title(f"{name}\n{filled:.0f} % of the cells", y=0.98)
        ax.set_xlabel("x, to the right [m]", labelpad=9)
        ax.set_ylabel("y, ahead [m]", labelpad=5)
        ax.xaxis.set_major_locator(MaxNLocator(5))
        ax.yaxis.set_major_locator(MaxNLocator(5))
        ax.zaxis.set_major_locator(MaxNLocator(4))
        ax.set_zlabel("elevation [m]")
        ax.set_zlim(low - 0.05, high + 0.05)
        ax.set_box_aspect((np.ptp(left), np.ptp(ahead), 1.6 * (high - low + 0.1)), zoom=1.0)
        ax.view_init(elev=32, azim=-112)
        axes.append(ax)
    figure.colorbar(drawn, ax=axes, shrink=0.62, pad=0.04, label="elevation [m]")
    figure.suptitle(f"{title}: the maps beside the truth\n{where}", fontsize=12)
    return _save(figure, path)


def draw_profiles(
    path: Path,
    title: str,
    where: str,
    window: Window,
    lines: tuple[Line, ...],
    profiles: tuple[TrueProfile, ...],
    true: TrueCells,
    layers: Mapping[str, Layers],
) -> Path:
    """A row a line, a column a map: estimate, bounds and the true ground."""
    figure = _figure((15.5, 1.6 + 3.1 * len(lines)))
    grid: Any = figure.subplots(len(lines), len(NAMES), sharex=True, sharey="row", squeeze=False)
    ahead, _ = window.centres()
    edges = np.append(ahead - 0.5 * window.cell_m, ahead[-1] + 0.5 * window.cell_m)
    for row, (line, profile) in enumerate(zip(lines, profiles, strict=True)):
        j = int(np.floor((-line.x_m - window.y_m[0]) / window.cell_m))
        for ax, name in zip(grid[row], NAMES, strict=True):
            layer, colour = layers[name], COLOURS[name]
            low, high, middle = layer.low[j], layer.high[j], layer.estimate[j]
            ax.stairs(high, edges, baseline=None, color=colour, linewidth=0.9)
            ax.stairs(low, edges, baseline=None, color=colour, linewidth=0.9)
            ax.fill_between(
                np.repeat(edges, 2)[1:-1],
                np.repeat(low, 2),
                np.repeat(high, 2),
                color=colour,
                alpha=0.25,
                label=BOUNDS[name],
            )
            ax.stairs(middle, edges, baseline=None, color=colour, linewidth=2.0, label="estimate")
            ax.plot(profile.y_m, profile.z_m, color="black", linewidth=1.0, label="true ground")
            hit = "where beams truly hit"
            ax.vlines(ahead, true.lowest[j], true.highest[j], color="crimson", linewidth=1.6, label=hit)
            ax.plot(ahead, true.lowest[j], ".", color="crimson", markersize=3)
            ax.set_title(f"{NAMES[name]}, along x = {line.x_m:g} m", fontsize=11)
            ax.grid(alpha=0.3)
            ax.set_xlim(*window.x_m)
            ax.tick_params(labelbottom=True, labelleft=True)
            ax.set_xlabel("y, ahead [m]")
            ax.set_ylabel("elevation [m]")
            if row == 0:
                ax.legend(loc="upper left", fontsize=8)
    figure.suptitle(
        f"{title}: cuts through the maps. Bounds speak of what beams hit; without a line a map says nothing\n{where}",
        fontsize=12,
    )
    return _save(figure, path)


def _figure(size: tuple[float, float]) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def _save(figure: Any, path: Path) -> Path:
    figure.savefig(path, dpi=85, pil_kwargs={"optimize": True})
    return path
