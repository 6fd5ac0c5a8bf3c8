"""The scanner's error memory, B2h: pairs of severity and number (LMS2XX section 5.4)."""

from dataclasses import dataclass

from drivers.sick_lms.telegrams import STATUS_OK, Command

PAST = 0x80
SEVERITIES = ("ok", "info", "warning", "error", "fatal error")
"""Also bits 0-2 of each status byte."""

MEANINGS = {
    5: "dazzled",
    **dict.fromkeys(range(17, 23), "window dirty"),
    29: "motor speed",
    45: "a value is missing",
    46: "a scan is missing",
    49: "laser power",
    53: "flash memory written",
    56: "watchdog",
    57: "no zero index of the mirror",
    **dict.fromkeys(range(58, 62), "synchronisation of two scanners"),
}


@dataclass(frozen=True, slots=True)
class ErrorEntry:
    """One entry."""

    severity: int
    """1 info .. 4 fatal."""
    number: int
    past: bool
    """It lasts no longer."""

    def __str__(self) -> str:
        severity = SEVERITIES[self.severity] if self.severity < len(SEVERITIES) else f"severity {self.severity}"
        meaning = MEANINGS.get(self.number)
        return f"{severity} {self.number}" + (f" ({meaning})" if meaning else "")


def parse_errors(payload: bytes) -> tuple[ErrorEntry, ...]:
    """From a B2h payload; without entries it holds the status byte alone."""
    data = payload[1:-1]
    return tuple(
        ErrorEntry(kind & ~PAST, number, bool(kind & PAST))
        for kind, number in zip(data[::2], data[1::2], strict=True)
        if kind & ~PAST
    )


def serialise_errors(entries: tuple[ErrorEntry, ...], status: int = STATUS_OK) -> bytes:
    """A B2h payload."""
    pairs = b"".join(bytes((entry.severity | PAST * entry.past, entry.number)) for entry in entries)
    return bytes((Command.ERRORS.answer,)) + pairs + bytes((status,))
