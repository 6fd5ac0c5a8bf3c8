"""The host's end of a SICK LMS2xx: finds it, sets it up, and turns its telegrams into scans. No port, no clock."""

from collections import Counter

from drivers.config import LaserConfig, latency_ns
from drivers.samples import Scan
from drivers.sick_lms.error_memory import ErrorEntry
from drivers.sick_lms.expected_scans import ExpectedScans
from drivers.sick_lms.findings import status_findings
from drivers.sick_lms.framing import SILENCE_WITHIN_FRAME_MS, Frame, FrameReader
from drivers.sick_lms.judgement import Identity, Judgement
from drivers.sick_lms.sent_times import SentTimes
from drivers.sick_lms.startup import (
    MOST_NAKS,
    MOST_WRITES,
    MOST_WRITES_HEARD,
    STEPS,
    TRANSITIONS,
    WAITS_MS,
    Outcome,
    State,
    goal_of,
)
from drivers.sick_lms.telegrams import (
    NAK,
    POWER_ON,
    RANGES,
    REFUSED,
    RESETTING,
    request,
)

MS = 1_000_000
RATES = (9600, 38400, 500000, 19200)
ACK_PATIENCE_MS = 150
"""The scanner acknowledges within 60 ms; the rest is for the host and its adapter."""
NAK_PAUSE_MS = 30
LONGEST_ANSWER = 170
"""Bytes of the longest answer but a scan: the status telegram."""
LEAST_WATCHDOG_MS = 500


