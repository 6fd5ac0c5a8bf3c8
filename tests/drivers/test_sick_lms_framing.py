"""Frames out of dirty streams."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.sick_lms.framing import Frame, FrameReader
from drivers.sick_lms.measurements import CM, MM
from drivers.sick_lms.range_telegrams import (
    AVERAGED,
    FAST_REFLECTIVITY,
    MEAN,
    PLACED,
    REFLECTIVITY,
    SUB_RANGE,
    SUB_RANGE_FIELDS,
    SUB_RANGE_MEAN,
    RangeTelegram,
    parse_ranges,
    serialise_reflectivity,
)
from drivers.sick_lms.telegrams import (
    ACK,
    LONGEST_REFLECTIVITY,
    NAK,
    OVERHEAD,
    RANGES,
    Command,
    Configuration,
    DeviceStatus,
    DeviceType,
    Variant,
    answer,
    checksum,
)

RECORD = bytes.fromhex("0000 7000 00 00 01 0000 02 02") + bytes(21) + b"\x02\x00"
DIRT = bytes((ACK, NAK, 0x02, 0x02, 0x80, 0x02, 0x80, 0xFF, 0x00, 0x11))


def codes(seed: int, count: int) -> NDArray[np.uint16]:
    """Any values, flags included."""
    return np.random.default_rng(seed).integers(0, 0x10000, count).astype(np.uint16)


def scan_payload(seed: int, count: int = 181) -> bytes:
    """A range telegram with any codes."""
    return RangeTelegram(codes(seed, count), MM).serialise()


PAYLOADS = {
    "power on": DeviceType("LMS221;302063;V02.30 ").serialise(0x90),
    "resetting": b"\x91\x10",
    "refused": b"\x92\x10",
    "mode": b"\xa0\x00\x10",
    "scan": scan_payload(1),
    "fine scan": scan_payload(2, 401),
    "status": DeviceStatus("V02.30", "00410123", 0x25, 0, 180, 100, 500000, MM).serialise(),
    "type": DeviceType("LMS221;302063;V02.30 ").serialise(0xBA, 0x11),
    "variant": Variant(180, 100).serialise_answer(True),
    "configuration": Configuration(RECORD).serialise_read(),
    "old configuration": Configuration(RECORD[:30]).serialise_read(),
    "written": Configuration(RECORD).serialise_written(True),
    "no errors": b"\xb2\x10",
    "errors": b"\xb2\x84\x16\x84\x31\x01\x31\x10",
    "counters": bytes.fromhex("B5 00 00 01 00 10"),
    "power-on rate": b"\xe6\x00\x10",
    "configuration part 2": b"\xfb" + bytes(84) + b"\x10",
    "indexed scan": RangeTelegram(codes(3, 361), MM, indices=(2, 0x80)).serialise(),
    "partial scan": RangeTelegram(codes(4, 180), CM, partial=True, quarter=3).serialise(),
    "mean": RangeTelegram(codes(5, 361), MM, command=MEAN, averaged=2).serialise(),
    "sub-range": RangeTelegram(codes(6, 100), MM, command=SUB_RANGE, first=101).serialise(),
    "partial sub-range": RangeTelegram(codes(7, 100), MM, True, 1, command=SUB_RANGE, first=81).serialise(),
    "fields": RangeTelegram(codes(8, 50), MM, command=SUB_RANGE_FIELDS, rest=b"\x02\x80\x02").serialise(),
    "mean of a sub-range": RangeTelegram(codes(9, 50), MM, command=SUB_RANGE_MEAN, averaged=250).serialise(),
    "fast": RangeTelegram(
        codes(10, 181), CM, command=FAST_REFLECTIVITY, rest=b"\x02\x00\x01\x00\x02\x00\x80\x02"
    ).serialise(),
    "reflectivity": serialise_reflectivity(
        [RangeTelegram(codes(k, 80), MM, command=REFLECTIVITY, first=80 * k + 1) for k in range(5)],
        [codes(20 + k, 80) for k in range(5)],
    ),
}
MANUAL = [
    "02 80 03 00 A0 00 10 16 0A",
    "02 80 02 00 91 10 79 30",
    "02 80 02 00 92 10 7F 33",
    "02 80 02 00 B2 10 3F 13",
    "02 80 06 00 B5 00 00 01 00 10 04 42",
    "02 80 07 00 BB 01 B4 00 32 00 10 03 9D",
    "02 80 17 00 BA" + b"LMS200;301063;V02.10 ".hex() + "10 22 61",
    "02 80 17 00 90" + b"LMS200;301063;V02.10 ".hex() + "10 63 5E",
    "02 80 25 00 F7 01" + RECORD.hex() + "10 C5 7A",
    "02 80 24 00 F4" + RECORD.hex() + "10 3C FB",
]


def payloads(frames: Sequence[Frame]) -> list[bytes]:
    """What the frames carry."""
    return [frame.payload for frame in frames]


def read(chunks: Sequence[bytes]) -> tuple[list[bytes], Counter[str]]:
    """Payloads found in `chunks` and then silence, and what was counted."""
    counts: Counter[str] = Counter()
    reader = FrameReader(counts)
    found = [payload for chunk in chunks for payload in payloads(reader.receive_data(chunk, 0))]
    return found + payloads(reader.release()), counts


@pytest.mark.parametrize("payload", PAYLOADS.values(), ids=PAYLOADS.keys())
@pytest.mark.parametrize("bytewise", [False, True])
@pytest.mark.parametrize("before", [b"", DIRT])
@pytest.mark.parametrize("behind", [b"", DIRT])
def test_a_telegram_is_found_however_it_comes(payload: bytes, bytewise: bool, before: bytes, behind: bytes) -> None:
    """Every telegram, whole or byte by byte, between clean or dirty neighbours, comes out once and unchanged."""
    data = before + answer(payload) + behind
    chunks = [data[i : i + 1] for i in range(len(data))] if bytewise else [data]

    assert read(chunks)[0] == [payload]


@pytest.mark.parametrize("payload", PAYLOADS.values(), ids=PAYLOADS.keys())
def test_a_telegram_may_be_split_anywhere(payload: bytes) -> None:
    """Two reads, cut at every byte in its turn, with dirt before and behind."""
    data = DIRT + answer(payload) + DIRT

    for cut in range(1, len(data)):
        assert read([data[:cut], data[cut:]])[0] == [payload]


@pytest.mark.parametrize("vector", MANUAL)
def test_the_manuals_answers_are_frames(vector: str) -> None:
    """Every answer that the manual prints rightly is understood, and one that differs in a bit is not."""
    frame = bytes.fromhex(vector)

    assert read([frame])[0] == [frame[4:-2]]
    for bit in range(8 * len(frame)):
        wrong = bytearray(frame)
        wrong[bit // 8] ^= 1 << bit % 8
        assert read([bytes(wrong)])[0] == []


@given(
    kind=st.sampled_from([RANGES, MEAN, SUB_RANGE, SUB_RANGE_FIELDS, SUB_RANGE_MEAN, FAST_REFLECTIVITY]),
    values=st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=200),
    unit=st.integers(0, 3),
    quarter=st.integers(0, 3),
    first=st.integers(1, 200),
    averaged=st.integers(2, 250),
    indices=st.none() | st.tuples(st.integers(0, 255), st.integers(0, 255)),
    rest=st.binary(max_size=40),
)
def test_every_kind_of_range_telegram_round_trips(
    kind: int,
    values: list[int],
    unit: int,
    quarter: int,
    first: int,
    averaged: int,
    indices: tuple[int, int] | None,
    rest: bytes,
) -> None:
    """What a scanner puts into bytes is what comes out of the reader and the parser."""
    match kind:
        case Command.SUB_RANGE_FIELDS.answer:
            indices = None  # nothing tells them from field values
        case Command.FAST_REFLECTIVITY.answer:
            rest = len(rest).to_bytes(2, "little") + b"\1\0\1\0" + rest
        case _:
            rest = b""
    sent = RangeTelegram(
        np.array(values, np.uint16),
        unit,
        partial=quarter > 0,
        quarter=quarter,
        indices=indices,
        command=kind,
        first=first if kind in PLACED else 1,
        averaged=averaged if kind in AVERAGED else 1,
        rest=rest,
    )

    (payload,), _ = read([answer(sent.serialise())])
    (got,) = parse_ranges(payload)

    assert got.codes.tolist() == values
    for name in ("unit", "partial", "quarter", "indices", "status", "command", "first", "last", "averaged", "rest"):
        assert getattr(got, name) == getattr(sent, name)


@given(seed=st.integers(0, 2**32 - 1), cuts=st.lists(st.integers(0, 3000), max_size=20))
def test_random_garbage_between_frames_loses_none(seed: int, cuts: list[int]) -> None:
    """All intact frames come out, in order, whatever lies between them and however the reads cut the stream."""
    rng = np.random.default_rng(seed)
    sent = [scan_payload(int(s), int(n)) for s, n in zip(rng.integers(0, 99, 4), rng.integers(1, 402, 4), strict=True)]
    garbage = [
        rng.choice([0x02, 0x80, 0xB0, 0x06, 0x00, 0x6E, 0x01], int(n)).astype(np.uint8).tobytes()
        for n in (9, 50, 3, 40)
    ]
    data = b"".join(g + answer(p) for g, p in zip(garbage, sent, strict=True))
    edges = [0, *sorted(min(c, len(data)) for c in cuts), len(data)]

    found, _ = read([data[a:b] for a, b in pairwise(edges)])

    assert found == sent


@pytest.mark.parametrize("cut", [5, 8, 100, 371])
def test_a_cut_frame_takes_no_other_with_it(cut: int) -> None:
    """The tail of a cut frame is the next frame's head; that one comes out all the same."""
    first, second = answer(scan_payload(1)), answer(scan_payload(2))

    found, counts = read([first[:cut] + second])

    assert found == [scan_payload(2)]
    assert counts["skipped_bytes"] == cut


