"""What all maps over one horizontal dimension share: where a beam ended, X = x + r cos pitch, Z = h + r sin pitch.

Measurements are taken in blocks: what each map does with a block before it touches cells is one plain loop, so that
the compiler makes it vector instructions, with sine and cosine among them.
"""

from math import factorial, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from mapper.fused import fused

Floats = NDArray[np.float64]

LANES = 64
"""Measurements in a block."""
_ROWS = 6
"""Of LANES numbers, as many as a map needs at most."""

S1, S2, S3, S4, S5, S6, S7 = ((-1.0) ** k / factorial(2 * k + 1) for k in range(1, 8))
C1, C2, C3, C4, C5, C6, C7, C8 = ((-1.0) ** k / factorial(2 * k) for k in range(1, 9))
STEEPEST_RAD = pi / 4.0
"""Pitch lies within this of level: no beam that maps the ground ahead is steeper."""


class Scratch(NamedTuple):
    """Room for one block, so that nothing is allocated."""

    rows: Floats
    cells: NDArray[np.int32]
    """First and last cell of each measurement."""
    ends: NDArray[np.float32]
    """Two numbers a measurement, as each map stores them."""


def new_scratch() -> Scratch:
    """Room for one block."""
    return Scratch(np.zeros(_ROWS * LANES), np.zeros(2 * LANES, np.int32), np.zeros(2 * LANES, np.float32))


@compiled
def sine_cosine(angle: float) -> tuple[float, float]:
    """sin and cos of an angle within STEEPEST_RAD, both within 4 * 2^-53 (Taylor; what is left out is below 5e-17)."""
    q = angle * angle
    s = fused(q, S7, S6)
    s = fused(q, s, S5)
    s = fused(q, s, S4)
    s = fused(q, s, S3)
    s = fused(q, s, S2)
    s = fused(q, s, S1)
    c = fused(q, C8, C7)
    c = fused(q, c, C6)
    c = fused(q, c, C5)
    c = fused(q, c, C4)
    c = fused(q, c, C3)
    c = fused(q, c, C2)
    c = fused(q, c, C1)
    return fused(angle * q, s, angle), fused(q, c, 1.0)


@compiled
def end_of_beam(pitch: float, r: float) -> tuple[float, float, float, float]:
    """r cos pitch, r sin pitch, cos pitch, sin pitch."""
    s, c = sine_cosine(pitch)
    return r * c, r * s, c, s
