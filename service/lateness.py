"""What our own delays cost: a read that came late makes the stamps of its samples begin earlier.

A driver stamps a sample with the time of the read that held its first byte, less the declared latency [least, most] of
the device and its adapter. That is right where the read followed the bytes' arrival at once. Where this process was
kept from reading (other work, another thread, a stopped process), the bytes lay in the port meanwhile; but not for
longer than since the port was last seen empty (drivers/transports.py). Nothing that the owner has declared is broken:

    stamp = [read - most - late, read - least]
    late = read - last seen empty - allowance, where that is positive

contains the acquisition again, as `most` counts the allowance for an ordinary wake-up (docs/decisions/0012).

A sample's first byte may have come in a late read and its last byte in a punctual one; so each sample whose stamp ends
no later than a late read is widened, which includes all that began in it.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from drivers.config import READ_ALLOWANCE_NS
from drivers.protocol import ComparesTimes
from drivers.samples import Sample

_KEPT_NS = 60_000_000_000
"""Nothing waits longer for its last byte."""
_KEPT = 64


class Lateness:
    """The late reads of one device that samples may still have begun in."""

    def __init__(self, protocol: object = None) -> None:
        """`protocol` is told of late reads, if it compares times itself."""
        self._protocol = protocol if isinstance(protocol, ComparesTimes) else None
        self._reads: deque[tuple[int, int]] = deque()
        """(time, lateness), the later of two always with the smaller lateness: it alone covers the other."""

    def read_late(self, read_ns: int, late_ns: int) -> None:
        """The read at `read_ns` came up to `late_ns` late; its bytes are to be given to the protocol next."""
        if self._protocol is not None:
            self._protocol.read_late(late_ns)
        reads = self._reads
        while reads and reads[-1][1] <= late_ns:
            reads.pop()
        reads.append((read_ns, late_ns))
        while reads[0][0] < read_ns - _KEPT_NS:
            reads.popleft()
        if len(reads) > _KEPT:
            (_, most_ns), (until_ns, _) = reads.popleft(), reads.popleft()
            reads.appendleft((until_ns, most_ns))

    def widened(self, samples: Sequence[Sample]) -> Sequence[Sample]:
        """The samples, those that may have begun in a late read with stamps that begin as much earlier."""
        if not self._reads:
            return samples
        return [self._widened(sample) for sample in samples]

    def _widened(self, sample: Sample) -> Sample:
        for read_ns, late_ns in self._reads:
            if sample.stamp.latest_ns <= read_ns:
                return replace(sample, stamp=sample.stamp.shifted(-late_ns, 0))
        return sample


def lateness_ns(lain_ns: int) -> int:
    """How late a read came whose bytes may have lain in the port for `lain_ns`; 0 where that is ordinary."""
    return lain_ns - READ_ALLOWANCE_NS if lain_ns > READ_ALLOWANCE_NS else 0
