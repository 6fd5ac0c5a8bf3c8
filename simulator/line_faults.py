"""Faults of a serial line, injected into the frames that a device sends; and what of it arrives whole all the same.

A frame is struck by at most one fault. `Arrival.copies` is the truth that a driver is held against: how often all of
the frame's bytes reach the host, one after the other. The same seed strikes the same frames in the same way.

    faults = LineFaults(LINES["imu"], [Fault.parse("garbage:0.2")], seed=1)
    for frame in frames:
        arrival = faults.send(frame)        # arrival.chunks: what the port gives, read by read
    rest = faults.flush()

FAULTS.md, rows 1 and 2, and the bytes' side of the others. What a device *says* wrongly is its emulator's affair.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from random import Random

_SHORTEST = 4
"""Shorter frames (a scanner's ACK, an adapter's carriage return) are never damaged, only delayed or silenced."""
_GARBAGE_BYTES = 64
_BURST_BYTES = 40
_LOST_BYTES = 8
_SILENCE_FRAMES = 25
_MERGED_FRAMES = 8
_LOOSE_BYTES = 2048
"""More than the longest frame."""
DEFAULT_RATE = 0.2


@dataclass(frozen=True, slots=True)
class LineFormat:
    """How the frames of one wire look: as much as is needed to strike them where it hurts."""

    starts: bytes
    """Bytes that a frame may begin with."""
    header_bytes: int
    """A frame's beginning up to where its length and kind are known: what makes a false header plausible."""
    frame_bytes: Callable[[bytes], int | None]
    """Length of the frame at the beginning of these bytes; None where that can't be told yet."""
    length_at: slice | None = None
    """Where the length field is, least significant byte first; None where the wire has none."""
    length_digits: bytes | None = None
    """The length field's characters, where it is text."""

    def cut(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Whole frames of an undamaged stream, and the unfinished rest."""
        frames, at = list[bytes](), 0
        while (size := self.frame_bytes(data[at:])) is not None and at + size <= len(data):
            frames.append(data[at : at + size])
            at += size
        return frames, data[at:]


@dataclass(frozen=True, slots=True)
class Fault:
    """A kind of fault, and the share of frames that it strikes."""

    kind: str
    rate: float = DEFAULT_RATE

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"no such fault: {self.kind}; there are {', '.join(KINDS)}")
        if not 0.0 < self.rate <= 1.0:
            raise ValueError(f"{self.kind}:{self.rate:g}: the rate is a share of the frames, above 0 and at most 1")

    @classmethod
    def parse(cls, text: str) -> "Fault":
        """KIND or KIND:RATE. Raises ValueError."""
        kind, colon, rate = text.partition(":")
        try:
            return cls(kind, float(rate) if colon else DEFAULT_RATE)
        except ValueError as error:
            if "could not convert" in str(error):
                raise ValueError(f"{text}: write KIND or KIND:RATE, as {kind or 'garbage'}:0.2") from None
            raise


@dataclass(frozen=True, slots=True)
class Arrival:
    """What became of one frame."""

    chunks: tuple[bytes, ...]
    """What the port gives while this frame is sent, a read each; b"" where nothing comes."""
    copies: int
    """How often the frame arrives with all of its bytes, one after the other (perhaps only with a later chunk)."""
    fault: str | None
    """What struck it."""


@dataclass(frozen=True, slots=True)
class Damaged:
    """A whole stream, damaged."""

    arrivals: list[Arrival]
    rest: bytes
    """What a merged write still held back at the end."""

    @property
    def chunks(self) -> list[bytes]:
        """All reads, in order; empty ones where the line was silent."""
        return [chunk for arrival in self.arrivals for chunk in arrival.chunks] + ([self.rest] if self.rest else [])

    def intact(self, frames: Sequence[bytes]) -> list[bytes]:
        """The frames that arrived whole, each as often as it did."""
        return [f for f, arrival in zip(frames, self.arrivals, strict=True) for _ in range(arrival.copies)]


def damage(frames: Sequence[bytes], line: LineFormat, faults: Iterable[Fault], seed: int = 1) -> Damaged:
    """All of `frames` through a faulty line."""
    injector = LineFaults(line, faults, seed)
    arrivals = [injector.send(frame) for frame in frames]
    return Damaged(arrivals, injector.flush())


@dataclass(frozen=True, slots=True)
class _Struck:
    """What goes over the line in place of a frame."""

    body: bytes
    copies: int = 0
    before: bytes = b""
    cuts: tuple[int, ...] = field(default=())
    """Where reads end inside it."""


_Strike = Callable[[bytes, LineFormat, Random], _Struck]


class LineFaults:
    """A faulty line from a device to its host."""

    def __init__(self, line: LineFormat, faults: Iterable[Fault], seed: int = 1) -> None:
        """Raises ValueError where the rates come to more than 1, or the wire can't have such a fault."""
        self._line = line
        self._faults = tuple(faults)
        if sum(fault.rate for fault in self._faults) > 1.0 + 1e-9:
            raise ValueError("the faults' rates come to more than 1; a frame is struck by one fault at most")
        for fault in self._faults:
            if fault.kind == "wrong-length" and line.length_at is None:
                raise ValueError("wrong-length: frames of this wire have no length field")
        self._random = Random(seed)
        self._offset = 0
        self._silent = 0
        self._held = b""
        self._holding = 0
        self._loose = b""
        """Bytes since the last frame that arrived whole."""
        self._broken = b""
        """The last frame that did not."""

    def send(self, frame: bytes) -> Arrival:
        """What the host's port gives while the device sends `frame`."""
        kind = self._draw()
        if kind == "silence" or self._silent:
            self._silent = max(self._silent, _SILENCE_FRAMES) - 1 if kind == "silence" else self._silent - 1
            return Arrival((b"",), 0, "silence")
        if kind == "merged":
            self._holding = _MERGED_FRAMES
        struck = self._strike(kind, frame)
        if struck.copies:
            self._loose, self._broken = b"", b""
        else:
            loose = self._loose + struck.before + struck.body
            self._loose, self._broken = loose[-_LOOSE_BYTES:], frame
        data = self._held + struck.before + struck.body
        self._held = b""
        if self._holding:
            self._holding -= 1
            if self._holding:
                self._held = data
                return Arrival((b"",), struck.copies, kind)
        behind = len(data) - len(struck.body)
        edges = [0, *(behind + cut for cut in struck.cuts), len(data)]
        chunks = tuple(data[a:b] for a, b in pairwise(edges))
        return Arrival(chunks, struck.copies, kind)

    def flush(self) -> bytes:
        """What is still held back."""
        held, self._held, self._holding = self._held, b"", 0
        return held

    def _draw(self) -> str | None:
        """The fault that strikes now."""
        drawn = self._random.random()
        for fault in self._faults:
            rate = fault.rate
            if fault.kind == "silence":  # it lasts: begun less often, so that its share of the frames is right
                rate = 1.0 if rate == 1.0 else min(1.0, rate / (_SILENCE_FRAMES * (1.0 - rate)))
            if drawn < rate:
                return fault.kind
            drawn -= rate
        return None

    def _strike(self, kind: str | None, frame: bytes) -> _Struck:
        if kind is None or kind == "merged":
            return _Struck(frame, copies=1)
        if kind == "split":
            self._offset += 1  # every offset in its turn
            return _Struck(frame, copies=1, cuts=(self._offset % max(1, len(frame) - 1) + 1,) if len(frame) > 1 else ())
        if len(frame) < _SHORTEST:
            return _Struck(frame, copies=1)
        while True:
            struck = _STRIKES[kind](frame, self._line, self._random)
            if not self._is_whole_by_chance(frame, struck):
                return struck

    def _is_whole_by_chance(self, frame: bytes, struck: _Struck) -> bool:
        """Would neighbouring bytes complete a frame that counts as broken?"""
        lost = [self._broken] if self._broken else []
        loose = self._loose + struck.before
        if not struck.copies:
            lost.append(frame)
            loose += struck.body
        return any(frame in loose + bytes((start,)) for frame in lost for start in self._line.starts)


def _garbage(frame: bytes, line: LineFormat, random: Random) -> _Struck:
    return _Struck(frame, copies=1, before=random.randbytes(random.randint(1, _GARBAGE_BYTES)))


def _bit_flip(frame: bytes, line: LineFormat, random: Random) -> _Struck:
    bit = random.randrange(8 * len(frame))
    body = bytearray(frame)
    body[bit // 8] ^= 1 << bit % 8
    return _Struck(bytes(body))


def _burst(frame: bytes, line: LineFormat, random: Random) -> _Struck:
    size = random.randint(2, min(_BURST_BYTES, len(frame)))
    at = random.randint(0, len(frame) - size)
    return _Struck(frame[:at] + random.randbytes(size) + frame[at + size :])


def _truncated(frame: bytes, line: LineFormat, random: Random) -> _Struck:
    return _Struck(frame[: random.randint(1, len(frame) - 1)])


def _dropped(frame: bytes, line: LineFormat, random: Random) -> _Struck:
    size = random.randint(1, min(_LOST_BYTES, len(frame) - 2))
    at = random.randint(0, len(frame) - size)
    return _Struck(frame[:at] + frame[at + size :])


def _inserted(frame: bytes, line: LineFormat, random: Random) -> _Struck:
    at = random.randint(1, len(frame) - 1)
    return _Struck(frame[:at] + random.randbytes(random.randint(1, _LOST_BYTES)) + frame[at:])


def _false_header(frame: bytes, line: LineFormat, random: Random) -> _Struck:
    """The beginning of such a frame, one to three times, and then the frame itself."""
    headers = [frame[: random.randint(1, line.header_bytes)] for _ in range(random.randint(1, 3))]
    return _Struck(frame, copies=1, before=b"".join(headers))


def _wrong_length(frame: bytes, line: LineFormat, random: Random) -> _Struck:
    at = line.length_at
    assert at is not None
    if line.length_digits is not None:
        field = bytes((random.choice(line.length_digits),))
    else:
        size, told = at.stop - at.start, int.from_bytes(frame[at], "little")
        near = told + random.choice((-1, 1)) * random.randint(1, 16)
        wrong = random.choice((near, random.randrange(256**size)))
        field = (wrong % 256**size).to_bytes(size, "little")
    return _Struck(frame[: at.start] + field + frame[at.stop :])


def _duplicated(frame: bytes, line: LineFormat, random: Random) -> _Struck:
    return _Struck(2 * frame, copies=2)


_STRIKES: dict[str, _Strike] = {
    "garbage": _garbage,
    "bit-flip": _bit_flip,
    "burst": _burst,
    "truncated": _truncated,
    "dropped": _dropped,
    "inserted": _inserted,
    "false-header": _false_header,
    "wrong-length": _wrong_length,
    "duplicated": _duplicated,
}
KINDS = {
    "garbage": "random bytes between frames",
    "bit-flip": "one bit wrong",
    "burst": "2 to 40 bytes overwritten",
    "truncated": "the end missing",
    "dropped": "1 to 8 bytes missing",
    "inserted": "1 to 8 bytes too many",
    "false-header": "the beginning of a frame that never comes, up to three times",
    "wrong-length": "a length field that lies",
    "duplicated": "the frame twice",
    "split": "two reads, cut at every offset in its turn",
    "merged": "eight frames in one read",
    "silence": "nothing for 25 frames",
}
"""What can go wrong, in words."""


def _lms_bytes(data: bytes) -> int | None:
    """LMS2XX section 2: 02 80 LEN, ..., CRC; ACK, NAK and the like are single bytes."""
    if data[:1] != b"\x02":
        return 1 if data else None
    return None if len(data) < 4 else int.from_bytes(data[2:4], "little") + 6


def _mavlink_bytes(data: bytes) -> int | None:
    if len(data) < 3:
        return None
    if data[0] == 0xFE:
        return 8 + data[1]
    return 12 + data[1] + (13 if data[2] & 1 else 0)


def _until(end: bytes) -> Callable[[bytes], int | None]:
    """Frames that end with one of these bytes."""

    def size(data: bytes) -> int | None:
        return next((i + 1 for i, byte in enumerate(data) if byte in end), None)

    return size


LINES = {
    "lms": LineFormat(b"\x02", 7, _lms_bytes, slice(2, 4)),
    "encoders": LineFormat(b"tTrRzZ", 5, _until(b"\r\a"), slice(4, 5), b"012345678"),
    "imu": LineFormat(b"\xfd\xfe", 10, _mavlink_bytes, slice(1, 2)),
    "gps": LineFormat(b"$!", 7, _until(b"\n")),
}
"""The four wires: SICK LMS2xx, slcan (its length digit stands where 11-bit identifiers have it), MAVLink, NMEA 0183."""
