"""When a telegram's first byte was sent, and thereby when the mirror turned for it (LMS2XX section 7)."""

from collections import Counter

from drivers.config import LaserConfig, latency_ns
from drivers.samples import Stamp
from drivers.sick_lms.framing import Frame

CLOCK_TOLERANCE = 0.03
"""A line's true rate differs from its nominal one by less than this, or nothing could be read."""
_NEVER_NS = -(1 << 62)


class SentTimes:
    """Intervals that surely contain these times, from the declared latency and from what bytes take on the line.

    A byte is read when its last bit has come; and bytes that came behind it with the same read had come, too. They may
    tell that a telegram's first byte was read later than declared; then the declared latency is taken as that of the
    read's last byte. Telegrams are sent one after the other, so no interval begins or ends before an earlier one does.
    """

    def __init__(self, config: LaserConfig, counts: Counter[str]) -> None:
        self._counts = counts
        self._latency_ns = latency_ns(config.latency_ms)
        self._phase_ns = latency_ns(config.mirror_phase_ms)
        self._earliest_ns = self._latest_ns = _NEVER_NS

    def restart(self) -> None:
        """The port was opened."""
        self._earliest_ns = self._latest_ns = _NEVER_NS

    def of(self, frame: Frame, byte_ns: int) -> Stamp:
        """The end of the mirror turns that a telegram tells of; `byte_ns`: what a byte takes on the line."""
        least, most = self._latency_ns
        on_line = frame.bytes_read * byte_ns
        surely = max(least, int(on_line / (1 + CLOCK_TOLERANCE)))
        at_most = most + byte_ns
        if surely > at_most:
            self._counts["late_telegrams"] += 1
            at_most += int(on_line * (1 + CLOCK_TOLERANCE))
        self._earliest_ns = max(self._earliest_ns, frame.stamp_ns - at_most)
        self._latest_ns = max(self._latest_ns, frame.stamp_ns - surely)
        return Stamp(self._earliest_ns, self._latest_ns).shifted(*self._phase_ns)
