"""What the tracks' difference says of yaw: alone where the gyroscope is silent, and against it where it speaks.

The ground speeds of the tracks differ by the yaw rate times the distance of their turning centres (Martinez et al.
2005), so over a stretch between two counts the integral of ω_z is in ((right - left) ± slip ± quanta) / [gauge]. That
distance may change meanwhile: with [gauge] = c ± w it is ((right - left) ± slip ± quanta ± w times the integral of
|ω_z|) / c, which is the same where all of the stretch turns to one side.
"""

from itertools import islice

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from drivers.samples import Stamp
from estimator.attitude import AttitudeChain
from estimator.inconsistency import Journal
from estimator.interval import (
    Interval,
    add,
    cosine,
    divide,
    is_empty,
    meet,
    mid,
    reach,
    scale,
    sine,
    sub,
    up,
    widen,
)
from estimator.motion import QUANTUM, TrackBounds
from estimator.position import Step
from estimator.rate_integral import partial
from estimator.tracks import to_and_fro
from estimator.tube import hull_between
from estimator.turn_cusum import add_step, begin_sums

STRETCH_NS = 400_000_000
"""Yaw is compared over at least so long: quanta and slip weigh less than in a single step."""
LONGEST_NS = 1_500_000_000
STUCK_PACKETS = 10
WELL_KNOWN = 0.2
"""rad: width of the gyroscope's turn over a stretch, beyond which it had a gap."""


class TrackYaw:
    """Watches the counts stretch by stretch."""

    def __init__(
        self, gauge_m: tuple[float, float] | None, tracks: TrackBounds, attitude: AttitudeChain, journal: Journal
    ) -> None:
        """`gauge_m`: least and most distance of the tracks' turning centres; None: the tracks say nothing of yaw."""
        self._gauge, self._tracks, self._attitude, self._journal = gauge_m, tracks, attitude, journal
        self._start: Stamp | None = None
        self._left = self._right = self._way = 0.0
        self._last: Stamp | None = None
        self._sums = np.zeros(2)
        """Of every stretch, see turn_cusum.py."""

    def watch(self, stamp: Stamp, step: Step) -> None:
        """A step further, up to the count with this stamp; contracts the newest yaws where the stretch is complete."""
        if self._gauge is None:
            return
        self._sum_up(stamp, step, self._gauge)
        if self._start is None or not step.counted:
            self._begin(stamp)
            return
        self._left += step.left
        self._right += step.right
        for way in to_and_fro(step.left, step.right, step.turning, step.time_high, self._tracks):
            self._way = up(self._way + way)
        lasted_ns = stamp.earliest_ns - self._start.latest_ns
        if lasted_ns >= STRETCH_NS and (self._compare(self._start, stamp, self._gauge) or lasted_ns > LONGEST_NS):
            self._begin(stamp)

    def _sum_up(self, stamp: Stamp, step: Step, gauge: tuple[float, float]) -> None:
        """Is there a stretch that ends here, over which tracks and gyroscope contradict each other?"""
        last, self._last, tube = self._last, stamp, self._attitude.tube
        if last is None or not step.counted:
            begin_sums(self._sums)
            return
        beyond = add_step(
            self._sums, step.left, step.right, step.time_high, tuple(self._tracks), gauge, tube.times, tube.net,
            tube.effort, tube.begin, tube.end, last.earliest_ns, last.latest_ns, stamp.earliest_ns, stamp.latest_ns,
        )  # fmt: skip
        if beyond > 0.0:
            begin_sums(self._sums)
            # So soon, which tells of the larger turn is chance: only a gyroscope that repeats itself gives itself away.
            sensor = "gyro" if self.gyro_repeats_itself else "encoders"
            self._journal.report(sensor, stamp.mid_ns, beyond / mid(gauge), "rad")

    def _begin(self, stamp: Stamp) -> None:
        self._start, self._left, self._right, self._way = stamp, 0.0, 0.0, 0.0

    def _compare(self, first: Stamp, last: Stamp, gauge: tuple[float, float]) -> bool:
        """Yaw at the gyro node after the last count less yaw at the first: by the tracks and by the gyroscope.

        False: go on from the same beginning, since the gyroscope knows little of this stretch.
        """
        chain, tube = self._attitude, self._attitude.tube
        a, a_after = tube.before(first.earliest_ns), tube.after(first.latest_ns)
        b_before, b = tube.before(last.earliest_ns), tube.after(last.latest_ns)
        if a < tube.begin or b >= tube.end or not chain.level:
            return True
        bounds = self._tracks
        slack = up(up(bounds.slip * self._way) + up(bounds.quantum_left + bounds.quantum_right))
        slack = up(slack + 1e-12 * (abs(self._left) + abs(self._right)))
        centre, to_and_fro = mid(gauge), float(tube.effort[b, 2] - tube.effort[a, 2]) * QUANTUM
        slack = up(slack + up(reach(gauge, centre) * to_and_fro))
        turned = divide(widen((self._right - self._left, self._right - self._left), slack), (centre, centre))
        by_tracks = yaw_by_tracks(tube.box, tube.swing, tube.net, tube.effort, a, a_after, b_before, b, turned)
        by_gyro = sub((0.0, 0.0), chain.yaw_between(a, a_after, b))
        if is_empty(meet(by_tracks, by_gyro)):
            gap = max(by_tracks[0] - by_gyro[1], by_gyro[0] - by_tracks[1])
            self._journal.report(self._likelier(mid(by_tracks), mid(by_gyro)), last.mid_ns, gap, "rad")
        elif by_tracks[1] - by_tracks[0] < by_gyro[1] - by_gyro[0]:
            chain.narrow_yaw(a, a_after, b, by_tracks, last.mid_ns)
        return by_gyro[1] - by_gyro[0] < WELL_KNOWN

    def _likelier(self, by_tracks: float, by_gyro: float) -> str:
        """Who is to be named. A gyroscope that says the same again and again is stuck; else wheels slip oftener.

        A track that slips runs further than the ground: tracks that tell of the smaller turn are right.
        """
        smaller = abs(by_tracks) < abs(by_gyro)
        return "gyro" if self.gyro_repeats_itself or smaller else "encoders"

    @property
    def gyro_repeats_itself(self) -> bool:
        """Have its last packets all said the same?"""
        return len({packet.rate for packet in islice(reversed(self._attitude.packets), STUCK_PACKETS)}) == 1


