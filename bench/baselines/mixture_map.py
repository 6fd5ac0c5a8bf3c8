"""The Gaussian mixture map in the plane (Miller and Campbell; BASELINES 3): a distribution of elevation for every cell.

A point N(m, P) is dealt to the cells within three sigma, each with the share of the in-plane normal distribution that
lies in it, and with its elevation given that cell's centre: three running sums a cell, S0, S1, S2.

The share: exact along y, and along x exact for a normal distribution with the mean and variance that x has given the
row (a row of cells: y known to be in it; the variance of y there is taken for at most that of a full row, w^2 / 12).
What that misses is the shape of x given the row. Each border's Phi is evaluated once: those along y for the point,
those along x for each row; only where x and y hardly correlate all rows share them.

Against exact quadrature it puts 1 % of a point's weight into other cells in the mean, 11 % at worst (poses with
correlated errors, 0.8 to 7 m, cells of 5 and 10 cm). Neglecting the correlation saves a quarter of the time, and
misplaces 7 to 17 % in the mean (tests/bench/test_plane_baselines.py).
"""

from typing import Any

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
from bench.baselines.mixture_cells import CELLS_A_STEP, LANES, add_masses, add_normal, masses, normal_borders
from bench.baselines.tiled_layers import TiledLayers
from drivers.compiled import compiled, compiled_without_heap
from drivers.config import LaserConfig
from drivers.samples import Scan
from mapper import footprints, kernel
from mapper.beam_order import BY_BEAM, BY_DIRECTION, BY_ORDER, BY_POSE, STEP, BeamOrder, put_in_order
from mapper.bound_arrays import Bound, bind, counts, floats, integers, singles, words
from mapper.grid import CELL_LIMIT, TILE_CELLS, TILE_SHIFT, TILE_SIDE, tile_key
from mapper.laser_geometry import laser_geometry, usable_range
from mapper.projection import LANES as BEAMS
from mapper.projection import larger, run_length

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Indices = NDArray[np.int32]
F32 = np.float32

CUT = 3.0
"""Standard deviations within which cells are touched."""
OBSERVED = 0.5
"""A cell is called observed when its S0 exceeds this."""
MOST_CELLS = 240
"""Cells along a footprint's side; a wider one is skipped and counted, as in the map's kernel."""
INDEPENDENT = 0.02
"""Below this correlation all rows share the masses along x: they would differ by less than 0.06 sigma."""
_IN_TILE = TILE_SIDE - 1
_PLANE_BYTES = 4 * TILE_CELLS
_BORDERS = MOST_CELLS + 2 * LANES
# Per-beam numbers of a block, rows of BEAMS.
V_ROW_SIGMA = 0  # of y, in cells
V_TURN = BEAMS  # x follows y by this much
V_NARROW = 2 * BEAMS  # 1: no wider than MOST_CELLS
V_SLOPE_X = 3 * BEAMS
V_SLOPE_Y = 4 * BEAMS
V_VARIANCE = 5 * BEAMS  # of z given x and y
V_SCATTER = 6 * BEAMS  # of x given the row, in cells; of x, where that hardly differs
V_PER_SIGMA = 7 * BEAMS
V_PER_SCATTER = 8 * BEAMS
V_APART = 9 * BEAMS  # 1: x and y hardly correlate
V_SIZE = 10 * BEAMS


_SINGLES: Any = F32(0.0), F32(1.0), F32(1e-12), F32(1.0 / 12.0)
_ZERO, _ONE, _TINY, _ROW_VARIANCE = _SINGLES


@compiled
def condition_block(count: int, spreads: Singles, per_m: Any, independent: Any, out: Singles) -> None:
    """What conditioning on the row, and on x and y, makes of each point's covariance (equation 7). All in float32."""
    widest = F32(MOST_CELLS / (2.0 * CUT))
    for n in range((count + STEP - 1) & -STEP):
        xx, xy, yy = spreads[N_P + n], spreads[N_P + BEAMS + n], spreads[N_P + 2 * BEAMS + n]
        xz, yz, zz = spreads[N_P + 3 * BEAMS + n], spreads[N_P + 4 * BEAMS + n], spreads[N_P + 5 * BEAMS + n]
        xx, yy = xx + _TINY, yy + _TINY
        turn = xy / yy
        column = larger(_TINY, xx - turn * xy)
        # P_EN^-1 by its Schur complement.
        slope_x = (xz - turn * yz) / column
        slope_y = yz / yy - turn * slope_x
        apart = xy * xy < independent * independent * xx * yy
        in_row = yy * per_m * per_m
        in_row = in_row if in_row < _ROW_VARIANCE else _ROW_VARIANCE
        sigma = np.sqrt(yy) * per_m
        scatter = np.sqrt(xx * per_m * per_m if apart else column * per_m * per_m + turn * turn * in_row)
        out[V_ROW_SIGMA + n], out[V_PER_SIGMA + n] = sigma, _ONE / sigma
        out[V_SCATTER + n], out[V_PER_SCATTER + n] = scatter, _ONE / scatter
        out[V_TURN + n], out[V_APART + n] = turn, _ONE if apart else _ZERO
        out[V_NARROW + n] = _ONE if (sigma < widest) & (np.sqrt(xx) * per_m < widest) else _ZERO
        out[V_SLOPE_X + n], out[V_SLOPE_Y + n] = slope_x, slope_y
        out[V_VARIANCE + n] = larger(_ZERO, zz - slope_x * xz - slope_y * yz)


