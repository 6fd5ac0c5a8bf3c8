"""Scans from recorded bytes, without a conversation: what the telegrams do not tell is learned from others or inferred.

A range telegram tells its unit and count, but not how wide its distances are (block D). That stands in configuration
and status telegrams, which a recording may hold. Until one came, the width is inferred: the narrowest that holds all
codes seen so far. A code that some narrower width would call special is then no distance either, so an undecided
width never makes up a range, beyond what flags in unused bits could fake.
"""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from drivers.samples import Scan
from drivers.sick_lms.framing import Frame, FrameReader
from drivers.sick_lms.measurements import (
    DISTANCE_BITS,
    LARGEST_SPECIAL_CODES,
    STEPS_PER_METRE,
    RangeTelegram,
    Sweep,
    ValueFormat,
    full_sweep,
    partial_sweep,
    scan_of,
)
from drivers.sick_lms.telegrams import (
    RANGES,
    UNASKED,
    VARIANTS,
    Command,
    Configuration,
    DeviceStatus,
    Variant,
)

_VARIANT_OF_COUNT = {full_sweep(variant).count: variant for variant in VARIANTS}
_WIDTHS = (13, 14, 15)
_FAST_ANGLE_DEG = 90
"""Only the LMS Fast scans this angle; its 181 beams look like those of 180 degrees."""


class LmsStreamDecoder:
    """Every scan in a stream of bytes from a scanner that somebody else talks to."""

    def __init__(self, measuring_mode: int | None = None, latency_ns: tuple[int, int] = (0, 0)) -> None:
        self.counts: Counter[str] = Counter()
        self._reader = FrameReader(self.counts)
        self._latency_ns = latency_ns
        self._bits = DISTANCE_BITS.get(measuring_mode) if measuring_mode is not None else None
        self._learned_nothing_usable = False
        self._narrowest = _WIDTHS[0]
        self._angle_deg: int | None = None

    def receive_data(self, data: bytes, stamp_ns: int = 0) -> list[Scan]:
        """Scans that `data` completes; telegrams of other kinds are taken note of, or counted as unsupported."""
        return self._scans(self._reader.receive_data(data, stamp_ns))

    def finish(self) -> list[Scan]:
        """No more bytes come: what still waited for the end of a frame that seemed to begin before."""
        return self._scans(self._reader.release())

    def _scans(self, frames: list[Frame]) -> list[Scan]:
        return [scan for frame in frames if (scan := self._take(frame)) is not None]

    def _take(self, frame: Frame) -> Scan | None:
        self.counts["telegrams"] += 1
        payload = frame.payload
        match frame.command:
            case _ if frame.command == RANGES:
                return self._scan(frame)
            case Command.READ_CONFIGURATION.answer | Command.WRITE_CONFIGURATION.answer:
                self._learn(Configuration.parse(payload).measuring_mode)
            case Command.STATUS.answer:
                status = DeviceStatus.parse(payload)
                self._learn(status.measuring_mode)
                self._angle_deg = status.angle_deg
            case Command.VARIANT.answer:
                self._angle_deg = Variant.parse(payload).angle_deg
            case _ if frame.command in UNASKED:
                self.counts["unsupported_telegrams"] += 1
        return None

    def _learn(self, measuring_mode: int) -> None:
        self._bits = DISTANCE_BITS.get(measuring_mode)
        self._learned_nothing_usable = self._bits is None  # as 3Fh: energies

    def _scan(self, frame: Frame) -> Scan | None:
        telegram = RangeTelegram.parse(frame.payload)
        sweep = self._sweep(telegram)
        if sweep is None or telegram.unit not in STEPS_PER_METRE or self._learned_nothing_usable:
            self.counts["unsupported_scans"] += 1
            return None
        self.counts["scans"] += 1
        if self._bits is not None:
            return scan_of(telegram, sweep, ValueFormat(self._bits, telegram.unit), frame.stamp_ns, self._latency_ns)
        self.counts["scans_of_inferred_width"] += 1
        self._narrowest = max(self._narrowest, _narrowest_width(telegram.codes))
        value_format = ValueFormat(self._narrowest, telegram.unit)
        scan = scan_of(telegram, sweep, value_format, frame.stamp_ns, self._latency_ns)
        scan.ranges_m[_special_in_any_width(telegram.codes)] = np.nan
        return scan

    def _sweep(self, telegram: RangeTelegram) -> Sweep | None:
        """The beams of this telegram; None for sub-ranges, doubtful partial scans, and scanners with another mirror."""
        count = len(telegram.codes)
        if telegram.partial:
            sweep = partial_sweep(telegram.quarter)
            # How narrower distances are coded in partial scans is told differently.
            return sweep if sweep.count == count and self._bits in (None, _WIDTHS[-1]) else None
        variant = _VARIANT_OF_COUNT.get(count)
        if variant is None or telegram.quarter or self._angle_deg == _FAST_ANGLE_DEG:
            return None
        return full_sweep(variant)


def _narrowest_width(codes: NDArray[np.uint16]) -> int:
    """Distance bits that hold all codes; bit 15 is a flag in every measuring mode."""
    longest = int((codes & np.uint16(0x7FFF)).max())
    return next(bits for bits in _WIDTHS if longest < 1 << bits)


def _special_in_any_width(codes: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """[n] codes that at least one width reserves."""
    distances = codes & np.uint16(0x7FFF)
    special = np.zeros(len(codes), np.bool_)
    for bits in _WIDTHS:
        top = (1 << bits) - 1
        special |= (distances >= top - LARGEST_SPECIAL_CODES) & (distances <= top)
    return special
