"""Frames out of a byte stream that may lie.

A frame begins with 02 80, but so may any data, and nothing marks its end (LMS2XX section 2). So each 02 80 whose header
makes sense is a *candidate*, and candidates are decided independently of each other once their last byte is there:

- checksum and status right: a frame. All candidates that overlap it die.
- otherwise: nothing. Its bytes stay, because the next frame may begin right behind the false STX.

A candidate that still waits for bytes never keeps a complete one behind it waiting. Each position is looked at once and
each candidate checked once, and no candidate is longer than 814 bytes: time is linear in the bytes, memory bounded.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

from drivers.sick_lms.telegrams import (
    ACK,
    FROM_SCANNER,
    HEADER,
    NAK,
    OVERHEAD,
    RANGES,
    SOURCE,
    STX,
    UNASKED,
    checksum,
    header_fits,
    status_fits,
)

_START = bytes((STX, FROM_SCANNER))


@dataclass(frozen=True, slots=True)
class Frame:
    """One telegram that passed all checks."""

    payload: bytes
    stamp_ns: int
    """When the read that held the STX returned."""

    @property
    def command(self) -> int:
        """What the telegram is."""
        return self.payload[0]


class FrameReader:
    """Finds every intact frame, and says what the first byte between frames was where an ACK or NAK is due."""

    def __init__(self, counts: Counter[str]) -> None:
        self._counts = counts
        self._buffer = bytearray()
        self._origin = 0  # place of the buffer's first byte in the whole stream
        self._searched = 0  # places in the buffer before this one were looked at for headers
        self._candidates: list[tuple[int, int]] = []  # (start, end) in the buffer, undecided
        self._reads: list[tuple[int, int]] = []  # (place of its first byte in the stream, stamp)
        self._acknowledgement_due = False
        self._acknowledgement: int | None = None
        self.scan_headers: AbstractSet[tuple[int, int]] | None = None
        """The only (LEN, count word) that a scan may have now; None while the scanner's settings are unknown.

        Where they are known the conversation is ours, and answers that nobody asked for are refused too.
        """
        self.source: int | None = None
        """The only source bits that a status byte may have now; None while they are unknown."""

    def receive_data(self, data: bytes, stamp_ns: int) -> list[Frame]:
        """All frames that `data` completes."""
        if not data:
            return []
        self._reads.append((self._origin + len(self._buffer), stamp_ns))
        self._buffer += data
        self._find_candidates()
        frames, done = self._decide()
        keep = self._candidates[0][0] if self._candidates else self._start_of_tail(done)
        self._pass_over(done, keep)
        self._drop(keep)
        return frames

    def expect_acknowledgement(self) -> None:
        """A request goes out: the next byte outside a frame may be its ACK or NAK."""
        self._acknowledgement_due = True
        self._acknowledgement = None

    def take_acknowledgement(self) -> int | None:
        """ACK or NAK, once, if one came where it was due."""
        taken, self._acknowledgement = self._acknowledgement, None
        return taken

    def clear(self) -> None:
        """Forget unfinished bytes: the line rate changes."""
        self._pass_over(0, len(self._buffer))
        self._candidates.clear()
        self._drop(len(self._buffer))

    def _find_candidates(self) -> None:
        buffer = self._buffer
        after_last = len(buffer) - HEADER + 1
        if after_last <= self._searched:
            return
        at = self._searched
        while (at := buffer.find(_START, at, after_last + 1)) >= 0:
            length = buffer[at + 2] | buffer[at + 3] << 8
            word = buffer[at + 5] | buffer[at + 6] << 8
            if self._header_fits(buffer[at + 4], length, word):
                self._candidates.append((at, at + length + OVERHEAD))
            at += 1
        self._searched = after_last

    def _header_fits(self, command: int, length: int, word: int) -> bool:
        if self.scan_headers is not None:
            if command == RANGES:
                return (length, word) in self.scan_headers
            if command in UNASKED:
                return False
        return header_fits(command, length, word)

    def _decide(self) -> tuple[list[Frame], int]:
        """Frames among the complete candidates, and the place behind the last of them."""
        frames: list[Frame] = []
        waiting: list[tuple[int, int]] = []
        done = 0
        for start, end in self._candidates:
            if start < done:
                continue
            if end > len(self._buffer):
                waiting.append((start, end))
            elif self._is_frame(start, end):
                self._pass_over(done, start)
                frames.append(Frame(bytes(self._buffer[start + 4 : end - 2]), self._stamp_at(start)))
                waiting.clear()
                done = end
        self._candidates = waiting
        return frames, done

    def _is_frame(self, start: int, end: int) -> bool:
        buffer = self._buffer
        if checksum(bytes(buffer[start : end - 2])) != buffer[end - 2] | buffer[end - 1] << 8:
            self._counts["bad_crc"] += 1
            return False
        status = buffer[end - 3]
        if not status_fits(status) or self.source not in (None, status & SOURCE):
            self._counts["bad_status"] += 1
            return False
        return True

    def _stamp_at(self, at: int) -> int:
        read = bisect_right(self._reads, self._origin + at, key=lambda read: read[0]) - 1
        return self._reads[read][1]

    def _start_of_tail(self, done: int) -> int:
        """Where the last bytes may be the beginning of a header."""
        buffer = self._buffer
        at = max(done, self._searched)
        while (at := buffer.find(STX, at)) >= 0:
            if at + 1 == len(buffer) or buffer[at + 1] == FROM_SCANNER:
                return at
            at += 1
        return len(buffer)

    def _pass_over(self, start: int, end: int) -> None:
        """These bytes belong to no frame."""
        if start >= end:
            return
        skipped = end - start
        if self._acknowledgement_due:
            self._acknowledgement_due = False
            if self._buffer[start] in (ACK, NAK):
                self._acknowledgement = self._buffer[start]
                skipped -= 1
        if skipped:
            self._counts["skipped_bytes"] += skipped

    def _drop(self, end: int) -> None:
        del self._buffer[:end]
        self._origin += end
        self._searched = max(0, self._searched - end)
        self._candidates = [(start - end, stop - end) for start, stop in self._candidates]
        first = bisect_right(self._reads, self._origin, key=lambda read: read[0]) - 1
        del self._reads[: max(0, first)]
