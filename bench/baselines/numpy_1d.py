"""The maps over one horizontal dimension in numpy, a whole drive at once: what one writes without a compiler."""

import numpy as np
from numpy.typing import NDArray

from bench.baselines.normal_table import PLACES_PER_UNIT, REACH, VALUES

Floats = NDArray[np.float64]


def mixture(
    x: Floats,
    pitch: Floats,
    ranges: Floats,
    sigma: Floats,
    height_m: float,
    width_m: float,
    first_cell: int,
    sums: Floats,
) -> None:
    """Equations (5) to (8) into sums [3, m]."""
    var_x, var_pitch, var_range = sigma * sigma
    c, s = np.cos(pitch), np.sin(pitch)
    ahead, up = ranges * c, ranges * s
    X, Z = x + ahead, height_m + up
    Pxx = var_x + c * c * var_range + up * up * var_pitch
    Pxz = c * s * (var_range - ranges * ranges * var_pitch)
    sd, gain = np.sqrt(Pxx), Pxz / Pxx
    variance = s * s * var_range + ahead * ahead * var_pitch - gain * Pxz
    first, last = np.floor((X - 3.0 * sd) / width_m + 0.5), np.floor((X + 3.0 * sd) / width_m + 0.5)
    most = int(np.max(last - first)) + 1
    j = first + np.arange(most)[:, None]
    borders = (np.concatenate((j[:1] - 0.5, j + 0.5)) * width_m - X) / sd
    phi = np.interp((borders + REACH) * PLACES_PER_UNIT, np.arange(VALUES.size), VALUES)
    p = np.where(j <= last, np.diff(phi, axis=0), 0.0)
    u = Z + gain * (j * width_m - X)
    cells = np.minimum(j, last).astype(np.int64).ravel() - first_cell
    for row, weights in zip(sums, (p, p * u, p * (u * u + variance)), strict=True):
        row += np.bincount(cells, weights.ravel(), row.size)


def hull(
    x: Floats,
    pitch: Floats,
    ranges: Floats,
    bounds: Floats,
    height_m: float,
    width_m: float,
    first_cell: int,
    low: Floats,
    high: Floats,
) -> None:
    """Equation (3) without its remainder, and the hull of every cell that it meets, into low, high [m]."""
    c, s = np.cos(pitch), np.sin(pitch)
    ahead, up = ranges * c, ranges * s
    X, Z = x + ahead, height_m + up
    dX = bounds[0] + np.abs(c) * bounds[2] + np.abs(up) * bounds[1]
    dZ = np.abs(s) * bounds[2] + np.abs(ahead) * bounds[1]
    first = np.floor((X - dX) / width_m + 0.5).astype(np.int64) - first_cell
    last = np.floor((X + dX) / width_m + 0.5).astype(np.int64) - first_cell
    for k in range(int(np.max(last - first)) + 1):
        cells = np.minimum(first + k, last)  # the last cell again: a hull taken twice changes nothing
        np.minimum.at(low, cells, Z - dZ)
        np.maximum.at(high, cells, Z + dZ)
