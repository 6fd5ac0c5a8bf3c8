"""What ails a scanner, in sentences for people: from its status bytes, its status telegram and its error memory."""

from collections.abc import Iterator

from drivers.sick_lms.error_memory import SEVERITIES, ErrorEntry

SEVERITY = 0x07
WARNING = 2
IMPLAUSIBLE = 0x40
POLLUTED = 0x80
"""Bits of the status byte that ends each telegram (section 2)."""


def status_findings(status: int) -> Iterator[str]:
    """What a status byte says."""
    if status & POLLUTED:
        yield "the scanner's window is dirty: clean it"
    if status & IMPLAUSIBLE:
        yield "the scanner calls its measured values implausible; they are not used"
    severity = status & SEVERITY
    if severity >= WARNING:
        yield f"the scanner reports a lasting {SEVERITIES[min(severity, 4)]}"


def error_findings(errors: tuple[ErrorEntry, ...]) -> Iterator[str]:
    """What the error memory holds."""
    present = [str(entry) for entry in errors if not entry.past]
    past = [str(entry) for entry in errors if entry.past]
    if present:
        yield f"the scanner's error memory holds {', '.join(present)}"
    if past:
        yield f"the scanner had {', '.join(past)} in the past"
