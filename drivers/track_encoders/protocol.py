"""Track encoders over CAN: counters of both tracks in, unwrapped ticks out."""

import re
from collections import Counter
from math import inf

from drivers.config import EncodersConfig, latency_ns
from drivers.errors import ConfigurationError
from drivers.samples import Stamp, WheelTicks
from drivers.track_encoders.adapter import AdapterIdentity, SlcanAdapter
from drivers.track_encoders.codec import (
    CAN_FRAME_BYTES,
    SLCAN_FD,
    SLCAN_LINE_BYTES,
    CanFrame,
    can_frames,
    parse_slcan,
)
from drivers.track_encoders.counters import TrackCounter, find_counter
from drivers.track_encoders.odometer import Count, Odometer, Reading, TrackLimits

_ADAPTER_BAUD = 115200
"""Usual for adapters behind a UART; one on USB doesn't care."""
_LINE_END = re.compile(rb"[\r\a]")
_FRAME_LETTER = re.compile(rb"[tTrR]")
_THANKS = (b"z", b"Z")
"""An adapter's, for a frame sent."""
_RUNNING_BITS = 62
"""Of a sum of increments."""
_LOST, _DUPLICATE = "lost", "duplicate"
_BUS_OFF, _RESTARTED = 0x40, 0x100
"""linux/can/error.h: classes of error frames, in the identifier's place."""


