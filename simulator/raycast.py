"""Where rays meet the terrain: the nearest intersection with grid triangles and boxes, exact to rounding.

A ray is carried from cell to cell of the height grid. Over one triangle its height above the surface is linear, so a
hit is a change of sign between two ends of a segment. The side of the surface is remembered from segment to segment,
not recomputed: no ray slips through the seam between two triangles.
"""

from math import floor, inf, isinf

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from simulator.terrain import Terrain

Array = NDArray[np.float64]


def cast(terrain: Terrain, origins: Array, directions: Array, range_max_m: float) -> Array:
    """Distances [n] along unit `directions` [n, 3] from `origins` [n, 3]; +inf where nothing is hit in range."""
    distances = np.empty(origins.shape[0])
    cast_rays(
        terrain.heights,
        terrain.x0_m,
        terrain.y0_m,
        terrain.cell_m,
        terrain.boxes,
        np.ascontiguousarray(origins, float),
        np.ascontiguousarray(directions, float),
        range_max_m,
        distances,
    )
    return distances


@compiled
def box_distance(
    box: Array, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, range_max: float
) -> float:
    """Distance at which the ray enters the box (slab test), or leaves it if it starts inside; +inf without a hit."""
    near = -inf
    far = inf
    for axis in range(3):
        if axis == 0:
            o, d = ox, dx
        elif axis == 1:
            o, d = oy, dy
        else:
            o, d = oz, dz
        if d == 0.0:
            if o < box[axis] or o > box[axis + 3]:
                return inf
            continue
        first = (box[axis] - o) / d
        second = (box[axis + 3] - o) / d
        near = max(near, min(first, second))
        far = min(far, max(first, second))
    distance = near if near >= 0.0 else far
    if near > far or distance < 0.0 or distance > range_max:
        return inf
    return distance


@compiled
def grid_distance(
    heights: Array,
    x0: float,
    y0: float,
    cell: float,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    range_max: float,
) -> float:
    """Distance at which the ray first crosses the triangulated surface, from either side; +inf without a hit."""
    ny, nx = heights.shape
    # In units of cells, so that cell borders are integers.
    u, w = (ox - x0) / cell, (oy - y0) / cell
    du, dw = dx / cell, dy / cell
    begin, end = 0.0, range_max
    for axis in range(2):
        o, d, size = (u, du, nx - 1.0) if axis == 0 else (w, dw, ny - 1.0)
        if d == 0.0:
            if o < 0.0 or o > size:
                return inf
            continue
        first = -o / d
        second = (size - o) / d
        begin = max(begin, min(first, second))
        end = min(end, max(first, second))
    if begin > end:
        return inf
    ix = min(max(floor(u + begin * du), 0), nx - 2)
    iy = min(max(floor(w + begin * dw), 0), ny - 2)
    step_x = 1 if du > 0.0 else -1
    step_y = 1 if dw > 0.0 else -1
    t = begin
    known = False
    above = True
    while True:
        exit_x = ((ix + (1 if du > 0.0 else 0)) - u) / du if du != 0.0 else inf
        exit_y = ((iy + (1 if dw > 0.0 else 0)) - w) / dw if dw != 0.0 else inf
        leave = max(min(exit_x, exit_y, end), t)
        z00 = heights[iy, ix]
        z10 = heights[iy, ix + 1]
        z01 = heights[iy + 1, ix]
        z11 = heights[iy + 1, ix + 1]
        z_low = min(oz + t * dz, oz + leave * dz)
        z_high = max(oz + t * dz, oz + leave * dz)
        if known and (
            (above and z_low > max(max(z00, z10), max(z01, z11)))
            or (not above and z_high < min(min(z00, z10), min(z01, z11)))
        ):
            t = leave
        else:
            # The diagonal parts the cell where u - ix == w - iy.
            across = du - dw
            offset = (u - ix) - (w - iy)
            middle = -offset / across if across != 0.0 else inf
            parts = 2 if t < middle < leave else 1
            for part in range(parts):
                a = t
                b = middle if part == 0 and parts == 2 else leave
                halfway = 0.5 * (a + b)
                if offset + halfway * across >= 0.0:
                    slope_u, slope_w = z10 - z00, z11 - z10
                else:
                    slope_u, slope_w = z11 - z01, z01 - z00
                # Height of the ray above the triangle's plane at both ends.
                at_a = oz + a * dz - (z00 + slope_u * (u + a * du - ix) + slope_w * (w + a * dw - iy))
                at_b = oz + b * dz - (z00 + slope_u * (u + b * du - ix) + slope_w * (w + b * dw - iy))
                if not known:
                    known = True
                    above = at_a > 0.0
                if (at_b > 0.0) != above:
                    share = at_a / (at_a - at_b) if at_a != at_b else 0.0
                    return a + (b - a) * min(max(share, 0.0), 1.0)
                t = b
        if leave >= end:
            return inf
        if exit_x <= exit_y:
            ix += step_x
            if ix < 0 or ix > nx - 2:
                return inf
        else:
            iy += step_y
            if iy < 0 or iy > ny - 2:
                return inf


@compiled
def cast_rays(
    heights: Array,
    x0: float,
    y0: float,
    cell: float,
    boxes: Array,
    origins: Array,
    directions: Array,
    range_max: float,
    out: Array,
) -> None:
    """Nearest hit of every ray into out [n]."""
    for i in range(origins.shape[0]):
        ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        nearest = inf
        for b in range(boxes.shape[0]):
            nearest = min(nearest, box_distance(boxes[b], ox, oy, oz, dx, dy, dz, range_max))
        limit = range_max if isinf(nearest) else nearest
        out[i] = min(nearest, grid_distance(heights, x0, y0, cell, ox, oy, oz, dx, dy, dz, limit))
