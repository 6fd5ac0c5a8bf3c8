"""The pictures of the paper's simulation: the profile with estimates and bounds of each map, and what they cost."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.paper.profile_drive import BOUNDS, CELL_M, CENTRES_M, drive, profile
from bench.paper.profile_methods import METHODS, Estimate, Readings
from bench.paper.table1_cost import FAST, INTERPRETED, NUMPY, PLAIN, Cost

matplotlib.use("Agg")
Floats = NDArray[np.float64]
SHOWN = {"ours": "tab:blue", "mixture, sigma = b/3": "tab:orange", "Kalman, sigma = b/3": "tab:green"}
WHOLE_M, CLOSE_M = (-10.0, 192.0), (145.0, 180.0)
_TITLES = {
    "ours": "set-valued (ours): interval of each cell",
    "mixture, sigma = b/3": "Gaussian mixture: mean and 3 sigma",
    "Kalman, sigma = b/3": "Kalman: mean and 3 sigma",
}


def draw_profile(path: Path, readings: Readings, title: str) -> None:
    """The whole profile on the left, ditch and wall on the right; a row a map, the truth in each."""
    figure = Figure(figsize=(13, 9), layout="constrained")
    axes = figure.subplots(len(SHOWN), 2, sharey=True, sharex="col", width_ratios=(2.2, 1.0))
    figure.suptitle(f"{title}\none drive at 5 m/s; bounds: place 0.6 m, pitch 0.5°, range 0.1 m; cells of 1 m")
    hit = np.zeros(CENTRES_M.size, np.bool_)
    hit[drive(0.0).hit_cells] = True
    for (left, right), (method, colour) in zip(axes, SHOWN.items(), strict=True):
        estimate = METHODS[method](readings, BOUNDS)
        for axis, limits in ((left, WHOLE_M), (right, CLOSE_M)):
            _draw_cells(axis, estimate, hit, colour)
            axis.plot(*profile().T, color="black", lw=1.0, label="true ground")
            axis.set_xlim(*limits)
            axis.grid(alpha=0.3)
        left.set_ylim(-1.6, 1.9)
        left.set_ylabel("elevation [m]")
        left.set_title(_TITLES[method], loc="left")
        right.set_title("ditch and wall", loc="left")
        left.legend(loc="lower left", ncols=4, fontsize="small")
    for axis in axes[-1]:
        axis.set_xlabel("way along the profile [m]")
    figure.savefig(path, dpi=90)


def _draw_cells(axis: Any, estimate: Estimate, hit: NDArray[np.bool_], colour: str) -> None:
    """Bound and estimate of every cell over its width; paler where no beam ended."""
    for cells, alpha, label in ((hit, 0.35, "bound"), (~hit, 0.12, "bound, cell never hit")):
        kept = cells & ~np.isnan(estimate.low)
        height = estimate.high[kept] - estimate.low[kept]
        axis.bar(CENTRES_M[kept], height, CELL_M, estimate.low[kept], color=colour, alpha=alpha, lw=0, label=label)
    left, right = CENTRES_M - 0.5 * CELL_M, CENTRES_M + 0.5 * CELL_M
    axis.hlines(estimate.mean, left, right, color=colour, lw=1.8, label="estimate", zorder=3)


def draw_bounds(path: Path, averages: dict[str, dict[str, dict[str, Any]]], laws: list[str]) -> None:
    """How often each map's bound holds the truth, beside how wide it is, law by law."""
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    shares, widths = figure.subplots(1, 2)
    methods = {
        "ours": "tab:blue",
        "paper, first order": "lightsteelblue",
        "mixture, sigma = b/3": "tab:orange",
        "mixture, sigma = b/sqrt 3": "moccasin",
        "Kalman, sigma = b/3": "tab:green",
        "Kalman, b/3, inflated": "lightgreen",
    }
    places = np.arange(len(laws))
    for i, (method, colour) in enumerate(methods.items()):
        where = places + (i - 2.5) * 0.14
        held = [100.0 * averages[law][method]["contained_hit"] for law in laws]
        wide = [averages[law][method]["width_flat"] for law in laws]
        shares.bar(where, held, 0.14, color=colour, label=method)
        widths.bar(where, wide, 0.14, color=colour)
    for axis in (shares, widths):
        axis.set_xticks(places, [law.replace(", ", ",\n").replace(" ", "\n", 1) for law in laws], fontsize="small")
        axis.grid(axis="y", alpha=0.3)
    shares.set_title("Truly hit cells whose bound holds the truth")
    shares.set_ylabel("share of cells [%]")
    shares.set_ylim(0.0, 105.0)
    widths.set_title("How wide the bounds are")
    widths.set_ylabel("mean width on flat ground [m]")
    figure.legend(loc="outside lower center", ncols=3, fontsize="small")
    figure.savefig(path, dpi=90)


def draw_costs(path: Path, costs: list[Cost]) -> None:
    """CPU time of a measurement, by how the maps are written."""
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    axes = figure.subplots(2, 2).ravel()
    figure.suptitle("CPU time of a measurement, projection included (percent: of the mixture's)")
    for axis, form in zip(axes, (INTERPRETED, NUMPY, PLAIN, FAST), strict=True):
        rows = [cost for cost in costs if cost.form == form][::-1]
        colours = ["tab:orange" if "mixture" in row.method else "tab:green" if "Kalman" in row.method else "tab:blue"
                   for row in rows]  # fmt: skip
        bars = axis.barh([row.method for row in rows], [row.median_ns for row in rows], color=colours)
        axis.bar_label(
            bars, [f" {row.median_ns:.0f} ns, {100 * row.of_mixture:.0f} %" for row in rows], fontsize="small"
        )
        axis.set_title(form, loc="left")
        axis.set_xlabel("ns a measurement")
        axis.set_xlim(0.0, 1.35 * max(row.median_ns for row in rows))
    figure.savefig(path, dpi=90)