@compiled
def mix_block(
    count: int,
    first: int,
    ranges: Floats,
    geometry: Floats,
    resolution_m: float,
    points: Floats,
    given: Singles,
    rows: Singles,
    shares: Singles,
    tiles: Indices,
    numbers: NDArray[np.int64],
    table: Indices,
    keys: NDArray[np.uint64],
    pool: Singles,
) -> None:
    """Deal `count` points to their cells."""
    inverse = 1.0 / resolution_m
    rows_at, shares_at = np.uint64(rows.ctypes.data), np.uint64(shares.ctypes.data)
    base, tile_bytes = np.uint64(pool.ctypes.data), pool.shape[1] * _PLANE_BYTES
    last_key, last_tile = np.uint64(0), np.int64(-1)
    for n in range(count):
        if not usable_range(ranges[first + n], geometry):
            numbers[footprints.NO_RANGE] += 1
            continue
        y, x = points[N_CENTRE + BEAMS + n] * inverse, points[N_CENTRE + n] * inverse
        sigma, turn, scatter = float(given[V_ROW_SIGMA + n]), float(given[V_TURN + n]), float(given[V_SCATTER + n])
        if given[V_NARROW + n] != 1.0:  # NaN too
            numbers[footprints.TOO_WIDE] += 1
            continue
        if not (abs(x) + MOST_CELLS < CELL_LIMIT and abs(y) + MOST_CELLS < CELL_LIMIT):
            numbers[footprints.TOO_FAR] += 1
            continue
        j0, j1 = int(np.floor(y - CUT * sigma)), int(np.floor(y + CUT * sigma))
        step, across = given[V_PER_SIGMA + n], given[V_PER_SCATTER + n]
        for k in range(0, j1 - j0 + 2, LANES):
            normal_borders(rows_at + np.uint64(8 * k), F32((j0 + k - y) * step), F32(step))
        apart, middle, reach = given[V_APART + n] == 1.0, x, CUT * scatter
        i0, i1 = int(np.floor(x - reach)), int(np.floor(x + reach))
        if apart:
            for k in range(0, i1 - i0 + 1, CELLS_A_STEP):
                masses(shares_at + np.uint64(4 * k), F32((i0 + k - x) * across), F32(across))
        slope_x, slope_y = given[V_SLOPE_X + n] * resolution_m, given[V_SLOPE_Y + n] * resolution_m
        z, variance = points[N_CENTRE + 2 * BEAMS + n], given[V_VARIANCE + n]
        fate = footprints.USED
        for j in range(j0, j1 + 1):
            # Phi and density of 16 borders lie in groups of 32 numbers.
            k = j - j0
            low, high = (k & -LANES) * 2 + (k & 15), ((k + 1) & -LANES) * 2 + ((k + 1) & 15)
            share = rows[high] - rows[low]
            if not apart:
                if share < F32(1e-7):
                    continue
                behind = sigma * float(rows[low + LANES] - rows[high + LANES]) / float(share)
                # The mean of y in the row lies in it.
                middle = x + turn * (min(max(y + behind, float(j)), float(j + 1)) - y)
                i0, i1 = int(np.floor(middle - reach)), int(np.floor(middle + reach))
            i = i0
            while i <= i1:
                i_last = min(i1, i | _IN_TILE, i + CELLS_A_STEP - 1)
                key = tile_key(i >> TILE_SHIFT, j >> TILE_SHIFT)
                if last_tile < 0 or key != last_key:
                    tile = kernel.neighbour_at(i >> TILE_SHIFT, j >> TILE_SHIFT, tiles, numbers, table, keys)
                    if tile < 0:
                        fate, i = footprints.BEYOND_CAP, i_last + 1
                        continue
                    last_key, last_tile = key, tile
                cell = (j & _IN_TILE) * TILE_SIDE + (i & _IN_TILE)
                address = base + np.uint64(last_tile * tile_bytes + 4 * cell)
                u = F32(z + slope_x * (i + 0.5 - x) + slope_y * (j + 0.5 - y))
                if apart:
                    at = shares_at + np.uint64(4 * (i - i0))
                    add_masses(address, _PLANE_BYTES, share, i_last - i + 1, u, F32(slope_x), variance, at)
                else:
                    t, dt = F32((i - middle) * across), F32(across)
                    add_normal(address, _PLANE_BYTES, share, i_last - i + 1, u, F32(slope_x), variance, t, dt)
                i = i_last + 1
        numbers[fate] += 1


