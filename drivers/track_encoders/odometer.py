"""Both tracks' counters without end, from counters that wrap around and from units that restart.

A counter of b bits has moved by d = (new - old) mod 2^b, taken as -2^(b-1) <= d < 2^(b-1), if it can have moved by less
than 2^(b-1) at all since the last reading. How far it can have moved, the track's greatest speed tells. So:

    it may have moved by half its range, or its unit may have restarted meanwhile    a gap: a new epoch begins here
    the change is one that a track can make                                          counted
    it is not, in either counter                                                     kept back until the next reading...
    ... which goes on from it alone                                                  the unit restarted: a new epoch
    ... which goes on from the reading before alone                                  it was a false one, and is dropped
    ... which may go on from either                                                  each begins an epoch of its own

A wrap that is believed is therefore a true one as long as the declared speed holds. Counts of different epochs are
never subtracted; a gap that was none costs tightness alone.
"""

from collections import Counter
from dataclasses import dataclass
from math import ceil

SLACK = 2.0
"""A change is taken for one of the tracks up to so many times the declared speed: whether that speed was exceeded is
the filter's question, not ours."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Both raw counts, and when the earlier and the later of them was read."""

    left: int
    right: int
    first_ns: int
    last_ns: int
    late_ns: int = 0
    """So much earlier than their reads they may have come, beside the declared latency."""


@dataclass(frozen=True, slots=True)
class Count:
    """A reading, unwrapped."""

    left: int
    right: int
    epoch: int
    reading: Reading


@dataclass(frozen=True, slots=True)
class TrackLimits:
    """What is known of one track's counter."""

    bits: int
    most_ticks_per_s: float | None
    """None: the track's speed isn't known. Then a wide counter is trusted a quarter of its range, a narrow one half."""
    error_ticks: float = 1.0
    """How far a difference of two counts can be off."""

    def most_change(self, elapsed_ns: int) -> int | None:
        """The greatest change in that time, by which a reading is judged; None: it can't be judged, nor unwrapped."""
        half = 1 << (self.bits - 1)
        if self.most_ticks_per_s is None:
            return half - 1 if self.bits < 16 else half // 2
        moved = self.most_ticks_per_s * max(elapsed_ns, 0) * 1e-9
        if moved * (1 + 1e-9) + self.error_ticks + 1 >= half:
            return None
        return min(half - 1, ceil(SLACK * moved + self.error_ticks + 1))

    def change(self, old: int, new: int) -> int:
        """The smallest change that leads from one raw count to another."""
        half = 1 << (self.bits - 1)
        return ((new - old + half) % (2 * half)) - half


class Odometer:
    """Counts both tracks. counts: `gaps` and `restarts`, which began new epochs, and `jumps`, readings kept back."""

    def __init__(
        self, left: TrackLimits, right: TrackLimits, spread_ns: int, restart_ns: int, counts: Counter[str]
    ) -> None:
        """spread_ns: how much later one reading can be read after its acquisition than another. restart_ns: a unit that
        restarts is silent at least so long.
        """
        self._limits = left, right
        self._spread_ns, self._restart_ns = spread_ns, restart_ns
        self._counts = counts
        self._last: Count | None = None
        self._doubtful: Reading | None = None
        self._epoch = 0

    def interrupt(self) -> None:
        """Nobody knows what was counted meanwhile: the next reading begins a new epoch."""
        self._doubtful = None
        if self._last is not None:
            self._epoch += 1
            self._last = None

    def take(self, reading: Reading) -> list[Count]:
        """The counts that are sure now: none, one, or the one kept back and this one."""
        if self._last is None:
            return [self._begin(reading)]
        if self._may_be_new(self._last.reading, reading):
            self._counts["gaps"] += 1
            return [*self.finish(), self._begin(reading)]
        doubtful, self._doubtful = self._doubtful, None
        count = self._next(self._last, reading)
        if doubtful is not None and not self._may_be_new(doubtful, reading):
            first = Count(doubtful.left, doubtful.right, self._epoch + 1, doubtful)
            restarted = self._next(first, reading)
            if count is not None and restarted is not None:
                self._counts["gaps"] += 1
                return [self._begin(doubtful), self._begin(reading)]
            if restarted is not None:
                self._counts["restarts"] += 1
                self.interrupt()
                self._last = restarted
                return [first, restarted]
        if count is not None:
            self._last = count
            return [count]
        self._counts["jumps"] += 1
        self._doubtful = reading
        return []

    def finish(self) -> list[Count]:
        """Nothing follows that could tell about a reading kept back: it is one of an epoch of its own."""
        return [self._begin(self._doubtful)] if self._doubtful is not None else []

    def _begin(self, reading: Reading) -> Count:
        self.interrupt()
        self._last = Count(reading.left, reading.right, self._epoch, reading)
        return self._last

    def _elapsed_ns(self, old: Reading, new: Reading) -> int:
        """At most."""
        return new.last_ns - old.first_ns + old.late_ns + self._spread_ns

    def _may_be_new(self, old: Reading, new: Reading) -> bool:
        """May the unit have restarted in between, or a counter have wrapped unseen?"""
        elapsed_ns = self._elapsed_ns(old, new)
        return elapsed_ns > self._restart_ns or any(track.most_change(elapsed_ns) is None for track in self._limits)

    def _next(self, old: Count, reading: Reading) -> Count | None:
        """The count that goes on from `old`; None where no track could have made that change."""
        left, right = self._limits
        elapsed_ns = self._elapsed_ns(old.reading, reading)
        changes = left.change(old.reading.left, reading.left), right.change(old.reading.right, reading.right)
        for track, change in zip(self._limits, changes, strict=True):
            if abs(change) > (track.most_change(elapsed_ns) or 0):
                return None
        return Count(old.left + changes[0], old.right + changes[1], old.epoch, reading)
