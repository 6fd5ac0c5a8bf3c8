"""Fans: sums of segments along fixed directions, which bound errors that are long one way and short the other.

A fan f [DIRECTIONS] stands for the set of all sum_m t_m e_m, |t_m| <= f_m, with e_m at m times 11.25 degrees: a
zonotope whose generators always point the same ways, so that fans are added number by number. Any other segment is
enclosed by its parts along the two neighbours, which reach at most 0.5 % farther along it and a tenth of its length
across; a box that is turned grows by up to the root of two, each time.
"""

from math import cos, floor, pi, sin

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.interval import up

DIRECTIONS = 16
"""A power of two."""
STEP = pi / DIRECTIONS
QUARTER_TURN = DIRECTIONS // 2
EAST = np.array([cos(m * STEP) for m in range(DIRECTIONS)] + [-1.0])
NORTH = np.array([sin(m * STEP) for m in range(DIRECTIONS)] + [0.0])
"""e_m; the last is -e_0."""
SINE = sin(STEP)
SLACK = 1e-11
"""Relative: covers the rounding of a segment's parts, and of the directions."""


@compiled
def parts(x: float, y: float) -> tuple[int, float, float]:
    """The segment from (-x, -y) to (x, y) as one along e_m and one along e_m+1: m and their lengths."""
    if y < 0.0:
        x, y = -x, -y
    m = 0
    jump = DIRECTIONS // 2
    while jump:
        if EAST[m + jump] * y - NORTH[m + jump] * x >= 0.0:
            m += jump
        jump //= 2
    ahead = abs(EAST[m] * y - NORTH[m] * x) / SINE
    behind = abs(x * NORTH[m + 1] - y * EAST[m + 1]) / SINE
    return m, behind, ahead


@compiled
def add_segment(fan: NDArray[np.float64], x: float, y: float) -> None:
    """fan += the segment from (-x, -y) to (x, y)."""
    m, behind, ahead = parts(x, y)
    slack = SLACK * (abs(x) + abs(y))
    fan[m] = up(fan[m] + (behind + slack))
    m = (m + 1) % DIRECTIONS
    fan[m] = up(fan[m] + (ahead + slack))


@compiled
def shared(least: NDArray[np.float64], x: float, y: float) -> None:
    """least [DIRECTIONS] to no more than the parts of that segment: what many segments have in common."""
    m, behind, ahead = parts(x, y)
    after = (m + 1) % DIRECTIONS
    for k in range(DIRECTIONS):
        least[k] = min(least[k], behind if k == m else (ahead if k == after else 0.0))


@compiled
def less(fan: NDArray[np.float64], least: NDArray[np.float64], credit: float, out: NDArray[np.float64]) -> None:
    """out: a sum of segments (and more), whose segments' lengths in units of those of `least` are `credit` less in all.

    Whichever of them are shorter: in each direction they are by no less than credit times the smallest part.
    """
    for k in range(DIRECTIONS):
        out[k] = fan[k]
        if credit > 0.0 and least[k] < 2.0:
            out[k] = max(0.0, up(fan[k] - credit * max(0.0, least[k] * (1.0 - 1e-9) - SLACK)))


@compiled
def add_box(fan: NDArray[np.float64], x: float, y: float) -> None:
    """fan += [-x, x] by [-y, y]."""
    fan[0] = up(fan[0] + up(abs(x)))
    fan[QUARTER_TURN] = up(fan[QUARTER_TURN] + up(abs(y)))


@compiled
def add_turned(fan: NDArray[np.float64], other: NDArray[np.float64], angle: float, sway: float) -> None:
    """fan += other turned by angle + η, for every |η| <= sway: each segment, and across it `sway` times its length."""
    turns = floor(angle / STEP)
    part = angle - turns * STEP
    behind, ahead = abs(sin(STEP - part)) / SINE + SLACK, abs(sin(part)) / SINE + SLACK
    first = int(turns) % DIRECTIONS
    for m in range(DIRECTIONS):
        value = other[m]
        for across in range(2):
            k = (first + m + across * QUARTER_TURN) % DIRECTIONS
            fan[k] = up(fan[k] + up(value * behind))
            k = (k + 1) % DIRECTIONS
            fan[k] = up(fan[k] + up(value * ahead))
            value = up(value * sway)


@compiled
def support(fan: NDArray[np.float64], x: float, y: float) -> float:
    """Not less than the largest (x, y) . v over the fan's v; |(x, y)| near 1."""
    total = 0.0
    size = 0.0
    for m in range(DIRECTIONS):
        total += fan[m] * abs(x * EAST[m] + y * NORTH[m])
        size += fan[m]
    return up(total + SLACK * size)
