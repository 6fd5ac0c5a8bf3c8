"""MAVLink frames, versions 1 and 2: found in a dirty stream, and built.

    v2: FD, length, incompatibility flags, compatibility flags, sequence, system, component, message id (3 bytes),
        payload (its trailing zeros cut off), checksum (2 bytes), signature (13 bytes if flag 01h is set)
    v1: FE, length, sequence, system, component, message id (1 byte), payload, checksum

The checksum is X.25 over everything between the magic byte and itself, then over one more byte that the message's
definition gives. pymavlink's own parser loses intact frames behind a stray magic byte, so the frames are searched here:
what can't be a header is refused at once, and where a checksum fails the search goes on one byte further. The message
definitions are pymavlink's and those of dialect.py. A payload may be longer than its definition here: then the sender
knows more fields. A signature is passed over: without a key there is nothing to hold it against.
"""

import re
import struct
from binascii import crc_hqx
from collections import Counter
from itertools import repeat
from typing import Any, NamedTuple

from drivers.framing import StampedBuffer
from drivers.imu.dialect import DEFINITIONS, Definition
from drivers.kept_results import kept_result

_MAGIC_V1, _MAGIC_V2 = 0xFE, 0xFD
_MAGIC = re.compile(rb"[\xfd\xfe]")
_SIGNED = 0x01
_SIGNATURE_BYTES = 13
_CRC = struct.Struct("<H")


def _of_pymavlink() -> dict[str, list[Any]]:
    """Its definitions: of each message what `Definition` holds, and of each of version 1 its number and length."""
    from pymavlink.dialects.v10 import ardupilotmega as v1
    from pymavlink.dialects.v20 import ardupilotmega as v2

    known = v2.mavlink_map.values()
    return {
        "messages": [[m.msgname, m.id, m.crc_extra, m.unpacker.format, list(m.ordered_fieldnames)] for m in known],
        "v1_bytes": [[number, m.unpacker.size] for number, m in v1.mavlink_map.items()],
    }


_KEPT = kept_result(__file__, "pymavlink", "ardupilotmega", _of_pymavlink)
_THEIRS = (
    Definition(name, number, crc_extra, struct.Struct(layout), tuple(names))
    for name, number, crc_extra, layout, names in _KEPT["messages"]
)
_DEFINITION: dict[int, Definition] = {one.id: one for one in (*_THEIRS, *DEFINITIONS)}
_V1_BYTES: dict[int, int] = dict(_KEPT["v1_bytes"])
"""Version 1 knows no extension fields and cuts nothing off: the length is exact."""
_V1_LENGTHS = frozenset(_V1_BYTES.values())
_BY_NAME: dict[str, Definition] = {one.msgname: one for one in _DEFINITION.values()}


_REFLECTED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def x25(data: bytes) -> int:
    """The MAVLink checksum of `data`: CRC-16 of the CCITT polynomial, begun with ones, least significant bit first.

    The standard library has the same with the most significant bit first, so bits are reflected before and after.
    """
    crc = crc_hqx(data.translate(_REFLECTED), 0xFFFF)
    return _REFLECTED[crc & 0xFF] << 8 | _REFLECTED[crc >> 8]


class MavlinkFrame(NamedTuple):
    """One intact frame."""

    message: str
    sequence: int
    system: int
    component: int
    payload: bytes
    version: int = 2

    def fields(self) -> dict[str, Any]:
        """The payload's fields by name, in the units of the message's definition; for messages without arrays."""
        return dict(zip(_BY_NAME[self.message].ordered_fieldnames, self.values(), strict=True))

    def values(self) -> tuple[Any, ...]:
        """The same without their names, in the order of `field_names`."""
        unpacker, payload = _BY_NAME[self.message].unpacker, self.payload
        if len(payload) < unpacker.size:
            payload = payload.ljust(unpacker.size, b"\0")
        return unpacker.unpack_from(payload)


def field_names(message: str) -> tuple[str, ...]:
    """The fields of a message, in the order in which they stand on the wire."""
    return _BY_NAME[message].ordered_fieldnames


def serialise(frame: MavlinkFrame) -> bytes:
    """The bytes of `frame`."""
    definition = _BY_NAME[frame.message]
    if frame.version == 1:
        payload = frame.payload
        head = bytes((len(payload), frame.sequence, frame.system, frame.component, definition.id))
    else:
        payload = frame.payload.rstrip(b"\0") or b"\0"
        addresses = (frame.sequence, frame.system, frame.component)
        head = bytes((len(payload), 0, 0, *addresses)) + definition.id.to_bytes(3, "little")
    body = head + payload
    magic = _MAGIC_V1 if frame.version == 1 else _MAGIC_V2
    return bytes((magic,)) + body + _CRC.pack(x25(body + bytes((definition.crc_extra,))))