@compiled
def yaw_by_tracks(
    box: NDArray[np.float64],
    swing: NDArray[np.float64],
    net: NDArray[np.float64],
    effort: NDArray[np.int64],
    a: int,
    a_after: int,
    b_before: int,
    b: int,
    turned: Interval,
) -> Interval:
    """Change of yaw from the first count, between gyro nodes a and a_after, to node b.

    turned: integral of ω_z from the first count to the last, which is between b_before and b. SMF equation 1 as in
    motion.turn: ψ' = (sφ ω_y + cφ ω_z) / cθ, the factors enclosed over all of the stretch.
    """
    angles = np.empty((box.shape[1], 2))
    hull_between(box, swing, a, b, angles)
    phi, theta = (angles[0, 0], angles[0, 1]), (angles[1, 0], angles[1, 1])
    ct = cosine(theta)
    if ct[0] < 0.1:
        return -1e3, 1e3
    y, z = divide(sine(phi), ct), divide(cosine(phi), ct)
    wy = partial(net, effort, 1, a, a_after)
    for i in range(a_after + 1, b + 1):
        wy = add(wy, (net[i, 1, 0], net[i, 1, 1]))
    wz = add(turned, partial(net, effort, 2, b_before, b))
    varied_y = (effort[b, 1] - effort[a, 1]) * QUANTUM
    varied_z = (effort[b, 2] - effort[a, 2]) * QUANTUM
    cy, cz = mid(y), mid(z)
    rest = up(up(reach(y, cy) * varied_y) + up(reach(z, cz) * varied_z))
    return widen(add(scale(cy, wy), scale(cz, wz)), up(rest))
