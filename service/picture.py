"""The picture of a drive: the map from above, how wide its bounds are, and a cut along the drive. Needs matplotlib."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import TerraboundError
from mapper.map_picture import hillshade
from mapper.saved_map import SavedMap

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """A cut through the terrain along a line in the map frame."""

    x_m: Array
    """[n]"""
    y_m: Array
    """[n]"""
    true_z_m: Array | None
    """[n] elevation of the true ground, where it is known."""

    @property
    def along_m(self) -> Array:
        """[n] distance from the line's beginning."""
        steps = np.hypot(np.diff(self.x_m), np.diff(self.y_m))
        return np.concatenate([[0.0], np.cumsum(steps)])


@dataclass(frozen=True, slots=True)
class Labels:
    """The words of a picture."""

    title: str
    summary: str


def draw(path: Path, saved: SavedMap, drive_xy: Array, profile: Profile, labels: Labels) -> None:
    """Draw map, widths and profile into a PNG. `drive_xy` [n, 2] is the robot's way in the map frame."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError:
        raise TerraboundError("pictures need matplotlib: pip install 'terrabound[plots]'") from None

    middle = (saved.low.astype(float) + saved.high) / 2
    width = saved.high.astype(float) - saved.low
    seen = np.isfinite(middle)
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    if len(rows) == 0:
        raise TerraboundError("the map is empty: nothing to draw")
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    middle, width = middle[window], width[window]
    cell = saved.resolution_m
    west, south = saved.origin_m[0] + columns[0] * cell, saved.origin_m[1] + rows[0] * cell
    extent = (west, west + middle.shape[1] * cell, south, south + middle.shape[0] * cell)

    figure = plt.figure(figsize=(14, 11), dpi=110, layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(1.5, 1.0))
    above, widths, cut = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, :])

    low, high = np.nanpercentile(middle, [1, 99])
    image = above.imshow(
        middle,
        origin="lower",
        extent=extent,
        cmap="gist_earth",
        vmin=low - 0.1,
        vmax=high + 0.1,
        interpolation="nearest",
    )
    above.imshow(hillshade(middle, cell), origin="lower", extent=extent, cmap="gray", alpha=0.35, vmin=0, vmax=1)
    if saved.surely_hit is not None:
        sure = np.where(saved.surely_hit[window], 1.0, np.nan)
        above.imshow(sure, origin="lower", extent=extent, cmap="cool", vmin=0, vmax=1, interpolation="nearest")
        above.plot([], [], "s", color="magenta", label="surely hit")
    figure.colorbar(image, ax=above, label="elevation, middle of the bounds [m]", shrink=0.85)
    above.set_title("The terrain from above")

    image = widths.imshow(
        width,
        origin="lower",
        extent=extent,
        cmap="magma_r",
        vmin=0,
        vmax=float(np.nanpercentile(width, 98)),
        interpolation="nearest",
    )
    figure.colorbar(image, ax=widths, label="upper bound - lower bound [m]", shrink=0.85)
    widths.set_title("How far apart the bounds are")

    for axes in (above, widths):
        axes.plot(drive_xy[:, 0], drive_xy[:, 1], color="tab:red", linewidth=1.8, label="drive")
        axes.plot(*drive_xy[0], "o", color="tab:red", markersize=6)
        axes.plot(profile.x_m, profile.y_m, color="tab:red", linewidth=0.9, linestyle=":", label="profile below")
        axes.set_xlabel("x, ahead at the start [m]")
        axes.set_ylabel("y, to the left [m]")
        axes.set_facecolor("0.93")
        axes.legend(loc="upper right", fontsize=8)

    lower, upper = _bounds_along(saved, profile)
    along = profile.along_m
    unseen = np.isnan(lower)
    cut.fill_between(
        along, 0, 1, where=unseen, transform=cut.get_xaxis_transform(), color="0.93", label="never hit by a beam"
    )
    cut.fill_between(along, lower, upper, step="mid", color="tab:blue", alpha=0.25, label="inside the bounds")
    cut.step(along, upper, where="mid", color="tab:blue", linewidth=1.2, label="upper bound")
    cut.step(along, lower, where="mid", color="navy", linewidth=1.2, label="lower bound")
    if profile.true_z_m is not None:
        cut.plot(along, profile.true_z_m, color="black", linewidth=1.6, label="true ground")
    cut.set_xlabel("along the drive [m]")
    cut.set_ylabel("elevation [m]")
    cut.set_title("Profile along the drive: the true ground stays between the bounds")
    cut.grid(alpha=0.3)
    cut.legend(loc="upper left", fontsize=9)

    figure.suptitle(f"{labels.title}\n{labels.summary}", fontsize=13)
    figure.savefig(path)
    plt.close(figure)


def _bounds_along(saved: SavedMap, profile: Profile) -> tuple[Array, Array]:
    """Low and high of the cell under each point of the profile; NaN where unseen or off the map."""
    column = np.floor((profile.x_m - saved.origin_m[0]) / saved.resolution_m).astype(int)
    row = np.floor((profile.y_m - saved.origin_m[1]) / saved.resolution_m).astype(int)
    on_map = (row >= 0) & (column >= 0) & (row < saved.low.shape[0]) & (column < saved.low.shape[1])
    lower, upper = np.full(len(row), np.nan), np.full(len(row), np.nan)
    lower[on_map] = saved.low[row[on_map], column[on_map]]
    upper[on_map] = saved.high[row[on_map], column[on_map]]
    return lower, upper
