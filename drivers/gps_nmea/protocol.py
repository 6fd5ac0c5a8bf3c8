"""GPS receiver: NMEA sentences in, one fix per epoch out.

An epoch is all sentences with the same time of day. Nothing on the wire says that it is over, so the protocol learns
which sentences an epoch brings, and delivers the fix with the last of them, or when the next epoch begins.
"""

from collections import Counter
from dataclasses import dataclass, field
from datetime import date

from drivers.config import GpsConfig, latency_ns
from drivers.framing import StampedBuffer
from drivers.gps_nmea.codec import (
    SENTENCE,
    SENTENCE_BYTES,
    Calendar,
    Dilution,
    ErrorEstimate,
    Position,
    Sentence,
    TimeOfDay,
    checksum,
    parse_content,
)
from drivers.samples import Fix, Stamp, Vector3

_SATELLITE_QUALITIES = (1, 2, 3, 4, 5)
"""Not 6 (dead reckoning), 7 (typed in), 8 (simulated): their errors have no bound."""
_RTK_FIXED = 4
_GEOID_LIMIT_M = 110.0
"""The geoid is nowhere further from the ellipsoid."""


@dataclass(slots=True)
class _Epoch:
    """The sentences of one instant."""

    time: TimeOfDay
    stamp_ns: int
    """Read of its first byte."""
    position: Position | None = None
    errors: ErrorEstimate | None = None
    vdop: float | None = None
    day: date | None = None
    kinds: Counter[str] = field(default_factory=Counter)
    delivered: bool = False


