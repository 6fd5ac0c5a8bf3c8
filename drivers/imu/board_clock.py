"""The board's clock against the host's: reboots, wraps, and when a packet was acquired at the latest.

A packet can't have been acquired after it was read. So the smallest (read - device time) seen so far bounds the offset
of the two clocks from above, for all sensors of the board; it ages by the clocks' drift. A packet that was held up on
its way is thereby placed as early as the punctual ones say. From below nothing is learned here: only the reader knows
how late it was (service/lateness.py), so the filter carries the beginnings of stamps forward.

Message clocks differ. Some count milliseconds in 32 bits and wrap after 49.7 days; a board may even stamp one kind of
message since its boot and another with a calendar's time, and times of two clocks must never be subtracted.
"""

from typing import NamedTuple, TypeAlias

SensorKey: TypeAlias = tuple[str, int]
"""Message and sensor."""

_JUMP_NS = 1_000_000_000
"""A clock that moves away from the host's by so much between two packets has been set anew."""
_SILENT_NS = 1_000_000_000
"""The clock of a board that is silent for so long is no reference any more."""
WRAP_US = 1000 << 32
"""32 bits of milliseconds."""


class Placed(NamedTuple):
    """One packet in time."""

    device_us: int | None
    """By the board's one clock, unwrapped; None where the message has a clock of its own."""
    latest_ns: int
    """Not acquired after this (host monotonic)."""
    restarted: bool
    """The board has begun anew before it: its earlier times mean nothing any more."""


class BoardClock:
    """What is known of one board's clock."""

    def __init__(self, latency_ns: tuple[int, int], drift: float) -> None:
        """[least, most] from acquisition to read; drift: relative rate error against the host's clock."""
        self._least_ns, self._most_ns = latency_ns
        self._drift = drift
        self.clear()

    def clear(self) -> None:
        """Nothing is known any more."""
        self._last: dict[SensorKey, tuple[int, int]] = {}
        """Of each sensor on the board's clock: its last packet's device time in us and its read in ns."""
        self._foreign: set[SensorKey] = set()
        self._newest: tuple[int, int] | None = None
        """The newest packet on the board's clock: device time in us, read in ns."""
        self._newest_wraps = False
        self._bound: tuple[int, int] | None = None
        """(device time in us at least, acquired at the latest in ns) of the packet that bounds the offset best."""

    @property
    def known(self) -> bool:
        """Has any packet been placed?"""
        return self._newest is not None

    def place(self, sensor: SensorKey, device_us: int, resolution_us: int, wraps: bool, read_ns: int) -> Placed:
        """Take a packet read at `read_ns`, whose time counts steps of `resolution_us`; `wraps`: in 32 bits."""
        raw_us, restarted = device_us, False
        if self._newest is not None:
            if wraps:
                device_us = self._unwrapped(raw_us)
            restarted = self._has_restarted(sensor, device_us, wraps, read_ns)
            if restarted:
                self.clear()
                device_us = raw_us
            elif sensor not in self._last and self._apart(device_us, read_ns, *self._newest):
                self._foreign.add(sensor)
        if sensor in self._foreign:
            return Placed(None, read_ns - self._least_ns, restarted)
        self._last[sensor] = self._newest = device_us, read_ns
        self._newest_wraps = wraps
        return Placed(device_us, self._latest_ns(device_us, resolution_us, read_ns - self._least_ns), restarted)

    def _unwrapped(self, device_us: int) -> int:
        """The time nearest to the board's newest that 32 bits of milliseconds can mean."""
        assert self._newest is not None
        return device_us + WRAP_US * max(0, round((self._newest[0] - device_us) / WRAP_US))

    def _has_restarted(self, sensor: SensorKey, device_us: int, wraps: bool, read_ns: int) -> bool:
        assert self._newest is not None
        if sensor in self._last:
            last_us, last_ns = self._last[sensor]
            return device_us < last_us or self._apart(device_us, read_ns, last_us, last_ns)
        if read_ns - self._newest[1] > _SILENT_NS:
            return True
        # A clock of 64 bits tells how often the one of 32 bits has wrapped, which was not known before.
        turns, rest = divmod(device_us - self._newest[0] + WRAP_US // 2, WRAP_US)
        return not wraps and self._newest_wraps and turns > 0 and abs(rest - WRAP_US // 2) * 1000 < _JUMP_NS

    def _apart(self, device_us: int, read_ns: int, last_us: int, last_ns: int) -> bool:
        """Have the two clocks moved apart by more than drift and latencies explain?"""
        device_ns, host_ns = (device_us - last_us) * 1000, read_ns - last_ns
        return abs(device_ns - host_ns) > _JUMP_NS + self._most_ns + self._drift * host_ns

    def _latest_ns(self, device_us: int, resolution_us: int, own_ns: int) -> int:
        """Not acquired after this: by its own read, or by the read of a packet that was quicker on its way."""
        bound_ns = own_ns
        if self._bound is not None:
            since_us = device_us + resolution_us - self._bound[0]
            if since_us < 0:
                return own_ns
            bound_ns = self._bound[1] + int(since_us * 1000 / (1.0 - self._drift)) + 2
        if bound_ns >= own_ns:
            self._bound = device_us - resolution_us, own_ns
            return own_ns
        # Older than the latency allows: the reader came late, or a promise was broken. Others will say which.
        return bound_ns if bound_ns >= own_ns + self._least_ns - self._most_ns else own_ns
