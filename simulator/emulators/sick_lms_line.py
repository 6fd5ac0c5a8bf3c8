"""The line on which an emulated SICK LMS2xx sends: bytes take their time, and long telegrams leave in bursts."""

from collections import deque
from dataclasses import dataclass

from drivers.sick_lms.measurements import TURN_NS

BURST = 508
"""Bytes of a telegram that the scanner can send within one mirror turn (LMS2XX section 3)."""


@dataclass(slots=True)
class _Burst:
    """Bytes that leave back to back."""

    start_ns: int
    baud: int
    data: bytes
    sent: int = 0

    def end_ns(self, count: int) -> int:
        """When the last bit of the first `count` bytes leaves."""
        return self.start_ns + count * 10_000_000_000 // self.baud

    def leave_until(self, now_ns: int) -> bytes:
        """Bytes that left by `now_ns` and were not handed out yet."""
        count = min(len(self.data), max(0, (now_ns - self.start_ns) * self.baud // 10_000_000_000))
        left = self.data[self.sent : count]
        self.sent = max(self.sent, count)
        return left


class SendingLine:
    """What is being sent, and when the line will be free."""

    def __init__(self, now_ns: int) -> None:
        self._bursts: deque[_Burst] = deque()
        self.free_ns = now_ns

    def send(self, data: bytes, baud: int, now_ns: int) -> None:
        """Put bytes on the line now, or as soon as it is free."""
        start = max(now_ns, self.free_ns)
        for at in range(0, len(data), BURST):
            burst = _Burst(start, baud, data[at : at + BURST])
            self._bursts.append(burst)
            self.free_ns = burst.end_ns(len(burst.data))
            start = max(self.free_ns, start + TURN_NS)

    def leave_until(self, now_ns: int) -> bytes:
        """Bytes whose last bit left by `now_ns`, each once."""
        left = b""
        while self._bursts:
            burst = self._bursts[0]
            left += burst.leave_until(now_ns)
            if burst.sent < len(burst.data):
                break
            self._bursts.popleft()
        return left

    def interrupt(self, now_ns: int) -> None:
        """Cut off what is being sent, after the byte that is under way."""
        for burst in self._bursts:
            begun = max(0, -((burst.start_ns - now_ns) * burst.baud // 10_000_000_000))
            burst.data = burst.data[: max(burst.sent, begun)]
        self.free_ns = max([now_ns, *(b.end_ns(len(b.data)) for b in self._bursts if b.data)])

    def clear(self, now_ns: int) -> None:
        """The power fails."""
        self._bursts.clear()
        self.free_ns = now_ns
