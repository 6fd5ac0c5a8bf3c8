"""Preintegrated odometry: the way between two remembered fixes, as seen along the heading at its start (SMF 7.1)."""

from math import cos, sin, sqrt
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.fan import DIRECTIONS, add_box, add_segment, shared
from estimator.interval import Interval, mid, norm, reach, up

ROUNDING = 1e-12
"""Relative: sums below of fewer than 10^4 products of numbers as large as the whole way."""


BLOCK = np.dtype(
    [
        ("antenna", np.float64, (2, 2)),
        ("offset", np.float64, (2, 2)),
        ("heading", np.float64, (3,)),
        ("seconds", np.float64),
        ("reference", np.float64),
        ("way", np.float64, (2,)),
        ("by_bias", np.float64, (2,)),
        ("error", np.float64, (DIRECTIONS,)),
        ("raw", np.float64, (DIRECTIONS,)),
        ("least", np.float64, (DIRECTIONS,)),
        ("path", np.float64),
        ("last", np.float64, (4,)),
    ],
    align=True,
)
"""A fix, and the way from it to the next. At the fix: box of the antenna (east, north), where that was from base_link
along the heading, heading and time of the gyro node then. The block of odometry that begins there is, in the yaw frame
of its start, way + by_bias (b - reference) + error, and `path` long.

While it is open: its error without the slip's credit, and what that is taken from (slip_ledger.py); axis of its last
step, and of the heading of that (N, τ, ρ) the latter two; NaN before the first."""
Blocks: TypeAlias = NDArray[np.void]
"""[n] of BLOCK."""


@compiled
def put_fix(
    blocks: Blocks,
    k: int,
    antenna: NDArray[np.float64],
    offset: NDArray[np.float64],
    heading: NDArray[np.float64],
    seconds: float,
) -> None:
    """What block k says of the fix."""
    fix = blocks[k]
    fix.antenna[:], fix.offset[:], fix.heading[:] = antenna, offset, heading
    fix.seconds = seconds


@compiled
def empty_block(blocks: Blocks, k: int, bias: NDArray[np.float64], slack: float) -> None:
    """Block k without a step yet; it begins at a count, around which the turning centre may have moved by `slack`."""
    block = blocks[k]
    block.way[:], block.by_bias[:], block.path = 0.0, 0.0, 0.0
    block.raw[:], block.least[:], block.last[:] = 0.0, np.inf, np.nan
    add_box(block.raw, slack, slack)
    block.reference = 0.5 * (bias[0] + bias[1])


@compiled
def follow_block(blocks: Blocks, k: int, bias: NDArray[np.float64], slack: float, quantum: float) -> None:
    """Block k begins where the one before it, if there is one, ends: at a count, which may be off by a quantum."""
    if k:
        add_box(blocks[k - 1].error, quantum, quantum)
    empty_block(blocks, k, bias, slack)


@compiled
def extend_block(
    block: Any,
    step: NDArray[np.float64],
    axis: NDArray[np.float64],
    heading: NDArray[np.float64],
    quantum: float,
    bias: NDArray[np.float64],
    drift: float,
    now_s: float,
) -> None:
    """SMF equation 19: a BLOCK, way + by_bias (b - reference) + error in the yaw frame of its start, a step longer.

    step [3, 2] is its box and axis [3] its middle axis, along the step's heading, which is that of the block turned by
    α + τ (b - reference) + ν, |ν| <= ρ, with b the bias now; since the block's start it drifted by no more than `drift`
    a second. Its `raw` is a fan; `least` what its segments of slip have in common, per metre of the tracks. The error
    of the count telescopes as in tracks.travel: a quantum for each change of the axis.
    """
    start, reference, way, by_bias = block.heading, block.reference, block.way, block.by_bias
    aged = up(drift * up(now_s - block.seconds))
    tau = heading[1] - start[1]
    rho = up(up(abs(heading[2] - start[2])) + up(abs(tau) * aged))
    alpha = heading[0] - start[0] + tau * reference
    h = reach((bias[0], bias[1]), reference)
    spread = up(up(abs(tau) * h) + rho)
    c, s = cos(alpha), sin(alpha)
    dx, dy = mid((step[0, 0], step[0, 1])), mid((step[1, 0], step[1, 1]))
    rx, ry = reach((step[0, 0], step[0, 1]), dx), reach((step[1, 0], step[1, 1]), dy)
    ux, uy = c * dx - s * dy, s * dx + c * dy
    along, across = rx, ry
    if spread < 1.0:
        bend, twist = 0.5 * spread * spread, spread * spread * spread / 6.0
        way[0] += ux
        way[1] += uy
        by_bias[0] -= tau * uy
        by_bias[1] += tau * ux
        along += spread * ry + rho * abs(dy) + bend * abs(dx) + twist * abs(dy)
        across += spread * rx + rho * abs(dx) + bend * abs(dy) + twist * abs(dx)
    else:
        along = across = norm((step[0, 0], step[0, 1]), (step[1, 0], step[1, 1]))
    ax, ay = c * axis[0] - s * axis[1], s * axis[0] + c * axis[1]
    if block.last[0] == block.last[0]:
        bent = quantum * bent_from_last(block, ax, ay, heading, up(h + aged))
        along += bent
        across += bent
    block.last[0], block.last[1], block.last[2], block.last[3] = ax, ay, heading[1], heading[2]
    block.path += sqrt(dx * dx + dy * dy)
    rounding = ROUNDING * (abs(way[0]) + abs(way[1]) + block.path + 1e-3)
    add_segment(block.raw, c * along, s * along)
    if spread < 1.0:
        shared(block.least, c * axis[0], s * axis[0])
    else:
        block.least[:] = 0.0
    add_segment(block.raw, -s * across, c * across)
    add_box(block.raw, rounding, rounding)


@compiled
def bent_from_last(block: Any, x: float, y: float, heading: NDArray[np.float64], h: float) -> float:
    """How far an axis along a heading, in the block's frame (x, y), may be from the last one; |b - reference| <= h."""
    last = block.last
    turned = abs(heading[1] - last[2]) * h + abs(heading[2] - last[3])
    return float(1.001 * (sqrt((x - last[0]) ** 2 + (y - last[1]) ** 2) + turned))


@compiled
def bend_to(block: Any, heading: NDArray[np.float64], bias: Interval, aged: float) -> float:
    """How far a BLOCK's last axis is from the heading of a later gyro node, at most; the bias now, and its drift since.

    As far as between two steps of `extend_block`.
    """
    alpha = heading[0] - block.heading[0] + (heading[1] - block.heading[1]) * block.reference
    return bent_from_last(block, cos(alpha), sin(alpha), heading, up(reach(bias, block.reference) + aged))


@compiled
def extend_two_blocks(
    k: int,
    other: int,
    step: NDArray[np.float64],
    axis: NDArray[np.float64],
    heading: NDArray[np.float64],
    quantum: float,
    bias: NDArray[np.float64],
    drift: float,
    now_s: float,
    blocks: Blocks,
) -> None:
    """The same step for two blocks."""
    extend_block(blocks[k], step, axis, heading, quantum, bias, drift, now_s)
    extend_block(blocks[other], step, axis, heading, quantum, bias, drift, now_s)
