"""The way back from now to each remembered fix, along the newest heading (SMF section 7.2).

    p - A_j  =  Rz(ψ) (q_j + slope_j (b - b_c) + e_j)

with p base_link now, A_j the antenna then, ψ yaw on Earth now, b the gyro's bias and e_j in a fan: no linearisation
in ψ, and errors along the way are kept apart from those across.
"""

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.fan import DIRECTIONS, add_box, add_segment, add_turned
from estimator.interval import mid, norm, reach, up
from estimator.odometry_block import ROUNDING, Blocks


class Chain(NamedTuple):
    """A row for each fix; the last is that of the newest one."""

    oldest: int
    """Fixes before this one say nothing: the heading is known too little."""
    h: float
    """|b - b_c| at most."""
    q: NDArray[np.float64]
    """[n + 1, 2]"""
    slope: NDArray[np.float64]
    """[n + 1, 2]"""
    fan: NDArray[np.float64]
    """[n + 1, DIRECTIONS]"""


@compiled
def chain(
    count: int,
    blocks: Blocks,
    now_s: float,
    quantum: float,
    low: float,
    high: float,
    drift: float,
) -> Chain:
    """SMF equations 20 and 21, for a bias in [low, high] now; the newest fix is blocks[count].

    A vector u turned by η = τ (b - b_c) + ν, |η| <= D, is in u (1 - κ/2) + η J u ± (κ/2 |u| + D^3/6 |J u|), κ = D^2/2;
    the errors ν of the blocks turn all that is older.
    """
    b = 0.5 * (low + high)
    h = reach((low, high), b)
    q, slope, fan = np.empty((count + 1, 2)), np.zeros((count + 1, 2)), np.zeros((count + 1, DIRECTIONS))
    half = np.empty(2)
    now = blocks[count]
    for c in range(2):
        q[count, c] = -mid((now.offset[c, 0], now.offset[c, 1]))
        half[c] = ROUNDING + reach((now.offset[c, 0], now.offset[c, 1]), -q[count, c])
    add_box(fan[count], half[0], half[1])
    noise, before = np.empty(count), np.empty((count, 2))
    w, centre, slopes, errors = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(DIRECTIONS)
    moved, there = np.empty(6), np.empty(6)
    total = length = 0.0
    oldest = count
    for i in range(count - 1, -1, -1):
        block, heading, after, offset = blocks[i], blocks[i].heading, blocks[i + 1].heading, blocks[i].offset
        tau = heading[1] - now.heading[1]
        aged = up(drift * up(now_s - block.seconds))
        rho = up(abs(after[2] - heading[2])) + abs(after[1] - heading[1]) * aged
        noise[i] = up(rho * 1.000001)
        before[i] = w
        total = up(total + noise[i])
        spread = up(abs(tau) * h + total)
        if not spread < 1.0:
            break
        oldest = i
        angle = heading[0] - now.heading[0] + tau * b
        shift = b - block.reference
        gx, gy = block.by_bias[0], block.by_bias[1]
        turn_vector(angle, tau, spread, h, block.way[0] + gx * shift, block.way[1] + gy * shift, gx, gy, moved, errors)
        add_turned(errors, block.error, angle, spread)
        drifted = sqrt(gx * gx + gy * gy) * aged * (1.0 + ROUNDING) + (quantum if i == count - 1 else 0.0)
        add_box(errors, drifted, drifted)
        w += moved[:2]
        centre += moved[2:4]
        slopes += moved[4:6]
        length += abs(moved[0]) + abs(moved[1])
        ox, oy = mid((offset[0, 0], offset[0, 1])), mid((offset[1, 0], offset[1, 1]))
        fan[i] = errors
        turn_vector(angle, tau, spread, h, ox, oy, 0.0, 0.0, there, fan[i])
        rest = norm((offset[0, 0] - ox, offset[0, 1] - ox), (offset[1, 0] - oy, offset[1, 1] - oy))
        slack = ROUNDING * (length + 1.0)
        add_box(fan[i], rest + slack, rest + slack)
        q[i] = centre - there[2:4]
        slope[i] = slopes - there[4:6]
        for k in range(i, count):
            dx, dy = w[0] - there[0] - before[k, 0], w[1] - there[1] - before[k, 1]
            add_segment(fan[i], -noise[k] * dy, noise[k] * dx)
    return Chain(oldest, h, q, slope, fan)


@compiled
def turn_vector(
    angle: float,
    tau: float,
    spread: float,
    h: float,
    dx: float,
    dy: float,
    gx: float,
    gy: float,
    out: NDArray[np.float64],
    rest: NDArray[np.float64],
) -> None:
    """d + g (b - b_c) turned by angle + η, see `chain`. out [6]: the turned d, centre, slope in b; the rest: rest."""
    c, s = cos(angle), sin(angle)
    ux, uy = c * dx - s * dy, s * dx + c * dy
    px, py = c * gx - s * gy, s * gx + c * gy
    kappa, twist = 0.5 * spread * spread, spread * spread * spread / 6.0
    out[0], out[1] = ux, uy
    out[2], out[3] = ux * (1.0 - 0.5 * kappa), uy * (1.0 - 0.5 * kappa)
    out[4], out[5] = px - tau * uy, py + tau * ux
    add_segment(rest, 0.5 * kappa * ux, 0.5 * kappa * uy)
    add_segment(rest, -twist * uy, twist * ux)
    add_segment(rest, kappa * h * px, kappa * h * py)
    add_segment(rest, -spread * h * py, spread * h * px)
