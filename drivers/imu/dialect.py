"""The two messages of our own, as terrabound.xml describes them: dual-axis acceleration and dual-axis tilt.

What mavgen makes of that file is 900 lines, of which a driver needs these; a test generates the rest and compares.
"""

import struct
from dataclasses import dataclass

UNKNOWN_TEMPERATURE_CDEGC = 0x7FFF


@dataclass(frozen=True, slots=True)
class Definition:
    """A message, under the names of pymavlink's generated classes."""

    msgname: str
    id: int
    crc_extra: int
    """Checksum of the definition itself: ends that disagree about the fields refuse each other's frames."""
    unpacker: struct.Struct
    ordered_fieldnames: tuple[str, ...]
    """In the order of the wire: largest fields first."""


_DUAL_AXIS = struct.Struct("<QfffhB")

DEFINITIONS = (
    Definition(
        "DUAL_AXIS_ACCELERATION", 44100, 22, _DUAL_AXIS, ("time_usec", "xacc", "yacc", "bound", "temperature", "id")
    ),
    Definition("DUAL_AXIS_TILT", 44101, 98, _DUAL_AXIS, ("time_usec", "roll", "pitch", "bound", "temperature", "id")),
)
