"""The gated Kalman map in the plane (Kleiner and Dornhege; BASELINES 4): an elevation and its variance for every cell.

A point's elevation, with the variance P_zz, corrects the one cell that the point's mean lies in. Within the gate the
two are fused; beyond it a higher point replaces the cell's elevation and a lower one is passed over (equation 10).
"""

import numpy as np
from numpy.typing import NDArray

from bench.baselines.gaussian_points import (
    N_CENTRE,
    N_P,
    N_SIZE,
    N_SPREADS,
    Q_SIZE,
    THREE_SIGMA,
    W_GAUSS,
    point_block,
    prepare_gaussian,
)
from bench.baselines.tiled_layers import TiledLayers
from drivers.compiled import compiled, compiled_without_heap
from drivers.config import LaserConfig
from drivers.samples import Scan
from mapper import footprints, kernel
from mapper.beam_order import BY_BEAM, BY_DIRECTION, BY_ORDER, BY_POSE, BeamOrder, put_in_order
from mapper.bound_arrays import Bound, bind, counts, floats, integers, singles, words
from mapper.grid import CELL_LIMIT, TILE_CELLS, TILE_SHIFT, TILE_SIDE, tile_key
from mapper.laser_geometry import laser_geometry, usable_range
from mapper.projection import LANES, run_length

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Indices = NDArray[np.int32]

GATE = 3.0
_HEIGHT, _VARIANCE, _TRAVELLED = range(3)
_IN_TILE = TILE_SIDE - 1


@compiled
def fuse(cell: Singles, at: int, z: float, variance: float, travelled_m: float, growth: float, planes: int) -> None:
    """Equation 10 on the cell `at`; `growth` m^2 of variance per metre travelled since the cell was last corrected."""
    h, v = float(cell[_HEIGHT, at]), float(cell[_VARIANCE, at])
    if planes > _TRAVELLED:
        v += growth * (travelled_m - float(cell[_TRAVELLED, at]))
        cell[_TRAVELLED, at] = np.float32(travelled_m)
    off, total = z - h, variance + v
    if not v >= 0.0 or (off > 0.0 and off * off >= GATE * GATE * total):  # NaN: nothing yet
        h, v = z, variance
    elif off * off < GATE * GATE * total:
        h, v = (variance * h + v * z) / total, variance * v / total
    cell[_HEIGHT, at], cell[_VARIANCE, at] = np.float32(h), np.float32(v)


A_SETTINGS, A_GEOMETRY, A_POSES, A_NARROW, A_WORK, A_POINTS, A_SPREADS = range(7)
A_NUMBERS, A_TABLE, A_KEYS, A_POOL = range(7, 11)