class SickLmsProtocol:
    """A conversation with one scanner, from wherever it stands to a stream of scans, and back there after any loss."""

    def __init__(self, config: LaserConfig) -> None:
        self.counts: Counter[str] = Counter()
        self._goal = goal_of(config)
        self._judgement = Judgement(config, self._goal)
        self._latency_ns = latency_ns(config.latency_ms)
        self._sent_times = SentTimes(config, self.counts)
        self._rates = tuple(dict.fromkeys((config.baud, *RATES)))
        self._baud: int = config.baud
        self._reader = FrameReader(self.counts)
        self._expected: ExpectedScans | None = None  # since the stream was asked for
        self._asked_at = 0  # place in the stream of bytes where that was
        self._outbox = bytearray()
        self._state = State.TUNING
        self._deadline_ns = 0
        self._release_ns = 0  # when frames that the reader holds back are due
        self._released: list[Scan] = []
        self._tries = 0
        self._naks = 0
        self._acknowledged = False
        self._heard = False  # an intact telegram or an ACK, since the request was sent first
        self._writes = 0
        self._writes_heard = 0

    @property
    def baud(self) -> int:
        """Line rate wanted now."""
        return self._baud

    @property
    def deadline_ns(self) -> int:
        """When `advance` wants to be called next."""
        return min(self._deadline_ns, self._release_ns) if self._reader.holds_frames else self._deadline_ns

    @property
    def state(self) -> str:
        """Where the conversation stands, for people."""
        if self._state is State.HALTED:
            return f"halted: {self._judgement.trouble}"
        if self._state in (State.TUNING, State.FINDING):
            return f"finding the scanner at {self._baud} baud"
        return str(self._state.value)

    @property
    def identity(self) -> Identity | None:
        """Known once the scanner has answered."""
        return self._judgement.identity

    @property
    def errors(self) -> tuple[ErrorEntry, ...]:
        """What its error memory held when it was found."""
        return self._judgement.errors

    @property
    def operating_hours(self) -> float | None:
        """Where it counts them."""
        return self._judgement.operating_hours

    @property
    def findings(self) -> tuple[str, ...]:
        """What ails the scanner, in sentences for people."""
        status = self._expected.status if self._expected else 0
        found = [*status_findings(status), *self._judgement.findings]
        if self.counts.get("late_telegrams"):
            found.append(
                "telegrams are read later than latency_ms allows: raise it, or lower the adapter's latency timer"
            )
        return tuple(found)

    @property
    def streaming(self) -> bool:
        """Do scans flow?"""
        return self._state is State.STREAMING

    def connection_made(self, now_ns: int) -> None:
        """The port was opened: find the scanner anew, from the wanted rate on."""
        self._outbox.clear()
        self._released.clear()
        self._sent_times.restart()
        self._set_baud(self._goal.baud)
        self._state = State.TUNING
        self._deadline_ns = now_ns

    def data_to_send(self) -> bytes:
        """Bytes to write now."""
        data = bytes(self._outbox)
        self._outbox.clear()
        return data

    def receive_data(self, data: bytes, stamp_ns: int) -> list[Scan]:
        """Scans that `data` completes."""
        frames = self._reader.receive_data(data, stamp_ns)
        self._release_ns = stamp_ns + SILENCE_WITHIN_FRAME_MS * MS + self._latency_ns[1]
        self._take_acknowledgement(stamp_ns)
        scans = self._released + [scan for frame in frames if (scan := self._take_frame(frame, stamp_ns)) is not None]
        self._released = []
        self.advance(stamp_ns)  # garbage that never ends must not keep time from passing
        return scans

    def advance(self, now_ns: int) -> None:
        """Repeat a request, or give up waiting, once the deadline has passed.

        A scan that was held back until now comes with the next `receive_data`.
        """
        if self._reader.holds_frames and now_ns >= self._release_ns:
            frames = self._reader.release()
            self._released += [scan for frame in frames if (scan := self._take_frame(frame, now_ns)) is not None]
        if now_ns < self._deadline_ns:
            return
        step = STEPS.get(self._state)
        if step is None:
            if self._state is State.STREAMING:
                self.counts["silences"] += 1
                self._end(Outcome.SILENT, now_ns)
            else:
                self._end(Outcome.ELAPSED, now_ns)
        elif self._tries < (step.tries if self._heard or self._state is not State.FINDING else 1):
            self.counts["repeats"] += 1
            self._send(now_ns)
        else:
            self._end(Outcome.SILENT, now_ns)

    # What comes in

    def _take_acknowledgement(self, now_ns: int) -> None:
        byte = self._reader.take_acknowledgement()
        if byte is None or (step := STEPS.get(self._state)) is None:
            return
        if byte == NAK:
            self.counts["naks"] += 1
            self._heard = True
            self._naks += 1
            if self._naks <= MOST_NAKS:
                self._tries -= 1
            if self._state is State.WRITING_CONFIGURATION:  # not understood, so not done
                self._writes -= 1
                self.counts["configuration_writes"] -= 1
            self._deadline_ns = now_ns + NAK_PAUSE_MS * MS  # where `advance` repeats the request
        else:
            self._acknowledged = True
            self._heard = True
            self._deadline_ns = now_ns + step.patience_ms * MS + self._line_ns(LONGEST_ANSWER)

    def _take_frame(self, frame: Frame, now_ns: int) -> Scan | None:
        self._heard = True
        step = STEPS.get(self._state)
        if frame.command == RANGES:
            return self._take_ranges(frame, now_ns)
        if frame.command in (POWER_ON, RESETTING):
            self.counts["resets"] += 1
            self._go(State.FINDING, now_ns)
        elif step is not None and frame.command == step.answer:
            may_write = self._writes < MOST_WRITES and self._writes_heard < MOST_WRITES_HEARD
            outcome = self._judgement.of(frame.payload, self._state, may_write)
            self._reader.source = self._judgement.source
            self._end(outcome, now_ns)
        elif step is not None and frame.command == REFUSED:
            self.counts["refusals"] += 1
            self._end(self._judgement.refusal(self._state), now_ns)
        else:
            self.counts["stray_answers"] += 1
        return None

    def _take_ranges(self, frame: Frame, now_ns: int) -> Scan | None:
        if frame.place < self._asked_at:  # of a stream that somebody else had asked for
            self.counts["scans_before_start"] += 1
            return None
        if self._state is State.STARTING:  # its answer was lost, but it streams
            self._end(Outcome.DONE, now_ns)
        if self._state is not State.STREAMING:
            self.counts["scans_before_start"] += 1
            return None
        self.counts["scans"] += 1
        self._deadline_ns = now_ns + self._watchdog_ns()
        assert self._expected is not None  # STARTING came before
        return self._expected.scan(frame.payload, self._sent_times.of(frame, self._line_ns(1)))

    # What goes out

    def _end(self, outcome: Outcome, now_ns: int) -> None:
        """Leave the state."""
        if self._state is State.SWITCHING_RATE and outcome in (Outcome.DONE, Outcome.SILENT):
            self._set_baud(self._goal.baud)
        if self._state is State.WRITING_CONFIGURATION and (outcome is not Outcome.SILENT or self._acknowledged):
            self._writes_heard += 1
        self._go(TRANSITIONS[self._state][outcome], now_ns)

    def _go(self, state: State, now_ns: int) -> None:
        """Enter `state`; a step that is needless leads straight on."""
        lost = state is State.FINDING and self._state not in (State.TUNING, State.FINDING)
        while (step := STEPS.get(state)) is not None and step.needless(self._goal, self._judgement.found):
            state = TRANSITIONS[state][Outcome.NEEDLESS]
        if state is State.TUNING:
            self._set_baud(self._rates[(self._rates.index(self._baud) + 1) % len(self._rates)])
        if state is State.FINDING:
            if lost:
                self.counts["restarts"] += 1
            self._judgement.begin(self._baud)
            self._reader.scan_headers = self._reader.source = None
        if state is State.STARTING:
            self._expect_scans()
        self._state = state
        self._tries = 0
        self._naks = 0
        self._heard = False
        if step is not None:
            self._send(now_ns)
        elif state is State.STREAMING:
            self._outbox.clear()
            self._deadline_ns = now_ns + self._watchdog_ns()
        else:
            self._outbox.clear()
            self._deadline_ns = now_ns + WAITS_MS[state] * MS

    def _send(self, now_ns: int) -> None:
        """The present state's request, once more."""
        data = request(STEPS[self._state].request(self._goal, self._judgement.found))
        self._outbox[:] = data
        self._tries += 1
        if self._state is State.WRITING_CONFIGURATION:
            self._writes += 1
            self.counts["configuration_writes"] += 1
        self._acknowledged = False
        self._reader.expect_acknowledgement()
        patience = ACK_PATIENCE_MS * MS + self._latency_ns[1]
        self._deadline_ns = now_ns + patience + self._line_ns(len(data) + LONGEST_ANSWER)

    def _set_baud(self, baud: int) -> None:
        self._baud = baud
        self._reader.clear()

    def _expect_scans(self) -> None:
        """From here on exactly these scans can be real."""
        configuration = self._judgement.found.configuration
        assert configuration is not None  # no path to STARTING avoids reading it
        self._expected = ExpectedScans(self._goal, configuration, self.counts)
        self._reader.scan_headers = self._expected.headers
        self._asked_at = self._reader.end

    def _line_ns(self, size: int) -> int:
        """Time that `size` bytes need on the line: 10 bits each."""
        return size * 10_000_000_000 // self._baud

    def _watchdog_ns(self) -> int:
        """Three scan periods."""
        assert self._expected is not None  # STARTING came before
        return max(LEAST_WATCHDOG_MS * MS, 3 * self._expected.period_ns(self._baud))
