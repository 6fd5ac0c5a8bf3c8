"""Step, slope and roughness of each cell as intervals, and what they mean for a robot of given limits.

All three speak of measured points alone: a cell bounds the points in it that were hit, nothing else. Each quantity is
a maximum over pairs (or a range over all) of the measured points in a neighbourhood of the cell; its upper bound holds
for all of them, its lower bound is reached by two that certainly exist, as they are of cells that were surely hit.
docs/traversability.md says what is promised.

    step        largest difference of elevation between a point of the cell and one of it or its eight neighbours
    slope       largest |dz| / horizontal distance between points of opposite ends of a baseline across the cell,
                in four directions
    roughness   range (largest minus smallest) of the heights above the plane that fits the middles of the window best
                (a level one, where the cells that were seen stand in one line)
"""

from dataclasses import dataclass
from enum import IntEnum
from math import isfinite, tan
from math import radians as to_radians

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_unlocked
from mapper.footprints import round_up
from mapper.saved_map import SavedMap

Layer = NDArray[np.float32]
Flags = NDArray[np.bool_]
Verdicts = NDArray[np.uint8]

_NAN = np.float32(np.nan)
_PAD = 2.0**-40
"""Per metre of what is added up: a thousand roundings of float64."""
_DIRECTIONS = np.array([[1, 0], [0, 1], [1, 1], [1, -1]])


class Verdict(IntEnum):
    """What a robot of given limits may think of a cell."""

    UNKNOWN = 0
    PASSABLE = 1
    """Every cell of the neighbourhood was surely hit, and no measured points in it exceed a limit."""
    IMPASSABLE = 2
    """There are measured points that exceed a limit."""


@dataclass(frozen=True, slots=True)
class RobotLimits:
    """What a robot can take."""

    max_step_m: float
    max_slope_deg: float
    max_roughness_m: float
    length_m: float
    """Of its tracks on the ground: baseline of slopes, side of the window of roughness."""

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise ValueError(f"{name} must be a positive number, not {value}")
        if self.max_slope_deg >= 90:
            raise ValueError(f"max_slope_deg must be below 90, not {self.max_slope_deg}")


@dataclass(frozen=True, slots=True, eq=False)
class Traversability:
    """Layers [ny, nx] as those of the map; NaN where nothing is known of the cell."""

    step_low: Layer
    """metres"""
    step_high: Layer
    slope_low: Layer
    """metres per metre; NaN also where no baseline has both ends seen"""
    slope_high: Layer
    roughness_low: Layer
    """metres"""
    roughness_high: Layer
    verdict: Verdicts


def assess(saved: SavedMap, limits: RobotLimits) -> Traversability:
    """Bounds and verdict of every cell. About 1.7 us a cell at a window of 13 x 13."""
    sure = np.zeros(saved.low.shape, np.bool_) if saved.surely_hit is None else saved.surely_hit
    reach = reach_of(limits, saved.resolution_m)
    layers = np.full((6, *saved.low.shape), _NAN, np.float32)
    verdict = np.zeros(saved.low.shape, np.uint8)
    # tan errs by less than the margin that both verdicts keep from a limit.
    slope = tan(to_radians(limits.max_slope_deg))
    _assess(
        np.ascontiguousarray(saved.low),
        np.ascontiguousarray(saved.high),
        np.ascontiguousarray(sure),
        saved.resolution_m,
        reach,
        np.array([limits.max_step_m, slope, limits.max_roughness_m]),
        layers,
        verdict,
    )
    step_low, step_high, slope_low, slope_high, roughness_low, roughness_high = layers
    return Traversability(step_low, step_high, slope_low, slope_high, roughness_low, roughness_high, verdict)


def reach_of(limits: RobotLimits, resolution_m: float) -> int:
    """Cells from a cell to the ends of its baseline and to the edge of its window."""
    return max(1, round(limits.length_m / (2 * resolution_m)))


@compiled_unlocked
def _assess(
    low: Layer,
    high: Layer,
    sure: Flags,
    cell_m: float,
    reach: int,
    limits: NDArray[np.float64],
    layers: Layer,
    verdict: Verdicts,
) -> None:
    """Fill layers [6, ny, nx] and verdict [ny, nx]; limits: step, slope, roughness."""
    rows, columns = low.shape
    for row in range(rows):
        for col in range(columns):
            if np.isnan(low[row, col]):
                continue
            step = _step(low, high, sure, row, col)
            slope = _slope(low, high, sure, row, col, reach, cell_m)
            rough = _roughness(low, high, sure, row, col, reach, cell_m)
            certain = step[2] and slope[2] and rough[2]
            within, beyond = True, False
            for k, (least, most) in enumerate(((step[0], step[1]), (slope[0], slope[1]), (rough[0], rough[1]))):
                if most < np.inf:
                    # Zero is a lower bound by itself: differences have no sign here.
                    layers[2 * k, row, col] = max(-round_up(-least), np.float32(0.0))
                    layers[2 * k + 1, row, col] = round_up(most)
                within &= most <= limits[k] * (1.0 - _PAD)
                beyond |= least > limits[k] * (1.0 + _PAD)
            if beyond:
                verdict[row, col] = 2
            elif within and certain:
                verdict[row, col] = 1


