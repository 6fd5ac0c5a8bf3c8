"""Scans from recorded bytes."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.sick_lms.framing import FrameReader
from drivers.sick_lms.measurements import CM, MM, TURN_NS, RangeTelegram, ValueFormat
from drivers.sick_lms.stream import LmsStreamDecoder
from drivers.sick_lms.telegrams import Configuration, DeviceStatus, Variant, answer

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

    scan = decoder.receive_data(ranges_telegram([0x1FFF, 0x3FF7, 0x3FFD, 9000, 2623]))[0]

    assert np.isnan(scan.ranges_m[:3]).all()
    assert scan.ranges_m[3:5].tolist() == [9.0, 2.623]
    assert decoder.counts["scans_of_inferred_width"] == 1


def test_all_variants_are_told_by_their_counts() -> None:
    """361 values are half degrees over 180 degrees, 401 quarter degrees over 100."""
    decoder = LmsStreamDecoder(measuring_mode=0x06)

    for count, step_deg, first_deg in (
        (181, 1.0, -90),
        (361, 0.5, -90),
        (101, 1.0, -50),
        (201, 0.5, -50),
        (401, 0.25, -50),
    ):
        codes = np.full(count, 1000, np.uint16)
        scan = decoder.receive_data(answer(RangeTelegram(codes, MM, indices=(1, 2)).serialise()))[0]
        assert np.degrees(scan.angle_increment_rad) == pytest.approx(step_deg)
        assert np.degrees(scan.angle_min_rad) == pytest.approx(first_deg)


def test_what_cannot_be_placed_is_counted_not_guessed() -> None:
    """Sub-ranges, 10 cm units, energies, doubtful partial scans and the LMS Fast give no scan."""
    codes = np.full(181, 1000, np.uint16)
    unsupported = [
        RangeTelegram(codes[:50], MM),
        RangeTelegram(codes, 2),
        RangeTelegram(codes[:180], MM),
        RangeTelegram(codes, MM, partial=True, quarter=1),
    ]
    decoder = LmsStreamDecoder(measuring_mode=0x06)
    for telegram in unsupported:
        assert decoder.receive_data(answer(telegram.serialise())) == []
    narrow = LmsStreamDecoder(measuring_mode=0x00)
    assert narrow.receive_data(answer(RangeTelegram(codes, MM, partial=True).serialise())) == []
    energy = LmsStreamDecoder()
    energy.receive_data(answer(Configuration(RECORD).with_format(0x3F, MM).serialise_read()))
    assert energy.receive_data(ranges_telegram([])) == []
    fast = LmsStreamDecoder(measuring_mode=0x06)
    fast.receive_data(answer(Variant(90, 50).serialise_answer(True)))
    assert fast.receive_data(ranges_telegram([])) == []

    assert decoder.counts["unsupported_scans"] == len(unsupported)
    assert all(d.counts["unsupported_scans"] == 1 and d.counts["scans"] == 0 for d in (narrow, energy, fast))


def test_garbage_never_raises() -> None:
    """100 kB of noise give no scan; the first good one behind it comes out."""
    decoder = LmsStreamDecoder()
    rng = np.random.default_rng(7)

    for size in rng.integers(1, 2000, 100):
        assert decoder.receive_data(rng.bytes(int(size))) == []

    assert len(decoder.receive_data(ranges_telegram([]))) == 1


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
