"""How wide distances are coded, where nothing says so: told from the values themselves.

A range telegram does not tell which of its bits are distance and which are flags (block D does). The two differ in how
they meet neighbours: surfaces are mostly smooth, so where two neighbouring beams differ in a flag, the bits below it
are mostly close; where they differ in a distance bit, those below it are close only by chance.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.sick_lms.measurements import LARGEST_SPECIAL_CODES, ValueFormat

WIDTHS = (13, 14, 15)
"""Bit 15 is no distance bit in any measuring mode."""

_CLOSE = 256
"""Codes: a quarter of a metre in millimetres."""
_FEWEST_PAIRS = 5


def inferred_width(scans: Sequence[NDArray[np.uint16]]) -> int:
    """Distance bits of `scans`, each [n] codes of neighbouring beams: the bits below the lowest bit that is a flag.

    Where none is, the narrowest width that holds all codes.
    """
    for bits in WIDTHS[:-1]:
        if is_flag(bits, scans):
            return bits
    longest = max((int((codes & np.uint16(0x7FFF)).max()) for codes in scans if codes.size), default=0)
    return next(bits for bits in WIDTHS if longest < 1 << bits)


def is_flag(bit: int, scans: Iterable[NDArray[np.uint16]]) -> bool | None:
    """Is `bit` a flag? None where the codes have too few neighbours that differ in it to tell."""
    below = (1 << bit) - 1
    pairs = close = 0
    for codes in scans:
        low = codes & np.uint16(below)
        usable = ~_special(low)
        differs = ((codes[1:] ^ codes[:-1]) >> bit & 1).astype(np.bool_) & usable[1:] & usable[:-1]
        step = low[1:].astype(np.int64) - low[:-1]
        pairs += int(differs.sum())
        close += int((differs & (np.abs(step) < _CLOSE)).sum())
    return None if pairs < _FEWEST_PAIRS else close > pairs / 2


def decode_inferred(codes: NDArray[np.uint16], bits: int, unit: int) -> NDArray[np.float64]:
    """Ranges [n] in metres of `codes` [n] in a width that was inferred.

    Codes that a narrower width would reserve are no distance either, and free space isn't told from the unknown.
    """
    ranges_m = ValueFormat(bits, unit).decode(codes)
    ranges_m[_special(codes & np.uint16((1 << bits) - 1))] = np.nan
    return ranges_m


def decode_agreed(codes: NDArray[np.uint16], one: ValueFormat, other: ValueFormat) -> NDArray[np.float64]:
    """Ranges [n] in metres of `codes` [n] where both formats say the same, else NaN."""
    ranges_m, others_m = one.decode(codes), other.decode(codes)
    ranges_m[ranges_m != others_m] = np.nan
    return ranges_m


def _special(distances: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """[n] distances that at least one width reserves."""
    special = np.zeros(len(distances), np.bool_)
    for bits in WIDTHS:
        top = (1 << bits) - 1
        special |= (distances >= top - LARGEST_SPECIAL_CODES) & (distances <= top)
    return special
