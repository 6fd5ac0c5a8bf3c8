"""Preintegrated odometry: the way between two remembered fixes, as seen along the heading at its start (SMF 7.1)."""

from math import cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.fan import add_box, add_segment, shared
from estimator.interval import mid, norm, reach, up

ROUNDING = 1e-12
"""Relative: sums below of fewer than 10^4 products of numbers as large as the whole way."""


@compiled
def extend_block(
    k: int,
    step: NDArray[np.float64],
    axis: NDArray[np.float64],
    heading: NDArray[np.float64],
    quantum: float,
    bias: NDArray[np.float64],
    drift: float,
    now_s: float,
    starts: NDArray[np.float64],
    seconds: NDArray[np.float64],
    references: NDArray[np.float64],
    last: NDArray[np.float64],
    ways: NDArray[np.float64],
    by_biases: NDArray[np.float64],
    errors: NDArray[np.float64],
    leasts: NDArray[np.float64],
    paths: NDArray[np.float64],
) -> None:
    """SMF equation 19: block k, way + by_bias (b - reference) + error in the yaw frame of its start, a step longer.

    step [3, 2] is its box and axis [3] its middle axis, along the step's heading, which is that of the block turned by
    α + τ (b - reference) + ν, |ν| <= ρ, with b the bias now; since the block's start it drifted by no more than `drift`
    a second. errors[k] is a fan; leasts[k] what its segments of slip have in common, per metre of the tracks. The error
    of the count telescopes as in motion.travel: a quantum for each change of the axis.
    """
    start, reference, way, by_bias, error = starts[k], references[k], ways[k], by_biases[k], errors[k]
    aged = up(drift * up(now_s - seconds[k]))
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
    if last[0] == last[0]:
        turned = abs(tau - last[2]) * h + abs(rho - last[3])
        bent = 1.001 * quantum * (sqrt((ax - last[0]) ** 2 + (ay - last[1]) ** 2) + turned)
        along += bent
        across += bent
    last[0], last[1], last[2], last[3] = ax, ay, tau, rho
    paths[k] += sqrt(dx * dx + dy * dy)
    rounding = ROUNDING * (abs(way[0]) + abs(way[1]) + paths[k] + 1e-3)
    add_segment(error, c * along, s * along)
    if spread < 1.0:
        shared(leasts[k], c * axis[0], s * axis[0])
    else:
        leasts[k] = 0.0
    add_segment(error, -s * across, c * across)
    add_box(error, rounding, rounding)


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
    starts: NDArray[np.float64],
    seconds: NDArray[np.float64],
    references: NDArray[np.float64],
    last: NDArray[np.float64],
    ways: NDArray[np.float64],
    by_biases: NDArray[np.float64],
    errors: NDArray[np.float64],
    leasts: NDArray[np.float64],
    paths: NDArray[np.float64],
) -> None:
    """The same step for two blocks; last [2, 4]."""
    for which in range(2):
        row = k if which == 0 else other
        extend_block(
            row, step, axis, heading, quantum, bias, drift, now_s, starts, seconds, references, last[which], ways,
            by_biases, errors, leasts, paths,
        )  # fmt: skip
