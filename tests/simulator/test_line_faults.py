"""The injector of line faults: what it says has arrived whole has, what it says has not has not."""

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.gps_nmea.codec import serialise as sentence
from drivers.imu.codec import serialise as packet
from drivers.imu.messages import highres_imu
from drivers.sick_lms.telegrams import Command, request
from drivers.track_encoders.codec import serialise_slcan
from simulator.emulators.track_encoders import tracks_frame
from simulator.line_faults import KINDS, LINES, Damaged, Fault, LineFaults, damage

FRAMES = {
    "lms": [request(bytes((Command.SCAN, i % 250, 2, i % 7))) for i in range(200)],
    "encoders": [serialise_slcan(tracks_frame(i, 3 * i)) for i in range(200)],
    "imu": [packet(highres_imu(i % 256, 5000 * i, 0, gyro_rps=(0.1, 0.2, i / 100))) for i in range(200)],
    "gps": [sentence(f"GPGSA,A,3,{i},,,,,,,,,,,,1.8,1.0,{i % 97}") for i in range(200)],
}
"""Frames of each wire, all different."""
CASES = [(name, kind) for name in LINES for kind in KINDS if (name, kind) != ("gps", "wrong-length")]


def occurrences(stream: bytes, frames: list[bytes]) -> list[int]:
    """How often each frame stands in the stream."""
    return [stream.count(frame) for frame in frames]


def struck(damaged: Damaged) -> int:
    """How many frames a fault struck."""
    return sum(arrival.fault is not None for arrival in damaged.arrivals)


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_what_is_said_to_arrive_whole_does_and_nothing_else(name: str, kind: str) -> None:
    """The frames are looked for in the damaged stream itself, for many seeds."""
    frames = FRAMES[name]
    for seed in range(12):
        damaged = damage(frames, LINES[name], [Fault(kind, 0.5)], seed)
        stream = b"".join(damaged.chunks)
        assert [arrival.copies for arrival in damaged.arrivals] == occurrences(stream, frames)
        assert struck(damaged) > 20


@pytest.mark.parametrize("name", LINES)
def test_faults_may_be_mixed(name: str) -> None:
    """Each strikes about as often as was asked for, and the truth stays exact."""
    kinds = [kind for kind in KINDS if (name, kind) != ("gps", "wrong-length")]
    frames = FRAMES[name]
    seen: Counter[str | None] = Counter()
    for seed in range(20):
        damaged = damage(frames, LINES[name], [Fault(kind, 0.05) for kind in kinds], seed)
        seen.update(arrival.fault for arrival in damaged.arrivals)
        assert [a.copies for a in damaged.arrivals] == occurrences(b"".join(damaged.chunks), frames)
    assert set(seen) == {None, *kinds}
    assert all(0.02 < seen[kind] / 4000 < 0.12 for kind in kinds)


def test_without_a_fault_the_stream_is_as_sent() -> None:
    """A frame a read; splitting and merging change only the reads."""
    frames = FRAMES["imu"]
    assert damage(frames, LINES["imu"], []).chunks == frames
    for kind in ("split", "merged"):
        damaged = damage(frames, LINES["imu"], [Fault(kind, 1.0)])
        assert b"".join(damaged.chunks) == b"".join(frames)
        assert damaged.chunks != frames
        assert damaged.intact(frames) == frames


def test_split_writes_pass_through_every_offset() -> None:
    """Each inner byte of a frame is once the first of a read."""
    frame = FRAMES["imu"][5]
    damaged = damage([frame] * len(frame), LINES["imu"], [Fault("split", 1.0)])
    assert {len(arrival.chunks[0]) for arrival in damaged.arrivals} == set(range(1, len(frame)))


def test_silence_lasts_and_takes_its_share() -> None:
    """25 frames at least without a byte; at a rate of one nothing ever comes."""
    frames = FRAMES["gps"] * 50
    damaged = damage(frames, LINES["gps"], [Fault("silence", 0.2)])
    quiet = [arrival.copies == 0 for arrival in damaged.arrivals]
    assert 0.1 < sum(quiet) / len(quiet) < 0.3
    runs = "".join("q" if each else " " for each in quiet).split()
    assert min(map(len, runs[:-1])) >= 25
    assert b"".join(damage(frames, LINES["gps"], [Fault("silence", 1.0)]).chunks) == b""


@pytest.mark.parametrize("name", LINES)
@given(cuts=st.lists(st.integers(1, 60), min_size=1, max_size=20))
@settings(max_examples=20)
def test_a_devices_stream_is_cut_into_its_frames(name: str, cuts: list[int]) -> None:
    """However the emulator hands its bytes out."""
    frames, stream, rest = list[bytes](), b"".join(FRAMES[name][:40]), b""
    while stream:
        size = cuts[len(frames) % len(cuts)]
        whole, rest = LINES[name].cut(rest + stream[:size])
        frames += whole
        stream = stream[size:]
    assert frames == FRAMES[name][:40]
    assert rest == b""


def test_the_same_seed_strikes_alike() -> None:
    """And another one differently."""
    frames, faults = FRAMES["lms"], [Fault("burst"), Fault("garbage")]
    assert damage(frames, LINES["lms"], faults, 7) == damage(frames, LINES["lms"], faults, 7)
    assert damage(frames, LINES["lms"], faults, 7) != damage(frames, LINES["lms"], faults, 8)


def test_a_scanners_single_bytes_are_never_damaged() -> None:
    """ACK is a frame of its own, and too short to strike."""
    assert LINES["lms"].cut(b"\x06\x15" + FRAMES["lms"][0])[0] == [b"\x06", b"\x15", FRAMES["lms"][0]]
    assert damage([b"\x06"] * 50, LINES["lms"], [Fault("burst", 1.0)]).chunks == [b"\x06"] * 50


@pytest.mark.parametrize("text", ["garbage", "garbage:0.05", "wrong-length:1"])
def test_faults_are_written_as_words(text: str) -> None:
    """KIND or KIND:RATE."""
    kind, _, rate = text.partition(":")
    assert Fault.parse(text) == Fault(kind, float(rate or 0.2))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("noise", "there are garbage, bit-flip"),
        ("garbage:much", "KIND:RATE"),
        ("garbage:2", "at most 1"),
        ("", "there"),
    ],
)
def test_what_is_no_fault_is_refused_in_words(text: str, told: str) -> None:
    """With what may be written instead."""
    with pytest.raises(ValueError, match=told):
        Fault.parse(text)


def test_impossible_combinations_are_refused() -> None:
    """More than every frame, or a length field where there is none."""
    with pytest.raises(ValueError, match="more than 1"):
        LineFaults(LINES["imu"], [Fault("garbage", 0.6), Fault("burst", 0.6)])
    with pytest.raises(ValueError, match="no length field"):
        LineFaults(LINES["gps"], [Fault("wrong-length")])
