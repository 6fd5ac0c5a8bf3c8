"""The slcan adapter between serial line and CAN bus: asked who it is, set to the bus's bit rate, opened, watched.

    step        sent        goes on with                                   or after 0.2 s
    IDENTIFY    \\r C V      V<version>: what was answered before is over   NUMBER
    NUMBER      N           N<serial number>, or a bell                    RATE
    RATE        S<code>     a carriage return; a bell: REFUSED             CHANNEL
    CHANNEL     O           a carriage return: OPEN; a bell: REFUSED       OPEN
    OPEN        -           a second without a frame: F, then IDENTIFY
    REFUSED     -           after a second: IDENTIFY

C closes the channel, which may be open at another rate since somebody else used it; the carriage return before it ends
what a host that died had begun to write. The channel is opened only once the rate was accepted: at a wrong rate an
adapter disturbs the whole bus. Adapters that answer nothing are opened all the same. Nothing is stored in the adapter
(Z would be: its time stamps are taken as they come, and not used).
"""

import re
from collections import Counter
from dataclasses import dataclass
from enum import Enum

OK, BELL = b"\r", b"\a"
SLCAN_BITRATES = {10000: 0, 20000: 1, 50000: 2, 100000: 3, 125000: 4, 250000: 5, 500000: 6, 800000: 7, 1000000: 8}
SILENCE_NS = 1_000_000_000
_PATIENCE_NS = 200_000_000
_VERSION = re.compile(rb"V([ -~]{1,40})")
_NUMBER = re.compile(rb"N([ -~]{1,40})")
_FLAGS = re.compile(rb"F([0-9A-Fa-f]{2})")


class Step(Enum):
    """Where the conversation stands, in words for people."""

    IDENTIFY = "asking the adapter who it is"
    NUMBER = "asking the adapter for its serial number"
    RATE = "setting the bit rate"
    CHANNEL = "opening the channel"
    OPEN = "open"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class AdapterIdentity:
    """What the adapter says of itself; empty where it doesn't."""

    version: str = ""
    serial_number: str = ""


class SlcanAdapter:
    """The host's side of the conversation, sans I/O.

    counts: `opened`, `reopened` after silence, `refused_commands`, `unanswered_commands`, `bus_errors` that its status
    flags told.
    """

    def __init__(self, bitrate: int, counts: Counter[str]) -> None:
        """Nothing said yet."""
        self._bitrate = bitrate
        self._counts = counts
        self._outbox = bytearray()
        self.step = Step.IDENTIFY
        self.identity = AdapterIdentity()
        self.deadline_ns: int | None = None

    @property
    def state(self) -> str:
        """For people."""
        if self.step is Step.REFUSED:
            return f"the adapter refuses {self._bitrate} bit/s; set the bus's bit rate, or use another adapter"
        return str(self.step.value)

    def start(self, now_ns: int) -> None:
        """From the beginning, whatever state the adapter is in."""
        self._outbox.clear()
        self._say(Step.IDENTIFY, b"\rC\rV\r", now_ns)

    def data_to_send(self) -> bytes:
        """Commands."""
        data = bytes(self._outbox)
        self._outbox.clear()
        return data

    def frame_came(self, now_ns: int) -> None:
        """The bus lives."""
        if self.step is Step.OPEN:
            self.deadline_ns = now_ns + SILENCE_NS

    def take_answer(self, text: bytes, end: bytes, now_ns: int) -> bool:
        """Take a line that holds no frame, as far as it answers anything; False: it doesn't."""
        if (flags := _FLAGS.fullmatch(text)) is not None:
            self._counts["bus_errors"] += int(flags.group(1), 16) != 0
            return True
        if self.step is Step.IDENTIFY:
            match = _VERSION.fullmatch(text)
            if match is not None:
                self.identity = AdapterIdentity(version=match.group(1).decode())
                self._say(Step.NUMBER, b"N\r", now_ns)
            return match is not None or not text
        if self.step is Step.NUMBER:
            match = _NUMBER.fullmatch(text)
            if match is not None:
                self.identity = AdapterIdentity(self.identity.version, match.group(1).decode())
            if match is not None or (not text and end == BELL):
                self._set_rate(now_ns)
            return match is not None or not text
        if text:
            return _VERSION.fullmatch(text) is not None or _NUMBER.fullmatch(text) is not None
        if self.step in (Step.RATE, Step.CHANNEL):
            if end == BELL:
                self._counts["refused_commands"] += 1
                self._say(Step.REFUSED, b"", now_ns, SILENCE_NS)
            elif self.step is Step.RATE:
                self._say(Step.CHANNEL, b"O\r", now_ns)
            else:
                self._counts["opened"] += 1
                self._say(Step.OPEN, b"", now_ns, SILENCE_NS)
        return True

    def advance(self, now_ns: int) -> None:
        """Let time pass."""
        if self.deadline_ns is None or now_ns < self.deadline_ns:
            return
        if self.step is Step.OPEN:
            self._counts["reopened"] += 1
            self.start(now_ns)
            self._outbox[:0] = b"F\r"
        elif self.step is Step.REFUSED:
            self.start(now_ns)
        else:
            self._counts["unanswered_commands"] += 1
            match self.step:
                case Step.IDENTIFY:
                    self._say(Step.NUMBER, b"N\r", now_ns)
                case Step.NUMBER:
                    self._set_rate(now_ns)
                case Step.RATE:
                    self._say(Step.CHANNEL, b"O\r", now_ns)
                case _:
                    self._say(Step.OPEN, b"", now_ns, SILENCE_NS)

    def _set_rate(self, now_ns: int) -> None:
        self._say(Step.RATE, b"S%d\r" % SLCAN_BITRATES[self._bitrate], now_ns)

    def _say(self, step: Step, command: bytes, now_ns: int, patience_ns: int = _PATIENCE_NS) -> None:
        self.step = step
        self._outbox += command
        self.deadline_ns = now_ns + patience_ns
