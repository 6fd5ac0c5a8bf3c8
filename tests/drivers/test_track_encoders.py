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
from drivers.track_encoders.adapter import AdapterIdentity
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
from drivers.track_encoders.counters import find_counter
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
ODD = (
    TWO_MESSAGES
    + """BO_ 18 X: 8 U
 SG_ NOTHING : 0|8@1+ (1,0) [0|0] "" U
"""
)
ODD = ODD.replace(
    ' SG_ COUNT : 7|32@0- (0.001,0) [0|0] "m" U',
    """ SG_ COUNT : 0|16@1+ (1,0) [0|0] "" U
 SG_ SPEED : 16|8@1+ (1,0) [0|0] "km/h" U
 SG_ ODD : 16|8@1- (0.5,0.3) [0|0] "" U
 SG_ WIDE : 24|40@1+ (1,0) [0|0] "" U""",
)
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
        device.receive_data(host.data_to_send(), t * MS)
    assert (host.counts["opened"], host.state) == (1, "open")
    assert host.identity == AdapterIdentity("1013", "A123")
    assert host.counts["refused_commands"] == 0
    start = samples[0]
    assert [(s.left - start.left, s.right - start.right) for s in samples] == [(10 * i, -5 * i) for i in range(5)]
    assert samples[0].stamp == Stamp(46 * MS, 49 * MS)
    assert {s.epoch for s in samples} == {0}


STREAM = b"".join(line(100 * i, 7 * i) for i in range(20))


@given(st.lists(st.integers(0, len(STREAM)), max_size=20))
def test_splits_do_not_matter(cuts: list[int]) -> None:
    """Whole, byte by byte or cut anywhere: the same ticks."""
    edges = [0, *sorted(cuts), len(STREAM)]
    host = protocol()
    samples = [s for a, b in pairwise(edges) for s in host.receive_data(STREAM[a:b], 0)]
    assert counts_of(samples) == [(100 * i, 7 * i) for i in range(20)]


KINDS_OF_LINES = [
    b"t1814AABBCCDD\r",
    b"T000001814AABBCCDD\r",
    b"r1814\r",
    b"R000001814\r",
    b"t1814AABBCCDD1F00\r",
    b"t1814aabbccdd0001F00A\r",
]


@pytest.mark.parametrize("text", KINDS_OF_LINES)
@pytest.mark.parametrize("dirt", [b"", b"\x00\xff", b"t181", b"T1FFF\xfe", b"t1814AABB\r\a"])
def test_every_kind_of_line_is_read_cut_anywhere_with_dirt_around(text: bytes, dirt: bytes) -> None:
    """Whole, cut at every byte, behind dirt and before it: the frame is there, once."""
    for cut in range(len(text) + 1):
        host = protocol()
        host.receive_data(dirt + text[:cut], 0)
        host.receive_data(text[cut:] + dirt + b"\r", 0)
        assert host.counts["frames"] == 1
        assert host.counts["ticks"] == text.startswith(b"t")
        assert host.counts["remote_frames"] == (text[:1] in b"rR")


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
    told = []
    for t, count in ((0, 30_000), (10, 30_010), (20, 0), (30, 5), (40, 9), (2000, 12)):
        told += [(s.left, s.epoch) for s in host.receive_data(line(count, count), t * MS)]
    host.connection_made(2005 * MS)
    told += [(s.left, s.epoch) for s in host.receive_data(line(15, 15), 2010 * MS)]
    assert told == [(30_000, 0), (30_010, 0), (0, 1), (5, 1), (9, 1), (12, 2), (15, 3)]
    assert (host.counts["restarts"], host.counts["gaps"]) == (1, 1)


INCREMENTS = """VERSION ""
BU_: U
BO_ 16 M: 4 U
 SG_ L : 7|16@0- (0.5,0) [0|0] "ticks" U
 SG_ R : 16|16@1+ (1,-32768) [0|0] "ticks" U
"""