def test_a_false_header_holds_a_complete_frame_only_until_the_line_is_silent() -> None:
    """A believable header that waits for 802 bytes gives up the frame inside it as soon as no more bytes come."""
    reader = FrameReader(Counter())

    assert reader.receive_data(answer(scan_payload(2, 401))[:9], 0) == []
    assert reader.receive_data(answer(PAYLOADS["mode"]), 0) == []
    assert reader.holds_frames
    assert payloads(reader.release()) == [PAYLOADS["mode"]]
    assert not reader.holds_frames


def test_a_false_header_over_several_frames_loses_none() -> None:
    """All frames inside the length that a false header claims come out once that length has come."""
    sent = [PAYLOADS[name] for name in ("mode", "variant", "status", "type", "configuration", "errors", "scan")]
    reader = FrameReader(Counter())

    found = reader.receive_data(answer(scan_payload(2, 401))[:7] + b"".join(map(answer, sent)), 0)
    assert not found
    found = reader.receive_data(answer(PAYLOADS["status"]) * 2, 0)

    assert payloads(found) == [*sent, PAYLOADS["status"], PAYLOADS["status"]]


def test_a_cut_frame_that_passes_the_checksum_by_chance_costs_no_intact_one() -> None:
    """Head of one scan, whole next scan, and the checksum of the mixture happens to be right: the whole one is real."""
    middle = bytearray(scan_payload(2))
    middle[265:268] = 0x10, 0x34, 0x12  # where the cut scan has its status byte and checksum
    head = bytearray(answer(scan_payload(0))[:100])
    head[11], head[19] = 201, 176  # searched for
    mixture = bytes(head) + answer(bytes(middle))[:272]
    assert checksum(mixture[:-2]) == int.from_bytes(mixture[-2:], "little")
    data = bytes(head) + answer(bytes(middle)) + answer(scan_payload(3))

    for size in (1, 50, 372, 2000):
        found, counts = read([data[at : at + size] for at in range(0, len(data), size)])
        assert found == [bytes(middle), scan_payload(3)]
        assert counts["overlapping_frames"] == 1


