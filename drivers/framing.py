"""Bytes that wait for the rest of their frame, and when each of them was read."""


class StampedBuffer:
    """A stream's unfinished end. Frames are searched in `data`; what has been dealt with is discarded."""

    def __init__(self) -> None:
        """Empty."""
        self.data = b""
        self._reads: list[tuple[int, int]] = []
        """(offset where a read begins, its time), the first of them at offset 0."""

    def append(self, data: bytes, stamp_ns: int) -> None:
        """Take what one read gave."""
        if data:
            self._reads.append((len(self.data), stamp_ns))
            self.data += data

    def time_of(self, offset: int) -> int:
        """Time of the read that held the byte at `offset`."""
        if len(self._reads) == 1:
            return self._reads[0][1]
        return next(stamp_ns for begin, stamp_ns in reversed(self._reads) if begin <= offset)

    def discard(self, n: int) -> None:
        """Drop the first `n` bytes."""
        if n == 0:
            return
        self.data = self.data[n:]
        if not self.data:
            self._reads.clear()
            return
        moved = [(begin - n, stamp_ns) for begin, stamp_ns in self._reads]
        # Of the reads that began in what was dropped, only the last may still have bytes here.
        first = max(i for i, (begin, _) in enumerate(moved) if begin <= 0)
        self._reads = [(max(0, begin), stamp_ns) for begin, stamp_ns in moved[first:]]

    def clear(self) -> int:
        """Drop everything; returns how many bytes that was."""
        n = len(self.data)
        self.discard(n)
        return n
