"""Every map of the comparison, on one drive along the profile: the same readings in, an estimate with bounds out."""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from bench.baselines import gaussian_mixture_1d, guaranteed_1d, kalman_1d, paper_set_valued_1d
from bench.baselines.beam_1d import new_scratch
from bench.paper.profile_drive import CELL_COUNT, CELL_M, FIRST_CELL, HEIGHT_M, PITCH_RAD, STEP_M, Drive
from drivers.config import LaserConfig
from drivers.samples import Scan, Stamp
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap

Floats = NDArray[np.float64]
ODOMETRY_VARIANCE_PER_M = 0.05**2
"""m^2: 5 cm after a metre. Our choice, made before the runs; the text at hand gives none."""
SCRATCH = new_scratch()


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """What the sensors say, in the order of the drive. All [n]."""

    x_m: Floats
    pitch_rad: Floats
    ranges_m: Floats

    @property
    def columns(self) -> tuple[Floats, Floats, Floats]:
        """As the maps take them."""
        return self.x_m, self.pitch_rad, self.ranges_m

    def at(self, places: NDArray[np.int64]) -> "Readings":
        """The readings of these places, in this order."""
        return Readings(*(column[places] for column in self.columns))


def read(drive: Drive, errors: Floats) -> Readings:
    """The true drive with errors [n, 3] of place, pitch and range added."""
    return Readings(drive.x_m + errors[:, 0], PITCH_RAD + errors[:, 1], drive.ranges_m + errors[:, 2])


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What a map says of each cell; NaN where it says nothing. All [CELL_COUNT]."""

    mean: Floats
    low: Floats
    high: Floats
    certified: NDArray[np.bool_] | None = None
    """Cells that were surely hit, if the map can tell."""


Method = Callable[[Readings, Floats], Estimate]
"""(readings, declared bounds [3]) to what the map says."""
GRID = (HEIGHT_M, CELL_M, FIRST_CELL)


def mixture(readings: Readings, sigma: Floats) -> Estimate:
    """Gaussian mixture, bound at three sigma."""
    cells = np.zeros((CELL_COUNT, gaussian_mixture_1d.SUMS), np.float32)
    gaussian_mixture_1d.insert_mixture(*readings.columns, sigma, *GRID, cells, SCRATCH)
    return _around(*gaussian_mixture_1d.mixture_moments(cells))


def kalman(readings: Readings, sigma: Floats, growth_per_m: float) -> Estimate:
    """Gated Kalman map, bound at three sigma."""
    cells = kalman_1d.unseen_cells(CELL_COUNT)
    kalman_1d.insert_kalman(*readings.columns, sigma, *GRID, cells, STEP_M, growth_per_m, SCRATCH)
    return _around(*kalman_1d.kalman_moments(cells))


def literal(readings: Readings, bounds: Floats, form: int) -> Estimate:
    """The paper's set-valued map as written."""
    cells = paper_set_valued_1d.unseen_cells(CELL_COUNT)
    paper_set_valued_1d.insert_set_valued(*readings.columns, bounds, *GRID, cells, form, SCRATCH)
    return _between(*paper_set_valued_1d.ends(cells))


def intersecting(readings: Readings, bounds: Floats, rule: int) -> Estimate:
    """What intersection in the place of the hull would give."""
    cells, levels = paper_set_valued_1d.unseen_cells(CELL_COUNT), np.zeros(CELL_COUNT, np.bool_)
    paper_set_valued_1d.insert_intersecting(*readings.columns, bounds, *GRID, cells, levels, rule, SCRATCH)
    return _between(*paper_set_valued_1d.ends(cells))


def guaranteed(readings: Readings, bounds: Floats) -> Estimate:
    """Ours."""
    cells, certified = guaranteed_1d.unseen_cells(CELL_COUNT), np.zeros(CELL_COUNT, np.bool_)
    guaranteed_1d.insert_guaranteed(*readings.columns, bounds, *GRID, cells, certified, STEP_M, SCRATCH)
    return _between(*guaranteed_1d.ends(cells), certified)


def mapper_in_the_plane(readings: Readings, bounds: Floats) -> Estimate:
    """The mapper that drives on the robot, on the same readings: a pose box in space for each, all in one row of cells.

    A cell of the mapper begins at a whole number of metres, one of the profile half a metre before; so x is moved.
    """
    count, half = readings.x_m.size, 0.5 * CELL_M
    laser = LaserConfig(
        port="none", latency_ms=(0.0, 1.0), range_bound_m=float(bounds[2]), angle_bound_deg=0.0, range_max_m=80.0,
        mount_x_m=0.0, mount_y_m=0.0, mount_z_m=0.0, mount_pitch_deg=0.0,
        mount_position_bound_m=0.0, mount_angle_bound_deg=0.0,
    )  # fmt: skip
    zeros = np.zeros(count)
    middle = np.stack((readings.x_m + half, zeros + half, zeros + HEIGHT_M, zeros, -readings.pitch_rad, zeros), axis=1)
    reach = np.array([bounds[0], 0.0, 0.0, 0.0, bounds[1], 0.0])
    low, high = middle - reach, middle + reach
    scan = Scan(Stamp(0, 0), np.zeros(count, np.int64), 0.0, 0.0, readings.ranges_m, 0)
    grid = ElevationMap(MapConfig(resolution_m=CELL_M, max_tiles=64, max_footprint_m=10.0), laser)
    grid.insert(scan, low, high, np.arange(count, dtype=np.int32))
    cell_low, cell_high = np.full((2, CELL_COUNT), np.nan)
    for tile in grid.tiles():
        row = tile.low.shape[0]
        places = tile.ix * row + np.arange(row) - FIRST_CELL
        inside = (places >= 0) & (places < CELL_COUNT)
        if tile.iy == 0:
            cell_low[places[inside]], cell_high[places[inside]] = tile.low[0][inside], tile.high[0][inside]
    return _between(cell_low, cell_high)


METHODS: dict[str, Method] = {
    "mixture, sigma = b/3": lambda readings, bounds: mixture(readings, bounds / 3.0),
    "mixture, sigma = b/sqrt 3": lambda readings, bounds: mixture(readings, bounds / sqrt(3.0)),
    "Kalman, sigma = b/3": lambda readings, bounds: kalman(readings, bounds / 3.0, 0.0),
    "Kalman, sigma = b/sqrt 3": lambda readings, bounds: kalman(readings, bounds / sqrt(3.0), 0.0),
    "Kalman, b/3, inflated": lambda readings, bounds: kalman(readings, bounds / 3.0, ODOMETRY_VARIANCE_PER_M),
    "paper, first order": lambda readings, bounds: literal(readings, bounds, paper_set_valued_1d.FIRST_ORDER),
    "paper, natural": lambda readings, bounds: literal(readings, bounds, paper_set_valued_1d.NATURAL),
    "ours": guaranteed,
    "intersection": lambda readings, bounds: intersecting(readings, bounds, paper_set_valued_1d.INTERSECT),
    "intersection until empty": lambda readings, bounds: intersecting(
        readings, bounds, paper_set_valued_1d.INTERSECT_UNTIL_EMPTY
    ),
}


def _around(mean: Floats, sd: Floats) -> Estimate:
    return Estimate(mean, mean - 3.0 * sd, mean + 3.0 * sd)


def _between(low: Floats, high: Floats, certified: NDArray[np.bool_] | None = None) -> Estimate:
    return Estimate(0.5 * (low + high), low, high, certified)
