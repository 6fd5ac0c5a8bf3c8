"""Track encoders over CAN: counters of both tracks in, unwrapped ticks out.

An slcan adapter is opened with three commands: C (close, lest it be open at another rate), S (bit rate), O (open).
Where nothing comes for a second it may have been plugged anew, or never heard us: it is opened again.
"""

from collections import Counter, deque

from drivers.config import EncodersConfig, latency_ns
from drivers.samples import Stamp, WheelTicks
from drivers.track_encoders.codec import (
    BELL,
    CAN_FRAME_BYTES,
    OK,
    SLCAN_BITRATES,
    SLCAN_LINE_BYTES,
    CanFrame,
    can_frames,
    parse_slcan,
)
from drivers.track_encoders.counters import TrackCounter, Unwrapped, find_counter

_ADAPTER_BAUD = 115200
"""Usual for adapters behind a UART; one on USB doesn't care."""
_SILENCE_NS = 1_000_000_000
_GAP_NS = 500_000_000
"""After a longer pause a counter may have wrapped unseen, or its unit have restarted."""
_FRAME_LETTERS, _LINE_ENDS = b"tTrR", OK + BELL


class TrackEncoderProtocol:
    """The host's end of the wire to the track encoders; see drivers/protocol.py for the contract.

    counts: `ticks` delivered, `frames` intact, `other_frames` of no interest, `error_frames`, `remote_frames`,
    `bad_frames` refused, `bad_length` of our messages, `skipped_bytes`, `opened` and `refused_commands` of the adapter,
    `reopened` after silence, `gaps` and `jumps` that began a new epoch.
    """

    def __init__(self, config: EncodersConfig, dbc: str) -> None:
        """`dbc` is the text of the DBC file. ConfigurationError where it lacks the two counters."""
        self.counts: Counter[str] = Counter()
        self._slcan = config.interface == "slcan"
        self._bitrate = config.bitrate
        self._least_ns, self._most_ns = latency_ns(config.latency_ms)
        self._tracks = [_Track(find_counter(dbc, name)) for name in (config.left, config.right)]
        self._message_bytes = {(c.can_id, c.extended): c.message_bytes for c in (t.counter for t in self._tracks)}
        self._epoch = 0
        self._partial = bytearray()
        self._begun_ns = 0
        """Time of the read that held the last letter that can begin a frame."""
        self._outbox = bytearray()
        self._unanswered: deque[bytes] = deque(maxlen=16)
        self._deadline_ns: int | None = None
        self._open_adapter()

    @property
    def baud(self) -> int | None:
        """Of the serial line to the adapter, which has nothing to do with the CAN's bit rate."""
        return _ADAPTER_BAUD if self._slcan else None

    @property
    def deadline_ns(self) -> int | None:
        """When silence has lasted too long."""
        return self._deadline_ns

    def connection_made(self, now_ns: int) -> None:
        """Open the adapter; begin a new epoch, since nobody knows what was counted meanwhile."""
        self._partial.clear()
        self._new_epoch()
        self._open_adapter()
        if self._slcan:
            self._deadline_ns = now_ns + _SILENCE_NS

    def advance(self, now_ns: int) -> None:
        """After a second of silence, open the adapter again."""
        if self._deadline_ns is not None and now_ns >= self._deadline_ns:
            self.counts["reopened"] += 1
            self._open_adapter()
            self._deadline_ns = now_ns + _SILENCE_NS

    def data_to_send(self) -> bytes:
        """Commands for the adapter."""
        data = bytes(self._outbox)
        self._outbox.clear()
        return data

    def receive_data(self, data: bytes, stamp_ns: int) -> list[WheelTicks]:
        """Take slcan text or `struct can_frame` records, by the configured interface."""
        return self._receive_slcan(data, stamp_ns) if self._slcan else self._receive_records(data, stamp_ns)

    def receive_frame(self, frame: CanFrame, stamp_ns: int) -> list[WheelTicks]:
        """Take one frame; both tracks must have been seen anew before a sample comes out."""
        if frame.error:
            self.counts["error_frames"] += 1
            return []
        self.counts["frames"] += 1
        if frame.remote:
            self.counts["remote_frames"] += 1
            return []
        length = self._message_bytes.get((frame.can_id, frame.extended))
        if length != len(frame.data):
            self.counts["other_frames" if length is None else "bad_length"] += 1
            return []
        for track in self._tracks:
            self._read_track(track, frame, stamp_ns)
        if not all(track.fresh for track in self._tracks):
            return []
        left, right = self._tracks
        left.fresh = right.fresh = False
        first_ns, last_ns = sorted((left.stamp_ns, right.stamp_ns))
        stamp = Stamp(first_ns - self._most_ns, last_ns - self._least_ns)
        self.counts["ticks"] += 1
        return [WheelTicks(stamp, left.count.total, right.count.total, self._epoch)]

    def _read_track(self, track: "_Track", frame: CanFrame, stamp_ns: int) -> None:
        counter = track.counter
        if (frame.can_id, frame.extended) != (counter.can_id, counter.extended):
            return
        raw = counter.read(frame)
        if raw is None:
            return
        if track.seen and stamp_ns - track.stamp_ns > _GAP_NS:
            self.counts["gaps"] += 1
            self._new_epoch()
        change = track.count.advance(raw)
        # A quarter of a wide counter's range between two neighbours is no motion: the unit has begun anew.
        if counter.bits >= 16 and abs(change) > 1 << (counter.bits - 2):
            self.counts["jumps"] += 1
            self._new_epoch()
            track.count.advance(raw)
        track.seen = track.fresh = True
        track.stamp_ns = stamp_ns

    def _new_epoch(self) -> None:
        if any(track.seen for track in self._tracks):
            self._epoch += 1
        for track in self._tracks:
            track.count.restart()
            track.seen = track.fresh = False

    def _receive_records(self, data: bytes, stamp_ns: int) -> list[WheelTicks]:
        samples: list[WheelTicks] = []
        for frame in can_frames(data):
            if frame is None:
                self.counts["bad_frames"] += 1
            else:
                samples += self.receive_frame(frame, stamp_ns)
        if rest := len(data) % CAN_FRAME_BYTES:  # a read never ends inside a record: this is dirt, not a beginning
            self.counts["skipped_bytes"] += rest
        return samples

    def _receive_slcan(self, data: bytes, stamp_ns: int) -> list[WheelTicks]:
        samples: list[WheelTicks] = []
        start = 0
        for i, byte in enumerate(data):
            if byte in _FRAME_LETTERS:
                self._begun_ns = stamp_ns
            elif byte in _LINE_ENDS:
                line = bytes(self._partial) + data[start:i]
                self._partial.clear()
                start = i + 1
                if not line:
                    self._take_answer(data[i:start])
                elif (frame := self._frame_at_end(line)) is not None:
                    if self._deadline_ns is not None:
                        self._deadline_ns = stamp_ns + _SILENCE_NS
                    samples += self.receive_frame(frame, self._begun_ns)
        self._partial += data[start:]
        if (excess := len(self._partial) - SLCAN_LINE_BYTES) > 0:  # only the end can still become a frame
            self.counts["skipped_bytes"] += excess
            del self._partial[:excess]
        return samples

    def _frame_at_end(self, line: bytes) -> CanFrame | None:
        """The frame that `line` ends with: dirt before it can't reach past the frame's own letter."""
        begin = max(line.rfind(letter) for letter in _FRAME_LETTERS)
        frame = parse_slcan(line[begin:]) if begin >= 0 else None
        if frame is None:
            if line not in (b"z", b"Z"):  # an adapter's thanks for a frame sent
                self.counts["bad_frames"] += 1
        elif begin:
            self.counts["skipped_bytes"] += begin
        return frame

    def _take_answer(self, answer: bytes) -> None:
        if not self._unanswered:
            return
        command = self._unanswered.popleft()
        if answer == OK and command == b"O":
            self.counts["opened"] += 1
        elif answer == BELL and command != b"C":  # a closed channel may refuse to be closed
            self.counts["refused_commands"] += 1

    def _open_adapter(self) -> None:
        if not self._slcan:
            return
        commands = (b"C", b"S%d" % SLCAN_BITRATES[self._bitrate], b"O")
        self._outbox[:] = b"".join(command + b"\r" for command in commands)
        self._unanswered.clear()
        self._unanswered.extend(commands)


class _Track:
    """What is known of one track."""

    def __init__(self, counter: TrackCounter) -> None:
        self.counter = counter
        self.count = Unwrapped(counter.bits)
        self.seen = False
        self.fresh = False
        """Read since the last sample?"""
        self.stamp_ns = 0