@compiled_without_heap
def fuse_beams(
    ranges: Floats, means: Floats, covariances: Floats, travelled_m: float, order: Bound, arrays: Bound
) -> None:
    """One scan into the map. Arrays are bound, as the mapper's kernel has them."""
    beams, directions = floats(order, BY_BEAM).reshape(3, -1), singles(order, BY_DIRECTION).reshape(2, -1)
    pose_index, settings, geometry = integers(order, BY_POSE), floats(arrays, A_SETTINGS), floats(arrays, A_GEOMETRY)
    bound_sigmas, resolution_m, growth = settings[0], settings[1], settings[2]
    poses, narrow = floats(arrays, A_POSES).reshape(-1, Q_SIZE), singles(arrays, A_NARROW).reshape(-1, Q_SIZE)
    work, points = floats(arrays, A_WORK).reshape(W_GAUSS, 6), floats(arrays, A_POINTS)
    spreads, numbers = singles(arrays, A_SPREADS), counts(arrays, A_NUMBERS)
    table, keys = integers(arrays, A_TABLE), words(arrays, A_KEYS)
    pool, ordered = singles(arrays, A_POOL).reshape(keys.size, -1, TILE_CELLS), beams[2]
    put_in_order(ranges, integers(order, BY_ORDER), ordered)
    for m in range(means.shape[0]):
        prepare_gaussian(means[m], covariances[m], geometry, bound_sigmas, work, poses[m], narrow[m])
    inverse, limit = 1.0 / resolution_m, float(CELL_LIMIT)
    last_key, last_tile = np.uint64(0), np.int64(-1)
    first = 0
    while first < ranges.size:
        m, count = pose_index[first], run_length(first, pose_index)
        if m < 0 or m >= means.shape[0]:
            numbers[footprints.NO_POSE] += count
        else:
            point_block(poses[m], narrow[m], geometry, first, count, beams, directions, points, spreads)
            for n in range(count):
                x, y = points[N_CENTRE + n] * inverse, points[N_CENTRE + LANES + n] * inverse
                if not usable_range(ordered[first + n], geometry):
                    numbers[footprints.NO_RANGE] += 1
                elif not (abs(x) < limit and abs(y) < limit):
                    numbers[footprints.TOO_FAR] += 1
                else:
                    i, j = int(np.floor(x)), int(np.floor(y))
                    key = tile_key(i >> TILE_SHIFT, j >> TILE_SHIFT)
                    tile = last_tile
                    if last_tile < 0 or key != last_key:
                        tile = kernel.tile_at(key, numbers, table, keys)
                    if tile < 0:
                        numbers[footprints.BEYOND_CAP] += 1
                    else:
                        last_key, last_tile = key, tile
                        z, variance = points[N_CENTRE + 2 * LANES + n], float(spreads[N_P + 5 * LANES + n])
                        at = (j & _IN_TILE) * TILE_SIDE + (i & _IN_TILE)
                        fuse(pool[tile], at, z, variance, travelled_m, growth, pool.shape[1])
                        numbers[footprints.USED] += 1
        first += count


class KalmanMap:
    """Elevation and variance for every cell, and where asked for, how far the robot had gone when it was corrected."""

    def __init__(
        self,
        resolution_m: float,
        laser: LaserConfig,
        bound_sigmas: float = THREE_SIGMA,
        growth_m2_per_m: float = 0.0,
        tiles: int = 128,
    ) -> None:
        """`growth_m2_per_m`: what odometry adds to a cell's variance per metre travelled; 0 leaves it out."""
        self.resolution_m = resolution_m
        self.layers = TiledLayers(3 if growth_m2_per_m > 0.0 else 2, np.nan, tiles)
        self.travelled_m = 0.0
        self._growth = growth_m2_per_m
        self._geometry = laser_geometry(laser)
        self._order = BeamOrder()
        self._poses, self._narrow = np.empty((64, Q_SIZE)), np.empty((64, Q_SIZE), np.float32)
        self._work, self._spreads = np.empty((W_GAUSS, 6)), np.zeros(N_SPREADS, np.float32)
        self._points, self._settings = np.zeros(N_SIZE), np.array([bound_sigmas, resolution_m, growth_m2_per_m])
        layers = self.layers
        self._bound = bind(
            *(self._settings, self._geometry, self._poses, self._narrow, self._work, self._points, self._spreads),
            *(layers.numbers, layers.table, layers.keys, layers.pool),
        )

    @property
    def bytes_a_cell(self) -> int:
        """8, or 12 where the variance grows with the distance travelled."""
        return 4 * self.layers.planes

    def insert(self, scan: Scan, mean: Floats, covariance: Floats, pose_index: Indices) -> None:
        """Take a scan in whose beam i was shot from N(mean, covariance)[pose_index[i]]; set `travelled_m` before."""
        order = self._order
        order.arrange(scan, pose_index)
        fuse_beams(scan.ranges_m, mean, covariance, self.travelled_m, order.bound, self._bound)

    def estimate(self) -> tuple[Floats, Floats, tuple[int, int]]:
        """Elevation and standard deviation [ny, nx] (NaN where nothing was seen), number of the first cell."""
        layers, first = self.layers.dense()
        height, variance = layers[:2].astype(np.float64)
        if self._growth > 0.0:
            variance = variance + self._growth * (self.travelled_m - layers[_TRAVELLED])
        return height, np.sqrt(variance), first