class GpsProtocol:
    """The host's end of the wire to the receiver; see drivers/protocol.py for the contract.

    counts: `fixes` delivered, `sentences` with a right checksum, `bad_checksum`, `bad_fields`, `other_sentences` of no
    interest, `skipped_bytes`; and of epochs not delivered: `no_position`, `no_fix`, `estimated`, `no_altitude`,
    `no_bound`.
    """

    def __init__(self, config: GpsConfig) -> None:
        """Nothing received yet."""
        self.counts: Counter[str] = Counter()
        self._config = config
        self._least_ns, self._most_ns = latency_ns(config.latency_ms)
        self._buffer = StampedBuffer()
        self._epoch: _Epoch | None = None
        self._usual: tuple[Counter[str], Counter[str]] = (Counter(), Counter())
        """Kinds of sentences of the last two epochs: one that was lost must not shorten the next epoch."""

    @property
    def baud(self) -> int | None:
        """The configured rate."""
        return self._config.baud

    @property
    def deadline_ns(self) -> int | None:
        """The receiver speaks by itself."""
        return None

    def connection_made(self, now_ns: int) -> None:
        """Forget the epoch that was cut off; another receiver may be there now."""
        self.counts["skipped_bytes"] += self._buffer.clear()
        self._epoch = None
        self._usual = (Counter(), Counter())

    def advance(self, now_ns: int) -> None:
        """Nothing is ever due."""

    def data_to_send(self) -> bytes:
        """Nothing: the receiver needs no asking."""
        return b""

    def receive_data(self, data: bytes, stamp_ns: int) -> list[Fix]:
        """Take bytes; the fixes of all epochs that they complete."""
        self._buffer.append(data, stamp_ns)
        text, position, fixes = self._buffer.data, 0, []
        for match in SENTENCE.finditer(text):
            self._count_skipped(text[position : match.start()])
            position = match.end()
            fixes += self._receive_sentence(match.group(1), match.group(2), self._buffer.time_of(match.start()))
        # Only what follows the last $ can still become a sentence, if it is short and on one line.
        begin = max(text.rfind(b"$"), position)
        rest = text[begin:]
        if len(rest) > SENTENCE_BYTES or not rest.startswith(b"$") or any(end in rest for end in (b"\r", b"\n")):
            begin = len(text)
        self._count_skipped(text[position:begin])
        self._buffer.discard(begin)
        return fixes

    def finish(self) -> list[Fix]:
        """The stream has ended, as a recording does: the fix of the last epoch, if it was still waited for."""
        fixes = self._deliver()
        self._epoch = None
        return fixes

    def _receive_sentence(self, content: bytes, digits: bytes, read_ns: int) -> list[Fix]:
        if checksum(content) != int(digits, 16):
            self.counts["bad_checksum"] += 1
            return []
        self.counts["sentences"] += 1
        parsed = parse_content(content)
        if parsed is None:
            self.counts["bad_fields"] += 1
            return []
        kind, sentence = parsed
        if sentence is None:
            self.counts["other_sentences"] += 1
            return []
        fixes = self._turn_epoch(sentence, read_ns)
        if self._epoch is not None:
            self._epoch.kinds[kind] += 1
            _attach(self._epoch, sentence)
            if self._epoch.kinds >= self._usual[0] | self._usual[1] != Counter():
                fixes += self._deliver()
        return fixes

    def _turn_epoch(self, sentence: Sentence, read_ns: int) -> list[Fix]:
        """Begin a new epoch if the sentence's time says so; the old one's fix, if it was still waited for."""
        if isinstance(sentence, Dilution) or sentence.time is None:
            return []
        if self._epoch is not None and sentence.time == self._epoch.time:
            return []
        fixes = self._deliver()
        if self._epoch is not None:
            self._usual = (self._usual[1], self._epoch.kinds)
        self._epoch = _Epoch(sentence.time, read_ns)
        return fixes

    def _deliver(self) -> list[Fix]:
        """The present epoch's fix, once; nothing where it has none that can be bounded."""
        epoch = self._epoch
        if epoch is None or epoch.delivered:
            return []
        epoch.delivered = True
        at = epoch.position
        if at is None:
            self.counts["no_position"] += 1
        elif at.quality == 0 or at.lat_deg is None or at.lon_deg is None:
            self.counts["no_fix"] += 1
        elif at.quality not in _SATELLITE_QUALITIES:
            self.counts["estimated"] += 1
        elif at.altitude_m is None:
            self.counts["no_altitude"] += 1
        elif (bound_m := self._bound(at, epoch.errors, epoch.vdop)) is None:
            self.counts["no_bound"] += 1
        else:
            self.counts["fixes"] += 1
            return [
                Fix(
                    stamp=Stamp(epoch.stamp_ns - self._most_ns, epoch.stamp_ns - self._least_ns),
                    utc=f"{epoch.day}T{epoch.time}Z" if epoch.day else None,
                    lat_deg=at.lat_deg,
                    lon_deg=at.lon_deg,
                    alt_m=at.altitude_m + (at.separation_m or 0.0),
                    quality=at.quality,
                    hdop=at.hdop if at.hdop is not None else float("nan"),
                    bound_m=bound_m,
                )
            ]
        return []

    def _bound(self, at: Position, errors: ErrorEstimate | None, vdop: float | None) -> Vector3 | None:
        """Half-widths (east, north, up); None where nothing tells them. A zero from the receiver tells nothing."""
        config = self._config
        dop = at.hdop
        east = north = dop * config.range_error_m + config.floor_horizontal_m if dop else None
        up = max(dop, vdop or 0.0) * config.range_error_m + config.floor_vertical_m if dop else None
        if errors is not None and errors.east_m and errors.north_m and errors.up_m:
            east = config.gst_factor * errors.east_m + config.floor_horizontal_m
            north = config.gst_factor * errors.north_m + config.floor_horizontal_m
            up = config.gst_factor * errors.up_m + config.floor_vertical_m
        if at.quality == _RTK_FIXED and config.rtk_fixed_horizontal_m is not None:
            east = north = config.rtk_fixed_horizontal_m
        if at.quality == _RTK_FIXED and config.rtk_fixed_vertical_m is not None:
            up = config.rtk_fixed_vertical_m
        if east is None or north is None or up is None:
            return None
        return east, north, up + (_GEOID_LIMIT_M if at.separation_m is None else 0.0)

    def _count_skipped(self, between: bytes) -> None:
        self.counts["skipped_bytes"] += len(between) - between.count(b"\r") - between.count(b"\n")


def _attach(epoch: _Epoch, sentence: Sentence) -> None:
    """Put what a sentence says into its epoch; of two positions the first with a fix stays."""
    match sentence:
        case Position():
            if epoch.position is None or epoch.position.quality == 0:
                epoch.position = sentence
        case ErrorEstimate():
            epoch.errors = sentence
        case Calendar():
            epoch.day = sentence.date or epoch.day
        case Dilution():
            epoch.vdop = max(sentence.vdop or 0.0, epoch.vdop or 0.0)
