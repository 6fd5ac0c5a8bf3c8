"""What an emulated SICK LMS2xx measures, put into the telegrams that it was asked for: LMS2XX sections 4 to 7."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.sick_lms.measurements import (
    DISTANCE_BITS,
    IMMEDIATE_MODE,
    TURN_NS,
    Sweep,
    ValueFormat,
    full_sweep,
    partial_sweep,
)
from drivers.sick_lms.range_telegrams import (
    FAST_REFLECTIVITY,
    MEAN,
    MOST_SUB_RANGES,
    REFLECTIVITY,
    SUB_RANGE,
    SUB_RANGE_MEAN,
    RangeTelegram,
    serialise_reflectivity,
)
from drivers.sick_lms.telegrams import FAST, RANGES, Command, Configuration, Mode, Variant

Measure: TypeAlias = Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]]
"""measure(shot_times_ns [n], angles_rad [n] in the laser's frame) -> ranges_m [n]: NaN no echo, +inf too far."""

_ENERGY = 9000
_REFLECTIVITY = 100


@dataclass(frozen=True, slots=True)
class Output:
    """Which measured values a request asks for, once or as a stream."""

    command: int = RANGES
    partial: bool = False
    averaged: int = 1
    every: int = 1
    """Every n-th value."""
    places: tuple[tuple[int, int], ...] = ()
    """(first, last) value of each sub-range."""

    def fits(self, variant: Variant) -> bool:
        """Can a scanner that scans `variant` do it?"""
        if (self.command == FAST_REFLECTIVITY) != (variant == FAST) and self.command in (
            FAST_REFLECTIVITY,
            REFLECTIVITY,
        ):
            return False
        count = full_sweep(variant).count
        return all(1 <= first <= last <= count for first, last in self.places) and 1 <= self.averaged <= 250

    def duration_ns(self, variant: Variant) -> int:
        """Mirror turns that it takes."""
        return TURN_NS if self.partial else self.averaged * full_sweep(variant).duration_ns


STREAM, STREAM_PARTIAL = Output(), Output(partial=True)


def output_of_mode(mode: int, data: bytes) -> Output | None:
    """The stream that 20h switches on (section 5.1), if it is one."""
    match mode:
        case Mode.STREAM if not data:
            return STREAM
        case Mode.STREAM_PARTIAL if not data:
            return STREAM_PARTIAL
        case Mode.STREAM_MEAN:
            return output_of_request(bytes((Command.MEAN,)) + data)
        case Mode.STREAM_SUB_RANGE:
            return output_of_request(bytes((Command.SUB_RANGE,)) + data)
        case Mode.STREAM_SUB_RANGE_MEAN:
            return output_of_request(bytes((Command.SUB_RANGE_MEAN,)) + data)
        case Mode.STREAM_REFLECTIVITY:
            return output_of_request(bytes((Command.REFLECTIVITY,)) + data)
        case Mode.STREAM_FAST_REFLECTIVITY:
            return output_of_request(bytes((Command.FAST_REFLECTIVITY,)) + data)
    return None


def output_of_request(payload: bytes) -> Output | None:
    """The single output that a request asks for (section 4), if it does."""
    data = payload[1:]
    match payload[0]:
        case Command.SCAN if data in _SCANS:
            return _SCANS[data]
        case Command.MEAN if len(data) == 1 and data[0] >= 2:
            return Output(MEAN, averaged=data[0])
        case Command.SUB_RANGE if len(data) == 4:
            return Output(SUB_RANGE, places=(_place(data),))
        case Command.SUB_RANGE_MEAN if len(data) == 5 and data[0] >= 2:
            return Output(SUB_RANGE_MEAN, averaged=data[0], places=(_place(data[1:]),))
        case Command.FAST_REFLECTIVITY if len(data) == 4:
            return Output(FAST_REFLECTIVITY, places=(_place(data),))
        case Command.REFLECTIVITY if len(data) >= 6:
            count = int.from_bytes(data[:2], "little")
            if 1 <= count <= MOST_SUB_RANGES and len(data) == 2 + 4 * count:
                return Output(REFLECTIVITY, places=tuple(_place(data[2 + 4 * k :]) for k in range(count)))
    return None


_SCANS = {b"\x01": STREAM, b"\x06": Output(every=2), b"\x07": Output(every=20), b"\x08": STREAM_PARTIAL}


def _place(data: bytes) -> tuple[int, int]:
    return int.from_bytes(data[:2], "little"), int.from_bytes(data[2:4], "little")


class Measurements:
    """The mirror and what it sees."""

    def __init__(self, measure: Measure, phase_ns: int, flags: int, immediate_partials: bool) -> None:
        """See SickLmsEmulator."""
        self._measure = measure
        self._phase_ns = phase_ns
        self._flags = flags
        self._immediate_partials = immediate_partials
        self.mirror_ns = 0
        """When some mirror turn began."""

    def turns(self, now_ns: int) -> int:
        """Whole mirror turns since then."""
        return (now_ns - self.mirror_ns) // TURN_NS

    def payload(
        self, output: Output, variant: Variant, configuration: Configuration, telegram_index: int, now_ns: int
    ) -> bytes:
        """The telegram of what was measured in the turns that have just ended, with status 0."""
        indices = (self.turns(now_ns) % 256, telegram_index % 256) if configuration.appends_indices else None
        quarter = 0
        if output.partial:
            offsets = 100 // variant.resolution_cdeg
            quarter = (self.turns(now_ns) - 1) % offsets * (4 // offsets)
        sweep = partial_sweep(quarter) if output.partial else full_sweep(variant)
        codes = self._codes(sweep, output, configuration, now_ns)[:: output.every]

        def telegram(first: int, codes: NDArray[np.uint16], rest: bytes = b"") -> RangeTelegram:
            return RangeTelegram(
                codes,
                configuration.unit,
                output.partial,
                quarter,
                indices,
                0,
                command=output.command,
                first=first,
                averaged=output.averaged,
                rest=rest,
            )

        match output.command:
            case Command.REFLECTIVITY.answer:
                parts = [telegram(first, codes[first - 1 : last]) for first, last in output.places]
                return serialise_reflectivity(parts, [np.full(len(p.codes), _ENERGY, np.uint16) for p in parts])
            case Command.FAST_REFLECTIVITY.answer:
                ((first, last),) = output.places
                words = b"".join(word.to_bytes(2, "little") for word in (last - first + 1, first, last))
                return telegram(1, codes, words + bytes((_REFLECTIVITY,)) * (last - first + 1)).serialise()
        first, last = output.places[0] if output.places else (1, len(codes))
        return telegram(first, codes[first - 1 : last]).serialise()

    def _codes(self, sweep: Sweep, output: Output, configuration: Configuration, now_ns: int) -> NDArray[np.uint16]:
        """[count] values; means carry no flags, and cover the last `averaged` scans."""
        end_ns = now_ns - (now_ns - self.mirror_ns) % TURN_NS + self._phase_ns
        scans = [
            self._measure(end_ns - k * sweep.duration_ns + sweep.beam_offset_ns, sweep.angles_rad)
            for k in range(output.averaged, 0, -1)
        ]
        immediate = output.partial and self._immediate_partials
        mode = IMMEDIATE_MODE if immediate else configuration.measuring_mode
        codes = ValueFormat(DISTANCE_BITS[mode], configuration.unit).encode(np.mean(scans, axis=0))
        if output.averaged == 1 and mode != IMMEDIATE_MODE:
            codes |= np.uint16(self._flags << DISTANCE_BITS[mode] & 0xFFFF)
        return codes
