"""The emulated track encoders: a CAN unit that sends both counters, behind an slcan adapter."""

from collections.abc import Callable
from math import floor

from drivers.track_encoders.adapter import BELL, OK, SLCAN_BITRATES
from drivers.track_encoders.codec import CanFrame, parse_slcan, serialise_slcan

TRACKS_ID = 0x181
"""Message TRACKS of docs/config/tracks.dbc: LEFT and RIGHT, 16 bits each, little-endian."""
_COUNTER_MASK = 0xFFFF
_COMMAND_BYTES = 64
_STAMP_WRAP_MS = 60_000
_BUS_ERROR_FLAG = 0x80
_ERROR_PASSIVE_FLAG = 0x20


class TrackEncodersEmulator:
    """Sends TRACKS at each whole multiple of its period, once the host has opened the adapter."""

    def __init__(
        self,
        count: Callable[[int], tuple[float, float]],
        *,
        start_ns: int = 0,
        period_ns: int = 10_000_000,
        latency_ns: int = 0,
        bitrate: int = 500000,
        firmware: bytes = b"1013",
        serial_number: bytes = b"A123",
    ) -> None:
        """`count(t_ns)` gives the true, fractional ticks of the left and the right track.

        The first acquisition is at `start_ns`; its frame is on the wire `latency_ns` later. A host that sets another
        bit rate than the unit's gets no frames.
        """
        self._count = count
        self._next_ns = start_ns
        self._period_ns = period_ns
        self.latency_ns = latency_ns
        """From acquisition to the wire."""
        self._bus_speed = SLCAN_BITRATES[bitrate]
        self._firmware, self._serial_number = firmware, serial_number
        self._speed: int | None = None
        self._open = False
        self._stamping = False
        self._flags = 0
        self._silent_until_ns: int | None = None
        self._zero = (0, 0)
        self._command = bytearray()
        self._outbox = bytearray()
        self._now_ns = start_ns

    @property
    def baud(self) -> int | None:
        """None: a USB adapter listens at any rate."""
        return None

    @property
    def is_open(self) -> bool:
        """Has the host opened the channel at the unit's bit rate?"""
        return self._open and self._speed == self._bus_speed

    def receive_data(self, data: bytes, now_ns: int) -> None:
        """Take commands; each is answered by a carriage return or a bell."""
        self._run_until(now_ns)
        for byte in data:
            if byte == 0x0D:
                self._outbox += self._obey(bytes(self._command))
                self._command.clear()
            elif len(self._command) < _COMMAND_BYTES:
                self._command.append(byte)

    def data_to_send(self, now_ns: int) -> bytes:
        """Answers, and all frames that have left by `now_ns`."""
        self._run_until(now_ns)
        data = bytes(self._outbox)
        self._outbox.clear()
        return data

    def restart_unit(self, now_ns: int, silence_ns: int) -> None:
        """The unit behind the adapter restarts: silent for a while, then its counters begin at zero."""
        self._run_until(now_ns)
        left, right = self._count(now_ns + silence_ns)
        self._silent_until_ns, self._zero = now_ns + silence_ns, (floor(left), floor(right))

    def bus_off(self, now_ns: int) -> None:
        """The adapter's controller switches itself off: no frame any more, until the channel is opened anew."""
        self._run_until(now_ns)
        self._flags = _BUS_ERROR_FLAG | _ERROR_PASSIVE_FLAG

    def _run_until(self, now_ns: int) -> None:
        """Let the unit send up to `now_ns`, into an adapter that passes frames on only while it is open."""
        self._now_ns = now_ns
        while self._next_ns + self.latency_ns <= now_ns:
            silent = self._silent_until_ns is not None and self._next_ns < self._silent_until_ns
            if self.is_open and not self._flags and not silent:
                left, right = self._count(self._next_ns)
                line = serialise_slcan(tracks_frame(left - self._zero[0], right - self._zero[1]))
                self._outbox += self._stamped(line, self._next_ns + self.latency_ns)
            self._next_ns += self._period_ns

    def _stamped(self, line: bytes, t_ns: int) -> bytes:
        return line[:-1] + b"%04X\r" % (t_ns // 1_000_000 % _STAMP_WRAP_MS) if self._stamping else line

    def _obey(self, command: bytes) -> bytes:
        """LAWICEL's CANUSB manual: what can't be done now is refused."""
        letter = command[:1]
        if letter == b"S" and len(command) == 2 and b"0" <= command[1:] <= b"8" and not self._open:
            self._speed = int(command[1:])
            return OK
        if command == b"O" and not self._open and self._speed is not None:
            self._open, self._flags = True, 0
            return OK
        if command == b"C" and self._open:
            self._open = False
            return OK
        if command in (b"Z0", b"Z1") and not self._open:
            self._stamping = command == b"Z1"
            return OK
        if command == b"V":
            return b"V" + self._firmware + OK
        if command == b"N":
            return b"N" + self._serial_number + OK
        if command == b"F" and self._open:
            return b"F%02X" % self._flags + OK
        if parse_slcan(command) is not None and self._open and not self._flags:
            return (b"z" if letter in b"tr" else b"Z") + OK
        return OK if command == b"" else BELL


def tracks_frame(left_ticks: float, right_ticks: float) -> CanFrame:
    """The frame of two counts: whole ticks, wrapped around."""
    counts = [(floor(ticks) & _COUNTER_MASK).to_bytes(2, "little") for ticks in (left_ticks, right_ticks)]
    return CanFrame(TRACKS_ID, b"".join(counts))
