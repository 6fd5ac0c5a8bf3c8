"""Telegrams both ways, without a stream around them."""

from math import inf, isnan, nan, pi, radians

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.samples import Stamp
from drivers.sick_lms.measurements import (
    CM,
    DISTANCE_BITS,
    MM,
    TURN_NS,
    ValueFormat,
    full_sweep,
    partial_sweep,
    scan_of,
)
from drivers.sick_lms.plausibility import header_fits, status_fits
from drivers.sick_lms.range_telegrams import RangeTelegram
from drivers.sick_lms.telegrams import (
    PASSWORD,
    VARIANTS,
    Command,
    Configuration,
    DeviceStatus,
    DeviceType,
    Mode,
    Variant,
    answer,
    request,
)

RECORD = bytes.fromhex("0000 7000 00 00 01 0000 02 02") + bytes(21) + b"\x02\x00"


@pytest.mark.parametrize(
    ("payload", "frame"),
    [
        (bytes((Command.MODE, Mode.STOP)), "02 00 02 00 20 25 35 08"),
        (bytes((Command.MODE, Mode.INSTALLATION)) + PASSWORD, "02 00 0A 00 20 00 53 49 43 4B 5F 4C 4D 53 BE C5"),
        (Variant(180, 50).serialise_request(), "02 00 05 00 3B B4 00 32 00 3B 1F"),
        (Configuration(RECORD).serialise_write(), "02 00 23 00 77 " + RECORD.hex() + "11 88"),
    ],
)
def test_requests_are_the_manuals_bytes(payload: bytes, frame: str) -> None:
    """What the driver sends is what the manual prints."""
    assert request(payload) == bytes.fromhex(frame)


@pytest.mark.parametrize(
    ("payload", "frame"),
    [
        (Variant(180, 50).serialise_answer(True), "02 80 07 00 BB 01 B4 00 32 00 10 03 9D"),
        (DeviceType("LMS200;301063;V02.10 ").serialise(0x90), None),
        (Configuration(RECORD).serialise_read(), "02 80 24 00 F4 " + RECORD.hex() + "10 3C FB"),
        (Configuration(RECORD).serialise_written(True), "02 80 25 00 F7 01" + RECORD.hex() + "10 C5 7A"),
    ],
)
def test_answers_are_the_manuals_bytes(payload: bytes, frame: str | None) -> None:
    """What the emulated scanner sends is what the manual prints."""
    expected = frame or "02 80 17 00 90" + b"LMS200;301063;V02.10 ".hex() + "10 63 5E"

    assert answer(payload) == bytes.fromhex(expected)


def test_configuration_changes_only_mode_and_unit() -> None:
    """Writing back keeps every byte that is not ours, and as many as were read."""
    found = Configuration.parse(answer(Configuration(RECORD).serialise_read())[4:-2])

    changed = found.with_format(0x06, CM)

    assert (changed.measuring_mode, changed.unit) == (0x06, CM)
    assert changed.record[:5] + changed.record[7:] == RECORD[:5] + RECORD[7:]
    assert Configuration.parse(changed.serialise_written(True)) == changed


def test_status_round_trips_at_the_manuals_positions() -> None:
    """B1h carries serial, mode, variant, rate and unit where the manual has them."""
    status = DeviceStatus("V02.30", "00410123", 0x25, 0x06, 100, 25, 38400, MM)

    payload = status.serialise()

    assert DeviceStatus.parse(payload) == status
    assert len(payload) == 154
    assert payload[10:18] == b"00410123"
    assert (payload[102], payload[107], payload[109], payload[122]) == (0x06, 100, 25, 1)
    assert payload[116:118] == b"\x19\x80"


@given(
    codes=st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=401),
    unit=st.sampled_from((CM, MM)),
    partial=st.booleans(),
    quarter=st.integers(0, 3),
    indices=st.none() | st.tuples(st.integers(0, 255), st.integers(0, 255)),
    status=st.integers(0, 255),
)
def test_range_telegrams_round_trip(
    codes: list[int],
    unit: int,
    partial: bool,
    quarter: int,
    indices: tuple[int, int] | None,
    status: int,
) -> None:
    """Parsing what was serialised gives the same values, flags, indices and status."""
    sent = RangeTelegram(np.array(codes, np.uint16), unit, partial, quarter, indices, status)

    payload = sent.serialise()
    got = RangeTelegram.parse(payload)

    assert header_fits(payload[0], len(payload), sent.count_word)
    assert got.codes.tolist() == codes
    assert (got.unit, got.partial, got.quarter, got.indices, got.status) == (unit, partial, quarter, indices, status)