class TrackEncoderProtocol:
    """The host's end of the wire to the track encoders; see drivers/protocol.py for the contract.

    counts: `ticks` delivered; `frames` intact, of them `other_frames` of no interest, `remote_frames`, `bad_length` of
    our messages; `error_frames`, of them `bus_off` and `bus_restarts`; `fd_frames` not read; `bad_frames` refused,
    `skipped_bytes`; of two messages `unpaired`; of increments `lost` and `duplicate`; and those of adapter.py and
    odometer.py.
    """

    def __init__(self, config: EncodersConfig, dbc: str, max_track_mps: float | None = None) -> None:
        """`dbc` is the text of the DBC file. `max_track_mps`: no track is ever faster; None: nobody knows.

        ConfigurationError where the DBC lacks the two counters, or their declaration can't be kept.
        """
        self.counts: Counter[str] = Counter()
        self._adapter = SlcanAdapter(config.bitrate, self.counts) if config.interface == "slcan" else None
        self._least_ns, self._most_ns = latency_ns(config.latency_ms)
        self._tracks = _Track(find_counter(dbc, config.left), config), _Track(find_counter(dbc, config.right), config)
        left, right = (track.counter for track in self._tracks)
        self._message_bytes = {(c.can_id, c.extended): c.message_bytes for c in (left, right)}
        self._apart = not left.comes_with(right)
        self._pair_within_ns = round(config.pair_within_ms * 1e6)
        self._odometer = Odometer(
            *_limits(config, left, right, max_track_mps, self._apart),
            spread_ns=self._most_ns - self._least_ns,
            restart_ns=round(config.restart_ms * 1e6),
            counts=self.counts,
        )
        self._bus_off = False
        self._partial = b""
        self._begun_ns = self._begun_late_ns = 0
        """Time and lateness of the read that held the last letter that can begin a frame."""
        self._late_ns = 0
        """Of the present read."""

    @property
    def baud(self) -> int | None:
        """Of the serial line to the adapter, which has nothing to do with the CAN's bit rate."""
        return _ADAPTER_BAUD if self._adapter is not None else None

    @property
    def deadline_ns(self) -> int | None:
        """When the adapter should have answered, or silence has lasted too long."""
        return self._adapter.deadline_ns if self._adapter is not None else None

    @property
    def identity(self) -> AdapterIdentity | None:
        """What the adapter says of itself."""
        return self._adapter.identity if self._adapter is not None else None

    @property
    def state(self) -> str:
        """For people: where the adapter stands, and the bus."""
        if self._bus_off:
            return "bus-off: the CAN controller has switched itself off; check the bus's wiring, ends and bit rate"
        return self._adapter.state if self._adapter is not None else ""

    @property
    def messages(self) -> tuple[tuple[int, bool], ...]:
        """Identifiers that carry the counters, and whether they are extended ones."""
        return tuple(self._message_bytes)

    def connection_made(self, now_ns: int) -> None:
        """Open the adapter; begin a new epoch, since nobody knows what was counted meanwhile."""
        self._partial = b""
        self._bus_off = False
        self._odometer.interrupt()
        for track in self._tracks:
            track.forget()
        if self._adapter is not None:
            self._adapter.start(now_ns)

    def advance(self, now_ns: int) -> None:
        """An adapter that doesn't answer, or is silent for a second, is dealt with."""
        if self._adapter is not None:
            self._adapter.advance(now_ns)

    def data_to_send(self) -> bytes:
        """Commands for the adapter."""
        return self._adapter.data_to_send() if self._adapter is not None else b""

    def read_late(self, late_ns: int) -> None:
        """The next read's bytes may have lain in the port; see drivers/protocol.py."""
        self._late_ns = late_ns

    def receive_data(self, data: bytes, stamp_ns: int) -> list[WheelTicks]:
        """Take slcan text or `struct can_frame` records, by the configured interface."""
        if self._adapter is not None:
            samples = self._receive_slcan(data, stamp_ns, self._adapter)
        else:
            samples = self._receive_records(data, stamp_ns)
        self._late_ns = 0
        return samples

    def finish(self) -> list[WheelTicks]:
        """The stream has ended, as a recording does: a reading that was kept back."""
        return [self._sample(count) for count in self._odometer.finish()]

    def receive_frame(self, frame: CanFrame, stamp_ns: int, late_ns: int = 0) -> list[WheelTicks]:
        """Take one frame; both tracks must have been seen anew before a sample comes out."""
        if frame.error:
            self._receive_error(frame)
            return []
        self._bus_off = False
        self.counts["frames"] += 1
        if frame.remote:
            self.counts["remote_frames"] += 1
            return []
        length = self._message_bytes.get((frame.can_id, frame.extended))
        if length != len(frame.data):
            self.counts["other_frames" if length is None else "bad_length"] += 1
            return []
        for track in self._tracks:
            if track.carried_by(frame) and (trouble := track.take(frame, stamp_ns, late_ns)) is not None:
                self.counts[trouble] += 1
                if trouble == _LOST:
                    self._odometer.interrupt()
        return [self._sample(count) for count in self._pair()]

    def _receive_error(self, frame: CanFrame) -> None:
        self.counts["error_frames"] += 1
        if frame.can_id & _BUS_OFF:
            self.counts["bus_off"] += 1
            self._bus_off = True
        if frame.can_id & _RESTARTED:
            self.counts["bus_restarts"] += 1
            self._bus_off = False

    def _pair(self) -> list[Count]:
        """What a reading of both tracks comes to, once there is one."""
        left, right = self._tracks
        if not (left.fresh and right.fresh):
            return []
        earlier, later = (left, right) if left.stamp_ns <= right.stamp_ns else (right, left)
        late_ns = max(left.late_ns, right.late_ns)
        if self._apart and later.stamp_ns - earlier.stamp_ns + late_ns > self._pair_within_ns:
            earlier.fresh = False  # its partner was lost
            self.counts["unpaired"] += 1
            return []
        left.fresh = right.fresh = False
        return self._odometer.take(Reading(left.raw, right.raw, earlier.stamp_ns, later.stamp_ns, late_ns))

    def _sample(self, count: Count) -> WheelTicks:
        self.counts["ticks"] += 1
        at = count.reading
        stamp = Stamp(at.first_ns - self._most_ns, at.last_ns - self._least_ns)
        return WheelTicks(stamp, count.left, count.right, count.epoch)

    def _receive_records(self, data: bytes, stamp_ns: int) -> list[WheelTicks]:
        samples: list[WheelTicks] = []
        for frame in can_frames(data):
            if frame is None:
                self.counts["bad_frames"] += 1
            else:
                samples += self.receive_frame(frame, stamp_ns, self._late_ns)
        if rest := len(data) % CAN_FRAME_BYTES:  # a read never ends inside a record: this is dirt, not a beginning
            self.counts["skipped_bytes"] += rest
        return samples

    def _receive_slcan(self, data: bytes, stamp_ns: int, adapter: SlcanAdapter) -> list[WheelTicks]:
        samples: list[WheelTicks] = []
        text, known = self._partial + data, len(self._partial)
        end = 0
        for match in _LINE_END.finditer(text):
            line, begin, end = text[end : match.start()], end, match.end()
            # The frame that the line ends with: dirt before it can't reach past the frame's own letter.
            letter = max(line.rfind(b"t"), line.rfind(b"T"), line.rfind(b"r"), line.rfind(b"R"))
            frame = parse_slcan(line[letter:]) if letter >= 0 else None
            if frame is None:
                self._take_other(line, match.group(), stamp_ns, adapter)
                continue
            if letter:
                self.counts["skipped_bytes"] += letter
            adapter.frame_came(stamp_ns)
            if begin + letter >= known:
                samples += self.receive_frame(frame, stamp_ns, self._late_ns)
            else:
                samples += self.receive_frame(frame, self._begun_ns, self._begun_late_ns)
        if _FRAME_LETTER.search(data, max(end - known, 0)):
            self._begun_ns, self._begun_late_ns = stamp_ns, self._late_ns
        self._partial = text[end:]
        if (excess := len(self._partial) - SLCAN_LINE_BYTES) > 0:  # only the end can still become a frame
            self.counts["skipped_bytes"] += excess
            self._partial = self._partial[excess:]
        return samples

    def _take_other(self, line: bytes, end: bytes, now_ns: int, adapter: SlcanAdapter) -> None:
        """A line that holds no frame of ours."""
        if line in _THANKS or adapter.take_answer(line, end, now_ns):
            return
        self.counts["fd_frames" if SLCAN_FD.fullmatch(line) else "bad_frames"] += 1


