"""The gated Kalman map of Kleiner and Dornhege (J. Field Robotics 24, 2007) over one horizontal dimension.

Each measurement goes into the nearest cell alone. Inside the gate of three sigma it is fused, above it replaces, below
it is dropped: equation (10) of our reference, which is a reconstruction from the stated model. Where the odometry is to
inflate the map, every cell's variance grows with the way driven.
"""

import numpy as np
from numpy.typing import NDArray

from bench.baselines.beam_1d import LANES, Scratch, end_of_beam
from drivers.compiled import compiled, compiled_unlocked
from mapper.fused import fused

Floats = NDArray[np.float64]
Cells = NDArray[np.float32]
GATE_SQUARED = 9.0
UNSEEN = np.float32(-1.0)
"""In place of a variance."""
ELEVATION = 0  # Z
VARIANCE = LANES  # R


def unseen_cells(count: int) -> Cells:
    """[count, 3] elevation, variance, and the way driven when the cell was last touched [m]."""
    return np.tile(np.array([0.0, UNSEEN, 0.0], np.float32), (count, 1))


@compiled_unlocked
def insert_kalman(
    x: Floats,
    pitch: Floats,
    ranges: Floats,
    sigma: Floats,
    height_m: float,
    width_m: float,
    first_cell: int,
    cells: Cells,
    step_m: float,
    growth_per_m: float,
    scratch: Scratch,
) -> None:
    """Take measurements: x [m], pitch [rad], ranges [m], all [n]; sigma [3] of x, pitch, range.

    cells [m, 3] as unseen_cells makes them. growth_per_m: by so much (m^2) each cell's variance grows with a metre
    driven, `step_m` a measurement; added when the cell is touched. 0: no inflation. What lies outside
    the cells is left out.
    """
    per_m, var_pitch, var_range = 1.0 / width_m, sigma[1] * sigma[1], sigma[2] * sigma[2]
    size = np.uint64(len(cells))
    for first in range(0, x.size, LANES):
        count = min(LANES, x.size - first)
        _place_block(first, count, x, pitch, ranges, var_pitch, var_range, height_m, per_m, scratch.rows, scratch.cells)
        for n in range(count):
            i = np.uint64(scratch.cells[n] - first_cell)
            if i >= size:
                continue
            cell = cells[i]
            Z, R, v = scratch.rows[ELEVATION + n], scratch.rows[VARIANCE + n], float(cell[1])
            if growth_per_m > 0.0:
                way = (first + n) * step_m
                v = v if v < 0.0 else v + growth_per_m * (way - cell[2])
                cell[2] = np.float32(way)
            _fuse(cell, Z, R, v)


@compiled
def _place_block(
    first: int,
    count: int,
    x: Floats,
    pitch: Floats,
    ranges: Floats,
    var_pitch: float,
    var_range: float,
    height_m: float,
    per_m: float,
    rows: Floats,
    nearest: NDArray[np.int32],
) -> None:
    """Elevation and its variance (5), and the nearest cell."""
    x, pitch, ranges = x[first : first + count], pitch[first : first + count], ranges[first : first + count]
    for n in range(count):
        ahead, up, _, s = end_of_beam(pitch[n], ranges[n])
        rows[ELEVATION + n] = height_m + up
        rows[VARIANCE + n] = fused(s * s, var_range, ahead * ahead * var_pitch)
        nearest[n] = np.int32(np.floor(fused(x[n] + ahead, per_m, 0.5)))


@compiled
def _fuse(cell: Cells, Z: float, R: float, v: float) -> None:
    """Equation (10) on one cell whose variance has grown to v."""
    away, spread = Z - cell[0], v + R
    if v < 0.0 or (away > 0.0 and away * away >= GATE_SQUARED * spread):
        cell[0], cell[1] = np.float32(Z), np.float32(R)
    elif away * away < GATE_SQUARED * spread:
        gain = v / spread
        cell[0] += np.float32(gain * away)
        cell[1] = np.float32(gain * R)
    else:
        cell[1] = np.float32(v)


def kalman_moments(cells: Cells) -> tuple[Floats, Floats]:
    """Mean and standard deviation of the elevation, each [m]; NaN where nothing was measured."""
    elevation, variance = cells[:, 0].astype(np.float64), cells[:, 1].astype(np.float64)
    seen = variance >= 0.0
    return np.where(seen, elevation, np.nan), np.sqrt(np.where(seen, variance, np.nan))
