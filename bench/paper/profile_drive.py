"""The paper's simulation: a robot drives along a profile of flats, a slope, a ditch and a wall, one beam ahead of it.

Lengths are the paper's. The heights are our assumption (0.6 m, 0.3 m, -1 m, 1 m): the text at hand does not give them.
Nothing of what is measured here is used to make the truth.
"""

import itertools
from dataclasses import dataclass
from math import cos, radians, tan

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Cells = NDArray[np.int64]

SPEED_MPS, RATE_HZ = 5.0, 75.0
STEP_M = SPEED_MPS / RATE_HZ
HEIGHT_M, PITCH_RAD = 1.5, radians(-5.0)
BOUNDS = np.array([0.6, radians(0.5), 0.1])
"""Of the errors of place [m], pitch [rad] and range [m]."""
CELL_M = 1.0
START_M, END_M = -25.0, 185.0
"""The robot's first and last place."""
FIRST_CELL, CELL_COUNT = -15, 225
CENTRES_M = (FIRST_CELL + np.arange(CELL_COUNT)) * CELL_M

SLOPE_M, DITCH_M, WALL_M = (40.5, 45.5), (150.5, 155.5), 170.5
EDGES_M = (*SLOPE_M, 70.5, 100.5, *DITCH_M, WALL_M)
_CORNERS = np.array(
    [(-60.0, 0.0), (40.5, 0.0), (45.5, 0.6), (70.5, 0.6), (70.5, 0.3), (100.5, 0.3), (100.5, 0.0), (150.5, 0.0),
     (150.5, -1.0), (155.5, -1.0), (155.5, 0.0), (170.5, 0.0), (170.5, 1.0), (260.0, 1.0)]
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Where the robot truly was, and what its beam truly hit. All [n]."""

    x_m: Floats
    ranges_m: Floats
    hit_x_m: Floats
    hit_z_m: Floats

    @property
    def hit_cells(self) -> Cells:
        """[n] number of the cell, from FIRST_CELL on, that holds the point that was hit."""
        return np.floor(self.hit_x_m / CELL_M + 0.5).astype(np.int64) - FIRST_CELL


def profile(scale: float = 1.0) -> Floats:
    """[k, 2] corners x, z of the ground, its heights multiplied."""
    corners: Floats = _CORNERS * np.array([1.0, scale])
    return corners


def true_elevations(scale: float = 1.0) -> Floats:
    """[CELL_COUNT] elevation in the middle of each cell (no middle lies on a vertical face)."""
    elevations: Floats = np.interp(CENTRES_M, *profile(scale).T)
    return elevations


def drive(phase: float, scale: float = 1.0) -> Drive:
    """One run along the profile; `phase` in [0, 1): where between two measurements it begins."""
    x = np.arange(START_M + phase * STEP_M, END_M, STEP_M)
    hit_x, hit_z = cast(x, profile(scale))
    return Drive(x, (hit_x - x) / cos(PITCH_RAD), hit_x, hit_z)


def cast(x: Floats, corners: Floats) -> tuple[Floats, Floats]:
    """Where beams from x [n], at HEIGHT_M and PITCH_RAD, first meet the ground: x, z, each [n]."""
    fall, best_x, best_z = tan(PITCH_RAD), np.full(x.size, np.inf), np.full(x.size, np.nan)
    for (x0, z0), (x1, z1) in itertools.pairwise(corners):
        if x0 == x1:
            hit_x, hit_z = np.full(x.size, x0), HEIGHT_M + (x0 - x) * fall
            met = (min(z0, z1) <= hit_z) & (hit_z <= max(z0, z1))
        else:
            rise = (z1 - z0) / (x1 - x0)
            hit_x = (HEIGHT_M - fall * x - z0 + rise * x0) / (rise - fall)
            hit_z = z0 + rise * (hit_x - x0)
            met = (x0 <= hit_x) & (hit_x < x1)
        met &= (hit_x > x) & (hit_x < best_x)
        best_x, best_z = np.where(met, hit_x, best_x), np.where(met, hit_z, best_z)
    return best_x, best_z


def flat_cells() -> NDArray[np.bool_]:
    """[CELL_COUNT] level ground more than two cells from every edge."""
    away = np.min(np.abs(CENTRES_M[:, None] - np.array(EDGES_M)), axis=1)
    slope = np.abs(CENTRES_M - np.mean(SLOPE_M)) < 0.5 * np.ptp(SLOPE_M)
    flat: NDArray[np.bool_] = (away > 2.0 * CELL_M) & ~slope
    return flat
