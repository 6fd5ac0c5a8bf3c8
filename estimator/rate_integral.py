"""The integral of a body rate between instants that are known to lie between two nodes of the attitude chain."""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.interval import Interval, add, hull, meet, mig, up, widen
from estimator.motion import QUANTUM


@compiled
def partial(net: NDArray[np.float64], effort: NDArray[np.int64], axis: int, first: int, last: int) -> Interval:
    """Integral of a body rate over any part of the steps first+1..last that begins or ends with them."""
    total = (0.0, 0.0)
    for i in range(first + 1, last + 1):
        total = add(total, (net[i, axis, 0], net[i, axis, 1]))
    varied = (effort[last, axis] - effort[first, axis]) * QUANTUM
    return widen(hull((0.0, 0.0), meet(total, (-varied, varied))), up(0.5 * max(0.0, varied - mig(total))))


@compiled
def integral_between(
    net: NDArray[np.float64], effort: NDArray[np.int64], axis: int, a: int, a_after: int, b_before: int, b: int
) -> Interval:
    """The same from an instant between nodes a and a_after to one between b_before and b, none before a_after."""
    total = add(partial(net, effort, axis, a, a_after), partial(net, effort, axis, b_before, b))
    for i in range(a_after + 1, b_before + 1):
        total = add(total, (net[i, axis, 0], net[i, axis, 1]))
    return total