def build(
    message: str, *, sequence: int = 0, system: int = 1, component: int = 1, version: int = 2, **fields: Any
) -> MavlinkFrame:
    """A frame from its fields; those not named are zero."""
    definition = _BY_NAME[message]
    payload: bytes = definition.unpacker.pack(*map(fields.get, definition.ordered_fieldnames, repeat(0)))
    if version == 1:
        payload = payload[: _V1_BYTES[definition.id]]
    return MavlinkFrame(message, sequence, system, component, payload, version)


class MavlinkStream:
    """Cuts a stream of bytes into frames; every intact one comes out, whatever stands around it.

    counts: `frames`, `bad_crc`, `skipped_bytes` (in no frame).
    """

    def __init__(self, counts: Counter[str]) -> None:
        """Counts go into `counts`."""
        self._counts = counts
        self._buffer = StampedBuffer()
        self._signature_ends = 0
        """Where the signature of the last frame ends, if it is all there; place in the buffer."""

    def clear(self) -> None:
        """Forget what has not become a frame."""
        self._skip(0, self._buffer.clear())
        self._signature_ends = 0

    def receive(self, data: bytes, stamp_ns: int) -> list[tuple[MavlinkFrame, int]]:
        """Take what one read gave; each frame with the time of the read that held its first byte."""
        self._buffer.append(data, stamp_ns)
        return self._take(ended=False)

    def finish(self) -> list[tuple[MavlinkFrame, int]]:
        """No more bytes will come: the frames behind a beginning that still waited for its end."""
        return self._take(ended=True)

    def _take(self, ended: bool) -> list[tuple[MavlinkFrame, int]]:
        frames: list[tuple[MavlinkFrame, int]] = []
        buffer, position, time_of = self._buffer.data, 0, self._buffer.time_of
        while (magic := _MAGIC.search(buffer, position)) is not None:
            start = magic.start()
            if start > position:
                self._skip(position, start)
                position = start
            size = _frame_bytes(buffer, start)
            if size is None or start + size > len(buffer):
                if not ended:
                    break
                size = 0
            frame = _checked(buffer, start, size) if size else None
            if frame is None:
                self._counts["bad_crc"] += size > 0
                self._skip(position, start + 1)
                position = start + 1
                continue
            position = start + size
            # No checksum covers a signature: where its end is missing, the next frame stands in its place.
            self._signature_ends = position + _SIGNATURE_BYTES * _is_signed(buffer, start)
            frames.append((frame, time_of(start)))
        else:
            if position < len(buffer):
                self._skip(position, len(buffer))
                position = len(buffer)
        self._counts["frames"] += len(frames)
        self._buffer.discard(position)
        self._signature_ends = max(0, self._signature_ends - position)
        return frames

    def _skip(self, begin: int, end: int) -> None:
        """These bytes of the buffer belong to no frame, unless to a signature."""
        self._counts["skipped_bytes"] += max(0, end - max(begin, self._signature_ends))


def _is_signed(buffer: bytes, start: int) -> bool:
    return buffer[start] == _MAGIC_V2 and bool(buffer[start + 2] & _SIGNED)


def _frame_bytes(buffer: bytes, start: int) -> int | None:
    """Length, without signature, of the frame that begins at `start`; None: too early to tell; 0: no header we know."""
    rest = len(buffer) - start
    if rest < 2:
        return None
    length = buffer[start + 1]
    if buffer[start] == _MAGIC_V1:
        if length not in _V1_LENGTHS:
            return 0
        if rest < 6:
            return None
        return 8 + length if _V1_BYTES.get(buffer[start + 5]) == length else 0
    if rest < 3:
        return None
    flags = buffer[start + 2]
    if flags & ~_SIGNED or length == 0:
        return 0
    if rest < 10:
        return None
    if int.from_bytes(buffer[start + 7 : start + 10], "little") not in _DEFINITION:
        return 0
    return 12 + length


def _checked(buffer: bytes, start: int, size: int) -> MavlinkFrame | None:
    """The frame in exactly these bytes; None where its checksum is wrong."""
    end = start + size - 2
    if buffer[start] == _MAGIC_V1:
        version, begin, (sequence, system, component, number) = 1, start + 6, buffer[start + 2 : start + 6]
    else:
        version, begin, (sequence, system, component, low, middle, high) = 2, start + 10, buffer[start + 4 : start + 10]
        number = low | middle << 8 | high << 16
    definition = _DEFINITION[number]
    if x25(buffer[start + 1 : end] + bytes((definition.crc_extra,))) != buffer[end] | buffer[end + 1] << 8:
        return None
    return MavlinkFrame(definition.msgname, sequence, system, component, buffer[begin:end], version)