@compiled
def _step(low: Layer, high: Layer, sure: Flags, row: int, col: int) -> tuple[float, float, bool]:
    """(least, most, was every cell surely hit) among the cell and its neighbours; float32 differences are exact."""
    rows, columns = low.shape
    a, b = np.float64(low[row, col]), np.float64(high[row, col])
    least, most, all_sure = 0.0, b - a, sure[row, col]
    for i in range(row - 1, row + 2):
        for j in range(col - 1, col + 2):
            if not (0 <= i < rows and 0 <= j < columns) or np.isnan(low[i, j]):
                all_sure = False
                continue
            c, d = np.float64(low[i, j]), np.float64(high[i, j])
            most = max(most, d - a, b - c)
            all_sure &= sure[i, j]
            if sure[row, col] and sure[i, j]:
                least = max(least, a - d, c - b)
    return least, most, all_sure


@compiled
def _slope(
    low: Layer, high: Layer, sure: Flags, row: int, col: int, reach: int, cell_m: float
) -> tuple[float, float, bool]:
    """(least, most, were all ends surely hit): two points are 2 reach - 1 to 2 reach + 1 cells apart along an axis."""
    rows, columns = low.shape
    near, far = (2 * reach - 1) * cell_m, (2 * reach + 1) * cell_m
    least, most, all_sure = 0.0, 0.0, True
    seen = False
    for k in range(4):
        i, j = reach * _DIRECTIONS[k, 0], reach * _DIRECTIONS[k, 1]
        if not (
            0 <= row - i < rows
            and 0 <= row + i < rows
            and min(col - j, col + j) >= 0
            and max(col - j, col + j) < columns
        ):
            all_sure = False
            continue
        a, b = np.float64(low[row - i, col - j]), np.float64(high[row - i, col - j])
        c, d = np.float64(low[row + i, col + j]), np.float64(high[row + i, col + j])
        if np.isnan(a) or np.isnan(c):
            all_sure = False
            continue
        seen = True
        both = sure[row - i, col - j] and sure[row + i, col + j]
        all_sure &= both
        shortest = near * (np.sqrt(2.0) if k > 1 else 1.0)
        longest = np.sqrt(far * far + (far * far if k > 1 else cell_m * cell_m))
        most = max(most, max(d - a, b - c) / shortest)
        if both:
            least = max(least, max(a - d, c - b) / longest)
    if not seen:
        return 0.0, np.inf, False
    return least * (1.0 - _PAD), most * (1.0 + _PAD), all_sure


@compiled
def _roughness(
    low: Layer, high: Layer, sure: Flags, row: int, col: int, reach: int, cell_m: float
) -> tuple[float, float, bool]:
    """(least, most, was every cell surely hit) in the window; any plane would be sound, this one is narrow."""
    rows, columns = low.shape
    i0, i1 = max(row - reach, 0), min(row + reach, rows - 1)
    j0, j1 = max(col - reach, 0), min(col + reach, columns - 1)
    all_sure = i1 - i0 == 2 * reach and j1 - j0 == 2 * reach
    datum = np.float64(low[row, col])
    n, sx, sy, sxx, sxy, syy, sz, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            a = np.float64(low[i, j])
            if np.isnan(a):
                continue
            x, y, z = float(j - col), float(i - row), 0.5 * ((a - datum) + (np.float64(high[i, j]) - datum))
            n, sx, sy, sz = n + 1.0, sx + x, sy + y, sz + z
            sxx, sxy, syy, sxz, syz = sxx + x * x, sxy + x * y, syy + y * y, sxz + x * z, syz + y * z
    # About the window's own centre, so that two unknowns remain.
    cx, cy, cz = sx / n, sy / n, sz / n
    vxx, vxy, vyy, vxz, vyz = (
        sxx - n * cx * cx,
        sxy - n * cx * cy,
        syy - n * cy * cy,
        sxz - n * cx * cz,
        syz - n * cy * cz,
    )
    determinant = vxx * vyy - vxy * vxy
    p, q = 0.0, 0.0
    if determinant > 1e-9 * n * n:
        p, q = (vxz * vyy - vyz * vxy) / determinant, (vyz * vxx - vxz * vxy) / determinant
    # Metres per cell; inside a cell the plane varies by half of it each way.
    within_cell = 0.5 * (abs(p) + abs(q))
    top, bottom, sure_top, sure_bottom, largest = -np.inf, np.inf, -np.inf, np.inf, 0.0
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            a, b = np.float64(low[i, j]), np.float64(high[i, j])
            if np.isnan(a):
                all_sure = False
                continue
            plane = cz + p * (j - col - cx) + q * (i - row - cy)
            below, above = (a - datum) - plane, (b - datum) - plane
            largest = max(largest, abs(a - datum), abs(b - datum), abs(plane))
            top, bottom = max(top, above), min(bottom, below)
            all_sure &= sure[i, j]
            if sure[i, j]:
                sure_top, sure_bottom = max(sure_top, below), min(sure_bottom, above)
    pad = 2.0 * within_cell + _PAD * (largest + 2.0 * reach * (abs(p) + abs(q)))
    least = max(sure_top - sure_bottom - pad, 0.0) if sure_top > -np.inf else 0.0
    return least, top - bottom + pad, all_sure
