"""Track counters over CAN: every intact frame is delivered, everything else is counted."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.config import EncodersConfig
from drivers.errors import ConfigurationError
from drivers.samples import Stamp, WheelTicks
from drivers.track_encoders.codec import (
    CanFrame,
    LoggedFrame,
    pack_can_frame,
    parse_candump_line,
    parse_slcan,
    serialise_candump_line,
    serialise_slcan,
    unpack_can_frame,
)
from drivers.track_encoders.counters import Unwrapped, find_counter
from drivers.track_encoders.protocol import TrackEncoderProtocol
from simulator.emulators.track_encoders import TrackEncodersEmulator, tracks_frame

TRACKS = (Path(__file__).resolve().parents[2] / "docs" / "config" / "tracks.dbc").read_text()
TWO_MESSAGES = """VERSION ""
BU_: U
BO_ 16 L: 8 U
 SG_ COUNT : 7|32@0- (0.001,0) [0|0] "m" U
BO_ 2147483665 R: 8 U
 SG_ PART M : 0|8@1+ (1,0) [0|0] "" U
 SG_ COUNT m2 : 8|24@1+ (1,0) [0|0] "" U
 SG_ SPEED m1 : 8|24@1+ (1,0) [0|0] "" U
"""
MS = 1_000_000

frames = st.builds(
    lambda extended, can_id, remote, data: CanFrame(
        can_id if extended else can_id & 0x7FF, b"" if remote else data, len(data), extended, remote
    ),
    st.booleans(),
    st.integers(0, 0x1FFF_FFFF),
    st.booleans(),
    st.binary(max_size=8),
)


def config(**changes: object) -> EncodersConfig:
    """Encoders of the emulated robot."""
    settings = {
        "port": "can",
        "dbc": "tracks.dbc",
        "left": "TRACKS.LEFT",
        "right": "TRACKS.RIGHT",
        "left_metres_per_tick": 1e-4,
        "right_metres_per_tick": 1e-4,
        "latency_ms": (1.0, 4.0),
    }
    return EncodersConfig(**(settings | changes))  # type: ignore[arg-type]


def protocol(**changes: object) -> TrackEncoderProtocol:
    """The host's end."""
    return TrackEncoderProtocol(config(**changes), TRACKS)


def load_dbc(text: str) -> Any:
    """The oracle: cantools' own reading of a DBC."""
    return cantools.database.load_string(text, database_format="dbc")


def line(left: int, right: int) -> bytes:
    """One frame of both counters on an slcan line."""
    return serialise_slcan(tracks_frame(left, right))


def counts_of(samples: list[WheelTicks]) -> list[tuple[int, int]]:
    """Left and right of each sample."""
    return [(s.left, s.right) for s in samples]


@given(frames)
def test_a_frame_survives_each_way_of_writing_it(frame: CanFrame) -> None:
    """slcan text, struct can_frame and candump line: parse undoes serialise."""
    assert parse_slcan(serialise_slcan(frame)[:-1]) == frame
    assert unpack_can_frame(pack_can_frame(frame)) == frame
    logged = LoggedFrame(1_627_276_799_721_150_000, "can0", frame)
    assert parse_candump_line(serialise_candump_line(logged)) == logged


@pytest.mark.parametrize(
    "text", ["t1234AABB", "t123", "t1239AABBCCDDEEFF001122", "t8000", "T200000000", "t12 2AABB", "tXYZ0", "t1231A", "x"]
)
def test_a_line_that_holds_no_whole_frame_is_refused(text: str) -> None:
    """Above all a length that doesn't match the data."""
    assert parse_slcan(text.encode()) is None


def test_an_adapters_time_stamp_is_no_data() -> None:
    """Four more digits are the adapter's milliseconds."""
    assert parse_slcan(b"t1232AABB1F00") == CanFrame(0x123, b"\xaa\xbb")


def test_the_host_opens_the_adapter_and_ticks_flow() -> None:
    """Mouth to mouth: nothing before the opening, every frame after it, wrapped counters unwrapped."""
    device = TrackEncodersEmulator(lambda t: (65_530 + t / MS, -t / MS / 2), period_ns=10 * MS)
    host = protocol()
    assert device.data_to_send(25 * MS) == b""
    host.connection_made(25 * MS)
    device.receive_data(host.data_to_send(), 25 * MS)
    samples = []
    for t in range(30, 100, 5):
        samples += host.receive_data(device.data_to_send(t * MS), t * MS)
    assert host.counts["opened"] == 1
    assert host.counts["refused_commands"] == 0
    start = samples[0]
    assert [(s.left - start.left, s.right - start.right) for s in samples] == [(10 * i, -5 * i) for i in range(7)]
    assert samples[0].stamp == Stamp(26 * MS, 29 * MS)
    assert {s.epoch for s in samples} == {0}


