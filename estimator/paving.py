"""What the remembered fixes leave of yaw, place and gyro bias now (SMF sections 7.3 and 7.4).

The bias is paved first: in a narrow cell of it the way back turns little, and yaw and bias are contracted together.
"""

from math import atan, atan2, cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.chaining import Chain, chain
from estimator.fan import support
from estimator.interval import Interval, direction, down, is_empty, mag, mid, mig, reach, sub, up
from estimator.observations import nearest_copy
from estimator.odometry_block import ROUNDING, Blocks

BIAS_CELLS = 4
TURN_OF_A_CELL = 0.06
"""rad: how far the bias of one cell turns the way back; fewer cells where it is better known."""
YAW_CELLS = 8
FINEST = 128
"""Yaw is shaved by slices down to this part of its width."""


@compiled
def contract_by_window(
    count: int,
    blocks: Blocks,
    now_s: float,
    quantum: float,
    drift: float,
    bias: NDArray[np.float64],
    yaw: NDArray[np.float64],
    place: NDArray[np.float64],
) -> bool:
    """Contract bias [2], yaw [2], place [2, 2] by the fixes of blocks 0..count; False if nothing is left."""
    cells = 1
    if count:
        turned = (bias[1] - bias[0]) * abs(blocks[0].heading[1] - blocks[count].heading[1])
        cells = int(min(max(turned / TURN_OF_A_CELL, 1.0), BIAS_CELLS))
    width = (bias[1] - bias[0]) / cells
    biases, yaws, places = empty_hull(1), empty_hull(1), empty_hull(2)
    for cell in range(cells):
        low = bias[0] if cell == 0 else bias[0] + cell * width
        high = bias[1] if cell == cells - 1 else bias[0] + (cell + 1) * width
        ways = chain(count, blocks, now_s, quantum, low, high, drift)
        psi = cut(count, blocks, ways, (yaw[0], yaw[1]))
        if not is_empty(psi):
            psi = shaved(count, blocks, ways, psi, place)
        if not is_empty(psi) and pave(count, blocks, ways, psi, place, places):
            grow(biases[0], low, high)
            grow(yaws[0], psi[0], psi[1])
    if not biases[0, 0] <= biases[0, 1]:
        return False
    bias[:], yaw[:], place[:] = biases[0], yaws[0], places
    return True


@compiled
def empty_hull(count: int) -> NDArray[np.float64]:
    """[count, 2] empty intervals."""
    hull = np.empty((count, 2))
    hull[:, 0], hull[:, 1] = np.inf, -np.inf
    return hull


@compiled
def grow(hull: NDArray[np.float64], low: float, high: float) -> None:
    """hull [2] to contain [low, high]."""
    hull[0], hull[1] = min(hull[0], low), max(hull[1], high)


@compiled
def cut(count: int, blocks: Blocks, ways: Chain, yaw: Interval) -> Interval:
    """What is left of yaw by the newest fix and each of the others, one after the other."""
    for j in range(count - 1, ways.oldest - 1, -1):
        if not as_far_apart(count, j, blocks, ways):
            return 1.0, -1.0
        seen = yaw_by_displacement(count, j, blocks, ways)
        if not is_empty(seen):
            yaw = nearest_copy(yaw, seen)
            if is_empty(yaw):
                return yaw
    return yaw


@compiled
def as_far_apart(newest: int, j: int, blocks: Blocks, ways: Chain) -> bool:
    """Can two fixes be as far from each other as they are by odometry? Whatever yaw is: a wrong scale shows here."""
    qx, qy = ways.q[j, 0] - ways.q[newest, 0], ways.q[j, 1] - ways.q[newest, 1]
    long = sqrt(qx * qx + qy * qy)
    if not long > 1e-6:
        return True
    x, y = qx / long, qy / long
    bx, by, h = ways.slope[j, 0], ways.slope[j, 1], ways.h
    along = abs(x * bx + y * by) * h + support(ways.fan[j], x, y) + support(ways.fan[newest], x, y)
    across = abs(x * by - y * bx) * h + support(ways.fan[j], -y, x) + support(ways.fan[newest], -y, x)
    east, north = between_fixes(blocks[newest].antenna, blocks[j].antenna)
    least = sqrt(mig(east) ** 2 + mig(north) ** 2)
    most = sqrt(mag(east) ** 2 + mag(north) ** 2)
    slack = 1.0 + 1e-12
    return most * slack >= long - along and least <= slack * sqrt((long + along) ** 2 + across**2)


@compiled
def between_fixes(last: NDArray[np.float64], first: NDArray[np.float64]) -> tuple[Interval, Interval]:
    """From one antenna's box [2, 2] to another's: east and north."""
    return (
        sub((last[0, 0], last[0, 1]), (first[0, 0], first[0, 1])),
        sub((last[1, 0], last[1, 1]), (first[1, 0], first[1, 1])),
    )


