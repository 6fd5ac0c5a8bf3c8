"""The emulated track encoders: a CAN unit that sends both counters, behind an slcan adapter."""

from collections.abc import Callable
from math import floor

from drivers.track_encoders.codec import BELL, OK, SLCAN_BITRATES, CanFrame, parse_slcan, serialise_slcan

TRACKS_ID = 0x181
"""Message TRACKS of docs/config/tracks.dbc: LEFT and RIGHT, 16 bits each, little-endian."""
_COUNTER_MASK = 0xFFFF
_COMMAND_BYTES = 64


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
        firmware: bytes = b"V1013",
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
        self._firmware = firmware
        self._speed: int | None = None
        self._open = False
        self._command = bytearray()
        self._outbox = bytearray()

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

    def _run_until(self, now_ns: int) -> None:
        """Let the unit send up to `now_ns`, into an adapter that passes frames on only while it is open."""
        while self._next_ns + self.latency_ns <= now_ns:
            if self.is_open:
                self._outbox += serialise_slcan(tracks_frame(*self._count(self._next_ns)))
            self._next_ns += self._period_ns

    def _obey(self, command: bytes) -> bytes:
        letter = command[:1]
        if letter == b"S" and len(command) == 2 and command[1:].isdigit() and not self._open and command[1:] <= b"8":
            self._speed = int(command[1:])
            return OK
        if command == b"O" and not self._open and self._speed is not None:
            self._open = True
            return OK
        if command == b"C" and self._open:
            self._open = False
            return OK
        if command == b"V":
            return self._firmware + OK
        if command == b"F" and self._open:
            return b"F00" + OK
        if parse_slcan(command) is not None and self._open:
            return (b"z" if letter in b"tr" else b"Z") + OK
        return OK if command == b"" else BELL


def tracks_frame(left_ticks: float, right_ticks: float) -> CanFrame:
    """The frame of two counts: whole ticks, wrapped around."""
    counts = [(floor(ticks) & _COUNTER_MASK).to_bytes(2, "little") for ticks in (left_ticks, right_ticks)]
    return CanFrame(TRACKS_ID, b"".join(counts))