def test_a_wrong_bit_rate_does_not_go_unnoticed() -> None:
    """An adapter that answers with a bell is counted, and opened again after a second of silence."""
    host = protocol()
    host.connection_made(0)
    assert host.data_to_send() == b"C\rS6\rO\r"
    host.receive_data(b"\a\a\a", MS)
    assert host.counts["refused_commands"] == 2
    assert host.deadline_ns == 1000 * MS
    host.advance(999 * MS)
    assert host.data_to_send() == b""
    host.advance(1000 * MS)
    assert host.data_to_send() == b"C\rS6\rO\r"


def test_an_adapter_refuses_what_it_cannot_do() -> None:
    """The emulator answers as adapters do."""
    device = TrackEncodersEmulator(lambda t: (0.0, 0.0), period_ns=10**15)
    answers = []
    for command in (b"O", b"C", b"S9", b"S6", b"O", b"O", b"S4", b"V", b"F", b"t1230", b"t1234", b"C"):
        device.receive_data(command + b"\r", 1)
        answers.append(device.data_to_send(1))
    assert answers == [
        b"\a",
        b"\a",
        b"\a",
        b"\r",
        b"\r",
        b"\a",
        b"\a",
        b"V1013\r",
        b"F00\r",
        b"z\r",
        b"\a",
        b"\r",
    ]


STREAM = b"".join(line(100 * i, 7 * i) for i in range(20))


@given(st.lists(st.integers(0, len(STREAM)), max_size=20))
def test_splits_do_not_matter(cuts: list[int]) -> None:
    """Whole, byte by byte or cut anywhere: the same ticks."""
    edges = [0, *sorted(cuts), len(STREAM)]
    host = protocol()
    samples = [s for a, b in pairwise(edges) for s in host.receive_data(STREAM[a:b], 0)]
    assert counts_of(samples) == [(100 * i, 7 * i) for i in range(20)]


def test_a_frame_is_stamped_by_the_read_of_its_first_byte() -> None:
    """Dirt that came before it, or the rest that came after, doesn't move the stamp."""
    host = protocol()
    host.receive_data(b"\xff\xff", 10 * MS)
    host.receive_data(line(1, 1)[:5], 20 * MS)
    samples = host.receive_data(line(1, 1)[5:], 30 * MS)
    assert [s.stamp for s in samples] == [Stamp(16 * MS, 19 * MS)]


@given(st.binary(max_size=60).filter(lambda dirt: not set(dirt) & set(b"tTrR")))
def test_dirt_before_and_behind_costs_no_intact_frame(dirt: bytes) -> None:
    """Whatever stands between the frames, each of them is delivered."""
    host = protocol()
    samples = host.receive_data(dirt + line(5, 6) + dirt + line(7, 8) + dirt + b"\r", 0)
    assert counts_of(samples) == [(5, 6), (7, 8)]


@given(st.binary(max_size=300))
def test_garbage_never_raises(data: bytes) -> None:
    """Not in text, nor in records."""
    for interface in ("slcan", "socketcan"):
        host = protocol(interface=interface)
        host.receive_data(data, 0)
        host.receive_data(data, 1)
        assert host.data_to_send() is not None


def test_a_truncated_frame_is_counted_not_read() -> None:
    """Four bytes announced, two there."""
    host = protocol()
    assert host.receive_data(b"t1814AABB\r", 0) == []
    assert host.counts["bad_frames"] == 1
    assert host.receive_data(b"t1812AABB\r", 0) == []
    assert host.counts["bad_length"] == 1


def test_records_of_the_kernel_carry_the_same_ticks() -> None:
    """SocketCAN: error frames and foreign messages are counted, the rest is read."""
    host = protocol(interface="socketcan")
    assert host.baud is None
    assert host.data_to_send() == b""
    records = [tracks_frame(1, 2), CanFrame(0x40, bytes(8), error=True), CanFrame(5, b"x"), tracks_frame(3, 4)]
    samples = host.receive_data(b"".join(map(pack_can_frame, records)) + b"dirt", 0)
    assert counts_of(samples) == [(1, 2), (3, 4)]
    assert host.counts["error_frames"] == host.counts["other_frames"] == 1
    assert host.counts["skipped_bytes"] == 4


@given(st.sampled_from([8, 16, 24, 32]), st.lists(st.floats(-0.49, 0.49), max_size=30))
def test_unwrapping_loses_no_tick(bits: int, steps: list[float]) -> None:
    """Any motion of less than half the range between two readings comes out exactly."""
    counter, true = Unwrapped(bits), (1 << bits) - 3
    counter.advance(true)
    for step in steps:
        change = int(step * (1 << bits))
        true += change
        assert counter.advance(true % (1 << bits)) == change
    assert counter.total == true


