"""Where the robot can be on Earth as a polygon: a side in each of 64 fixed directions, moved from fix to fix.

A polygon h [SIDES] is the set of all p with d_m . p <= h_m, d_m at m times 5.6 degrees. A box that is moved grows by
all that is unknown of the way on every axis, the window's fans in `paving.fits` likewise: what the tracks tell of the
way *along* the heading, and how little yaw tells across it, are mixed. Here they stay apart, so that the fixes pin the
way along as well as the tracks allow, and a wrong scale contradicts them as soon as it can.
"""

from math import cos, pi, sin

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.chaining import Chain
from estimator.fan import support
from estimator.interval import down, mid, reach, up

SIDES = 64
HALF, QUARTER = SIDES // 2, SIDES // 4
SIDE_STEP = 2.0 * pi / SIDES
SIDE_EAST = np.array([cos(m * SIDE_STEP) for m in range(SIDES)])
SIDE_NORTH = np.array([sin(m * SIDE_STEP) for m in range(SIDES)])
SINES = np.array([sin(m * SIDE_STEP) for m in range(HALF)])
ROUNDING = 1e-12
"""Relative: covers the directions' rounding and that of a few products, ten times."""


@compiled
def polygon_of(box: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """out [SIDES] encloses the box [2, 2]."""
    for m in range(SIDES):
        out[m] = farthest(box, m)


@compiled
def farthest(box: NDArray[np.float64], m: int) -> float:
    """Not less than d_m . p over the box [2, 2]."""
    x = box[0, 1] if SIDE_EAST[m] > 0.0 else box[0, 0]
    y = box[1, 1] if SIDE_NORTH[m] > 0.0 else box[1, 0]
    return up(SIDE_EAST[m] * x + SIDE_NORTH[m] * y + ROUNDING * (abs(x) + abs(y)))


@compiled
def cut_polygon(polygon: NDArray[np.float64], box: NDArray[np.float64]) -> bool:
    """The part of polygon [SIDES] in box [2, 2], and box to enclose it, both in place; False where there is none.

    No point is left exactly if, once the sides are tight, two opposite ones have passed each other (Farkas).
    """
    size = 0.0
    for m in range(SIDES):
        polygon[m] = min(polygon[m], farthest(box, m))
        size = max(size, abs(polygon[m]))
    tighten(polygon, 64.0 * ROUNDING * size)
    for m in range(HALF):
        if polygon[m] < -polygon[m + HALF]:
            return False
    slack = ROUNDING * size
    box[0, 0], box[0, 1] = max(box[0, 0], down(-polygon[HALF] - slack)), min(box[0, 1], up(polygon[0] + slack))
    box[1, 0] = max(box[1, 0], down(-polygon[HALF + QUARTER] - slack))
    box[1, 1] = min(box[1, 1], up(polygon[QUARTER] + slack))
    return bool(box[0, 0] <= box[0, 1] and box[1, 0] <= box[1, 1])


@compiled
def tighten(polygon: NDArray[np.float64], slack: float) -> None:
    """Each side as tight as two others make it: in two dimensions that is all. `slack`: of rounding.

    Going round, a side is let go that its neighbours leave no edge (as in Graham's scan); what is kept goes on as the
    neighbour. Once round is enough to forget where that began, and once more to see what follows; so only the second of
    three laps counts. Any two sides bound those between them, so a mistake of rounding here costs nothing but width.
    """
    kept = np.empty(3 * SIDES, np.int64)
    count = 0
    for m in range(3 * SIDES):
        while count > 1 and m - kept[count - 2] < HALF:
            if polygon[kept[count - 1] % SIDES] < by_two_sides(polygon, kept[count - 2], kept[count - 1], m):
                break
            count -= 1
        kept[count] = m
        count += 1
    for k in range(count - 1):
        i, j = kept[k], kept[k + 1]
        if j - i < HALF:
            for m in range(max(i + 1, SIDES), min(j, 2 * SIDES)):
                side = m % SIDES
                polygon[side] = min(polygon[side], up(by_two_sides(polygon, i, m, j) + slack))


@compiled
def by_two_sides(polygon: NDArray[np.float64], i: int, m: int, j: int) -> float:
    """h_m is no more than this, for directions i < m < j less than half a turn apart.

    d_m = (sin(j - m) d_i + sin(m - i) d_j) / sin(j - i), and h_m is at most the same of h_i and h_j.
    """
    return float((SINES[j - m] * polygon[i % SIDES] + SINES[m - i] * polygon[j % SIDES]) / SINES[j - i])


@compiled
def moved_polygon(
    polygon: NDArray[np.float64], ways: Chain, first: float, last: float, out: NDArray[np.float64]
) -> None:
    """out [SIDES] encloses where a point of polygon is after the one way of `ways`, if yaw is in [first, last] now.

    The way turned by the yaw's half-width w as in `paving.fits` (SMF equation 23), for any direction in the place of
    the axes.
    """
    psi = mid((first, last))
    w = reach((first, last), psi)
    c, s = cos(psi), sin(psi)
    kappa = min(0.5 * w * w, 2.0)
    along, error = np.empty(HALF), np.empty(HALF)
    for m in range(HALF):  # the direction as seen along the newest heading
        x, y = c * SIDE_EAST[m] + s * SIDE_NORTH[m], c * SIDE_NORTH[m] - s * SIDE_EAST[m]
        along[m] = x * ways.q[0, 0] + y * ways.q[0, 1]
        error[m] = abs(x * ways.slope[0, 0] + y * ways.slope[0, 1]) * ways.h + support(ways.fan[0], x, y)
    for m in range(HALF):
        across = (m + QUARTER) % HALF
        way = along[m] * (1.0 - 0.5 * kappa)
        rest = w * abs(along[across]) + 0.5 * kappa * abs(along[m]) + error[m] + w * error[across]
        for side in range(m, SIDES, HALF):
            slack = ROUNDING * (abs(polygon[side]) + abs(along[m]) + rest + 1.0)
            out[side] = up(polygon[side] + ((way if side == m else -way) + rest + slack))
