"""Scans from recorded bytes."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.samples import Scan
from drivers.sick_lms.framing import FrameReader
from drivers.sick_lms.measurements import CM, MM, TEN_CM, TURN_NS, ValueFormat
from drivers.sick_lms.range_telegrams import (
    FAST_REFLECTIVITY,
    MEAN,
    REFLECTIVITY,
    SUB_RANGE,
    SUB_RANGE_FIELDS,
    SUB_RANGE_MEAN,
    RangeTelegram,
    serialise_reflectivity,
)
from drivers.sick_lms.stream import LmsStreamDecoder
from drivers.sick_lms.telegrams import Configuration, DeviceStatus, DeviceType, Variant, answer

RECORD = bytes.fromhex("0000 7000 00 06 01 0000 02 02") + bytes(21) + b"\x02\x00"


def ranges_telegram(codes: list[int] | NDArray[np.uint16], unit: int = MM) -> bytes:
    """A whole frame of 181 values that begins with these."""
    values = np.full(181, 1000, np.uint16)
    values[: len(codes)] = codes
    return answer(RangeTelegram(values, unit).serialise())


@given(
    ranges=st.lists(st.floats(0, 32.7), min_size=181, max_size=181),
    unit=st.sampled_from((CM, MM)),
    cuts=st.lists(st.integers(1, 400), max_size=5),
)
def test_scans_round_trip_through_bytes(ranges: list[float], unit: int, cuts: list[int]) -> None:
    """What a scanner encodes is what comes out, within half a step, wherever reads cut the bytes."""
    codes = ValueFormat(15, unit).encode(np.array(ranges))
    data = answer(RangeTelegram(codes, unit).serialise())
    decoder = LmsStreamDecoder(measuring_mode=0x06)
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]

    scans = [scan for a, b in pairwise(edges) for scan in decoder.receive_data(data[a:b], a)]

    assert len(scans) == 1
    assert np.abs(scans[0].ranges_m - ranges).max() <= (0.0005 if unit == MM else 0.005) * (1 + 1e-9)
    assert scans[0].stamp.mid_ns == -TURN_NS


@pytest.mark.parametrize("learned_from", ["configuration", "status"])
def test_the_measuring_mode_is_learned_from_telegrams(learned_from: str) -> None:
    """F4h and B1h tell the width of a distance, so flags above it are no part of the range."""
    teaching = {
        "configuration": Configuration(RECORD).with_format(0x01, MM).serialise_read(),
        "status": DeviceStatus("V02.30", "00410123", 0x24, 0x01, 180, 100, 500000, MM).serialise(),
    }
    decoder = LmsStreamDecoder()

    scan = decoder.receive_data(answer(teaching[learned_from]) + ranges_telegram([0xE000 | 2623, 0x1FF7, 0x1FFF]))[0]

    assert scan.ranges_m[0] == 2.623
    assert scan.ranges_m[1] == np.inf
    assert np.isnan(scan.ranges_m[2])


def test_an_unknown_measuring_mode_never_turns_a_special_code_into_a_range() -> None:
    """Without F4h and B1h, a code that any width reserves is no distance; others are what they say."""
    decoder = LmsStreamDecoder()

    assert decoder.receive_data(ranges_telegram([0x1FFF, 0x3FF7, 0x3FFD, 9000, 2623])) == []  # it waits for more
    scan = decoder.finish()[0]

    assert np.isnan(scan.ranges_m[:3]).all()
    assert scan.ranges_m[3:5].tolist() == [9.0, 2.623]
    assert decoder.counts["scans_of_inferred_width"] == 1


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize(("mode", "flag_bits"), [(0x00, 3), (0x01, 3), (0x03, 2), (0x04, 2), (0x05, 1), (0x06, 1)])
@pytest.mark.parametrize("nearest", [1500, 7000, 15000])
def test_flags_are_no_distance_whether_the_mode_is_told_or_not(
    mode: int, flag_bits: int, nearest: int, told: bool
) -> None:
    """A rough wall with reflectors and fields on some of its beams, far enough to use all distance bits."""
    rng = np.random.default_rng(9)
    bits = 16 - flag_bits
    distances = np.minimum(nearest + 30 * np.abs(np.arange(181) - 90) + rng.integers(0, 40, 181), (1 << bits) - 20)
    flags = rng.integers(0, 1 << flag_bits, 181) * (rng.random(181) < 0.3)
    decoder = LmsStreamDecoder(mode if told else None)

    scans = decoder.receive_data(ranges_telegram((distances | flags << bits).astype(np.uint16))) + decoder.finish()

    special = distances & 0x1FFF >= 0x1FF7 if not told else np.zeros(181, bool)
    assert scans[0].ranges_m[~special] == pytest.approx(distances[~special] / 1000)


def test_scans_wait_for_the_mode_only_so_long() -> None:
    """A recording without a word about its mode gives its first scans after 128 of them, not at its end."""
    decoder = LmsStreamDecoder()

    scans = [scan for k in range(130) for scan in decoder.receive_data(ranges_telegram([k]))]

    assert [scan.ranges_m[0] for scan in scans] == [k / 1000 for k in range(130)]


def test_all_variants_are_told_by_their_counts() -> None:
    """361 values are half degrees over 180 degrees, 401 quarter degrees over 100, 91 every second of 181."""
    decoder = LmsStreamDecoder(measuring_mode=0x06)

    for count, step_deg, first_deg in (
        (181, 1.0, -90),
        (361, 0.5, -90),
        (101, 1.0, -50),
        (201, 0.5, -50),
        (401, 0.25, -50),
        (51, 2.0, -50),
        (19, 10.0, -90),
        (21, 5.0, -50),
        (181, 1.0, -90),
        (91, 2.0, -90),
        (10, 20.0, -90),
    ):
        codes = np.full(count, 1000, np.uint16)
        scan = decoder.receive_data(answer(RangeTelegram(codes, MM, indices=(1, 2)).serialise()))[0]
        assert np.degrees(scan.angle_increment_rad) == pytest.approx(step_deg)
        assert np.degrees(scan.angle_min_rad) == pytest.approx(first_deg)
        assert len(scan.ranges_m) == len(scan.beam_offset_ns) == count


def codes_of(count: int) -> NDArray[np.uint16]:
    """Values that tell which is which."""
    return np.arange(1000, 1000 + count, dtype=np.uint16)


FORMS = {
    "mean": (RangeTelegram(codes_of(361), MM, command=MEAN, averaged=7), -90.0, 0.5),
    "sub-range": (RangeTelegram(codes_of(100), MM, command=SUB_RANGE, first=101), -40.0, 0.5),
    "sub-range with fields": (
        RangeTelegram(codes_of(10), CM, command=SUB_RANGE_FIELDS, first=181, rest=b"\x01\x00\x02\x00\x03"),
        0.0,
        0.5,
    ),
    "mean of a sub-range": (
        RangeTelegram(codes_of(41), MM, command=SUB_RANGE_MEAN, first=361 - 40, averaged=250),
        70.0,
        0.5,
    ),
    "partial scan": (RangeTelegram(codes_of(180), MM, partial=True, quarter=3), -89.25, 1.0),
    "sub-range of a partial scan": (
        RangeTelegram(codes_of(20), MM, partial=True, quarter=2, command=SUB_RANGE, first=81),
        -9.5,
        1.0,
    ),
    "ten centimetres": (RangeTelegram(codes_of(361), TEN_CM), -90.0, 0.5),
    "LMS Fast with reflectivity": (
        RangeTelegram(codes_of(181), CM, command=FAST_REFLECTIVITY, rest=bytes.fromhex("0300 0100 0300 0A0B0C")),
        -45.0,
        0.5,
    ),
}


@pytest.mark.parametrize(("telegram", "first_deg", "step_deg"), FORMS.values(), ids=FORMS)
@pytest.mark.parametrize("indices", [None, (250, 7)])
def test_every_form_becomes_a_scan_with_its_angles(
    telegram: RangeTelegram, first_deg: float, step_deg: float, indices: tuple[int, int] | None
) -> None:
    """Means, sub-ranges, partial scans, 10 cm units and the LMS Fast, with and without indices."""
    decoder = LmsStreamDecoder(measuring_mode=0x06)
    decoder.receive_data(answer(Variant(180, 50).serialise_answer(True)))

    scan = decoder.receive_data(answer(replace(telegram, indices=indices).serialise()))[0]

    steps = {CM: 100, MM: 1000, TEN_CM: 10}[telegram.unit]
    assert scan.ranges_m == pytest.approx(telegram.codes / steps)
    assert np.degrees(scan.angle_min_rad) == pytest.approx(first_deg)
    assert np.degrees(scan.angle_increment_rad) == pytest.approx(step_deg)
    assert len(scan.beam_offset_ns) == len(telegram.codes)


@pytest.mark.parametrize("indices", [None, (250, 7)])
def test_ranges_with_reflectivity_give_a_scan_for_each_sub_range(indices: tuple[int, int] | None) -> None:
    """F5 holds up to five sub-ranges of pairs; energies are not taken for distances."""
    parts = [
        RangeTelegram(codes_of(n), MM, indices=indices, command=REFLECTIVITY, first=first)
        for n, first in ((10, 1), (100, 51), (61, 301))
    ]
    payload = serialise_reflectivity(parts, [np.full(len(part.codes), 0x7FFF, np.uint16) for part in parts])
    decoder = LmsStreamDecoder(measuring_mode=0x0F, variant=Variant(180, 50))

    scans = decoder.receive_data(answer(payload))

    assert [np.degrees(scan.angle_min_rad) for scan in scans] == pytest.approx([-90.0, -65.0, 60.0])
    for scan, part in zip(scans, parts, strict=True):
        assert scan.ranges_m == pytest.approx(part.codes / 1000)


def test_a_mean_is_as_old_as_all_of_its_scans() -> None:
    """Its stamp reaches back to the first of the scans that it averages."""
    decoder = LmsStreamDecoder(measuring_mode=0x06)

    scan = decoder.receive_data(answer(RangeTelegram(codes_of(361), MM, command=MEAN, averaged=10).serialise()))[0]

    assert (scan.stamp.earliest_ns, scan.stamp.latest_ns) == (-20 * TURN_NS, -2 * TURN_NS)


@pytest.mark.parametrize(
    ("teaching", "first_deg"),
    [
        (DeviceType("LMS221;302063;V02.30 ").serialise(0x90), -90 + 50.0),
        (DeviceType("LMS211;302063;V02.30 ").serialise(0x90), -50 + 50.0),
        (DeviceType("LMS291;S14;V02.30    ").serialise(0xBA), -45 + 50.0),
        (RangeTelegram(codes_of(401), MM).serialise(), -50 + 25.0),
        (DeviceStatus("V02.30", "00410123", 0x24, 0x06, 180, 100, 500000, MM).serialise(), -90 + 100.0),
    ],
)
def test_sub_ranges_are_placed_by_what_the_scanner_said(teaching: bytes, first_deg: float) -> None:
    """Power-on string, type, whole scan or status tell where value 101 points."""
    decoder = LmsStreamDecoder(measuring_mode=0x06)
    decoder.receive_data(answer(teaching))

    scan = decoder.receive_data(answer(RangeTelegram(codes_of(50), MM, command=SUB_RANGE, first=101).serialise()))[0]

    assert np.degrees(scan.angle_min_rad) == pytest.approx(first_deg)


def test_a_status_of_unknown_layout_teaches_nothing() -> None:
    """Where angle and resolution of B1h make no sense, its measuring mode is not believed either."""
    decoder = LmsStreamDecoder()
    status = bytearray(DeviceStatus("V02.30", "00410123", 0x24, 0x3F, 180, 100, 500000, MM).serialise())
    status[107:109] = b"\x00\x10"

    scans = decoder.receive_data(answer(bytes(status)) + ranges_telegram([])) + decoder.finish()

    assert len(scans) == 1


def test_a_sub_range_waits_to_be_placed() -> None:
    """What the scanner says of itself behind its first sub-ranges places these too, and their order is kept."""
    decoder = LmsStreamDecoder(measuring_mode=0x06)
    sub_ranges = [answer(RangeTelegram(codes_of(n), MM, command=SUB_RANGE, first=11).serialise()) for n in (5, 6)]

    assert decoder.receive_data(b"".join(sub_ranges)) == []
    scans = decoder.receive_data(answer(Variant(100, 25).serialise_answer(True)))

    assert [len(scan.ranges_m) for scan in scans] == [5, 6]
    assert np.degrees(scans[0].angle_min_rad) == pytest.approx(-47.5)


@pytest.mark.parametrize("flagged", [False, True])
def test_partial_scans_are_read_in_either_coding(flagged: bool) -> None:
    """As configured with flags, or "immediate" and wide: the values tell; what both codings share comes out at once."""
    rng = np.random.default_rng(10)
    distances = 6000 + np.cumsum(rng.integers(-20, 60, 180))
    flags = rng.integers(0, 8, 180) << 13 if flagged else np.zeros(180, np.int64)
    decoder = LmsStreamDecoder(measuring_mode=0x01)
    wall = np.minimum(distances, 8100) if flagged else distances

    def send(codes: NDArray[np.int64]) -> Scan:
        telegram = RangeTelegram(codes.astype(np.uint16), MM, partial=True, quarter=1)
        return decoder.receive_data(answer(telegram.serialise()))[0]

    near = send(np.full(180, 2623))
    scan = send(wall | flags)

    assert near.ranges_m.tolist() == [2.623] * 180
    usable = ~np.isnan(scan.ranges_m)
    assert usable.all() or (~flagged and usable.sum() > 60)
    assert scan.ranges_m[usable] == pytest.approx(wall[usable] / 1000)


def test_lost_and_repeated_telegrams_are_counted_by_their_indices() -> None:
    """Indices rise by one, modulo 256; a restarted scanner begins anew."""
    decoder = LmsStreamDecoder(measuring_mode=0x06)

    def send(*indices: int) -> None:
        for index in indices:
            decoder.receive_data(answer(RangeTelegram(codes_of(181), MM, indices=(0, index)).serialise()))

    send(253, 254, 1, 2, 2, 3)
    decoder.receive_data(answer(DeviceType("LMS221;302063;V02.30 ").serialise(0x90)))
    send(100, 101)

    assert decoder.counts["lost_telegrams"] == 2
    assert decoder.counts["repeated_telegrams"] == 1


def test_what_cannot_be_placed_is_counted_not_guessed() -> None:
    """Unknown units, counts of no variant, sub-ranges of unknown scans and energies give no scan, and say why."""
    undecodable = {
        "undecoded_count": RangeTelegram(codes_of(179), MM),
        "undecoded_unit": RangeTelegram(codes_of(181), 3),
        "undecoded_sub_range": RangeTelegram(codes_of(50), MM, command=SUB_RANGE, first=1),
        "undecoded_energies": RangeTelegram(codes_of(181), MM),
        "undecoded_measuring_mode": RangeTelegram(codes_of(181), MM),
    }
    for reason, telegram in undecodable.items():
        decoder = LmsStreamDecoder({"undecoded_energies": 0x3F, "undecoded_measuring_mode": 0x07}.get(reason, 0x06))
        assert decoder.receive_data(answer(telegram.serialise())) + decoder.finish() == []
        assert decoder.counts["undecoded_scans"] == decoder.counts[reason] == 1
        assert decoder.counts["scans"] == 0


def test_garbage_never_raises() -> None:
    """100 kB of noise give no scan; the first good one behind it comes out."""
    decoder = LmsStreamDecoder()
    rng = np.random.default_rng(7)

    for size in rng.integers(1, 2000, 100):
        assert decoder.receive_data(rng.bytes(int(size))) == []

    assert len(decoder.receive_data(ranges_telegram([])) + decoder.finish()) == 1


@pytest.mark.parametrize("fault", ["flip", "burst", "truncate", "drop", "insert", "false header", "wrong length"])
def test_no_fault_costs_an_intact_frame_or_makes_a_false_one(fault: str) -> None:
    """With every fifth frame damaged, each intact frame comes out, and nothing else does."""
    rng = np.random.default_rng(8)
    stream = b""
    intact = []
    for _ in range(2000):
        frame = answer(RangeTelegram(rng.integers(0, 0x10000, 181).astype(np.uint16), MM).serialise())
        if rng.random() >= 0.2:
            intact.append(frame)
            stream += frame
            continue
        bad = bytearray(frame)
        at = int(rng.integers(0, len(frame) - 8))
        match fault:
            case "flip":
                bad[at] ^= 1 << int(rng.integers(8))
            case "burst":
                bad[at : at + 8] = rng.bytes(8)
            case "truncate":
                del bad[at:]
            case "drop":
                del bad[at : at + int(rng.integers(1, 8))]
            case "insert":
                bad[at:at] = rng.bytes(int(rng.integers(1, 8)))
            case "false header":
                bad[0:0] = b"\x02\x80\x6e\x01\xb0\xb5\x40"
                intact.append(frame)
            case "wrong length":
                bad[2:4] = rng.bytes(2)
        stream += bad
    reader = FrameReader(Counter())
    reader.scan_headers = frozenset({(366, 0x40B5)})

    found = [
        answer(frame.payload)
        for at in range(0, len(stream), 100)
        for frame in reader.receive_data(stream[at : at + 100], at)
    ]

    assert found == intact