def test_left_and_right_in_two_messages_are_paired_by_arrival() -> None:
    """A sample comes when both were seen anew; its stamp covers both; foreign multiplexed parts are skipped."""
    host = TrackEncoderProtocol(config(left="L.COUNT", right="R.COUNT"), TWO_MESSAGES)
    left = serialise_slcan(CanFrame(16, bytes.fromhex("FFFFFFFE00000000")))
    speed, right = (
        serialise_slcan(CanFrame(17, bytes.fromhex(h + "00" * 4), extended=True)) for h in ("01050000", "02060000")
    )
    assert host.receive_data(left, 10 * MS) == []
    assert host.receive_data(speed, 11 * MS) == []
    assert host.receive_data(right, 12 * MS) == [WheelTicks(Stamp(6 * MS, 11 * MS), 0xFFFF_FFFE, 6)]
    left = serialise_slcan(CanFrame(16, bytes.fromhex("0000000200000000")))
    assert host.receive_data(right, 13 * MS) == []
    (sample,) = host.receive_data(left, 14 * MS)
    assert sample.left == 0x1_0000_0002


@pytest.mark.parametrize("order", ["little_endian", "big_endian"])
def test_a_signals_place_agrees_with_cantools(order: str) -> None:
    """Both byte orders, every length and start that fit."""
    for bits in (5, 8, 13, 16, 32):
        for start in range(0, 64, 3):
            text = (
                f'VERSION ""\nBU_: U\nBO_ 1 M: 8 U\n SG_ S : {start}|{bits}@{int(order[0] == "l")}+ (1,0) [0|0] "" U\n'
            )
            try:
                message = load_dbc(text).get_message_by_name("M")
            except cantools.database.errors.Error:
                continue  # doesn't fit into the message
            counter = find_counter(text, "M.S")
            data = bytes.fromhex("0123456789ABCDEF")
            assert counter.field(data) == message.decode(data)["S"]


def test_a_new_epoch_begins_where_counts_may_not_be_subtracted() -> None:
    """A long gap, a restarted unit and a reopened port: nobody subtracts across them."""
    host = protocol()
    epochs = [s.epoch for s in host.receive_data(line(30_000, 30_000), 0)]
    epochs += [s.epoch for s in host.receive_data(line(30_010, 30_010), 10 * MS)]
    epochs += [s.epoch for s in host.receive_data(line(0, 0), 20 * MS)]
    epochs += [s.epoch for s in host.receive_data(line(5, 5), 30 * MS)]
    epochs += [s.epoch for s in host.receive_data(line(9, 9), 2000 * MS)]
    host.connection_made(2005 * MS)
    epochs += [s.epoch for s in host.receive_data(line(9, 9), 2010 * MS)]
    assert epochs == [0, 0, 1, 1, 2, 3]


@pytest.mark.parametrize(
    ("name", "text"), [("TRACK.LEFT", "TRACKS"), ("TRACKS.L", "LEFT, RIGHT"), ("TRACKS", "LEFT, RIGHT"), ("", "TRACKS")]
)
def test_a_counter_that_the_dbc_lacks_is_named_with_the_choice(name: str, text: str) -> None:
    """The message says what there is."""
    with pytest.raises(ConfigurationError, match=text):
        protocol(left=name)


def test_a_file_that_is_no_dbc_is_refused() -> None:
    """Garbage in place of the DBC is the owner's mistake, said so."""
    with pytest.raises(ConfigurationError, match="DBC"):
        TrackEncoderProtocol(config(), "hello {")


def test_a_real_drive_is_read_frame_by_frame(recordings: Path) -> None:
    """5477 frames over 44.592 s, the same ones that python-can reads."""
    path = recordings / "can" / "css_canmod_drive_60FEB5A8.candump.log"
    logged = [parse_candump_line(text) for text in path.read_text().splitlines()]
    assert len(logged) == 5477
    whole = [entry for entry in logged if entry is not None]
    assert len(whole) == 5477
    assert round((whole[-1].stamp_ns - whole[0].stamp_ns) / 1e9, 3) == 44.592
    theirs = list(can.CanutilsLogReader(path))
    assert [(m.arbitration_id, bytes(m.data), m.is_extended_id) for m in theirs] == [
        (e.frame.can_id, e.frame.data, e.frame.extended) for e in whole
    ]


def test_a_real_trip_counter_runs_through_the_protocol(recordings: Path) -> None:
    """Two signals of the recorded unit, read as counters, give the same numbers as cantools."""
    folder = recordings / "can"
    dbc = (folder / "css_canmod-gps.dbc").read_text()
    message = next(m for m in load_dbc(dbc).messages if any("rip" in s.name for s in m.signals))
    signal = next(s for s in message.signals if "rip" in s.name)
    name = f"{message.name}.{signal.name}"
    host = TrackEncoderProtocol(config(left=name, right=name), dbc)
    totals, expected = [], []
    for text in (folder / "css_canmod_drive_60FEB5A8.candump.log").read_text().splitlines():
        entry = parse_candump_line(text)
        assert entry is not None
        totals += [s.left for s in host.receive_frame(entry.frame, entry.stamp_ns)]
        if entry.frame.can_id == message.frame_id:
            expected.append(message.decode(entry.frame.data, scaling=False)[signal.name])
    assert totals == expected
    assert totals[-1] > totals[0]