@pytest.mark.parametrize("name", ["mode", "refused", "power on", "configuration", "status"])
@pytest.mark.parametrize("followed", [False, True])
def test_a_scan_whose_values_spell_a_whole_telegram_is_one_scan(name: str, followed: bool) -> None:
    """A telegram inside the data of another is data, also if bytes come one by one and nothing comes behind."""
    inner = answer(PAYLOADS[name])
    payload = bytearray(scan_payload(4))
    payload[21 : 21 + len(inner)] = inner
    outer = bytes(payload)
    data = answer(outer) + (answer(scan_payload(5)) if followed else b"")

    for size in (1, 64, 2000):
        found, counts = read([data[at : at + size] for at in range(0, len(data), size)])
        assert found == [outer] + [scan_payload(5)] * followed
        assert counts["overlapping_frames"] == 1


def test_headers_inside_values_start_no_frames() -> None:
    """A scan whose values spell headers is one frame."""
    values = np.full(181, 0x8002, np.uint16)
    values[1::2] = 0x0002
    values[90:94] = (0x8002, 0x016E, 0xB5B0, 0x4000)
    payload = RangeTelegram(values, MM).serialise()

    for chunk in (1, 7, 400):
        data = answer(payload) + answer(PAYLOADS["mode"])
        found, counts = read([data[i : i + chunk] for i in range(0, len(data), chunk)])
        assert found == [payload, PAYLOADS["mode"]]
        assert counts["skipped_bytes"] == 0


