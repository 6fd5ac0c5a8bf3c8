"""Track counters inside CAN messages: where a DBC says that they stand, and how they are unwrapped.

A signal is read raw, without its scale and offset: what counts is the number of ticks. cantools reads the DBC; the
decoding itself is a shift and a mask, made once.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import cantools

from drivers.errors import ConfigurationError
from drivers.track_encoders.codec import CanFrame


class Field(Protocol):
    """An unsigned number inside the data of a message."""

    def __call__(self, data: bytes) -> int:
        """The raw number."""


@dataclass(frozen=True, slots=True)
class LittleEndianField:
    """Intel order: the signal's start bit is its least significant one."""

    shift: int
    mask: int

    def __call__(self, data: bytes) -> int:
        """The raw number."""
        return (int.from_bytes(data, "little") >> self.shift) & self.mask


@dataclass(frozen=True, slots=True)
class BigEndianField:
    """Motorola order; `shift` counts from the message's last bit."""

    shift: int
    mask: int

    def __call__(self, data: bytes) -> int:
        """The raw number."""
        return (int.from_bytes(data, "big") >> self.shift) & self.mask


@dataclass(frozen=True, slots=True)
class TrackCounter:
    """One track's counter: the message that carries it and its place there."""

    can_id: int
    extended: bool
    message_bytes: int
    bits: int
    field: Field
    selector: Field | None
    """Of a multiplexed message: which part of it this frame holds..."""
    selected: frozenset[int]
    """... and in which parts the counter stands."""

    def read(self, frame: CanFrame) -> int | None:
        """The raw count in a frame of this message (of its right length); None where this part doesn't hold it."""
        if self.selector is not None and self.selector(frame.data) not in self.selected:
            return None
        return self.field(frame.data)


def find_counter(dbc: str, name: str) -> TrackCounter:
    """The counter called `name` (MESSAGE.SIGNAL) in the text of a DBC file."""
    try:
        database: Any = cantools.database.load_string(dbc, database_format="dbc")
    except Exception as error:  # the parser raises many kinds
        raise ConfigurationError(f"the DBC file can't be read ({error}); give a Vector DBC file") from error
    message_name, _, signal_name = name.partition(".")
    message = next((m for m in database.messages if m.name == message_name), None)
    if message is None:
        raise ConfigurationError(f"{name!r}: the DBC has no message {message_name!r}; {_choice(database.messages)}")
    signal = next((s for s in message.signals if s.name == signal_name), None)
    if signal is None:
        known = _choice(message.signals)
        raise ConfigurationError(f"{name!r}: {message_name} has no signal {signal_name!r}; {known} (MESSAGE.SIGNAL)")
    if signal.is_float:
        raise ConfigurationError(f"{name!r}: is a floating point signal; a track counter is an integer")
    if message.length > 8:
        raise ConfigurationError(f"{name!r}: {message_name} has {message.length} bytes; only classic CAN (8) is read")
    selector = next((s for s in message.signals if s.name == signal.multiplexer_signal), None)
    return TrackCounter(
        can_id=message.frame_id,
        extended=message.is_extended_frame,
        message_bytes=message.length,
        bits=signal.length,
        field=_field(signal, message.length),
        selector=None if selector is None else _field(selector, message.length),
        selected=frozenset(signal.multiplexer_ids or ()),
    )


def _field(signal: Any, message_bytes: int) -> Field:
    mask = (1 << signal.length) - 1
    if signal.byte_order == "little_endian":
        return LittleEndianField(signal.start, mask)
    # DBC counts a Motorola signal's start in its own zigzag: byte * 8 + bit, bit 7 being the byte's first on the wire.
    first_bit = 8 * (signal.start // 8) + 7 - signal.start % 8
    return BigEndianField(8 * message_bytes - first_bit - signal.length, mask)


def _choice(things: Any) -> str:
    names = sorted(thing.name for thing in things)
    return f"choose one of {', '.join(names[:20])}{', ...' if len(names) > 20 else ''}"


class Unwrapped:
    """A counter without end, from one that wraps around after `bits` bits.

    With d = (new - old) mod 2^bits, taken as -2^(bits-1) <= d < 2^(bits-1): right as long as the true change since
    the last reading is within these limits.
    """

    def __init__(self, bits: int) -> None:
        """Nothing read yet."""
        self._half = 1 << (bits - 1)
        self._raw: int | None = None
        self.total = 0

    def advance(self, raw: int) -> int:
        """Take a reading; returns the change since the last one (0 for the first)."""
        if self._raw is None:
            self._raw = self.total = raw
            return 0
        change = ((raw - self._raw + self._half) % (2 * self._half)) - self._half
        self._raw = raw
        self.total += change
        return change

    def restart(self) -> None:
        """Forget: the next reading begins a new count."""
        self._raw = None
