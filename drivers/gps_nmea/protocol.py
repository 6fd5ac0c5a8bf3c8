"""GPS receiver: NMEA sentences in, one fix per epoch out.

An epoch is all sentences with the same time of day. Nothing on the wire says that it is over, so the protocol learns
which sentences an epoch brings, and delivers the fix with the last of them, or when the next epoch begins.

A fix is stamped by the read of its epoch's first sentence. Where that one may have been lost the stamp reaches back to
the last sentence of the epoch before: it was read after that.

VTG and GSA bear no time. One that is read before the next epoch can have been belongs to the present one. Of any other
nobody knows: some receivers send them first. Then a velocity is not used, and the dilution holds for both epochs.
"""

from collections import Counter
from datetime import date

from drivers.config import GpsConfig, latency_ns
from drivers.framing import StampedBuffer
from drivers.gps_nmea.calendar import DayTeller
from drivers.gps_nmea.codec import (
    SENTENCE,
    SENTENCE_BYTES,
    UNSUMMED,
    Calendar,
    Dilution,
    Minimum,
    Velocity,
    checksum,
    parse_content,
)
from drivers.gps_nmea.epoch import Epoch, EpochSentence, worst
from drivers.gps_nmea.fields import TimeOfDay
from drivers.samples import Fix, Stamp

_BURST_NS = 2_000_000_000
"""No receiver takes longer over the sentences of one epoch."""
_KNOWN_AFTER = 5
"""So many epochs must have begun with a sentence before it is known to be an epoch's first."""