class _Track:
    """What is known of one track."""

    def __init__(self, counter: TrackCounter, config: EncodersConfig) -> None:
        self.counter = counter
        self._incremental = config.counting == "incremental"
        self._least_period_ns = (config.least_period_ms or inf) * 1e6
        least_ns, most_ns = latency_ns(config.latency_ms)
        self._spread_ns = most_ns - least_ns
        self.forget()

    def forget(self) -> None:
        """Nothing read yet."""
        self.raw = 0
        """Raw count, or the sum of increments."""
        self.seen = self.fresh = False
        """Ever read? Since the last reading of both?"""
        self.stamp_ns = self.late_ns = 0

    def carried_by(self, frame: CanFrame) -> bool:
        """Is it this message?"""
        return (frame.can_id, frame.extended) == (self.counter.can_id, self.counter.extended)

    def take(self, frame: CanFrame, stamp_ns: int, late_ns: int) -> str | None:
        """Take what the message holds; what is wrong with it: an increment before it may be lost, or it came twice."""
        counter = self.counter
        value = counter.read_increment(frame) if self._incremental else counter.read(frame)
        if value is None:
            return None
        most_apart_ns = stamp_ns - self.stamp_ns + self.late_ns + self._spread_ns
        trouble = None
        if self._incremental and self.seen:
            if most_apart_ns < self._least_period_ns:
                return _DUPLICATE
            trouble = _LOST if most_apart_ns >= 2 * self._least_period_ns else None
        self.raw = self.raw + value if self._incremental else value
        self.seen = self.fresh = True
        self.stamp_ns, self.late_ns = stamp_ns, late_ns
        return trouble


def _limits(
    config: EncodersConfig, left: TrackCounter, right: TrackCounter, max_track_mps: float | None, apart: bool
) -> tuple[TrackLimits, TrackLimits]:
    """What the odometer may believe of each track. Raises ConfigurationError."""
    incremental = config.counting == "incremental"
    least_ns, most_ns = latency_ns(config.latency_ms)
    if incremental and config.least_period_ms is None:
        raise ConfigurationError("least_period_ms: is missing; incremental counts need it, to tell when one was lost")
    if incremental and (most_ns - least_ns) * 1e-6 >= (config.least_period_ms or inf):
        raise ConfigurationError(
            f"latency_ms: {config.latency_ms} varies by more than least_period_ms ({config.least_period_ms}): no loss "
            "of an incremental count could be told; declare it more closely (socketcan has kernel time stamps)"
        )
    tracks = []
    for counter, metres in ((left, config.left_metres_per_tick), (right, config.right_metres_per_tick)):
        rate = max_track_mps / abs(metres) if max_track_mps is not None and metres else None
        if rate is not None and apart:
            between_s = config.pair_within_ms * 1e-3 + (most_ns - least_ns) * 1e-9
            if config.quantisation_ticks < rate * between_s:
                raise ConfigurationError(
                    f"quantisation_ticks: {config.quantisation_ticks:g} is too small: {config.left} and {config.right} "
                    f"come in two messages, up to {between_s * 1e3:g} ms apart (pair_within_ms and what latency_ms "
                    f"varies by), in which a track can count {rate * between_s:.0f} ticks; declare that many more"
                )
        bits = _RUNNING_BITS if incremental else counter.bits
        tracks.append(TrackLimits(bits, rate, config.quantisation_ticks))
    return tracks[0], tracks[1]
