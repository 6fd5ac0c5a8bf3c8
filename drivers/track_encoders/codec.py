"""CAN frames and the three ways they reach us: slcan text, Linux `struct can_frame`, candump log lines.

Parse and serialise stand side by side. A frame whose data doesn't match its length code is refused everywhere.

slcan (the text protocol of LAWICEL adapters), each line ended by a carriage return:

    tIIIL[DD..]       11-bit identifier, length, data          rIIIL       remote request, no data
    TIIIIIIIIL[DD..]  29-bit identifier                         RIIIIIIIIL
    ... then, if the adapter stamps its frames, four more hexadecimal digits of milliseconds, or eight

CAN FD frames (d, D, b, B; `##` in a log) are recognised, and not read: the counters are classic frames.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

_CAN_FRAME = struct.Struct("=IB3x8s")
"""linux/can.h: identifier with flags in the host's byte order, length, padding, data."""
CAN_FRAME_BYTES = _CAN_FRAME.size
_EXTENDED_FLAG, _REMOTE_FLAG, _ERROR_FLAG = 0x8000_0000, 0x4000_0000, 0x2000_0000
_STANDARD_MASK, _EXTENDED_MASK = 0x7FF, 0x1FFF_FFFF

SLCAN_LINE_BYTES = len("D1FFFFFFFF") + 2 * 64 + len("FFFFFFFF")
"""Longest line, without its end."""

_SLCAN_FRAME = re.compile(
    rb"(?:([tr])([0-7][0-9A-Fa-f]{2})|([TR])([01][0-9A-Fa-f]{7}))([0-8])((?:[0-9A-Fa-f]{2})*)", re.ASCII
)
SLCAN_FD = re.compile(rb"(?:[db][0-7][0-9A-Fa-f]{2}|[DB][01][0-9A-Fa-f]{7})[0-9A-Fa-f](?:[0-9A-Fa-f]{2}){0,68}")
"""A CAN FD frame, as CANable adapters write it."""
_STAMP = r"\(([0-9]{1,10})\.([0-9]{6}|[0-9]{9})\)"
_IDENTIFIER = r"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
_CANDUMP_LINE = re.compile(
    rf"{_STAMP} +(\S{{1,32}}) +{_IDENTIFIER}#(?:(R)([0-8])?|((?:[0-9A-Fa-f]{{2}}){{0,8}})(?:_[9A-Fa-f])?)(?: [RT])?\s*",
    re.ASCII,
)
_CANDUMP_SHOWN = re.compile(
    rf" *(?:(?:{_STAMP}|\([0-9: .-]+\)) +)?(\S{{1,32}}) +(?:[RT]X [B-] [E-] +)?{_IDENTIFIER} +\[([0-8])\]"
    r"(?: +(remote request)|((?: +[0-9A-Fa-f]{2}){0,8}))(?: +'.{0,8}')?(?: +ERRORFRAME)?\s*",
    re.ASCII,
)
"""A line as candump shows it on a terminal, with or without a time."""
CANDUMP_FD = re.compile(
    rf"{_STAMP} +\S{{1,32}} +{_IDENTIFIER}##[0-9A-Fa-f](?:[0-9A-Fa-f]{{2}}){{0,64}}(?: [RT])?\s*"
    rf"|[^\[]* {_IDENTIFIER} +\[[0-9]{{2}}\](?: .*)?"
)
"""A CAN FD frame in such a log, or as shown."""


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One classic CAN frame."""

    can_id: int
    data: bytes = b""
    dlc: int = -1
    """Length code; that of the data where not given (a remote request has a length but no data)."""
    extended: bool = False
    """29-bit identifier."""
    remote: bool = False
    error: bool = False
    """The controller's report of a fault on the bus, not a message."""

    def __post_init__(self) -> None:
        if self.dlc < 0:
            object.__setattr__(self, "dlc", len(self.data))


def parse_slcan(line: bytes) -> CanFrame | None:
    """The frame in one slcan line (without its end); None where the line holds no whole, well-formed frame."""
    match = _SLCAN_FRAME.fullmatch(line)
    if match is None:
        return None
    short, short_id, long, long_id, length, digits = match.groups()
    dlc, remote = int(length), (short or long) in b"rR"
    data = bytes.fromhex(digits.decode())
    data_bytes = 0 if remote else dlc
    if len(data) not in (data_bytes, data_bytes + 2, data_bytes + 4):  # more: the adapter's own time stamp
        return None
    return CanFrame(int(short_id or long_id, 16), data[:data_bytes], dlc, extended=long is not None, remote=remote)


