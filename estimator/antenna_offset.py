"""Where the antenna was at a fix, from where base_link is now: the lever arm then, less the way since (SMF eq. 26)."""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.interval import Interval, sub
from estimator.motion import relative_yaw_between
from estimator.observations import lever
from estimator.travelled import travelled_along, travelled_since
from estimator.tube import hull_between


@compiled
def antenna_offsets(
    arm: NDArray[np.float64],
    i: int,
    j: int,
    now: int,
    net: NDArray[np.float64],
    swing: NDArray[np.float64],
    step_heading: NDArray[np.float64],
    local: NDArray[np.float64],
    a: int,
    b: int,
    newest: int,
    box: NDArray[np.float64],
    turn_swing: NDArray[np.float64],
    heading: NDArray[np.float64],
    bias: Interval,
    along: NDArray[np.float64],
    in_map: NDArray[np.float64],
) -> None:
    """`along` [3, 2] as seen along the newest heading, and `in_map` [3, 2] along the map's axes.

    The fix lies between the nodes i and j of the position chain, whose newest is `now`, and a and b of the attitude
    chain; [bias] is that of ω_z since a.
    """
    attitude, there = np.empty((4, 2)), np.empty((3, 2))
    hull_between(box, turn_swing, a, b, attitude)
    lever(attitude, arm, there)
    subtract(there, travelled_since(net, swing, i, j, now), in_map)
    attitude[2, 0], attitude[2, 1] = relative_yaw_between(heading, turn_swing, a, b, heading[newest], bias)
    lever(attitude, arm, there)
    subtract(there, travelled_along(heading[newest], bias, step_heading, local, i, j, now), along)


@compiled
def subtract(a: NDArray[np.float64], b: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """out = a - b, intervals [3, 2]."""
    for c in range(3):
        out[c, 0], out[c, 1] = sub((a[c, 0], a[c, 1]), (b[c, 0], b[c, 1]))