@given(
    mode=st.sampled_from(sorted(DISTANCE_BITS)),
    unit=st.sampled_from((CM, MM)),
    fractions=st.lists(st.floats(0, 1), min_size=1, max_size=50),
)
def test_ranges_come_back_within_half_a_step(mode: int, unit: int, fractions: list[float]) -> None:
    """Quantisation is to the nearest step, up to the reach of the measuring mode."""
    value_format = ValueFormat(DISTANCE_BITS[mode], unit)
    ranges = np.array(fractions) * value_format.reach_m

    got = value_format.decode(value_format.encode(ranges))

    half_step = 0.0005 if unit == MM else 0.005
    assert np.all(np.abs(got - ranges) <= half_step * (1 + 1e-9))


@pytest.mark.parametrize("bits", [13, 14, 15])
def test_only_codes_below_the_special_ones_are_distances(bits: int) -> None:
    """Top - 8 is free space, everything above says nothing, and flags above the distance change nothing."""
    value_format = ValueFormat(bits, MM)
    top = (1 << bits) - 1
    flags = 0xFFFF & ~top

    codes = np.array([top - 9, top - 8, *range(top - 7, top + 1), flags | 2623], np.uint16)
    got = value_format.decode(codes)

    assert got[0] == (top - 9) / 1000
    assert got[1] == inf
    assert all(isnan(r) for r in got[2:-1])
    assert got[-1] == 2.623


@pytest.mark.parametrize("bits", [13, 14, 15])
def test_what_is_no_distance_is_encoded_as_a_special_code(bits: int) -> None:
    """No echo, free space and distances beyond the reach never come back as distances."""
    value_format = ValueFormat(bits, CM)

    got = value_format.decode(value_format.encode(np.array([nan, inf, 1e9, value_format.reach_m + 0.01])))

    assert isnan(got[0])
    assert got[1:].tolist() == [inf, inf, inf]


@pytest.mark.parametrize(
    ("variant", "count", "turns", "first"),
    [
        (Variant(180, 100), 181, 1, -pi / 2),
        (Variant(180, 50), 361, 2, -pi / 2),
        (Variant(100, 100), 101, 1, radians(-50)),
        (Variant(100, 50), 201, 2, radians(-50)),
        (Variant(100, 25), 401, 4, radians(-50)),
    ],
)
def test_beams_are_shot_when_the_mirror_passes_them(variant: Variant, count: int, turns: int, first: float) -> None:
    """Beam i is shot in turn i mod n, when the mirror points at it, and the fan is symmetric about ahead."""
    sweep = full_sweep(variant)

    assert (sweep.count, sweep.turns) == (count, turns)
    assert sweep.angle_min_rad == first
    assert sweep.angles_rad[-1] == pytest.approx(-first)
    mirror_angle = sweep.beam_offset_ns % TURN_NS / TURN_NS * 2 * pi - pi / 2
    assert mirror_angle == pytest.approx(sweep.angles_rad)
    assert (sweep.beam_offset_ns // TURN_NS).tolist() == [i % turns for i in range(count)]


def test_partial_scans_fill_the_gaps_between_whole_degrees() -> None:
    """The four partial scans together are 180 degrees at 0.25 degree."""
    angles = np.sort(np.concatenate([partial_sweep(quarter).angles_rad for quarter in range(4)]))

    assert angles == pytest.approx(np.radians(np.arange(721) * 0.25 - 90))


def test_scan_begins_one_sweep_before_its_first_byte() -> None:
    """The stamp is that of the first mirror turn's beginning, widened by the declared latency."""
    sweep = full_sweep(Variant(180, 50))
    telegram = RangeTelegram(np.full(361, 2623, np.uint16), MM, status=0x11)

    sent = Stamp(10**9 - 6_000_000, 10**9 - 1_000_000)
    scan = scan_of(telegram, sweep, ValueFormat(15, MM).decode(telegram.codes), sent)

    assert scan.stamp.earliest_ns == 10**9 - 2 * TURN_NS - 6_000_000
    assert scan.stamp.latest_ns == 10**9 - 2 * TURN_NS - 1_000_000
    assert scan.ranges_m.tolist() == [2.623] * 361
    assert scan.status == 0x11


def test_every_variant_has_its_own_count() -> None:
    """The number of values tells the variant."""
    assert len({full_sweep(variant).count for variant in VARIANTS}) == len(VARIANTS)


def test_headers_and_status_bytes_that_cannot_be_are_refused() -> None:
    """A length that contradicts the count, an unknown command, or a foreign source is no telegram."""
    assert header_fits(0xB0, 366, 0x40B5)
    assert not header_fits(0xB0, 365, 0x40B5)
    assert not header_fits(0xB0, 4, 0x4000)
    assert not header_fits(0xC6, 580, 0)
    assert not header_fits(0xA0, 4, 0)
    assert status_fits(0x10)
    assert status_fits(0xF1)
    assert not status_fits(0x08)
    assert not status_fits(0x17)
