"""What a receiver's ground velocity says of yaw (in the place of SMF equation 18, whose pitfall 5 it has not).

Around the fix lie two encoder readings, T seconds apart, between which odometry tells the way W along the newest
heading. A velocity that changes by no more than A a second is off its mean by at most A T / 2, so that of the antenna
times T is in

    Rz(ψ) (W ± A T^2 / 2 ± |arm| integral of the body rates)

and in what the receiver declares. Stops, spins and reversals are no special cases: a way that may be none has no
direction, and one backwards points backwards.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.frames import turned
from estimator.interval import Interval, add, direction, is_empty, sub, up, widen
from estimator.motion import relative_yaw


@compiled
def way_along(
    heading: NDArray[np.float64],
    bias: Interval,
    step_heading: NDArray[np.float64],
    local: NDArray[np.float64],
    first: int,
    last: int,
) -> tuple[Interval, Interval]:
    """From position node `first` to `last`, seen along `heading` [3]: ahead and left; see travelled.travelled_along."""
    ahead = left = (0.0, 0.0)
    for k in range(first + 1, last + 1):
        yaw = relative_yaw(step_heading[k], heading, bias)
        x, y = turned(yaw, (local[k, 0, 0], local[k, 0, 1]), (local[k, 1, 0], local[k, 1, 1]))
        ahead, left = add(ahead, x), add(left, y)
    return ahead, left


def off_mean(seconds: float, acceleration: float, arm_m: float, turned_rad: float) -> float:
    """How far (m) the antenna's velocity, times the stretch's `seconds`, may be from the way of base_link.

    acceleration: of each body axis at most; turned_rad: integrals of the body rates' sizes, summed.
    """
    return up(up(0.5 * sqrt(3.0) * 1.0001 * acceleration * seconds * seconds) + up(arm_m * turned_rad))


@compiled
def yaw_by_velocity(east: float, north: float, bound: float, way: tuple[Interval, Interval], off: float) -> Interval:
    """Yaw by the velocity, each axis within `bound`, and the way within `off`; empty where either may be zero."""
    seen = direction(widen((east, east), bound), widen((north, north), bound))
    own = direction(widen(way[0], off), widen(way[1], off))
    if is_empty(seen) or is_empty(own):
        return 1.0, -1.0
    return sub(seen, own)
