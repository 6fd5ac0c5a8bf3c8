"""Scans from recorded bytes, without a conversation: what telegrams do not tell is learned from others, or inferred.

A range telegram tells its unit and count, but neither how wide its distances are (block D) nor, if it holds a
sub-range, at which angle and resolution the scanner works. That stands in configuration, status and variant telegrams,
which a recording may hold. Until one came, range telegrams wait; at the end, or when many wait, the width is inferred
from their values (width.py), and sub-ranges that nothing places are counted. An inferred width never makes a range of a
code that any width reserves.
"""

from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.samples import Scan, Stamp
from drivers.sick_lms.framing import Frame, FrameReader
from drivers.sick_lms.indices import IndexGaps
from drivers.sick_lms.measurements import (
    DISTANCE_BITS,
    IMMEDIATE_MODE,
    STEPS_PER_METRE,
    Sweep,
    ValueFormat,
    full_sweep,
    partial_sweep,
    scan_of,
)
from drivers.sick_lms.range_telegrams import (
    FAST_REFLECTIVITY,
    PLACED,
    RANGE_COMMANDS,
    REFLECTIVITY,
    RangeTelegram,
    parse_ranges,
)
from drivers.sick_lms.telegrams import (
    FAST,
    POWER_ON,
    VARIANTS,
    Command,
    Configuration,
    DeviceStatus,
    DeviceType,
    Variant,
)
from drivers.sick_lms.width import decode_agreed, decode_inferred, inferred_width, is_flag

EVERY_NTH = (2, 20)
"""30h 06 and 07 give every second or twentieth value."""
_VARIANT_OF_COUNT = {full_sweep(variant).count: variant for variant in VARIANTS}
_EVERY_NTH_OF_COUNT = {
    (count - 1) // every + 1: (variant, every) for count, variant in _VARIANT_OF_COUNT.items() for every in EVERY_NTH
}
"""Counts of whole scans mean whole scans; no other count comes twice."""
_PLACED = PLACED | {REFLECTIVITY}
_MOST_WAITING = 128
_ONE_SHORT = 180
"""Values of 181 that some programs keep when they record."""


def _known_sweep(variant: Variant | None) -> Sweep | None:
    """The whole scan of a variant that scanners have."""
    return full_sweep(variant) if variant in (*VARIANTS, FAST) else None


