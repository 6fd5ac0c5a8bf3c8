"""The mixture map of Miller and Campbell (J. Field Robotics 23, 2006) over one horizontal dimension.

Errors of place, pitch and range are independent and Gaussian. Each measurement goes into every cell within three sigma
with the probability that it belongs there; a cell is a mixture of Gaussians, kept as three running sums. Equations
(5) to (9) of our reference. One Φ for each border between two such cells: what (6) has beyond three sigma goes to the
outermost cell, so the outer borders need none (p is off by less than 0.00135, and sums to one).
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from bench.baselines.beam_1d import LANES, Scratch, end_of_beam
from bench.baselines.normal_table import normal_cdf
from drivers.compiled import compiled, compiled_unlocked
from mapper.fused import fused

Floats = NDArray[np.float64]
Cells = NDArray[np.float32]
SUMS = 3
OBSERVED = 0.5
"""A cell counts as observed from this much probability on."""
PLACE = 0  # X
ELEVATION = LANES  # Z
PER_SD = 2 * LANES
GAIN = 3 * LANES
VARIANCE = 4 * LANES


@compiled_unlocked
def insert_mixture(
    x: Floats,
    pitch: Floats,
    ranges: Floats,
    sigma: Floats,
    height_m: float,
    width_m: float,
    first_cell: int,
    cells: Cells,
    scratch: Scratch,
) -> None:
    """Take measurements: x [m], pitch [rad], ranges [m], all [n]; sigma [3] of x, pitch, range.

    cells [m, 3]: S0, S1, S2 of cell first_cell + i, centre (first_cell + i) * width_m. Elevations count from the ground
    where the drive began: the local datum that keeps (9) from cancelling.
    A measurement that may lie outside the cells is left out.
    """
    for first in range(0, x.size, LANES):
        count = min(LANES, x.size - first)
        _spread_block(first, count, x, pitch, ranges, sigma, height_m, 1.0 / width_m, scratch.rows, scratch.cells)
        _add_block(count, width_m, first_cell, scratch.rows, scratch.cells, cells)


@compiled
def _spread_block(
    first: int,
    count: int,
    x: Floats,
    pitch: Floats,
    ranges: Floats,
    sigma: Floats,
    height_m: float,
    per_m: float,
    rows: Floats,
    spans: NDArray[np.int32],
) -> None:
    """Points, covariances (5), what (7) needs of them, and the cells within three sigma."""
    var_x, var_pitch, var_range = sigma[0] * sigma[0], sigma[1] * sigma[1], sigma[2] * sigma[2]
    x, pitch, ranges = x[first : first + count], pitch[first : first + count], ranges[first : first + count]
    for n in range(count):
        r = ranges[n]
        ahead, up, c, s = end_of_beam(pitch[n], r)
        X = x[n] + ahead
        Pxx = fused(c * c, var_range, fused(up * up, var_pitch, var_x))
        Pxz = c * s * fused(-r * r, var_pitch, var_range)
        Pzz = fused(s * s, var_range, ahead * ahead * var_pitch)
        sd = sqrt(Pxx)
        gain = Pxz / Pxx
        rows[PLACE + n], rows[ELEVATION + n] = X, height_m + up
        rows[PER_SD + n], rows[GAIN + n], rows[VARIANCE + n] = 1.0 / sd, gain, Pzz - gain * Pxz
        spans[n] = np.int32(np.floor(fused(X - 3.0 * sd, per_m, 0.5)))
        spans[LANES + n] = np.int32(np.floor(fused(X + 3.0 * sd, per_m, 0.5)))


@compiled
def _add_block(
    count: int, width_m: float, first_cell: int, rows: Floats, spans: NDArray[np.int32], cells: Cells
) -> None:
    """Each measurement into its cells, by its probability: (6) and (8)."""
    size = np.uint64(len(cells))
    for n in range(count):
        gain, per_sd, variance = rows[GAIN + n], rows[PER_SD + n], rows[VARIANCE + n]
        away = spans[n] * width_m - rows[PLACE + n]  # of the cell's centre
        u, u_step = rows[ELEVATION + n] + gain * away, gain * width_m
        border, border_step = (away - 0.5 * width_m) * per_sd, width_m * per_sd
        below = normal_cdf(border)
        i, last = np.uint64(spans[n] - first_cell), np.uint64(spans[LANES + n] - first_cell)
        while i <= last < size:
            border += border_step
            up_to = normal_cdf(border)
            p, below = up_to - below, up_to
            cell = cells[i]
            cell[0] += np.float32(p)
            cell[1] += np.float32(p * u)
            cell[2] += np.float32(p * fused(u, u, variance))
            u += u_step
            i += np.uint64(1)


def mixture_moments(cells: Cells) -> tuple[Floats, Floats]:
    """Mean and standard deviation of the elevation, each [m]; NaN where S0 <= 0.5. Equation (9)."""
    S0, S1, S2 = cells.astype(np.float64).T
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(S0 > OBSERVED, S1 / S0, np.nan)
        return mean, np.sqrt(np.maximum(S2 / S0 - mean * mean, 0.0))
