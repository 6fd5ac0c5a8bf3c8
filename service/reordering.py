"""Samples of several devices, put into the order in which they were acquired.

Transport delays differ, so samples arrive out of order. They are held until the newest stamp seen is a window ahead,
then handed on sorted by stamp. What comes later than that is refused: dropping a measurement is always sound. Ties are
broken by device and arrival, so the order depends on the samples alone, not on which thread was quicker.
"""

import heapq
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from drivers.samples import Sample, Scan
from service.sample_queue import Arrival


def time_in_order(sample: Sample) -> int:
    """The instant that a sample is sorted by: the end of its stamp, for a scan that of its last shot.

    The end, since it follows the reads: samples of one device keep their order where a late read widened their stamps.
    """
    if isinstance(sample, Scan):
        return sample.stamp.latest_ns + int(np.max(sample.beam_offset_ns, initial=0))
    return sample.stamp.latest_ns


def _begins_at(entry: tuple[int, int, int, Arrival]) -> int:
    return entry[3].sample.stamp.earliest_ns


class ReorderingWindow:
    """Holds arrivals for `window_ns` of their own time and releases them in order."""

    def __init__(self, window_ns: int, devices: tuple[str, ...], capacity: int = 4096) -> None:
        self.late: Counter[str] = Counter()
        """Samples that came after their place in the order was gone, by device."""
        self._window_ns = window_ns
        self._rank = {device: rank for rank, device in enumerate(devices)}
        self._capacity = capacity
        self._heap: list[tuple[int, int, int, Arrival]] = []
        self._arrived = 0
        self._newest_of: dict[str, int] = {}
        self._newest_ns: int | None = None
        self._released: tuple[int, int] | None = None

    def add(self, arrival: Arrival) -> None:
        """Take one arrival into the window, or count it as late."""
        device = arrival.device
        when, newest = time_in_order(arrival.sample), self._newest_of.get(device)
        if newest is not None and newest > when:
            when = newest  # samples of one device never overtake each other, however late the reads that gave them
        self._newest_of[device] = when
        rank = self._rank[device]
        if self._released is not None and (when, rank) < self._released:
            self.late[device] += 1
            return
        self._arrived += 1
        heapq.heappush(self._heap, (when, rank, self._arrived, arrival))
        if self._newest_ns is None or when > self._newest_ns:
            self._newest_ns = when

    def oldest_ns(self, device: str) -> int | None:
        """Time in the order of the first sample of `device` that is held."""
        rank = self._rank[device]
        return min((entry[0] for entry in self._heap if entry[1] == rank), default=None)

    def released_at_ns(self, device: str, begin_ns: int) -> int | None:
        """When the newest stamp must have come for the first sample of `device` to be released whose own stamp begins
        at `begin_ns` or later. None where none such is held.
        """
        rank = self._rank[device]
        held = (entry[0] for entry in self._heap if entry[1] == rank and _begins_at(entry) >= begin_ns)
        first = min(held, default=None)
        return None if first is None else first + self._window_ns

    def release(self) -> Sequence[Arrival]:
        """Everything that is a window older than the newest, in order."""
        heap = self._heap
        if not heap or self._newest_ns is None:
            return ()
        until_ns, released = self._newest_ns - self._window_ns, list[Arrival]()
        while heap and (heap[0][0] <= until_ns or len(heap) > self._capacity):
            released.append(self._pop())
        return released

    def release_all(self) -> Iterator[Arrival]:
        """The rest, in order: the stream has ended."""
        while self._heap:
            yield self._pop()

    def _pop(self) -> Arrival:
        when, rank, _, arrival = heapq.heappop(self._heap)
        self._released = (when, rank)
        return arrival
