"""Frames out of a byte stream that may lie.

A frame begins with 02 80, but so may any data, and nothing marks its end (LMS2XX section 2). So each 02 80 whose header
makes sense is a *candidate*, and candidates are checked independently of each other once their last byte is there. One
that fails (checksum, status, layout) is forgotten, but its bytes stay: the next frame may begin right behind its STX.

One that passes is a frame, unless another that passes overlaps it: the checksum is weak, and of several overlapping
frames one at most was sent. So a frame is handed out once no unfinished candidate overlaps it, and among frames that
overlap those win that together explain most bytes. Of two equals the later one does, because a cut frame's head before
a whole frame is an everyday fault, while data that spell a header and the right checksum are not.

Waiting for an unfinished candidate must end where its bytes never come: who reads calls `release` once the line has
been silent for `SILENCE_WITHIN_FRAME_MS`. Each position is looked at once, each candidate checked once, and none is
longer than 1646 bytes: time is linear in the bytes, memory bounded.
"""

from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import islice
from typing import TypeAlias

from drivers.checksums import lms_crc
from drivers.sick_lms.plausibility import HEADER_PATTERN, UNASKED, header_fits, payload_fits, status_fits
from drivers.sick_lms.telegrams import (
    ACK,
    FROM_SCANNER,
    HEADER,
    LONGEST_PAYLOAD,
    NAK,
    OVERHEAD,
    RANGES,
    SOURCE,
    STX,
)

SILENCE_WITHIN_FRAME_MS = 50
"""A frame whose next byte has not come after this won't go on. The scanner pauses for 14 ms at most (section 3); the
rest is for adapters and for the host."""

_LONGEST_GROUP = 4 * (LONGEST_PAYLOAD + OVERHEAD)
"""Overlapping frames are not held back any further; only a forger can make so many."""

_Place: TypeAlias = tuple[int, int]
"""(start, end)."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One telegram that passed all checks."""

    payload: bytes
    stamp_ns: int
    """When the read that held the STX returned."""
    bytes_read: int
    """How many of the frame's bytes that read held: for so long, at least, the STX had been on its way."""
    place: int
    """Of the STX in the whole stream."""

    @property
    def command(self) -> int:
        """What the telegram is."""
        return self.payload[0]


