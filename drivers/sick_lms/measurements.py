"""What the measured values of a SICK LMS2xx say: distance codes, and where and when each beam was shot.

LMS2XX sections 6 and 7.
"""

from dataclasses import dataclass
from functools import cache
from math import radians

import numpy as np
from numpy.typing import NDArray

from drivers.samples import Scan, Stamp
from drivers.sick_lms.range_telegrams import RangeTelegram
from drivers.sick_lms.telegrams import FAST, Variant

TURN_NS = 13_320_000
"""One mirror turn."""
NS_PER_DEGREE = TURN_NS // 360

CM, MM, TEN_CM = 0, 1, 2
STEPS_PER_METRE = {CM: 100.0, MM: 1000.0, TEN_CM: 10.0}

DISTANCE_BITS = {0x00: 13, 0x01: 13, 0x02: 13, 0x03: 14, 0x04: 14, 0x05: 15, 0x06: 15, 0x0F: 15}
"""Measuring mode (block D) to the width of a distance; the bits above it are flags, but for 0Fh."""
WIDEST_MODE = 0x06
IMMEDIATE_MODE = 0x0F
"""No flags: codes above the special ones are no distances either."""

LARGEST_SPECIAL_CODES = 8
"""Codes from top - 8 up to the top (all distance bits set) are no distances; top - 8 means beyond the maximum."""


@dataclass(frozen=True, slots=True)
class ValueFormat:
    """How one value codes a distance."""

    bits: int
    unit: int
    immediate: bool = False
    """No flags stand above the distance."""

    @classmethod
    def of(cls, measuring_mode: int, unit: int) -> "ValueFormat | None":
        """The format of a measuring mode and a unit, if both are known and the mode measures distances."""
        bits = DISTANCE_BITS.get(measuring_mode)
        if bits is None or unit not in STEPS_PER_METRE:
            return None
        return cls(bits, unit, measuring_mode == IMMEDIATE_MODE)

    @property
    def top(self) -> int:
        """All distance bits set: no echo."""
        return (1 << self.bits) - 1

    @property
    def reach_m(self) -> float:
        """Longest distance that can be told."""
        return (self.top - LARGEST_SPECIAL_CODES - 1) / STEPS_PER_METRE[self.unit]

    def decode(self, codes: NDArray[np.uint16]) -> NDArray[np.float64]:
        """Ranges [n] in metres of `codes` [n]: +inf beyond the maximum, NaN for every other code without a distance."""
        distances = codes if self.immediate else codes & np.uint16(self.top)
        ranges = distances.astype(np.float64)
        ranges /= STEPS_PER_METRE[self.unit]
        beyond = self.top - LARGEST_SPECIAL_CODES
        ranges[distances >= beyond] = np.nan
        ranges[distances == beyond] = np.inf
        return ranges

    def encode(self, ranges_m: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Codes [n] of `ranges_m` [n], rounded to the nearest step, no flags set; NaN becomes `top` (no echo)."""
        beyond = self.top - LARGEST_SPECIAL_CODES
        steps = np.rint(ranges_m * STEPS_PER_METRE[self.unit])
        limited = np.clip(np.where(np.isnan(steps), 0.0, steps), 0.0, beyond)
        return np.where(np.isnan(steps), self.top, limited).astype(np.uint16)


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Where and when the beams of one telegram were shot.

    Angles count counter-clockwise from straight ahead. Full scans of n turns are sorted by angle, so beam i was shot
    in turn i mod n; the telegram's first byte leaves at the end of the last turn.
    """

    count: int
    turns: int
    angle_min_rad: float
    angle_increment_rad: float
    beam_offset_ns: NDArray[np.int64]
    """[count] after the start of the first turn."""

    @property
    def angles_rad(self) -> NDArray[np.float64]:
        """[count] in the laser's frame."""
        i = np.arange(self.count, dtype=np.float64)
        return np.asarray(self.angle_min_rad + i * self.angle_increment_rad, np.float64)

    @property
    def duration_ns(self) -> int:
        """From the start of the first turn to the end of the last."""
        return self.turns * TURN_NS

    def part(self, first: int, count: int, every: int = 1) -> "Sweep":
        """`count` beams from number `first` (from 1) on, every `every`-th of them."""
        offset = self.beam_offset_ns[first - 1 :: every][:count]
        assert len(offset) == count
        begin = self.angle_min_rad + (first - 1) * self.angle_increment_rad
        return Sweep(count, self.turns, begin, every * self.angle_increment_rad, offset)


def _sweep(count: int, turns: int, first_cdeg: int, step_cdeg: int) -> Sweep:
    """`first_cdeg`: first beam in 1/100 degree of the scanner's own frame, where 90 degrees is straight ahead."""
    i = np.arange(count, dtype=np.int64)
    offset = i % turns * TURN_NS + (first_cdeg + i * step_cdeg) * NS_PER_DEGREE // 100
    offset.setflags(write=False)
    return Sweep(count, turns, radians(first_cdeg / 100 - 90), radians(step_cdeg / 100), offset)


@cache
def full_sweep(variant: Variant) -> Sweep:
    """A whole scan of `variant`; the LMS Fast shoots half degrees in one turn."""
    step = variant.resolution_cdeg
    turns = 1 if variant == FAST else 100 // step
    return _sweep(variant.angle_deg * 100 // step + 1, turns, (180 - variant.angle_deg) * 50, step)


@cache
def partial_sweep(quarter: int) -> Sweep:
    """One turn of an interlaced scan: 181 beams at whole degrees, 180 beams between them."""
    return _sweep(180 if quarter else 181, 1, 25 * quarter, 100)


def scan_of(telegram: RangeTelegram, sweep: Sweep, ranges_m: NDArray[np.float64], sent: Stamp) -> Scan:
    """The scan of a telegram whose first byte was sent within `sent`, at the end of the last mirror turn."""
    duration = sweep.duration_ns
    return Scan(
        stamp=sent.shifted(-telegram.averaged * duration, -duration),
        beam_offset_ns=sweep.beam_offset_ns,
        angle_min_rad=sweep.angle_min_rad,
        angle_increment_rad=sweep.angle_increment_rad,
        ranges_m=ranges_m,
        status=telegram.status,
    )
