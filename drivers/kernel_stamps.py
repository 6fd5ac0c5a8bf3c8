"""The kernel stamps a frame's receipt by the wall clock; everything here runs on the monotonic one.

    monotonic receipt = stamp - (wall - monotonic)         the offset as measured beside the read

That holds while nobody sets the clock between receipt and read. So the offset is measured at every read; where it has
changed by more than slewing explains, the offsets of before are tried as well, until the queue was seen empty. A frame
was received after the one before it, after the last look that found the queue empty, and not after the read: where
that leaves one time it is taken, else none: the frame is like one of a port without stamps. So a clock that is set
moves no stamp.
"""

import time
from collections.abc import Callable

_SLEW = 500e-6
"""The most that a kernel slews its clock."""
_JITTER_NS = 50_000
"""How differently the offset may be measured twice."""
_ATTEMPTS = 4
_OFFSETS = 4


class KernelStamps:
    """Turns receipt stamps into monotonic times."""

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        """From now on."""
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._now_ns, offset_ns = self._measure()
        self._offsets_ns = [offset_ns]
        """The present one last; before it those of frames that may still be queued."""
        self.not_before_ns = self._now_ns
        """The next frame was not received before."""
        self.clock_steps = 0
        """How often the wall clock was set."""
        self.unstamped = 0
        """Frames whose receipt could not be told."""

    def empty_at(self, now_ns: int) -> None:
        """The queue was seen empty at this monotonic time."""
        self.not_before_ns = max(self.not_before_ns, now_ns)
        del self._offsets_ns[:-1]

    def received_ns(self, stamp_ns: int) -> int | None:
        """Monotonic time of the receipt of the frame that was just read, from its wall-clock stamp; None: not known."""
        before_ns = self._now_ns
        self._now_ns, offset_ns = self._measure()
        if abs(offset_ns - self._offsets_ns[-1]) > _JITTER_NS + _SLEW * (self._now_ns - before_ns):
            self.clock_steps += 1
            self._offsets_ns = [*self._offsets_ns[1 - _OFFSETS :], offset_ns]
        else:
            self._offsets_ns[-1] = offset_ns
        low_ns, high_ns = self.not_before_ns - _JITTER_NS, self._now_ns + _JITTER_NS
        possible = [t for t in (stamp_ns - offset for offset in self._offsets_ns) if low_ns <= t <= high_ns]
        if len(possible) != 1:
            self.unstamped += 1
            return None
        self.not_before_ns = min(max(possible[0], self.not_before_ns), self._now_ns)
        return self.not_before_ns

    def _measure(self) -> tuple[int, int]:
        """Monotonic time, and how much the wall clock is ahead: the closest of a few attempts."""
        closest_ns, now_ns, offset_ns = 1 << 62, 0, 0
        for _ in range(_ATTEMPTS):
            begin_ns, wall_ns, end_ns = self._monotonic_ns(), self._wall_ns(), self._monotonic_ns()
            if end_ns - begin_ns < closest_ns:
                closest_ns, now_ns, offset_ns = end_ns - begin_ns, end_ns, wall_ns - (begin_ns + end_ns) // 2
            if closest_ns < _JITTER_NS // 10:
                break
        return now_ns, offset_ns
