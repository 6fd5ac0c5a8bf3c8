"""The one queue between the readers and the pipeline: bounded, dropping the oldest, counting what it drops."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from drivers.samples import Sample


class Arrival(NamedTuple):
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
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._waiting = 0
        """So many wait for a change; where none does, nobody need be told, which takes longer than all the rest."""

    def put(self, arrivals: Sequence[Arrival]) -> None:
        """Add arrivals; never waits. A full queue loses its oldest: dropping a measurement is always sound."""
        with self._lock:
            for arrival in arrivals:
                if self.keeps_from_ns is None or arrival.received_ns < self.keeps_from_ns:
                    self.dropped[arrival.device] += 1
                else:
                    self._arrivals.append(arrival)
            while len(self._arrivals) > self._capacity:
                self.dropped[self._arrivals.popleft().device] += 1
            self._tell()

    def take(self, timeout_s: float) -> list[Arrival]:
        """All that is there, oldest first; waits for the first at most `timeout_s`."""
        with self._lock:
            if not self._arrivals and timeout_s > 0:
                self._wait(lambda: bool(self._arrivals), timeout_s)
            arrivals = list(self._arrivals)
            self._arrivals.clear()
            self._tell()
            return arrivals

    @property
    def empty(self) -> bool:
        """Is nothing waiting?"""
        return not self._arrivals

    def wait_for_room(self, timeout_s: float) -> bool:
        """Wait until the queue is at most a quarter full: for replays, which can be told to wait; a robot cannot."""
        if 4 * len(self._arrivals) <= self._capacity:
            return True
        with self._lock:
            return self._wait(lambda: 4 * len(self._arrivals) <= self._capacity, timeout_s)

    def _wait(self, until: Callable[[], bool], timeout_s: float) -> bool:
        self._waiting += 1
        try:
            return self._changed.wait_for(until, timeout_s)
        finally:
            self._waiting -= 1

    def _tell(self) -> None:
        if self._waiting:
            self._changed.notify_all()
