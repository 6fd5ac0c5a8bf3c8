"""Tracks against gyroscope over every stretch of the way at once: a cumulative sum (Page 1954), with bounds for errors.

Between two counts i < j the tracks' difference is gauge times the integral of ω_z, up to slips, steps' errors and
quanta: |sum over i+1..j of (right - left) - c ∫ω_z| <= sum of slacks + q (track_yaw.py). So for either sign the largest

    H_j  =  max over i < j of  sum over i+1..j of (± (right - left - c ∫ω_z) - slack)

must not exceed q, and H_j = max(H_{j-1}, 0) + the newest step's term: every stretch is looked at, in a few operations.
A stuck gyroscope and slips that change from step to step meet in some of them long before they do in the whole.

The gyroscope's nodes and the counts have clocks of their own: H is kept up to the gyro node after the newest count,
and at both ends of a stretch the part between count and node is left to be anything it can be.
"""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.interval import Interval, down, mid, mul, reach, up
from estimator.motion import QUANTUM, TrackBounds
from estimator.rate_integral import partial
from estimator.tracks import to_and_fro
from estimator.tube import first_not_before, last_not_after

NEVER = -1e9


@compiled
def begin_sums(sums: NDArray[np.float64]) -> None:
    """No stretch reaches over here."""
    sums[:] = NEVER


@compiled
def add_step(
    sums: NDArray[np.float64],
    left: float,
    right: float,
    time_high: float,
    tracks: tuple[float, ...],
    gauge: Interval,
    times: NDArray[np.int64],
    net: NDArray[np.float64],
    effort: NDArray[np.int64],
    begin: int,
    end: int,
    last_earliest_ns: int,
    last_latest_ns: int,
    earliest_ns: int,
    latest_ns: int,
) -> float:
    """A step further, from the count with the last stamp to the one with the next; sums [2]: H for either sign.

    By how much (m) q is exceeded in the worst stretch that ends here; 0 where it is not.
    """
    bounds = TrackBounds(*tracks)
    a = last_not_after(times, begin, end, last_earliest_ns)
    a_after = first_not_before(times, begin, end, last_latest_ns)
    b_before, b = last_not_after(times, begin, end, earliest_ns), first_not_before(times, begin, end, latest_ns)
    if a < begin or b >= end:
        begin_sums(sums)
        return 0.0
    c = mid(gauge)
    turning = (effort[b, 2] - effort[a, 2]) * QUANTUM
    slack = up(reach(gauge, c) * turning)
    for way in to_and_fro(left, right, turning, time_high, bounds):
        slack = up(slack + up(bounds.slip * way))
    slack = up(slack + 1e-12 * (abs(left) + abs(right)))
    least = most = 0.0
    for i in range(a_after + 1, b + 1):
        least, most = down(least + net[i, 2, 0]), up(most + net[i, 2, 1])
    least, most = mul((c, c), (least, most))
    first, last = mul((c, c), partial(net, effort, 2, a, a_after)), mul((c, c), partial(net, effort, 2, b_before, b))
    q = up(bounds.quantum_left + bounds.quantum_right)
    difference, worst = right - left, 0.0
    for side in range(2):
        before, after = (first[1], last[0]) if side == 0 else (-first[0], -last[1])
        step = difference - most if side == 0 else least - difference
        # A stretch that begins here may be worse than all those before.
        sums[side] = down(max(sums[side], -before) + down(step - slack))
        worst = max(worst, down(down(sums[side] + after) - q))
    return worst
