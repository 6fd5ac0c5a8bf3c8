"""The paper's set-valued map as written: its boxes (literal_boxes.py) into the cells of our own map.

Cells, tiles, association and the hull are the map's own code, so that what differs is the box alone.
"""

from math import radians
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bench.baselines.literal_boxes import (
    F_SIZE,
    I_SIZE,
    cosine_bounds,
    first_order_block,
    natural_block,
    prepare_first_order,
    prepare_intervals,
)
from bench.baselines.tiled_layers import TiledLayers
from drivers.compiled import compiled, compiled_unlocked
from drivers.config import LaserConfig
from drivers.samples import Scan
from mapper import footprints, kernel
from mapper.beam_order import BY_BEAM, BY_ORDER, BY_POSE, BeamOrder, put_in_order
from mapper.bound_arrays import Bound, bind, counts, flags, floats, integers, singles, words
from mapper.grid import TILE_SIDE
from mapper.laser_geometry import G_SCAN_BOUND, laser_geometry
from mapper.pose_terms import W_ROWS
from mapper.projection import B_SIZE, LANES, run_length

Floats = NDArray[np.float64]
Indices = NDArray[np.int32]


@compiled
def interval_table(directions: Floats, bound_rad: float, out: Floats) -> None:
    """[4, n] bounds of the cosine, then of the sine, of each beam's angle; directions [>= 2, n]."""
    quarter = 0.5 * np.pi
    for i in range(out.shape[1]):
        angle = np.arctan2(directions[1, i], directions[0, i])
        out[0, i], out[1, i] = cosine_bounds(angle - bound_rad, angle + bound_rad)
        out[2, i], out[3, i] = cosine_bounds(angle - bound_rad - quarter, angle + bound_rad - quarter)


_POSE_SIZE = max(F_SIZE, I_SIZE)
A_LIMITS, A_GEOMETRY, A_MOUNT, A_POSES, A_MATRICES, A_WORK, A_BLOCK, A_SPANS, A_HEIGHTS = range(9)
A_NUMBERS, A_TABLE, A_KEYS, A_DIRTY, A_POOL, A_SURE = range(9, 15)


@compiled_unlocked
def insert_literally(
    natural: bool,
    ranges: Floats,
    intervals: Floats,
    pose_low: Floats,
    pose_high: Floats,
    order: Bound,
    arrays: Bound,
) -> None:
    """One scan into the map. Arrays are bound, as the mapper's kernel has them."""
    beams, pose_index = floats(order, BY_BEAM).reshape(3, -1), integers(order, BY_POSE)
    limits, geometry, mount = floats(arrays, A_LIMITS), floats(arrays, A_GEOMETRY), floats(arrays, A_MOUNT)
    poses, block = floats(arrays, A_POSES).reshape(-1, _POSE_SIZE), floats(arrays, A_BLOCK)
    matrices, work = floats(arrays, A_MATRICES).reshape(5, 3, 3, 2), floats(arrays, A_WORK).reshape(W_ROWS, 4)
    spans, heights = integers(arrays, A_SPANS), singles(arrays, A_HEIGHTS)
    numbers, table, keys = counts(arrays, A_NUMBERS), integers(arrays, A_TABLE), words(arrays, A_KEYS)
    dirty, sure = flags(arrays, A_DIRTY), words(arrays, A_SURE).reshape(-1, TILE_SIDE)
    pool, ordered = singles(arrays, A_POOL).reshape(keys.size, 1, kernel.TILE_FLOATS), beams[2]
    put_in_order(ranges, integers(order, BY_ORDER), ordered)
    for m in range(pose_low.shape[0]):
        if natural:
            prepare_intervals(pose_low[m], pose_high[m], geometry, mount, matrices, poses[m])
        else:
            prepare_first_order(pose_low[m], pose_high[m], geometry, work, poses[m])
    n = 0
    while n < ranges.size:
        m, count = pose_index[n], run_length(n, pose_index)
        if m < 0 or m >= pose_low.shape[0]:
            numbers[footprints.NO_POSE] += count
        else:
            if natural:
                natural_block(poses[m], geometry, n, count, ordered, intervals, block)
            else:
                first_order_block(poses[m], geometry, n, count, ordered, beams[0], beams[1], block)
            footprints.locate_block(count, 1.0 / limits[0], limits[1], block, spans, heights)
            kernel.touch_block(count, 0, True, spans, heights, numbers, table, keys, dirty, pool, sure)
        n += count


class LiteralMap:
    """Intervals of elevation, from boxes that are the paper's."""

    bytes_a_cell = 8

    def __init__(
        self,
        resolution_m: float,
        laser: LaserConfig,
        form: Literal["natural", "first order"],
        max_footprint_m: float = 3.0,
        tiles: int = 128,
    ) -> None:
        self.resolution_m = resolution_m
        self.layers = TiledLayers(2, -np.inf, tiles)
        self._natural = form == "natural"
        self._geometry = laser_geometry(laser)
        self._mount = np.array(
            [radians(laser.mount_roll_deg), -radians(laser.mount_pitch_deg), radians(laser.mount_yaw_deg)]
        )
        self._limits = np.array([resolution_m, max_footprint_m])
        self._order = BeamOrder()
        self._beams, self._intervals = np.empty((3, 0)), np.empty((4, 0))
        self._poses = np.empty((64, _POSE_SIZE))
        self._matrices, self._work = np.empty((5, 3, 3, 2)), np.empty((W_ROWS, 4))
        self._block = np.zeros(B_SIZE)
        self._spans, self._heights = np.zeros(kernel.S_SIZE, np.int32), np.zeros(2 * LANES, np.float32)
        self._dirty, self._sure = np.zeros(tiles, np.bool_), np.zeros((tiles, TILE_SIDE), np.uint64)
        # The hull's own layout: (-low, high) of a cell side by side, in one plane.
        layers = self.layers
        self._bound = bind(
            *(self._limits, self._geometry, self._mount, self._poses, self._matrices, self._work),
            *(self._block, self._spans, self._heights),
            *(layers.numbers, layers.table, layers.keys, self._dirty, layers.pool, self._sure),
        )

    def insert(self, scan: Scan, low: Floats, high: Floats, pose_index: Indices) -> None:
        """Take a scan in whose beam i was shot from the pose box [low, high][pose_index[i]]."""
        order = self._order
        order.arrange(scan, pose_index)
        if self._natural and order.beams is not self._beams:
            self._beams, self._intervals = order.beams, np.empty((4, order.beams.shape[1]))
            interval_table(order.beams, float(self._geometry[G_SCAN_BOUND]), self._intervals)
        insert_literally(self._natural, scan.ranges_m, self._intervals, low, high, order.bound, self._bound)

    def bounds(self) -> tuple[Floats, Floats, tuple[int, int]]:
        """Low and high [ny, nx] (NaN where nothing was seen), number of the first cell."""
        used = int(self.layers.numbers[kernel.N_TILES])
        # Seen as two planes of one number each, the interleaved lanes must be parted again.
        interleaved = self.layers.pool[:used].reshape(used, -1, 2)
        parted = np.ascontiguousarray(interleaved.transpose(0, 2, 1))
        twin = TiledLayers(2, -np.inf, max(used, 1))
        twin.pool[:used], twin.keys[:used] = parted, self.layers.keys[:used]
        twin.numbers[kernel.N_TILES] = used
        (negative, high), first = twin.dense()
        seen = high > -np.inf
        return np.where(seen, -negative, np.nan).astype(float), np.where(seen, high, np.nan).astype(float), first
