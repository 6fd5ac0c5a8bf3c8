"""How good a map of the profile is: section 6 of our reference, a number each."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.paper.profile_drive import CELL_COUNT, CENTRES_M, DITCH_M, WALL_M, Drive, flat_cells
from bench.paper.profile_methods import Estimate

Floats = NDArray[np.float64]
FLAT = flat_cells()
_STEPS_M = (70.5, 100.5, *DITCH_M, WALL_M)
_WINDOW_M = 4.0
_WALL_CELLS = np.flatnonzero(np.abs(CENTRES_M - WALL_M) < 1.0)
COUNTED = ("false", "hits_outside", "hits_unseen", "certified", "certified_false", "certified_not_hit", "wall_bounded")
"""Scores whose sum over all runs is told, too."""


def scores(estimate: Estimate, truth: Floats, drive: Drive) -> dict[str, float]:
    """Of one run. NaN where there is nothing to score. Lengths in metres.

    rmse_*, roughness over observed cells; contained_* shares of them whose middle's elevation is in the bound; false:
    truly hit cells with it outside; hits_outside: points that were hit and are outside the bound of their cell;
    hits_unseen: points in cells without one.
    """
    hit = np.zeros(CELL_COUNT, np.bool_)
    hit[drive.hit_cells] = True
    seen, error = ~np.isnan(estimate.mean), estimate.mean - truth
    inside = (estimate.low <= truth) & (truth <= estimate.high)
    pairs = FLAT[1:] & FLAT[:-1] & seen[1:] & seen[:-1]
    points = (estimate.low[drive.hit_cells] <= drive.hit_z_m) & (drive.hit_z_m <= estimate.high[drive.hit_cells])
    wall_low, wall_high = np.nanmin(estimate.low[_WALL_CELLS]), np.nanmax(estimate.high[_WALL_CELLS])
    result = {
        "rmse_all": _rms(error[seen]),
        "rmse_flat": _rms(error[seen & FLAT]),
        "rmse_edge": _rms(error[seen & ~FLAT]),
        "rmse_hit": _rms(error[seen & hit]),
        "bias_flat": float(np.mean(error[seen & FLAT])),
        "roughness": _rms(np.diff(estimate.mean)[pairs]),
        "observed": float(seen.sum()),
        "never_hit": float((seen & ~hit).sum()),
        "rmse_never_hit": _rms(error[seen & ~hit]),
        "contained_all": float(inside[seen].mean()),
        "contained_hit": float(inside[seen & hit].mean()),
        "false": float((seen & hit & ~inside).sum()),
        "hits_outside": float((seen[drive.hit_cells] & ~points).sum()),
        "hits_unseen": float((~seen[drive.hit_cells]).sum()),
        "width_flat": float((estimate.high - estimate.low)[seen & FLAT].mean()),
        "width_all": float((estimate.high - estimate.low)[seen].mean()),
        "jump": float(np.max([_jump(estimate.mean, edge) for edge in _STEPS_M])),
        "wall_bounded": float(wall_low <= truth[_WALL_CELLS].min() and truth[_WALL_CELLS].max() <= wall_high),
        "wall_span": float(wall_high - wall_low),
    }
    if estimate.certified is not None:
        result |= {
            "certified": float(estimate.certified.sum()),
            "certified_false": float((estimate.certified & ~inside).sum()),
            "certified_not_hit": float((estimate.certified & ~hit).sum()),
        }
    return result


def average(runs: list[dict[str, float]]) -> dict[str, Any]:
    """Mean over runs of each score, and of those that must be zero the sum, as `total_*`."""
    means: dict[str, Any] = {name: float(np.nanmean([run[name] for run in runs])) for name in runs[0]}
    return means | {f"total_{name}": round(sum(run[name] for run in runs)) for name in COUNTED if name in means}


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values * values))) if values.size else float("nan")


def _jump(mean: Floats, edge_m: float) -> float:
    """Largest step of the estimate from cell to cell around an edge."""
    near = mean[np.abs(CENTRES_M - edge_m) < _WINDOW_M]
    return float(np.nanmax(np.abs(np.diff(near))))
