"""From a scanner in an unknown state to a stream of scans: the states, their requests, and what leads where.

Theory. The scanner speaks when it is asked, at a rate that only it knows (9600 after power-on, anything if a former
driver left it streaming), and obeys one request at a time: ACK, then one answer that carries the request's number
+ 80h. So each state but the waiting ones holds one request and one answer. The outcome of the exchange picks the next
state from `TRANSITIONS`; whatever goes wrong leads back to FINDING, which stops a running stream and thereby also ends
an installation mode that somebody left. Three points need care:

- Answers do not say which of several equal requests they belong to. No two states that wait for the same answer follow
  each other, so a late answer to a repeated request can't be taken for the next one.
- A rate change is answered at the old rate. Only then does the line change, and nothing is sent until both ends have
  settled. Where no answer comes, it is more likely the answer that was lost than each of two requests: the new rate is
  tried first.
- Writing the configuration wears the EEPROM out. It happens only after reading it and finding a difference, is never
  repeated without reading again (but after a NAK, which says that it was not even understood), at most
  `MOST_WRITES_HEARD` times where the scanner acknowledged it, and at most `MOST_WRITES` times in all.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

from drivers.config import LaserConfig
from drivers.sick_lms.measurements import CM, DISTANCE_BITS, MM, WIDEST_MODE, ValueFormat
from drivers.sick_lms.telegrams import (
    BAUD_MODES,
    FAST,
    PASSWORD,
    Command,
    Configuration,
    DeviceStatus,
    DeviceType,
    Mode,
    Variant,
)

MOST_WRITES_HEARD, MOST_WRITES = 2, 10
MOST_NAKS = 5
"""Requests damaged on the line, one after the other, before one counts as a try."""


class State(Enum):
    """Where the conversation stands; the value is for people."""

    TUNING = "setting the line rate"
    FINDING = "finding the scanner"
    IDENTIFYING = "reading its type"
    READING_STATUS = "reading its status"
    READING_ERRORS = "reading its error memory"
    READING_COUNTERS = "reading its operating hours"
    READING_CONFIGURATION = "reading its configuration"
    ENTERING_INSTALLATION = "entering installation mode"
    WRITING_CONFIGURATION = "writing its configuration"
    LEAVING_INSTALLATION = "leaving installation mode"
    SETTING_VARIANT = "setting angle and resolution"
    SWITCHING_RATE = "switching the line rate"
    SETTLING = "waiting for the new line rate"
    CONFIRMING = "confirming the new line rate"
    STARTING = "starting the stream"
    STREAMING = "streaming"
    HALTED = "halted"


class Outcome(Enum):
    """How a state ends."""

    DONE = auto()
    NEEDLESS = auto()
    """The scanner is as the state would make it."""
    DIFFERS = auto()
    """The configuration must be written."""
    REFUSED = auto()
    """The scanner won't, or must not be used as it is."""
    SILENT = auto()
    """No answer, however often asked; in STREAMING, no scan."""
    ELAPSED = auto()
    """The wait is over."""


@dataclass(frozen=True, slots=True)
class Goal:
    """How the scanner shall stream."""

    variant: Variant
    interlaced: bool
    """180 degrees at 0.25 degree: partial scans over 180 degrees, one a mirror turn."""
    baud: int
    unit: int
    reach_m: float
    """Distances that the measuring mode must be able to tell, if any can."""

    def configuration(self, found: Configuration) -> Configuration:
        """`found`, changed only where it does not serve."""
        return found.with_format(
            found.measuring_mode if self._serves(found.measuring_mode) else WIDEST_MODE,
            self.unit,
        )

    def _serves(self, measuring_mode: int) -> bool:
        bits = DISTANCE_BITS.get(measuring_mode, 0)
        widest = DISTANCE_BITS[WIDEST_MODE]
        # How partial scans are coded is told differently; with the widest distances all agree.
        if bits == 0 or self.interlaced:
            return bits == widest
        return ValueFormat(bits, self.unit).reach_m >= min(self.reach_m, ValueFormat(widest, self.unit).reach_m)