class GpsProtocol:
    """The host's end of the wire to the receiver; see drivers/protocol.py for the contract.

    counts: `fixes` delivered, of them `unbounded`; `sentences` with a right checksum, of them `other_sentences` of no
    interest, `untimed`, `late` and of an `unsure_epoch` (VTG, GSA); `bad_checksum`, `bad_unsummed` without one,
    `bad_fields`, `skipped_bytes`; `unsure_beginnings` of epochs; dates mended after `week_rollovers`; and epochs
    without a fix: `no_position`, `no_fix`, `not_measured`.
    """

    def __init__(self, config: GpsConfig, not_before: date | None = None) -> None:
        """Nothing received yet. A receiver that tells a day `not_before` has lost weeks by 1024: they are added."""
        self.counts: Counter[str] = Counter()
        self._config = config
        self._least_ns, self._most_ns = latency_ns(config.latency_ms)
        self._buffer = StampedBuffer()
        self._late_ns = 0
        """How late a read was that holds a part of the present sentence."""
        self._days = DayTeller(not_before)
        self._forget()

    def _forget(self) -> None:
        """Nothing is known of the receiver."""
        self._epoch: Epoch | None = None
        self._last_time: TimeOfDay | None = None
        """Of the epoch before."""
        self._periods_ns = (0, 0)
        """From each of the last epochs to the next; 0: not known."""
        self._next_from_ns = 0
        """Before this the next epoch can't have been."""
        self._between: Dilution | None = None
        """What GSA sentences said that may belong to the next epoch."""
        self._usual: tuple[Counter[str], Counter[str]] = (Counter(), Counter())
        """Sentences of the last two epochs: one that was lost must not shorten the next epoch."""
        self._read_ns: int | None = None
        """The newest sentence had not come before."""
        self._clean = False
        """Has everything since then been understood?"""
        self._openers: Counter[str] = Counter()
        """How many epochs began with a sentence..."""
        self._followers: set[str] = set()
        """... and which sentences were ever seen behind another one."""

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
        self._forget()

    def advance(self, now_ns: int) -> None:
        """Nothing is ever due."""

    def data_to_send(self) -> bytes:
        """Nothing: the receiver needs no asking."""
        return b""

    def read_late(self, late_ns: int) -> None:
        """The next read's bytes may have lain in the port; see drivers/protocol.py."""
        self._late_ns = max(self._late_ns, late_ns)

    def receive_data(self, data: bytes, stamp_ns: int) -> list[Fix]:
        """Take bytes; the fixes of all epochs that they complete."""
        self._buffer.append(data, stamp_ns)
        text, position, fixes = self._buffer.data, 0, []
        for match in SENTENCE.finditer(text):
            self._skip(text[position : match.start()])
            position = match.end()
            fixes += self._receive_sentence(match.group(1), match.group(2), self._buffer.time_of(match.start()))
        # Only what follows the last $ can still become a sentence, if it is short and on one line.
        begin = max(text.rfind(b"$"), position)
        rest = text[begin:]
        if len(rest) > SENTENCE_BYTES or not rest.startswith(b"$") or any(end in rest for end in (b"\r", b"\n")):
            begin = len(text)
        self._skip(text[position:begin])
        self._buffer.discard(begin)
        if begin == len(text):
            self._late_ns = 0
        return fixes

    def finish(self) -> list[Fix]:
        """The stream has ended, as a recording does: the fix of the last epoch, if it was still waited for."""
        fixes = self._deliver()
        self._epoch = None
        return fixes

    def _receive_sentence(self, content: bytes, digits: bytes, read_ns: int) -> list[Fix]:
        if checksum(content) != int(digits, 16):
            self.counts["bad_checksum"] += 1
            self._clean = False
            return []
        self.counts["sentences"] += 1
        parsed = parse_content(content)
        if parsed is None:
            self.counts["bad_fields"] += 1
            self._clean = False
            return []
        address, sentence = parsed
        fixes = []
        if sentence is None:
            self.counts["other_sentences"] += 1
        elif isinstance(sentence, Calendar):
            self._days.told(sentence.time, sentence.date)
        else:
            fixes = self._turn_epoch(address, sentence, read_ns)
            fixes += self._attach(address, sentence, read_ns)
        self._read_ns, self._clean = read_ns - self._late_ns, True
        return fixes

    def _turn_epoch(self, address: str, sentence: EpochSentence, read_ns: int) -> list[Fix]:
        """Begin a new epoch if the sentence's time says so; the old one's fix, if it was still waited for."""
        if isinstance(sentence, Dilution | Velocity) or sentence.time is None:
            return []
        epoch, time = self._epoch, sentence.time
        if epoch is not None and time in (epoch.time, self._last_time):
            return []
        fixes = self._deliver()
        if epoch is not None:
            self._usual = (self._usual[1], epoch.sentences)
            self._last_time = epoch.time
            self._periods_ns = self._periods_ns[1], time.since_ns(epoch.time)
        self._days.advance(time)
        dilution = self._between or (epoch.dilution if epoch is not None else None)
        self._between = None
        self._epoch = Epoch(time, self._stamp(address, read_ns), former_dilution=dilution)
        # The receiver keeps its rate.
        period_ns = min(self._periods_ns) or self._periods_ns[1]
        self._next_from_ns = self._epoch.stamp.earliest_ns - self._late_ns + period_ns
        return fixes

    def _stamp(self, address: str, read_ns: int) -> Stamp:
        """When the epoch was, whose first sentence to arrive is `address`."""
        begin_ns = read_ns
        known = address not in self._followers and self._openers[address] >= _KNOWN_AFTER
        if not (known and self._clean):
            self.counts["unsure_beginnings"] += 1
            begin_ns = read_ns - _BURST_NS if self._read_ns is None else max(self._read_ns, read_ns - _BURST_NS)
        self._openers[address] += 1
        return Stamp(begin_ns - self._most_ns, read_ns - self._least_ns)

    def _of_either(self, dilution: Dilution, epoch: Epoch | None) -> Dilution:
        """It may be the next epoch's: what it says of the present one is no better than what was said before."""
        self._between = worst(dilution, self._between)
        return worst(dilution, epoch.dilution if epoch else None)

    def _attach(self, address: str, sentence: EpochSentence, read_ns: int) -> list[Fix]:
        """Put a sentence into its epoch; the fix, if it was the last of the usual ones."""
        epoch = self._epoch
        if isinstance(sentence, Dilution | Velocity) and not (epoch and read_ns < self._next_from_ns):
            self.counts["unsure_epoch"] += 1
            if isinstance(sentence, Velocity):
                return []
            sentence = self._of_either(sentence, epoch)
        if not isinstance(sentence, Dilution | Velocity) and sentence.time is None:
            self.counts["untimed"] += 1
            return []
        if epoch is None:
            return []
        if not isinstance(sentence, Dilution | Velocity) and sentence.time != epoch.time:
            self.counts["late"] += 1
            return []
        if isinstance(sentence, Minimum) and sentence.position.quality:
            self._days.told(sentence.time, sentence.date)
        epoch.attach(sentence)
        if epoch.sentences and address not in epoch.sentences:
            self._followers.add(address)
        epoch.sentences[address] += 1
        if epoch.sentences >= self._usual[0] | self._usual[1] != Counter():
            return self._deliver()
        return []

    def _deliver(self) -> list[Fix]:
        """The present epoch's fix, once."""
        epoch = self._epoch
        if epoch is None or epoch.delivered:
            return []
        epoch.delivered = True
        fix = epoch.outcome(self._config, self._days.day)
        self.counts["week_rollovers"] = self._days.rollovers
        if isinstance(fix, str):
            self.counts[fix] += 1
            return []
        self.counts["fixes"] += 1
        self.counts["unbounded"] += max(fix.bound_m) == float("inf")
        return [fix]

    def _skip(self, between: bytes) -> None:
        """Account for bytes that are no sentence."""
        if not between.strip(b"\r\n"):
            return
        self._clean = False
        unsummed = UNSUMMED.findall(between)
        self.counts["bad_unsummed"] += len(unsummed)
        lost = len(between) - sum(map(len, unsummed)) - between.count(b"\r") - between.count(b"\n")
        self.counts["skipped_bytes"] += max(0, lost)
