"""Tracks that change their pace faster than the robot can: a wheel that begins to spin shows within a step or two.

Between two counts the robot's middle goes G = ∫v, told by the left track and half the turn, by the right one and half
the turn, and by both: each up to slips and quanta (slip_ledger.py). As |dv/dt| <= a, v at either end of a stretch of T
seconds is within a T / 2 of G / T. So each stretch tells of v at both its ends, and stretches that end and begin at the
same count must agree on it; so must v at one count and at the next, to within a T.

Slips may change from one instant to the next, but only inside their bounds, and where both tracks slip to opposite
sides the gyroscope leaves them no room for that.
"""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_bare
from drivers.samples import Stamp
from estimator.attitude import AttitudeChain
from estimator.inconsistency import Journal
from estimator.interval import Interval, add, down, is_empty, meet, mid, mul, neg, reach, scale, up, widen
from estimator.motion import QUANTUM, TrackBounds
from estimator.position import Step
from estimator.rate_integral import integral_between
from estimator.tracks import to_and_fro
from estimator.tube import first_not_before, last_not_after

LONGEST = 16
"""Stretches are 1, 2, 4, 8, 16 steps long."""
ANY_SPEED = 1e6


class SpeedChange:
    """Watches the counts: is there a speed that explains each stretch and the one after it?"""

    def __init__(
        self, gauge_m: tuple[float, float] | None, tracks: TrackBounds, attitude: AttitudeChain, journal: Journal
    ) -> None:
        """`gauge_m`: as in TrackYaw; None: the tracks are taken to slip independently."""
        self._gauge, self._tracks, self._attitude, self._journal = gauge_m, tuple(tracks), attitude, journal
        self._steps = np.zeros((LONGEST + 1, 4))
        """[k, :] up to the k-th newest count: travel of the left and the right track, and by how much each may slip."""
        self._stamps = np.zeros((LONGEST + 1, 2), np.int64)
        self._speeds = np.zeros((LONGEST + 1, 2))
        """By all that was before each count, m/s."""
        self._known = 0
        """How many counts there are of these, the newest included."""

    def watch(self, stamp: Stamp, step: Step) -> None:
        """A step further, up to the count with this stamp."""
        if not step.counted:
            self._known = 0
        tube = self._attitude.tube
        self._known, beyond = follow(
            self._steps, self._stamps, self._speeds, self._known, step.left, step.right, step.turning, step.time_high,
            stamp.earliest_ns, stamp.latest_ns, self._tracks, self._gauge is not None, self._gauge or (0.0, 0.0),
            tube.times, tube.net, tube.effort, tube.begin, tube.end,
        )  # fmt: skip
        if beyond > 0.0:
            self._journal.report("encoders", stamp.mid_ns, beyond, "m/s")


@compiled_bare
def follow(
    steps: NDArray[np.float64],
    stamps: NDArray[np.int64],
    speeds: NDArray[np.float64],
    known: int,
    left: float,
    right: float,
    turning: float,
    time_high: float,
    earliest_ns: int,
    latest_ns: int,
    tracks: tuple[float, ...],
    geared: bool,
    gauge: Interval,
    times: NDArray[np.int64],
    net: NDArray[np.float64],
    effort: NDArray[np.int64],
    begin: int,
    end: int,
) -> tuple[int, float]:
    """A count further: how many are known now, and by how much (m/s) two stretches miss each other; 0: they don't.

    known 0: the step before this count is not one. turning: no less than the integral of |ω_z| over it. `geared`: the
    tracks' difference is [gauge] times the turn.
    """
    bounds = TrackBounds(*tracks)
    for k in range(min(known, LONGEST), 0, -1):
        for side in range(2):  # number by number: copies of rows are allocated
            steps[k, side], steps[k, 2 + side] = steps[k - 1, side], steps[k - 1, 2 + side]
            stamps[k, side], speeds[k, side] = stamps[k - 1, side], speeds[k - 1, side]
    stamps[0, 0], stamps[0, 1] = earliest_ns, latest_ns
    speeds[0, 0], speeds[0, 1] = -ANY_SPEED, ANY_SPEED
    if known == 0:
        return 1, 0.0
    known = min(known + 1, LONGEST + 1)
    a = bounds.most_acceleration
    steps[0, 0], steps[0, 1] = left, right
    ways = to_and_fro(left, right, turning, time_high, bounds)
    steps[0, 2], steps[0, 3] = up(bounds.slip * ways[0]), up(bounds.slip * ways[1])
    now = widen((speeds[1, 0], speeds[1, 1]), up(a * up((latest_ns - stamps[1, 0]) * 1e-9)))
    b_before, b = last_not_after(times, begin, end, earliest_ns), first_not_before(times, begin, end, latest_ns)
    left, right, left_slips, right_slips = 0.0, 0.0, bounds.quantum_left, bounds.quantum_right
    stretch, worst = 1, 0.0
    for k in range(1, known):
        left += steps[k - 1, 0]
        right += steps[k - 1, 1]
        left_slips = up(left_slips + steps[k - 1, 2] + 1e-14 * abs(left))
        right_slips = up(right_slips + steps[k - 1, 3] + 1e-14 * abs(right))
        if k < stretch:
            continue
        stretch *= 2
        shortest, longest = down((earliest_ns - stamps[k, 1]) * 1e-9), up((latest_ns - stamps[k, 0]) * 1e-9)
        if shortest <= 0.0:
            continue
        went = widen(scale(0.5, (left + right, left + right)), up(0.5 * (left_slips + right_slips)))
        if geared:
            first = last_not_after(times, begin, end, stamps[k, 0])
            after = first_not_before(times, begin, end, stamps[k, 1])
            if first >= begin and b < end and after <= b_before:
                turned = integral_between(net, effort, 2, first, after, b_before, b)
                c = mid(gauge)
                half = scale(0.5, mul((c, c), turned))
                half = widen(half, up(reach(gauge, c) * ((effort[b, 2] - effort[first, 2]) * QUANTUM)))
                went = meet(went, widen(add((left, left), half), left_slips))
                went = meet(went, widen(add((right, right), neg(half)), right_slips))
        if is_empty(went):  # that tracks and gyroscope contradict each other is found elsewhere
            continue
        least = down(went[0] / (shortest if went[0] < 0.0 else longest))
        most = up(went[1] / (shortest if went[1] > 0.0 else longest))
        v = widen((least, most), up(0.5 * up(a * longest)))
        worst = max(worst, max(v[0] - speeds[k, 1], speeds[k, 0] - v[1]))
        now = meet(now, v)
    worst = max(worst, now[0] - now[1])
    if worst > 0.0:
        return 1, worst
    speeds[0, 0], speeds[0, 1] = now
    return known, 0.0