def test_increments_are_summed_with_their_sign_and_offset() -> None:
    """Two's complement on one side, an offset on the other; a lost message begins a new epoch."""
    host = TrackEncoderProtocol(
        config(left="M.L", right="M.R", counting="incremental", least_period_ms=8.0), INCREMENTS, max_track_mps=1.0
    )

    def message(left: int, right: int) -> bytes:
        return serialise_slcan(
            CanFrame(16, left.to_bytes(2, "big", signed=True) + (right + 32768).to_bytes(2, "little"))
        )

    told = []
    for t, left, right in ((0, 5, 7), (10, -3, 8), (20, -1, -9), (20, -1, -9), (30, 4, 1), (50, 1, 1), (60, 2, 3)):
        told += [(s.left, s.right, s.epoch) for s in host.receive_data(message(left, right), t * MS)]
    assert told == [(5, 7, 0), (2, 15, 0), (1, 6, 0), (5, 7, 0), (6, 8, 1), (8, 11, 1)]
    assert (host.counts["duplicate"], host.counts["lost"]) == (2, 2)  # in either track


def test_a_late_read_hides_how_long_ago_a_count_was() -> None:
    """What lay in the port for 90 ms may be older than a restart takes: from there a new epoch begins."""
    told = []
    for late_ms in (0, 70, 98):
        host = TrackEncoderProtocol(config(), TRACKS, max_track_mps=1.0)
        host.read_late(late_ms * MS)
        told += [s.epoch for s in host.receive_data(line(5, 5), 0)]
        told += [s.epoch for s in host.receive_data(line(6, 6), 10 * MS)]
    assert told == [0, 0, 0, 0, 0, 1]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"counting": "incremental"}, "least_period_ms"),
        ({"counting": "incremental", "least_period_ms": 3.0}, "latency_ms"),
        ({"left": "L.COUNT", "right": "R.COUNT"}, "quantisation_ticks: 1 is too small"),
        ({"left": "L.SPEED"}, "is a speed"),
        ({"left": "L.WIDE"}, "40 bits"),
        ({"left": "L.ODD", "counting": "incremental", "least_period_ms": 9.0}, "no whole number of steps"),
    ],
)
def test_a_declaration_that_cannot_be_kept_is_refused(changes: dict[str, object], text: str) -> None:
    """The message names the key, and says what would do."""
    with pytest.raises(ConfigurationError, match=text):
        TrackEncoderProtocol(config(**{"left": "L.COUNT", "right": "L.COUNT", **changes}), ODD, max_track_mps=1.0)


def test_left_and_right_too_far_apart_are_no_pair() -> None:
    """One of the two messages was lost: the other waits for none that comes a cycle later."""
    host = TrackEncoderProtocol(config(left="L.COUNT", right="R.COUNT"), TWO_MESSAGES)
    left, right = CanFrame(16, bytes(8)), CanFrame(17, b"\x02" + bytes(7), extended=True)
    told = []
    for frame, t in ((left, 0), (right, 1), (right, 11), (left, 20), (right, 21), (left, 30), (right, 31)):
        told += [s.stamp.latest_ns // MS for s in host.receive_frame(frame, t * MS)]
    assert told == [0, 20, 30]
    assert host.counts["unpaired"] == 1


@pytest.mark.parametrize("speed", [1.0, None])
def test_a_false_count_is_kept_back(speed: float | None) -> None:
    """A flipped digit that no track could have run is never delivered, and costs no epoch."""
    host = TrackEncoderProtocol(config(), TRACKS, speed)
    samples = []
    for i in range(20):
        samples += host.receive_data(line(100 * i, 50 * i + (0x6000 if i == 7 else 0)), 10 * i * MS)
    assert counts_of(samples) == [(100 * i, 50 * i) for i in range(20) if i != 7]
    assert {s.epoch for s in samples} == {0}
    assert host.counts["jumps"] == 1


def test_bus_errors_are_told_as_what_they_are() -> None:
    """Error frames by their class: bus-off stands in the state until the bus is heard again."""
    host = protocol(interface="socketcan")
    host.receive_frame(CanFrame(0x04, bytes(8), error=True), 0)
    assert host.state == ""
    host.receive_frame(CanFrame(0x40, bytes(8), error=True), 1)
    assert "bus-off" in host.state
    host.receive_frame(CanFrame(0x100, bytes(8), error=True), 2)
    assert host.state == ""
    assert [host.counts[name] for name in ("error_frames", "bus_off", "bus_restarts")] == [3, 1, 1]


def test_frames_of_can_fd_are_told_apart_from_dirt() -> None:
    """Not read, but known."""
    host = protocol()
    assert host.receive_data(b"d1819" + b"00" * 12 + b"\rB00000181F" + b"00" * 64 + b"\r" + line(1, 2), 0)
    assert (host.counts["fd_frames"], host.counts["bad_frames"], host.counts["skipped_bytes"]) == (2, 0, 0)


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