def serialise_slcan(frame: CanFrame) -> bytes:
    """The slcan line of `frame`, its end included."""
    letter = "tTrR"[frame.extended + 2 * frame.remote]
    digits = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
    return f"{letter}{digits}{frame.dlc}{'' if frame.remote else frame.data.hex().upper()}\r".encode()


def unpack_can_frame(record: bytes) -> CanFrame | None:
    """The frame in one `struct can_frame`; None where it is none."""
    if len(record) != CAN_FRAME_BYTES:
        return None
    word, dlc, data = _CAN_FRAME.unpack(record)
    if dlc > 8:
        return None
    extended, remote, error = bool(word & _EXTENDED_FLAG), bool(word & _REMOTE_FLAG), bool(word & _ERROR_FLAG)
    if not (extended or error) and word & _EXTENDED_MASK > _STANDARD_MASK:
        return None
    can_id = word & (_EXTENDED_MASK if extended or error else _STANDARD_MASK)
    return CanFrame(can_id, b"" if remote else data[:dlc], dlc, extended, remote, error)


def pack_can_frame(frame: CanFrame) -> bytes:
    """The frame as `struct can_frame`."""
    flags = _EXTENDED_FLAG * frame.extended | _REMOTE_FLAG * frame.remote | _ERROR_FLAG * frame.error
    return _CAN_FRAME.pack(frame.can_id | flags, frame.dlc, frame.data)


@dataclass(frozen=True, slots=True)
class LoggedFrame:
    """A frame from a candump log, with the time its line states."""

    stamp_ns: int
    interface: str
    frame: CanFrame


def parse_candump_line(line: str) -> LoggedFrame | None:
    """The frame in one line of candump, whichever way it writes them; None where the line holds none.

    A line without a time, or with a date, is stamped 0.
    """
    match = _CANDUMP_LINE.fullmatch(line)
    if match is not None:
        seconds, fraction, interface, digits, remote, remote_dlc, data = match.groups()
    elif (match := _CANDUMP_SHOWN.fullmatch(line)) is not None:
        seconds, fraction, interface, digits, remote_dlc, remote, data = match.groups(default="")
        data = "".join(data.split())
        if not remote and len(data) != 2 * int(remote_dlc):
            return None
        seconds, fraction = seconds or "0", fraction or "0"
    else:
        return None
    stamp_ns = int(seconds) * 1_000_000_000 + int(fraction.ljust(9, "0"))
    word = int(digits, 16)
    # Eight digits: a 29-bit identifier, or the error flag of the kernel's own word.
    extended = len(digits) == 8 and not word & _ERROR_FLAG
    if word & (_EXTENDED_FLAG | _REMOTE_FLAG) or (len(digits) == 3 and word > _STANDARD_MASK):
        return None
    error = bool(word & _ERROR_FLAG) and len(digits) == 8
    payload = bytes.fromhex(data or "")
    dlc = int(remote_dlc or 0) if remote else len(payload)
    frame = CanFrame(word & _EXTENDED_MASK, payload, dlc, extended, bool(remote), error)
    return LoggedFrame(stamp_ns, interface, frame)


def serialise_candump_line(logged: LoggedFrame) -> str:
    """The line of `candump -l` for a frame, without its end."""
    frame = logged.frame
    word = frame.can_id | _ERROR_FLAG * frame.error
    digits = f"{word:08X}" if frame.extended or frame.error else f"{word:03X}"
    payload = f"R{frame.dlc}" if frame.remote else frame.data.hex().upper()
    seconds, nanoseconds = divmod(logged.stamp_ns, 1_000_000_000)
    return f"({seconds}.{nanoseconds // 1000:06d}) {logged.interface} {digits}#{payload}"


def can_frames(records: bytes) -> Iterator[CanFrame | None]:
    """The frames in whole `struct can_frame` records, None for each that is none."""
    for start in range(0, len(records) - CAN_FRAME_BYTES + 1, CAN_FRAME_BYTES):
        yield unpack_can_frame(records[start : start + CAN_FRAME_BYTES])
