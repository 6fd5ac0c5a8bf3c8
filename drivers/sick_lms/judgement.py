"""What a scanner's answers say of it, and whether it may be used as it is."""

from dataclasses import dataclass

from drivers.config import LaserConfig
from drivers.sick_lms.error_memory import ErrorEntry, parse_errors
from drivers.sick_lms.findings import error_findings
from drivers.sick_lms.measurements import CM, DISTANCE_BITS, MM, ValueFormat
from drivers.sick_lms.startup import Found, Goal, Outcome, State
from drivers.sick_lms.telegrams import SOURCE, Command, Configuration, DeviceStatus, DeviceType, Variant

_UNITS = {CM: "cm", MM: "mm"}
_WRONG_PASSWORD = (
    "the password is wrong; set it back to SICK_LMS with the maker's software, or set write_configuration = false and "
    "unit to the scanner's"
)


@dataclass(frozen=True, slots=True)
class Identity:
    """Which scanner this is."""

    type: str
    firmware: str
    serial: str


class Judgement:
    """Takes the answers that were awaited."""

    def __init__(self, config: LaserConfig, goal: Goal) -> None:
        """Nothing known yet."""
        self.found = Found(goal.baud)
        """Since the scanner was found last."""
        self.identity: Identity | None = None
        self.errors: tuple[ErrorEntry, ...] = ()
        """What its error memory held when it was found."""
        self.operating_hours: float | None = None
        self.source: int | None = None
        """Status bits that tell which kind of scanner speaks; None while they are unknown."""
        self.trouble = ""
        """Why it can't be used, for people."""
        self._goal = goal
        self._write_allowed = config.write_configuration
        self._short_reach_m: float | None = None

    def begin(self, baud: int) -> None:
        """Find the scanner anew: it may be another one."""
        self.found = Found(baud)
        self.source = None

    @property
    def findings(self) -> tuple[str, ...]:
        """What ails the scanner, in sentences for people."""
        found = [*error_findings(self.errors)]
        if self.found.status is not None and self.found.status.defective:
            found.append("the scanner says that it is defective")
        if self._short_reach_m is not None:
            found.append(
                f"the scanner's measuring mode reaches {self._short_reach_m:.1f} m, short of range_max_m; "
                "set write_configuration = true, or range_max_m to that"
            )
        return tuple(found)

    def refusal(self, state: State) -> Outcome:
        """The scanner has refused what the state asks for."""
        self.trouble = f"the scanner refused {state.value}"
        if state is State.SETTING_VARIANT:
            self.trouble += "; an LMS Fast has scan_angle_deg = 90 and resolution_deg = 0.5 alone"
        return Outcome.REFUSED

    def of(self, payload: bytes, state: State, may_write: bool) -> Outcome:
        """What the answer means that the state awaited; `may_write`: was the EEPROM written seldom enough so far?"""
        match payload[0]:
            case Command.MODE.answer if payload[1] != 0:
                self.trouble = f"{state.value}: {_WRONG_PASSWORD if payload[1] == 1 else 'fault in the scanner'}"
                return Outcome.REFUSED
            case Command.TYPE.answer:
                self.found.kind = kind = DeviceType.parse(payload)
                self.identity = Identity(kind.model, kind.text.split(";")[-1].strip(), "")
            case Command.STATUS.answer:
                self.source = payload[-1] & SOURCE
                self.found.status = status = DeviceStatus.parse(payload)
                self.identity = Identity(self.identity.type if self.identity else "", status.firmware, status.serial)
            case Command.ERRORS.answer:
                self.errors = parse_errors(payload)
            case Command.COUNTERS.answer:
                self.operating_hours = int.from_bytes(payload[1:3], "little") / 2
            case Command.READ_CONFIGURATION.answer:
                return self._of_configuration(Configuration.parse(payload), may_write)
            case Command.WRITE_CONFIGURATION.answer if payload[1] != 1:
                return Outcome.REFUSED
            case Command.VARIANT.answer if payload[1] != 1 or Variant.parse(payload) != self._goal.variant:
                wanted = self._goal.variant
                self.trouble = (
                    f"the scanner can't scan {wanted.angle_deg} degrees at {wanted.resolution_cdeg / 100} degree; "
                    "set scan_angle_deg and resolution_deg to what it can"
                )
                return Outcome.REFUSED
        return Outcome.DONE

    def _of_configuration(self, found: Configuration, may_write: bool) -> Outcome:
        self.found.configuration = found
        self._short_reach_m = None
        wanted = self._goal.configuration(found)
        if found == wanted:
            return Outcome.DONE
        if self._write_allowed and may_write:
            return Outcome.DIFFERS
        # The declared range error holds for the declared unit only. A shorter reach alone does no harm.
        if found.unit == wanted.unit and found.measuring_mode in DISTANCE_BITS and not self._goal.interlaced:
            self._short_reach_m = ValueFormat(DISTANCE_BITS[found.measuring_mode], found.unit).reach_m
            return Outcome.DONE
        self.trouble = (
            f"the scanner measures in {_UNITS.get(found.unit, hex(found.unit))}, mode {found.measuring_mode:02X}h, "
            f"but {_UNITS[wanted.unit]}, mode {wanted.measuring_mode:02X}h is needed; "
            + (
                "it does not take its new configuration"
                if self._write_allowed
                else "set write_configuration = true, or unit to the scanner's"
            )
        )
        return Outcome.REFUSED
