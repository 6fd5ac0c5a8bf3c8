"""The one queue between the readers and the pipeline: bounded, dropping the oldest, counting what it drops."""

import threading
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.samples import Sample


@dataclass(frozen=True, slots=True)
class Arrival:
    """A sample, whose it is, and when its last byte was read (system monotonic; never for bounds)."""

    device: str
    sample: Sample
    received_ns: int


class SampleQueue:
    """Many readers put, one pipeline takes."""

    def __init__(self, capacity: int = 4096) -> None:
        self.dropped: Counter[str] = Counter()
        """Arrivals lost to a full queue, or put while none were kept, by device."""
        self.keeps_from_ns: int | None = 0
        """Arrivals that were received earlier are not kept; None: none are."""
        self._capacity = capacity
        self._arrivals: deque[Arrival] = deque()
        self._changed = threading.Condition()

    def put(self, arrivals: Sequence[Arrival]) -> None:
        """Add arrivals; never waits. A full queue loses its oldest: dropping a measurement is always sound."""
        with self._changed:
            for arrival in arrivals:
                if self.keeps_from_ns is None or arrival.received_ns < self.keeps_from_ns:
                    self.dropped[arrival.device] += 1
                else:
                    self._arrivals.append(arrival)
            while len(self._arrivals) > self._capacity:
                self.dropped[self._arrivals.popleft().device] += 1
            self._changed.notify_all()

    def take(self, timeout_s: float) -> list[Arrival]:
        """All that is there, oldest first; waits for the first at most `timeout_s`."""
        with self._changed:
            if not self._arrivals:
                self._changed.wait(timeout_s)
            arrivals = list(self._arrivals)
            self._arrivals.clear()
            self._changed.notify_all()
            return arrivals

    @property
    def empty(self) -> bool:
        """Is nothing waiting?"""
        return not self._arrivals

    def wait_for_room(self, timeout_s: float) -> bool:
        """Wait until the queue is at most a quarter full: for replays, which can be told to wait; a robot cannot."""
        if 4 * len(self._arrivals) <= self._capacity:
            return True
        with self._changed:
            return self._changed.wait_for(lambda: 4 * len(self._arrivals) <= self._capacity, timeout_s)