class FrameReader:
    """Finds every intact frame, and says what the first byte between frames was where an ACK or NAK is due.

    All places are counted from the beginning of the stream.
    """

    def __init__(self, counts: Counter[str]) -> None:
        self._counts = counts
        self._buffer = bytearray()
        self._origin = 0  # place of the buffer's first byte
        self._searched = 0  # places before this one were looked at for headers
        self._unfinished: dict[int, int] = {}  # start: end of each candidate, by starts
        self._ends: list[tuple[int, int]] = []  # heap of their (end, start)
        self._passed: list[_Place] = []  # frames not handed out yet, by starts
        self._reads: list[tuple[int, int]] = []  # (place of its first byte, stamp)
        self._acknowledgement_due = False
        self._acknowledgement: int | None = None
        self.scan_headers: AbstractSet[tuple[int, int]] | None = None
        """The only (LEN, count word) that a scan may have now; None while the scanner's settings are unknown.

        Where they are known the conversation is ours, and answers that nobody asked for are refused too.
        """
        self.source: int | None = None
        """The only source bits that a status byte may have now; None while they are unknown."""

    @property
    def holds_frames(self) -> bool:
        """Does an intact frame wait for an unfinished candidate that overlaps it?"""
        return bool(self._passed)

    def receive_data(self, data: bytes, stamp_ns: int) -> list[Frame]:
        """All frames that `data` completes."""
        if not data:
            return []
        self._reads.append((self.end, stamp_ns))
        self._buffer += data
        self._find_candidates()
        self._check_candidates()
        if not self._passed and next(iter(self._unfinished), -1) == self._origin:
            return []  # amid a candidate: nothing new is known
        return self._hand_out(forced=False)

    def release(self) -> list[Frame]:
        """The frames that were held back: the line is silent. Unfinished candidates that overlap none stay."""
        return self._hand_out(forced=True) if self._passed else []

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
        self._unfinished.clear()
        self._ends.clear()
        self._passed.clear()
        self._pass_over(self._origin, self.end)
        self._drop(self.end)

    @property
    def end(self) -> int:
        """Place behind the last byte that was read."""
        return self._origin + len(self._buffer)

    def _find_candidates(self) -> None:
        buffer, origin = self._buffer, self._origin
        after_last = len(buffer) - HEADER + 1
        at = self._searched - origin
        if after_last <= at:
            return
        # The pattern has all but the last two bytes of a header.
        while (found := HEADER_PATTERN.search(buffer, at, after_last + HEADER - 3)) is not None:
            at = found.start()
            length = buffer[at + 2] | buffer[at + 3] << 8
            word = buffer[at + 5] | buffer[at + 6] << 8
            if self._header_fits(buffer[at + 4], length, word):
                start = origin + at
                end = start + length + OVERHEAD
                self._unfinished[start] = end
                heappush(self._ends, (end, start))
            at += 1
        self._searched = origin + after_last

    def _header_fits(self, command: int, length: int, word: int) -> bool:
        if self.scan_headers is not None:
            if command == RANGES:
                return (length, word) in self.scan_headers
            if command in UNASKED:
                return False
        return header_fits(command, length, word)

    def _check_candidates(self) -> None:
        """Each candidate whose last byte is there has passed now, or is none."""
        read_end = self.end
        if not self._ends or self._ends[0][0] > read_end:
            return
        while self._ends and self._ends[0][0] <= read_end:
            end, start = heappop(self._ends)
            if self._unfinished.pop(start, None) is not None and self._is_frame(start, end):
                insort(self._passed, (start, end))

    def _is_frame(self, start: int, end: int) -> bool:
        buffer, first, behind = self._buffer, start - self._origin, end - self._origin
        status = buffer[behind - 3]  # looked at first, because it costs least
        if not status_fits(status) or self.source not in (None, status & SOURCE):
            self._counts["bad_status"] += 1
            return False
        if lms_crc(buffer, first, behind - 2) != buffer[behind - 2] | buffer[behind - 1] << 8:
            self._counts["bad_crc"] += 1
            return False
        if not payload_fits(bytes(buffer[first + 4 : behind - 2])):
            self._counts["bad_layout"] += 1
            return False
        return True

    def _hand_out(self, forced: bool) -> list[Frame]:
        """The frames that nothing overlaps any more; bytes before what is still undecided are dropped."""
        frames: list[Frame] = []
        done = self._origin
        while self._passed:
            group, group_end = self._first_group()
            start = group[0][0]
            if not forced and group_end - start <= _LONGEST_GROUP and self._is_overlapped(start, group_end):
                break
            del self._passed[: len(group)]
            for start, end in group if len(group) == 1 else self._most_likely(group):
                self._pass_over(done, start)
                frames.append(self._frame(start, end))
                done = end
        while self._unfinished and (first := next(iter(self._unfinished))) < done:
            del self._unfinished[first]
        keep = min([*islice(self._unfinished, 1), *(start for start, _ in self._passed[:1])], default=None)
        if keep is None:
            keep = self._start_of_tail(done)
        self._pass_over(done, keep)
        self._drop(keep)
        return frames

    def _first_group(self) -> tuple[list[_Place], int]:
        """The first frames that overlap each other, however indirectly, and where the last of them ends."""
        group, group_end = [self._passed[0]], self._passed[0][1]
        for start, end in self._passed[1:]:
            if start >= group_end:
                break
            group.append((start, end))
            group_end = max(group_end, end)
        return group, group_end

    def _is_overlapped(self, start: int, end: int) -> bool:
        """... by a candidate that may still turn out to be a frame."""
        return any(a < end and start < b for a, b in self._unfinished.items())

    def _most_likely(self, group: list[_Place]) -> list[_Place]:
        """Those of overlapping frames that do not overlap and explain most bytes; of equals, the latest."""
        by_end = sorted(group, key=lambda place: place[1])
        ends = [end for _, end in by_end]
        best: list[tuple[int, list[_Place]]] = [(0, [])]  # among the first k: bytes explained, and by which frames
        for k, (start, end) in enumerate(by_end):
            explained, places = best[bisect_right(ends, start, hi=k)]
            best.append(max((explained + end - start, [*places, (start, end)]), best[-1], key=lambda choice: choice[0]))
        chosen = best[-1][1]
        self._counts["overlapping_frames"] += len(group) - len(chosen)
        return chosen

    def _frame(self, start: int, end: int) -> Frame:
        after = bisect_right(self._reads, start, key=lambda read: read[0])
        read_end = self._reads[after][0] if after < len(self._reads) else end
        payload = bytes(self._buffer[start - self._origin + 4 : end - self._origin - 2])
        return Frame(payload, self._reads[after - 1][1], min(end, read_end) - start, start)

    def _start_of_tail(self, done: int) -> int:
        """Where the last bytes may be the beginning of a header."""
        buffer = self._buffer
        at = max(done, self._searched) - self._origin
        while (at := buffer.find(STX, at)) >= 0:
            if at + 1 == len(buffer) or buffer[at + 1] == FROM_SCANNER:
                return self._origin + at
            at += 1
        return self.end

    def _pass_over(self, start: int, end: int) -> None:
        """These bytes belong to no frame."""
        if start >= end:
            return
        skipped = end - start
        if self._acknowledgement_due:
            self._acknowledgement_due = False
            byte = self._buffer[start - self._origin]
            if byte in (ACK, NAK):
                self._acknowledgement = byte
                skipped -= 1
        if skipped:
            self._counts["skipped_bytes"] += skipped

    def _drop(self, end: int) -> None:
        if end == self._origin:
            return
        del self._buffer[: end - self._origin]
        self._origin = end
        self._searched = max(end, self._searched)
        first = bisect_right(self._reads, end, key=lambda read: read[0]) - 1
        del self._reads[: max(0, first)]
