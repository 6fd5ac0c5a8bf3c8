"""The surface that the robot's body rides on: the terrain's top, low-passed over the tracks, twice differentiable."""

from dataclasses import dataclass
from math import floor

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from simulator.terrain import Terrain, smoothed

Array = NDArray[np.float64]

SURFACE_STEP_M = 0.05
LEAST_STEPS = 13
"""... or so many to a track, where that is coarser."""


@dataclass(frozen=True, slots=True, eq=False)
class BodySurface:
    """A cubic B-spline S(x, y): coefficients [ny, nx] on a grid of `step_m` from (x0_m, y0_m). Twice differentiable."""

    coefficients: Array
    x0_m: float
    y0_m: float
    step_m: float

    def height(self, x: float, y: float) -> float:
        """S(x, y)."""
        return float(surface_at(self.coefficients, self.x0_m, self.y0_m, self.step_m, x, y)[0])


def body_surface(track_length_m: float, terrain: Terrain) -> BodySurface:
    """The terrain's top, low-passed over the tracks' footprint."""
    ny, nx = terrain.heights.shape
    course = terrain.course
    reach = course.reach_m
    low_x = max(terrain.x0_m, course.x_m - reach)
    low_y = max(terrain.y0_m, course.y_m - reach)
    high_x = min(terrain.x0_m + (nx - 1) * terrain.cell_m, course.x_m + reach)
    high_y = min(terrain.y0_m + (ny - 1) * terrain.cell_m, course.y_m + reach)
    step = max(SURFACE_STEP_M, track_length_m / LEAST_STEPS)
    x, y = np.arange(low_x, high_x, step), np.arange(low_y, high_y, step)
    top = terrain.height(*np.meshgrid(x, y))
    return BodySurface(smoothed(top, track_length_m / 3.0 / step), float(x[0]), float(y[0]), step)


@compiled
def surface_at(
    c: Array, x0: float, y0: float, step: float, x: float, y: float
) -> tuple[float, float, float, float, float, float]:
    """S, dS/dx, dS/dy, d2S/dx2, d2S/dxdy, d2S/dy2 of the cubic B-spline."""
    u = (x - x0) / step
    w = (y - y0) / step
    ix = min(max(floor(u), 1), c.shape[1] - 3)
    iy = min(max(floor(w), 1), c.shape[0] - 3)
    u -= ix
    w -= iy
    bx = ((1 - u) ** 3 / 6, (3 * u**3 - 6 * u**2 + 4) / 6, (-3 * u**3 + 3 * u**2 + 3 * u + 1) / 6, u**3 / 6)
    by = ((1 - w) ** 3 / 6, (3 * w**3 - 6 * w**2 + 4) / 6, (-3 * w**3 + 3 * w**2 + 3 * w + 1) / 6, w**3 / 6)
    dbx = (-((1 - u) ** 2) / 2, (3 * u**2 - 4 * u) / 2, (-3 * u**2 + 2 * u + 1) / 2, u**2 / 2)
    dby = (-((1 - w) ** 2) / 2, (3 * w**2 - 4 * w) / 2, (-3 * w**2 + 2 * w + 1) / 2, w**2 / 2)
    ddbx = (1 - u, 3 * u - 2, 1 - 3 * u, u)
    ddby = (1 - w, 3 * w - 2, 1 - 3 * w, w)
    s, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(4):
        row, d_row, dd_row = 0.0, 0.0, 0.0
        for j in range(4):
            value = c[iy - 1 + i, ix - 1 + j]
            row += bx[j] * value
            d_row += dbx[j] * value
            dd_row += ddbx[j] * value
        s += by[i] * row
        sx += by[i] * d_row
        sy += dby[i] * row
        sxx += by[i] * dd_row
        sxy += dby[i] * d_row
        syy += ddby[i] * row
    return s, sx / step, sy / step, sxx / step**2, sxy / step**2, syy / step**2