A_SETTINGS, A_GEOMETRY, A_POSES, A_NARROW, A_WORK, A_POINTS, A_SPREADS, A_GIVEN, A_ROWS, A_SHARES = range(10)
A_TILES, A_NUMBERS, A_TABLE, A_KEYS, A_POOL = range(10, 15)


@compiled_without_heap
def mix_beams(ranges: Floats, means: Floats, covariances: Floats, order: Bound, arrays: Bound) -> None:
    """One scan into the map: points, conditioning, cells. Arrays are bound, as the mapper's kernel has them."""
    beams, directions = floats(order, BY_BEAM).reshape(3, -1), singles(order, BY_DIRECTION).reshape(2, -1)
    pose_index, settings, geometry = integers(order, BY_POSE), floats(arrays, A_SETTINGS), floats(arrays, A_GEOMETRY)
    bound_sigmas, resolution_m, independent = settings[0], settings[1], settings[2]
    poses, narrow = floats(arrays, A_POSES).reshape(-1, Q_SIZE), singles(arrays, A_NARROW).reshape(-1, Q_SIZE)
    work, points = floats(arrays, A_WORK).reshape(W_GAUSS, 6), floats(arrays, A_POINTS)
    spreads, given = singles(arrays, A_SPREADS), singles(arrays, A_GIVEN)
    rows, shares, tiles = singles(arrays, A_ROWS), singles(arrays, A_SHARES), integers(arrays, A_TILES)
    numbers, table, keys = counts(arrays, A_NUMBERS), integers(arrays, A_TABLE), words(arrays, A_KEYS)
    pool, ordered = singles(arrays, A_POOL).reshape(keys.size, 3, TILE_CELLS), beams[2]
    put_in_order(ranges, integers(order, BY_ORDER), ordered)
    for m in range(means.shape[0]):
        prepare_gaussian(means[m], covariances[m], geometry, bound_sigmas, work, poses[m], narrow[m])
    n = 0
    while n < ranges.size:
        m, count = pose_index[n], run_length(n, pose_index)
        if m < 0 or m >= means.shape[0]:
            numbers[footprints.NO_POSE] += count
        else:
            point_block(poses[m], narrow[m], geometry, n, count, beams, directions, points, spreads)
            condition_block(count, spreads, F32(1.0 / resolution_m), F32(independent), given)
            # fmt: off
            mix_block(
                count, n, ordered, geometry, resolution_m, points, given, rows, shares,
                tiles, numbers, table, keys, pool,
            )
            # fmt: on
        n += count


class MixtureMap:
    """Sums of weights, weighted elevations and their squares, for every cell."""

    bytes_a_cell = 12

    def __init__(
        self,
        resolution_m: float,
        laser: LaserConfig,
        bound_sigmas: float = THREE_SIGMA,
        independent: float = INDEPENDENT,
        tiles: int = 128,
    ) -> None:
        """`independent`: correlation of x and y below which it is neglected; 1.0 neglects it always."""
        self.resolution_m = resolution_m
        self.layers = TiledLayers(3, 0.0, tiles)
        self._geometry = laser_geometry(laser)
        self._order = BeamOrder()
        self._poses, self._narrow = np.empty((64, Q_SIZE)), np.empty((64, Q_SIZE), F32)
        self._work, self._points = np.empty((W_GAUSS, 6)), np.zeros(N_SIZE)
        self._spreads, self._given = np.zeros(N_SPREADS, F32), np.zeros(V_SIZE, F32)
        self._rows, self._shares = np.zeros(2 * _BORDERS, F32), np.zeros(_BORDERS + LANES, F32)
        self._tiles = np.full(kernel.S_SIZE, kernel.NO_TILE, np.int32)
        layers, self._settings = self.layers, np.array([bound_sigmas, resolution_m, independent])
        self._bound = bind(
            *(self._settings, self._geometry, self._poses, self._narrow, self._work),
            *(self._points, self._spreads, self._given, self._rows, self._shares),
            *(self._tiles, layers.numbers, layers.table, layers.keys, layers.pool),
        )

    def insert(self, scan: Scan, mean: Floats, covariance: Floats, pose_index: Indices) -> None:
        """Take a scan in whose beam i was shot from N(mean, covariance)[pose_index[i]] ([m, 6] and [m, 6, 6])."""
        order = self._order
        order.arrange(scan, pose_index)
        mix_beams(scan.ranges_m, mean, covariance, order.bound, self._bound)

    def estimate(self) -> tuple[Floats, Floats, tuple[int, int]]:
        """Mean and standard deviation [ny, nx] (equation 9; NaN where not observed), number of the first cell."""
        sums, first = self.layers.dense()
        s0, s1, s2 = sums.astype(np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            seen = s0 > OBSERVED
            mean = np.where(seen, s1 / s0, np.nan)
            return mean, np.sqrt(np.maximum(np.where(seen, s2 / s0, np.nan) - mean**2, 0.0)), first
