"""When the robot surely stood still: no tick for a declared time before and after. It stays, and its bias shows."""

import numpy as np
from numpy.typing import NDArray

from drivers.samples import WheelTicks
from estimator.attitude import AttitudeChain
from estimator.config import FilterConfig
from estimator.position import PositionChain

HELD_EVERY_NS = 100_000_000
HELD_LONGEST_NS = 1_000_000_000
"""So long yaw is held against the same instant; it has to be among the nodes still."""


class Standstill:
    """Watches the counts; while they rest, the gyroscope's bias shows, and yaw and place are held.

    The robot may begin to move, or come to rest, within a tick; so both ends of a stretch are left out.
    """

    def __init__(self, config: FilterConfig, attitude: AttitudeChain, position: PositionChain) -> None:
        """What is declared of tracks without a tick for so long."""
        self._after_ns = None if config.standstill_s is None else int(config.standstill_s * 1e9)
        self._way_m = config.standstill_way_m if config.set == "box" else None
        """A new ellipsoid around a box, every time, would be wider than what is gained."""
        self._attitude, self._position = attitude, position
        self._last: WheelTicks | None = None
        self._still: tuple[WheelTicks, int] | None = None
        """First reading of the present counts, and until when they were used."""
        self._held_from_ns = self._held_to_ns = 0
        self._stands_in: NDArray[np.float64] | None = None
        """[3, 2] the place in the map, as it was first known in this rest."""

    def forget_place(self) -> None:
        """What was known of it is not all any more."""
        self._stands_in = None

    def watch(self, ticks: WheelTicks) -> None:
        """Take one reading; the true rate in the stretch is within standstill_rate, the rest is bias."""
        last, self._last = self._last, ticks
        if self._after_ns is None or last is None:
            return
        same = (ticks.left, ticks.right, ticks.epoch) == (last.left, last.right, last.epoch)
        if not same or ticks.stamp.earliest_ns - last.stamp.latest_ns > self._after_ns:
            self._still = self._stands_in = None
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
            self._hold_place(end_ns)
            self._held_to_ns = end_ns
            if end_ns - self._held_from_ns >= HELD_LONGEST_NS:
                self._held_from_ns = end_ns

    def _hold_place(self, end_ns: int) -> None:
        """It is where it was when that was first known, give or take what is declared."""
        if self._way_m is None:
            return
        if self._stands_in is None:
            self._stands_in = self._position.place_at(end_ns)
        else:
            self._position.hold_place(self._stands_in, end_ns, self._way_m)