@compiled
def yaw_by_displacement(newest: int, j: int, blocks: Blocks, ways: Chain) -> Interval:
    """SMF equation 22: yaw from the way between two fixes and the same way by odometry; empty where they are too near.

    A vector q with errors up to e_∥ along itself and e_⊥ across is off its direction by atan(e_⊥ / (|q| - e_∥)).
    """
    qx, qy = ways.q[j, 0] - ways.q[newest, 0], ways.q[j, 1] - ways.q[newest, 1]
    long = sqrt(qx * qx + qy * qy)
    if not long > 1e-6:
        return 1.0, -1.0
    x, y = qx / long, qy / long
    bx, by, h = ways.slope[j, 0], ways.slope[j, 1], ways.h
    along = abs(x * bx + y * by) * h + support(ways.fan[j], x, y) + support(ways.fan[newest], x, y)
    if not long > 1.000001 * along:
        return 1.0, -1.0
    across = abs(x * by - y * bx) * h + support(ways.fan[j], -y, x) + support(ways.fan[newest], -y, x)
    east, north = between_fixes(blocks[newest].antenna, blocks[j].antenna)
    seen = direction(east, north)
    if is_empty(seen):
        return seen
    off = atan(across / (long - along)) * (1.0 + 1e-9) + 1e-12
    angle = atan2(qy, qx)
    return sub(seen, (angle - off, angle + off))


@compiled
def fits(
    count: int,
    blocks: Blocks,
    ways: Chain,
    first: float,
    last: float,
    place: NDArray[np.float64],
    out: NDArray[np.float64],
) -> bool:
    """May yaw be in [first, last]? Then out [2, 2] is where in `place` the robot is."""
    psi = mid((first, last))
    w, c, s = reach((first, last), psi), cos(psi), sin(psi)
    out[:] = place
    for j in range(count, ways.oldest - 1, -1):
        x, y = place_by(j, c, s, w, blocks, ways)
        out[0, 0], out[0, 1] = max(out[0, 0], x[0]), min(out[0, 1], x[1])
        out[1, 0], out[1, 1] = max(out[1, 0], y[0]), min(out[1, 1], y[1])
        if out[0, 0] > out[0, 1] or out[1, 0] > out[1, 1]:
            return False
    return True


@compiled
def place_by(j: int, c: float, s: float, w: float, blocks: Blocks, ways: Chain) -> tuple[Interval, Interval]:
    """SMF equation 23: where base_link is by fix j, for any yaw within w of the one with cosine c and sine s."""
    kappa = min(0.5 * w * w, 2.0)
    ux, uy = c * ways.q[j, 0] - s * ways.q[j, 1], s * ways.q[j, 0] + c * ways.q[j, 1]
    fx = abs(c * ways.slope[j, 0] - s * ways.slope[j, 1]) * ways.h + support(ways.fan[j], c, -s)
    fy = abs(s * ways.slope[j, 0] + c * ways.slope[j, 1]) * ways.h + support(ways.fan[j], s, c)
    rx = w * abs(uy) + 0.5 * kappa * abs(ux) + fx + w * fy
    ry = w * abs(ux) + 0.5 * kappa * abs(uy) + fy + w * fx
    ux *= 1.0 - 0.5 * kappa
    uy *= 1.0 - 0.5 * kappa
    slack = ROUNDING * (abs(ux) + abs(uy) + rx + ry + 1.0)
    rx += slack
    ry += slack
    antenna = blocks[j].antenna
    x = down(antenna[0, 0] + (ux - rx)), up(antenna[0, 1] + (ux + rx))
    y = down(antenna[1, 0] + (uy - ry)), up(antenna[1, 1] + (uy + ry))
    return x, y


@compiled
def shaved(count: int, blocks: Blocks, ways: Chain, yaw: Interval, place: NDArray[np.float64]) -> Interval:
    """Yaw without the slices at its ends that fit no place; ever thinner ones."""
    out = np.empty((2, 2))
    first, last = yaw
    width = last - first
    slice_ = width / 4.0
    while slice_ > max(width / FINEST, 1e-9):
        while first < last and not fits(count, blocks, ways, first, min(first + slice_, last), place, out):
            first = first + slice_
        while first < last and not fits(count, blocks, ways, max(last - slice_, first), last, place, out):
            last = last - slice_
        if not first < last:
            return 1.0, -1.0
        slice_ *= 0.5
    return first, last


@compiled
def pave(
    count: int,
    blocks: Blocks,
    ways: Chain,
    yaw: Interval,
    place: NDArray[np.float64],
    places: NDArray[np.float64],
) -> bool:
    """Grow places [2, 2] by those that fit yaw, cell by cell of it; False if none does."""
    width = (yaw[1] - yaw[0]) / YAW_CELLS
    out = np.empty((2, 2))
    found = False
    for cell in range(YAW_CELLS):
        first = yaw[0] if cell == 0 else yaw[0] + cell * width
        last = yaw[1] if cell == YAW_CELLS - 1 else yaw[0] + (cell + 1) * width
        if fits(count, blocks, ways, first, last, place, out):
            found = True
            for axis in range(2):
                grow(places[axis], out[axis, 0], out[axis, 1])
    return found