class LmsStreamDecoder:
    """Every scan in a stream of bytes from a scanner that somebody else talks to."""

    def __init__(
        self,
        measuring_mode: int | None = None,
        variant: Variant | None = None,
        *,
        unit: int | None = None,
        sent: Callable[[Frame], Stamp] = lambda frame: Stamp(frame.stamp_ns, frame.stamp_ns),
        counts: Counter[str] | None = None,
    ) -> None:
        """unit: scans in another one are left out. sent: when a telegram's first byte was; else that it was read."""
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._reader = FrameReader(self.counts)
        self._gaps = IndexGaps(self.counts)
        self._unit = unit
        self._sent = sent
        self._mode = measuring_mode
        self._inferred_bits: int | None = None
        self._variant = variant
        self._waiting: list[Frame] = []
        self._waited_enough = False
        self._partial_codes: list[NDArray[np.uint16]] = []
        self._partial_flags: bool | None = None

    def receive_data(self, data: bytes, stamp_ns: int = 0) -> list[Scan]:
        """Scans that can be told now; each at the time of the read with its first byte."""
        return self._scans(self._reader.receive_data(data, stamp_ns))

    def finish(self) -> list[Scan]:
        """No more bytes come: the scans that still waited to be told."""
        scans = self._scans(self._reader.release())
        return scans + self._scans_that_waited()

    def _scans(self, frames: list[Frame]) -> list[Scan]:
        scans = []
        for frame in frames:
            self.counts["telegrams"] += 1
            if frame.command in RANGE_COMMANDS:
                self._waiting.append(frame)
                self._waited_enough |= len(self._waiting) >= _MOST_WAITING
            else:
                self._learn(frame)
            if self._waiting and (self._waited_enough or self._all_told):
                scans += self._scans_that_waited()
        return scans

    @property
    def _all_told(self) -> bool:
        """Is known what the telegrams that wait do not say of themselves?"""
        return self._mode is not None and (
            self._variant is not None or not any(frame.command in _PLACED for frame in self._waiting)
        )

    def _learn(self, frame: Frame) -> None:
        """What a telegram without measured values says about those that have some."""
        payload = frame.payload
        match frame.command:
            case Command.READ_CONFIGURATION.answer | Command.WRITE_CONFIGURATION.answer:
                self._mode = Configuration.parse(payload).measuring_mode
            case Command.STATUS.answer:
                status = DeviceStatus.parse(payload)
                variant = Variant(status.angle_deg, status.resolution_cdeg)
                if _known_sweep(variant) is not None:  # or its layout is one that we do not know
                    self._mode, self._variant = status.measuring_mode, variant
            case Command.VARIANT.answer:
                self._variant = Variant.parse(payload)
            case Command.TYPE.answer:
                if DeviceType.parse(payload).is_fast:
                    self._variant = FAST
            case _ if frame.command == POWER_ON:
                self._gaps.restart()
                self._variant = DeviceType.parse(payload).power_on_variant
            case Command.MODE.answer:
                self._gaps.restart()

    def _scans_that_waited(self) -> list[Scan]:
        if self._mode is None and self._inferred_bits is None and self._waiting:
            parts = [part.codes for frame in self._waiting for part in parse_ranges(frame.payload)]
            self._inferred_bits = inferred_width(parts)
        frames, self._waiting = self._waiting, []
        return [scan for frame in frames for scan in self._scans_of(frame)]

    def _scans_of(self, frame: Frame) -> list[Scan]:
        scans = []
        parts = parse_ranges(frame.payload)
        self._gaps.take(parts[0].indices)
        sent = self._sent(frame)
        for part in parts:
            sweep, ranges_m = self._sweep(part), self._ranges_m(part)
            if sweep is None or ranges_m is None:
                self.counts["undecoded_scans"] += 1
                continue
            self.counts["scans"] += 1
            scans.append(scan_of(part, sweep, ranges_m, sent))
        return scans

    def _ranges_m(self, part: RangeTelegram) -> NDArray[np.float64] | None:
        """[n] distances of a part, or None if it holds none."""
        if part.unit not in STEPS_PER_METRE or self._unit not in (None, part.unit):
            self.counts["undecoded_unit"] += 1
            return None
        if self._mode is None:
            self.counts["scans_of_inferred_width"] += 1
            assert self._inferred_bits is not None  # or nothing would be decoded yet
            return decode_inferred(part.codes, self._inferred_bits, part.unit)
        value_format = ValueFormat.of(self._mode, part.unit)
        if value_format is None:
            self.counts["undecoded_energies" if self._mode == 0x3F else "undecoded_measuring_mode"] += 1
            return None
        if part.partial and self._mode != IMMEDIATE_MODE:
            return self._partial_ranges_m(part, value_format)
        return value_format.decode(part.codes)

    def _partial_ranges_m(self, part: RangeTelegram, configured: ValueFormat) -> NDArray[np.float64]:
        """The manual codes partial scans without flags ("immediate"), scanners as configured: the values may tell."""
        immediate = ValueFormat(DISTANCE_BITS[IMMEDIATE_MODE], part.unit, immediate=True)
        if self._partial_flags is None and np.any(part.codes >> configured.bits):
            self._partial_codes = [*self._partial_codes[1 - _MOST_WAITING :], part.codes]
            highest = bool(np.any(part.codes >> 15))  # no distance is as long as that
            self._partial_flags = highest or is_flag(configured.bits, self._partial_codes)
        if self._partial_flags is None:
            return decode_agreed(part.codes, configured, immediate)
        return (configured if self._partial_flags else immediate).decode(part.codes)

    def _sweep(self, part: RangeTelegram) -> Sweep | None:
        """The beams of a part, or None, counted, if nothing tells where they point."""
        count = len(part.codes)
        placed = part.command in _PLACED
        if part.partial:
            whole = partial_sweep(part.quarter)
            if placed and part.last <= whole.count:
                return whole.part(part.first, count)
            if not placed and whole.count == count:
                return whole
        elif placed:
            variant = self._variant or (_VARIANT_OF_COUNT[401] if part.last > 361 else None)
            known = _known_sweep(variant)
            if known is not None and part.last <= known.count:
                return known.part(part.first, count)
            self.counts["undecoded_sub_range"] += 1
            return None
        elif not part.quarter:
            return self._whole_sweep(part.command, count)
        self.counts["undecoded_count"] += 1
        return None

    def _whole_sweep(self, command: int, count: int) -> Sweep | None:
        """The beams of a whole scan, or of every n-th of its values: their number tells."""
        if command == FAST_REFLECTIVITY:
            self._variant = FAST
        if (known := _known_sweep(self._variant)) is not None:
            for every in (1, *EVERY_NTH):
                if (known.count - 1) // every + 1 == count:
                    return known.part(1, count, every) if every > 1 else known
        if (variant := _VARIANT_OF_COUNT.get(count)) is not None:
            self._variant = variant
            return full_sweep(variant)
        if count in _EVERY_NTH_OF_COUNT:
            variant, every = _EVERY_NTH_OF_COUNT[count]
            return full_sweep(variant).part(1, count, every)
        if count == _ONE_SHORT:
            return full_sweep(VARIANTS[0]).part(1, count)
        self.counts["undecoded_count"] += 1
        return None
