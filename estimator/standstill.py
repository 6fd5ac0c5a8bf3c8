"""When the robot surely stood still: no tick for a declared time before and after. Its yaw stays, its bias shows."""

from drivers.samples import WheelTicks
from estimator.attitude import AttitudeChain

HELD_EVERY_NS = 100_000_000
HELD_LONGEST_NS = 1_000_000_000
"""So long yaw is held against the same instant; it has to be among the nodes still."""


class Standstill:
    """Watches the counts; while they rest, the gyroscope's bias shows and yaw is held.

    The robot may begin to move, or come to rest, within a tick; so both ends of a stretch are left out.
    """

    def __init__(self, after_s: float | None, attitude: AttitudeChain) -> None:
        """`after_s`: tracks without a tick for this long say that the robot stands; None: they never do."""
        self._after_ns = None if after_s is None else int(after_s * 1e9)
        self._attitude = attitude
        self._last: WheelTicks | None = None
        self._still: tuple[WheelTicks, int] | None = None
        """First reading of the present counts, and until when they were used."""
        self._held_from_ns = self._held_to_ns = 0

    def watch(self, ticks: WheelTicks) -> None:
        """Take one reading; the true rate in the stretch is within standstill_rate, the rest is bias."""
        last, self._last = self._last, ticks
        if self._after_ns is None or last is None:
            return
        same = (ticks.left, ticks.right, ticks.epoch) == (last.left, last.right, last.epoch)
        if not same or ticks.stamp.earliest_ns - last.stamp.latest_ns > self._after_ns:
            self._still = None
            return
        first, used_until_ns = self._still if self._still else (last, 0)
        begin_ns, end_ns = first.stamp.latest_ns + self._after_ns, ticks.stamp.earliest_ns - self._after_ns
        if end_ns > max(begin_ns, used_until_ns):
            self._attitude.learn_bias(begin_ns, end_ns, used_until_ns)
            self._hold(begin_ns, end_ns)
            used_until_ns = end_ns
        self._still = (first, used_until_ns)

    def _hold(self, begin_ns: int, end_ns: int) -> None:
        """Yaw is what it was at an instant of the stretch, which is a new one now and then."""
        if not begin_ns <= self._held_from_ns <= end_ns:
            self._held_from_ns = self._held_to_ns = begin_ns
        if end_ns - self._held_to_ns >= HELD_EVERY_NS:
            self._attitude.hold_yaw(self._held_from_ns, end_ns)
            self._held_to_ns = end_ns
            if end_ns - self._held_from_ns >= HELD_LONGEST_NS:
                self._held_from_ns = end_ns