def goal_of(config: LaserConfig) -> Goal:
    """What the configuration asks of the scanner."""
    interlaced = (config.scan_angle_deg, config.resolution_deg) == (180, 0.25)
    return Goal(
        # 180 degrees at 0.25 degree are partial scans, which always cover 180 degrees; the scanner itself is set to
        # 100 degrees, the only angle at which it knows this resolution.
        variant=Variant(100 if interlaced else config.scan_angle_deg, round(100 * config.resolution_deg)),
        interlaced=interlaced,
        baud=config.baud,
        unit=MM if config.unit == "mm" else CM,
        reach_m=config.range_max_m,
    )


@dataclass(slots=True)
class Found:
    """What is known of the scanner, since FINDING."""

    baud: int
    """Rate at which it was found."""
    kind: DeviceType | None = None
    status: DeviceStatus | None = None
    configuration: Configuration | None = None


@dataclass(frozen=True, slots=True)
class Step:
    """One exchange."""

    request: Callable[[Goal, Found], bytes]
    """Payload to send."""
    answer: int
    """First byte of the answer's payload."""
    patience_ms: int
    """From the ACK to the answer (LMS2XX section 3), transmission not counted."""
    tries: int = 3
    """The scanner misses a request now and then, during a mirror turn."""
    needless: Callable[[Goal, Found], bool] = lambda goal, found: False


def _mode(mode: Mode, data: bytes = b"") -> Callable[[Goal, Found], bytes]:
    return lambda goal, found: bytes((Command.MODE, mode)) + data


def _ask(command: Command) -> Callable[[Goal, Found], bytes]:
    return lambda goal, found: bytes((command,))


def _write_configuration(goal: Goal, found: Found) -> bytes:
    assert found.configuration is not None  # READING_CONFIGURATION came before
    return goal.configuration(found.configuration).serialise_write()


def _variant_stands(goal: Goal, found: Found) -> bool:
    """The LMS Fast has one variant, and does not know the request for another."""
    status = found.status
    if goal.variant == FAST and found.kind is not None and found.kind.is_fast:
        return True
    return status is not None and Variant(status.angle_deg, status.resolution_cdeg) == goal.variant


def _counts_no_hours(goal: Goal, found: Found) -> bool:
    return found.kind is None or not found.kind.counts_hours


def _rate_stands(goal: Goal, found: Found) -> bool:
    return found.baud == goal.baud


STEPS = {
    State.FINDING: Step(_mode(Mode.STOP), Command.MODE.answer, 3000),
    State.IDENTIFYING: Step(_ask(Command.TYPE), Command.TYPE.answer, 300),
    State.READING_STATUS: Step(_ask(Command.STATUS), Command.STATUS.answer, 300),
    State.READING_ERRORS: Step(_ask(Command.ERRORS), Command.ERRORS.answer, 300, tries=2),
    State.READING_COUNTERS: Step(
        _ask(Command.COUNTERS), Command.COUNTERS.answer, 300, tries=2, needless=_counts_no_hours
    ),
    State.READING_CONFIGURATION: Step(_ask(Command.READ_CONFIGURATION), Command.READ_CONFIGURATION.answer, 300),
    State.ENTERING_INSTALLATION: Step(_mode(Mode.INSTALLATION, PASSWORD), Command.MODE.answer, 3000),
    State.WRITING_CONFIGURATION: Step(
        _write_configuration, Command.WRITE_CONFIGURATION.answer, patience_ms=15000, tries=1
    ),
    State.LEAVING_INSTALLATION: Step(_mode(Mode.STOP), Command.MODE.answer, 3000),
    State.SETTING_VARIANT: Step(
        lambda goal, found: goal.variant.serialise_request(), Command.VARIANT.answer, 3000, needless=_variant_stands
    ),
    State.SWITCHING_RATE: Step(
        lambda goal, found: bytes((Command.MODE, BAUD_MODES[goal.baud])),
        Command.MODE.answer,
        3000,
        tries=2,
        needless=_rate_stands,
    ),
    State.CONFIRMING: Step(_ask(Command.STATUS), Command.STATUS.answer, 300),
    State.STARTING: Step(
        lambda goal, found: bytes((Command.MODE, Mode.STREAM_PARTIAL if goal.interlaced else Mode.STREAM)),
        Command.MODE.answer,
        3000,
    ),
}

