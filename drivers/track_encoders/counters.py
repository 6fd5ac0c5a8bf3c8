"""Track counters inside CAN messages: where a DBC says that they stand.

What counts is the number of ticks. A counter that runs on is read raw: its scale and offset mean metres to somebody
else, and its sign only says from where it wraps. One that is sent as an increment is read with its sign and with its
offset, in raw steps. cantools reads the DBC; the decoding itself is a shift and a mask, made once. Little and big
endian, any length up to 32 bits, multiplexed or not.
"""

from dataclasses import asdict, dataclass
from typing import Any, Protocol

from drivers.errors import ConfigurationError
from drivers.kept_results import kept_result
from drivers.track_encoders.codec import CanFrame

_SPEEDS = ("m/s", "mps", "mm/s", "km/h", "kmh", "kph", "kmph", "mph", "rpm", "1/min", "rad/s", "deg/s", "hz", "ticks/s")


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
    signed: bool
    offset: int
    """Of an increment, in raw steps."""
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

    def read_increment(self, frame: CanFrame) -> int | None:
        """The ticks that such a frame adds, with their sign; None as above."""
        raw = self.read(frame)
        if raw is None:
            return None
        return raw + self.offset - (((raw >> (self.bits - 1)) << self.bits) if self.signed else 0)

    def comes_with(self, other: "TrackCounter") -> bool:
        """Does the same frame carry both?"""
        mine, its = (self.can_id, self.extended), (other.can_id, other.extended)
        selected = self.selected == other.selected and len(self.selected) <= 1
        return mine == its and self.selector == other.selector and selected


def find_counter(dbc: str, name: str) -> TrackCounter:
    """The counter called `name` (MESSAGE.SIGNAL) in the text of a DBC file."""
    return _counter(kept_result(__file__, "cantools", [dbc, name], lambda: _plain(_sought(dbc, name))))


_FIELDS = {"little": LittleEndianField, "big": BigEndianField}
_PLACES = "field", "selector"


def _counter(values: dict[str, Any]) -> TrackCounter:
    """Out of what is kept."""
    fields = {place: values[place] and _FIELDS[values[place].pop("order")](**values[place]) for place in _PLACES}
    return TrackCounter(**(values | fields | {"selected": frozenset(values["selected"])}))


def _plain(counter: TrackCounter) -> dict[str, Any]:
    """As it is kept."""
    values = asdict(counter) | {"selected": sorted(counter.selected)}
    for place in _PLACES:
        if values[place] is not None:
            little = isinstance(getattr(counter, place), LittleEndianField)
            values[place]["order"] = "little" if little else "big"
    return values


def _sought(dbc: str, name: str) -> TrackCounter:
    """The same, looked for in the file."""
    import cantools

    try:
        text = dbc.removeprefix("ï»¿")  # Notepad's mark, in the encoding of DBC files
        database: Any = cantools.database.load_string(text, database_format="dbc", strict=False)
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
    if not 2 <= signal.length <= 32:
        raise ConfigurationError(f"{name!r}: has {signal.length} bits; a track counter has 2 to 32")
    if str(signal.unit or "").strip().lower() in _SPEEDS:
        raise ConfigurationError(
            f"{name!r}: is a speed ({signal.unit}); what happens between two speeds nobody knows. Name a counter, or "
            "the ticks since the last message (counting = 'incremental')"
        )
    if message.length > 8:
        raise ConfigurationError(f"{name!r}: {message_name} has {message.length} bytes; only classic CAN (8) is read")
    field = _field(signal, message.length)
    if field.shift < 0 or field.shift + signal.length > 8 * message.length:
        raise ConfigurationError(
            f"{name!r}: lies outside the {message.length} bytes of {message_name}; mend the DBC file"
        )
    selector = next((s for s in message.signals if s.name == signal.multiplexer_signal), None)
    return TrackCounter(
        can_id=message.frame_id,
        extended=message.is_extended_frame,
        message_bytes=message.length,
        bits=signal.length,
        signed=signal.is_signed,
        offset=_offset(name, signal),
        field=field,
        selector=None if selector is None else _field(selector, message.length),
        selected=frozenset(signal.multiplexer_ids or ()),
    )


def _offset(name: str, signal: Any) -> int:
    """In raw steps: a DBC's physical value is raw * scale + offset."""
    steps = signal.offset / signal.scale if signal.scale else 0.0
    if steps != round(steps):
        raise ConfigurationError(f"{name!r}: offset {signal.offset} is no whole number of steps of {signal.scale}")
    return round(steps)


def _field(signal: Any, message_bytes: int) -> LittleEndianField | BigEndianField:
    mask = (1 << signal.length) - 1
    if signal.byte_order == "little_endian":
        return LittleEndianField(signal.start, mask)
    # DBC counts a Motorola signal's start in its own zigzag: byte * 8 + bit, bit 7 being the byte's first on the wire.
    first_bit = 8 * (signal.start // 8) + 7 - signal.start % 8
    return BigEndianField(8 * message_bytes - first_bit - signal.length, mask)


def _choice(things: Any) -> str:
    names = sorted(thing.name for thing in things)
    return f"choose one of {', '.join(names[:20])}{', ...' if len(names) > 20 else ''}"