def test_each_frame_keeps_the_stamp_of_the_read_with_its_first_byte() -> None:
    """Reads hold ends and beginnings of frames; the STX decides."""
    reader = FrameReader(Counter())
    first, second = answer(PAYLOADS["status"]), answer(PAYLOADS["mode"])

    assert reader.receive_data(b"\x00\x02" + first[:1], 10) == []
    assert reader.receive_data(first[1:50], 20) == []
    frames = reader.receive_data(first[50:] + second[:3], 30)
    frames += reader.receive_data(second[3:] + second, 40)

    assert [frame.stamp_ns for frame in frames] == [10, 30, 40]


def test_an_error_that_a_check_can_tell_is_never_accepted() -> None:
    """Single wrong bits, and errors that the checksum cannot see but the header or the settings contradict."""
    counts: Counter[str] = Counter()
    good = answer(scan_payload(1))
    for bit in range(8 * len(good)):
        wrong = bytearray(good)
        wrong[bit // 8] ^= 1 << bit % 8
        reader = FrameReader(counts)
        assert reader.receive_data(bytes(wrong), 0) == []
    # Bit k of a byte with bit k + 1 of the next is invisible to the checksum.
    for byte in (1, 2, 3, 4, 5):
        for bit in range(7):
            wrong = bytearray(good)
            wrong[byte] ^= 1 << bit
            wrong[byte + 1] ^= 2 << bit
            reader = FrameReader(counts)
            reader.scan_headers = frozenset({(366, 0x40B5)})
            assert reader.receive_data(bytes(wrong), 0) == []


def test_a_foreign_source_is_refused_once_ours_is_known() -> None:
    """The status byte's source bits never change."""
    counts: Counter[str] = Counter()
    reader = FrameReader(counts)
    reader.source = 0x10

    assert reader.receive_data(answer(b"\xa0\x00\x18"), 0) == []
    assert payloads(reader.receive_data(answer(b"\xa0\x00\xe1") + answer(b"\xa0\x00\x71"), 0)) == [b"\xa0\x00\x71"]
    assert counts["bad_status"] == 2


@pytest.mark.parametrize("byte", [ACK, NAK])
def test_acknowledgements_are_believed_only_where_one_is_due(byte: int) -> None:
    """The first byte outside a frame after a request is its ACK or NAK; any other 06 or 15 is dirt."""
    counts: Counter[str] = Counter()
    reader = FrameReader(counts)

    reader.receive_data(bytes((byte,)), 0)
    assert reader.take_acknowledgement() is None
    reader.expect_acknowledgement()
    reader.receive_data(answer(PAYLOADS["scan"]) + bytes((byte, byte)), 0)

    assert reader.take_acknowledgement() == byte
    assert reader.take_acknowledgement() is None
    assert counts["skipped_bytes"] == 2


def test_garbage_costs_bounded_memory_and_never_raises() -> None:
    """100 kB of noise, and as much of the most believable noise, leave less than one frame in the buffer."""
    rng = np.random.default_rng(3)
    noise = rng.integers(0, 256, 100_000, dtype=np.uint8).tobytes()
    headers = answer(scan_payload(1, 401))[:7] * 15_000
    counts: Counter[str] = Counter()
    reader = FrameReader(counts)

    for data in (noise, headers):
        for at in range(0, len(data), 997):
            assert reader.receive_data(data[at : at + 997], at) == []
            assert len(reader._buffer) <= LONGEST_REFLECTIVITY + OVERHEAD
            assert len(reader._reads) <= LONGEST_REFLECTIVITY + OVERHEAD

    assert payloads(reader.receive_data(answer(PAYLOADS["mode"]), 0) + reader.release()) == [PAYLOADS["mode"]]
    assert counts["skipped_bytes"] == len(noise) + len(headers)
