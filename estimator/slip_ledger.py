"""What the gyroscope proves of the tracks' slip: it can't be the largest on both tracks where they disagree.

Over a step let the tracks run T_L and T_R and the ground come g = T + δ, |δ| <= r (slip times the way). base_link goes
by (g_L + g_R) / 2, and g_R - g_L is the turn times the distance of the turning centres (track_yaw.py). So with
x = (T_R - T_L - gauge * turn) / 2 and m = (δ_L + δ_R) / 2, the slip of the middle, δ_L = m + x and δ_R = m - x, and

    |m|  <=  (r_L + r_R) / 2 - | |x| - |r_L - r_R| / 2 |.

Over many steps the slips of the middle add up to no more than their bounds less the *credit*,
|sum x| - sum |r_L - r_R| / 2; where less than these bounds is paid for (tracks.slipping), the credit is less by as
much. Tracks that slip alike earn none; where they slip by their bounds to opposite sides, nothing is left of the slip's
error. Only sums count, so the error of the counts enters once. The gauge may change from one instant to the next within
[gauge] = c ± w: the integral of gauge times turn is then c times the whole turn, ± w times how much was turned to and
fro.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_bare
from drivers.samples import Stamp
from estimator.attitude import AttitudeChain
from estimator.interval import Interval, mid, mig, mul, reach, sub, up, widen
from estimator.motion import QUANTUM, TrackBounds
from estimator.rate_integral import integral_between
from estimator.tracks import to_and_fro

BREAKS = 3


class Mark(NamedTuple):
    """Where a stretch begins: at a count."""

    stamp: Stamp
    sums: NDArray[np.float64]
    """[4] travel of the left and of the right track, sum |r_L - r_R| / 2 and of what isn't paid for of the bounds
    (tracks.slipping), and how often no stretch may reach over."""


class SlipLedger:
    """Sums over the counts, from which the credit of a stretch follows."""

    def __init__(self, gauge_m: tuple[float, float] | None, tracks: TrackBounds, attitude: AttitudeChain) -> None:
        """`gauge_m`: as in TrackYaw; None: there never is a credit."""
        self._gauge, self._tracks, self._attitude = gauge_m, tracks, attitude
        self._bounds = tuple(tracks)
        self._stamp: Stamp | None = None
        self._sums = np.zeros(4)

    def step(
        self, stamp: Stamp, left: float, right: float, counted: bool, slid: float, turning: float, time_high: float
    ) -> None:
        """A count further; not `counted`, or nearly as fast as the robot can: a stretch can't reach over it."""
        self._stamp = stamp
        if self._gauge is not None:
            enter(self._sums, left, right, counted, slid, turning, time_high, self._bounds)

    def mark(self) -> Mark | None:
        """A stretch begins at the newest count."""
        return None if self._stamp is None else Mark(self._stamp, self._sums.copy())

    def credit(self, since: Mark | None) -> float:
        """Metres by which the slips of the middle since then add up to less than their bounds."""
        if self._stamp is None or since is None or self._gauge is None or self._sums[BREAKS] != since.sums[BREAKS]:
            return 0.0
        turned = self._turned(since.stamp, self._stamp)
        if turned is None:
            return 0.0
        whole, to_and_fro = turned
        centre = mid(self._gauge)
        left, right, spread, _ = (self._sums - since.sums).tolist()
        rounding = 1e-11 * (1.0 + float(np.abs(self._sums[:BREAKS]).sum()))
        q = up(up(self._tracks.quantum_left + self._tracks.quantum_right) + rounding)
        q = up(q + up(reach(self._gauge, centre) * to_and_fro))
        x = sub(widen((right - left, right - left), q), mul((centre, centre), whole))
        return float(max(0.0, (0.5 * mig(x) - spread - rounding) * (1.0 - 1e-12)))

    def _turned(self, first: Stamp, last: Stamp) -> tuple[Interval, float] | None:
        """The integral of ω_z between two counts, and no less than that of |ω_z|; None without nodes around them."""
        tube = self._attitude.tube
        a, a_after = tube.before(first.earliest_ns), tube.after(first.latest_ns)
        b_before, b = tube.before(last.earliest_ns), tube.after(last.latest_ns)
        if a < tube.begin or b >= tube.end or a_after > b_before:
            return None
        to_and_fro = float(tube.effort[b, 2] - tube.effort[a, 2]) * QUANTUM
        return integral_between(tube.net, tube.effort, 2, a, a_after, b_before, b), to_and_fro


@compiled_bare
def enter(
    sums: NDArray[np.float64],
    left: float,
    right: float,
    counted: bool,
    slid: float,
    turning: float,
    time_high: float,
    tracks: tuple[float, ...],
) -> None:
    """One step more in sums [4]; its slips bounded as in `tracks.tracked`, which must not have cut the way short."""
    bounds = TrackBounds(*tracks)
    if not counted:
        sums[BREAKS] += 1.0
        return
    a, b = to_and_fro(left, right, turning, time_high, bounds)
    if up(0.5 * abs(left + right) + up(bounds.slip * up(a + b))) >= bounds.most_speed * time_high:
        sums[BREAKS] += 1.0
    sums[0] += left
    sums[1] += right
    sums[2] += up(up(0.5 * bounds.slip) * up(up(abs(a - b)) + up(max(0.0, up(a + b) - slid))))