WAITS_MS = {
    State.TUNING: 30,
    State.SETTLING: 400,
    State.HALTED: 10000,
}

TRANSITIONS = {
    State.TUNING: {Outcome.ELAPSED: State.FINDING},
    State.FINDING: {
        Outcome.DONE: State.IDENTIFYING,
        Outcome.REFUSED: State.IDENTIFYING,
        Outcome.SILENT: State.TUNING,  # at the next rate
    },
    State.IDENTIFYING: {  # who it is, and how it is, is good to know, but no scan needs it
        Outcome.DONE: State.READING_STATUS,
        Outcome.REFUSED: State.READING_STATUS,
        Outcome.SILENT: State.READING_STATUS,
    },
    State.READING_STATUS: {
        Outcome.DONE: State.READING_ERRORS,
        Outcome.REFUSED: State.READING_ERRORS,
        Outcome.SILENT: State.READING_ERRORS,
    },
    State.READING_ERRORS: {
        Outcome.DONE: State.READING_COUNTERS,
        Outcome.REFUSED: State.READING_COUNTERS,
        Outcome.SILENT: State.READING_COUNTERS,
    },
    State.READING_COUNTERS: {
        Outcome.DONE: State.READING_CONFIGURATION,
        Outcome.NEEDLESS: State.READING_CONFIGURATION,
        Outcome.REFUSED: State.READING_CONFIGURATION,
        Outcome.SILENT: State.READING_CONFIGURATION,
    },
    State.READING_CONFIGURATION: {
        Outcome.DONE: State.SETTING_VARIANT,
        Outcome.DIFFERS: State.ENTERING_INSTALLATION,
        Outcome.REFUSED: State.HALTED,
        Outcome.SILENT: State.FINDING,
    },
    State.ENTERING_INSTALLATION: {
        Outcome.DONE: State.WRITING_CONFIGURATION,
        Outcome.REFUSED: State.HALTED,
        Outcome.SILENT: State.FINDING,
    },
    State.WRITING_CONFIGURATION: {
        Outcome.DONE: State.LEAVING_INSTALLATION,
        Outcome.REFUSED: State.LEAVING_INSTALLATION,  # and what it has is read once more
        Outcome.SILENT: State.FINDING,
    },
    State.LEAVING_INSTALLATION: {
        Outcome.DONE: State.READING_CONFIGURATION,
        Outcome.REFUSED: State.HALTED,
        Outcome.SILENT: State.FINDING,
    },
    State.SETTING_VARIANT: {
        Outcome.DONE: State.SWITCHING_RATE,
        Outcome.NEEDLESS: State.SWITCHING_RATE,
        Outcome.REFUSED: State.HALTED,
        Outcome.SILENT: State.FINDING,
    },
    State.SWITCHING_RATE: {
        Outcome.DONE: State.SETTLING,
        Outcome.NEEDLESS: State.STARTING,
        Outcome.REFUSED: State.HALTED,
        Outcome.SILENT: State.SETTLING,
    },
    State.SETTLING: {Outcome.ELAPSED: State.CONFIRMING},
    State.CONFIRMING: {
        Outcome.DONE: State.STARTING,
        Outcome.REFUSED: State.STARTING,  # a refusal, too, came at the new rate
        Outcome.SILENT: State.FINDING,
    },
    State.STARTING: {
        Outcome.DONE: State.STREAMING,
        Outcome.REFUSED: State.HALTED,
        Outcome.SILENT: State.FINDING,
    },
    State.STREAMING: {Outcome.SILENT: State.FINDING},
    State.HALTED: {Outcome.ELAPSED: State.FINDING},
}
