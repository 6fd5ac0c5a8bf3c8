"""The inertial board's packets: every intact frame is delivered, in base_link, and dirt costs nothing else."""

import struct
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from math import inf, isnan, nan
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.config import ImuConfig
from drivers.imu.codec import MavlinkFrame, MavlinkStream, build, serialise, x25
from drivers.imu.messages import attitude, highres_imu
from drivers.imu.protocol import ImuProtocol
from drivers.samples import InertialSample, Stamp
from simulator.emulators.imu import ImuEmulator

MS = 1_000_000


def protocol() -> ImuProtocol:
    """The host's end."""
    return ImuProtocol(
        ImuConfig(
            port="imu",
            latency_ms=(1.0, 4.0),
            clock_drift_ppm=50,
            gyro_bias_bound_dps=0.5,
            gyro_bias_drift_dps2=0.001,
            gyro_noise_bound_dps=0.1,
            gyro_scale_bound=0.005,
            tilt_bound_deg=1.0,
            accel_bound_mps2=0.5,
        )
    )


def board(**settings: int) -> ImuEmulator:
    """A board whose readings tell when they were taken."""
    return ImuEmulator(
        lambda t0, t1: (t0 / 1e9, t1 / 1e9, 0.5),
        lambda t, sensor: (t / 1e9, float(sensor)),
        lambda t: (t / 1e9, -t / 2e9),
        **settings,
    )


def same(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    """Equal to float32's precision, NaN where NaN."""
    return all((isnan(x) and isnan(y)) or x == pytest.approx(y, rel=1e-6) for x, y in zip(a, b, strict=True))


def test_checksum_is_the_standards() -> None:
    """X.25 of the digits 1 to 9, as used by MAVLink (without the final inversion)."""
    assert x25(b"123456789") == 0x6F91


def test_frames_are_those_of_pymavlink() -> None:
    """Byte for byte, versions 1 and 2."""
    theirs = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    theirs.seq = 7
    message = theirs.attitude_encode(1234, 0.1, -0.2, 0.3, 0.0, 0.0, 0.0)
    fields: dict[str, Any] = {"time_boot_ms": 1234, "roll": 0.1, "pitch": -0.2, "yaw": 0.3}
    assert serialise(build("ATTITUDE", sequence=7, **fields)) == message.pack(theirs)
    assert serialise(build("ATTITUDE", sequence=7, version=1, **fields)) == message.pack(theirs, force_mavlink1=True)


def test_readings_arrive_in_base_link_mouth_to_mouth() -> None:
    """What the world gave the board comes out of the protocol: axes, signs, identifiers, times and stamps."""
    device, host = board(latency_ns=2 * MS), protocol()
    samples: list[InertialSample] = []
    for t in range(30):
        samples += host.receive_data(device.data_to_send(t * MS), t * MS)
    gyro = [s for s in samples if s.sensor_id == 0 and s.message == "HIGHRES_IMU"]
    assert len(gyro) == 5
    assert same(gyro[1].gyro_rps, (0.005, 0.010, 0.5))
    assert all(map(isnan, gyro[1].accel_mps2 + gyro[1].tilt_rad))
    assert gyro[1].device_time_us == 10_000
    assert gyro[1].stamp == Stamp(8 * MS, 11 * MS)
    accel = [s for s in samples if s.sensor_id == 2]
    assert len(accel) == 3
    assert same(accel[2].accel_mps2, (0.020, 2.0, nan))
    tilt = [s for s in samples if s.message == "ATTITUDE"]
    assert same(tilt[2].tilt_rad, (0.020, -0.010))
    assert host.counts["lost"] == host.counts["skipped_bytes"] == 0
    assert host.counts["samples"] == len(samples) == 14


def test_pitch_is_positive_nose_down_and_gravity_points_up() -> None:
    """MAVLink says nose up and z down; a level robot at rest feels +9.81 along our z."""
    host = protocol()
    level = build("SCALED_IMU", xacc=100, yacc=200, zacc=-1000, xgyro=1, ygyro=2, zgyro=3)
    nose_up = build("ATTITUDE", sequence=1, roll=0.1, pitch=0.2, yaw=nan)
    rest, tilt = host.receive_data(serialise(level) + serialise(nose_up), 0)
    assert same(rest.accel_mps2, (0.980665, -1.96133, 9.80665))
    assert same(rest.gyro_rps, (0.001, -0.002, -0.003))
    assert same(tilt.tilt_rad, (0.1, -0.2))


STREAM = b"".join(serialise(highres_imu(i, 5000 * i, 0, gyro_rps=(0.0, 0.1, i / 100))) for i in range(15))


@given(st.lists(st.integers(0, len(STREAM)), max_size=20))
def test_splits_do_not_matter(cuts: list[int]) -> None:
    """Whole, byte by byte or cut anywhere: the same samples."""
    edges = [0, *sorted(cuts), len(STREAM)]
    host = protocol()
    samples = [s for a, b in pairwise(edges) for s in host.receive_data(STREAM[a:b], 0)]
    assert [s.device_time_us for s in samples] == [5000 * i for i in range(15)]


def test_byte_by_byte_each_frame_is_stamped_by_its_first_byte() -> None:
    """The read of the first byte stamps the frame, even one held back behind a stray beginning."""
    host = protocol()
    stray = serialise(build("ATTITUDE"))[:10]  # a whole header, so that only the checksum tells
    samples: list[InertialSample] = []
    for t, byte in enumerate(stray + STREAM):
        samples += host.receive_data(bytes((byte,)), t * MS)
    size = len(STREAM) // 15
    starts = [(len(stray) + i * size) * MS for i in range(15)]
    assert [s.stamp.latest_ns + MS for s in samples] == starts


def dirty(magic: bytes) -> Iterator[bytes]:
    """Stray bytes of every kind before a frame."""
    yield magic
    yield magic * 3
    yield magic + b"\x05\x00"
    yield serialise(attitude(0, 1, 0.1, 0.2))[:-1]
    yield serialise(attitude(0, 1, 0.1, 0.2))[:9]
    yield bytes(300)


@pytest.mark.parametrize("dirt", [*dirty(b"\xfd"), *dirty(b"\xfe"), b"$GPGGA,hello\r\n"])
def test_stray_bytes_swallow_no_frame(dirt: bytes) -> None:
    """All intact frames behind, between and before dirt are delivered as soon as they are whole."""
    frames = [serialise(highres_imu(i, i, 0, gyro_rps=(0.0, 0.0, 1.0))) for i in range(12)]
    host = protocol()
    samples = host.receive_data(b"".join(dirt + frame for frame in frames) + dirt, 0)
    samples += host.receive_data(b"".join(frames), 0)
    assert len(samples) == 24


@given(st.binary(max_size=600))
def test_garbage_never_raises(data: bytes) -> None:
    """And no sample comes out of it."""
    host = protocol()
    assert host.receive_data(data, 0) == []
    assert host.receive_data(b"\xfd" + data, 1) == []


@given(st.integers(0, len(STREAM) // 15 * 8 - 1))
def test_a_flipped_bit_costs_its_frame_and_no_other(bit: int) -> None:
    """Fourteen of fifteen frames come out right."""
    frame = len(STREAM) // 15
    bad = bytearray(STREAM)
    bad[7 * frame + bit // 8] ^= 1 << bit % 8
    host = protocol()
    samples = host.receive_data(bytes(bad), 0)
    assert [s.device_time_us for s in samples] == [5000 * i for i in range(15) if i != 7]
    assert host.counts["lost"] == 1


def test_signed_and_version_1_frames_are_read() -> None:
    """A signature is skipped; version 1 carries the same fields."""
    plain = serialise(build("RAW_IMU", xacc=5, time_usec=9))
    signed = bytearray(plain)
    signed[2] = 1
    crc = x25(bytes(signed[1:-2]) + bytes((144,)))
    signed[-2:] = struct.pack("<H", crc)
    first = serialise(build("RAW_IMU", sequence=1, xacc=5, time_usec=9, version=1))
    host = protocol()
    samples = host.receive_data(bytes(signed) + bytes(13) + first, 0)
    assert [s.accel_mps2[0] for s in samples] == [5 * 9.80665e-3] * 2
    assert host.counts["skipped_bytes"] == 0


@pytest.mark.parametrize(
    ("frame", "count"),
    [
        (highres_imu(0, 1, 0, gyro_rps=(0.0, inf, 0.0)), "not_finite"),
        (build("ATTITUDE", roll=nan), "not_finite"),
        (highres_imu(0, 1, 0, accel_mps2=(1e30, nan, nan)), "out_of_range"),
        (build("ATTITUDE", roll=4.0), "out_of_range"),
        (highres_imu(0, 1, 0), "nothing_new"),
        (build("SCALED_IMU2", time_boot_ms=5), "dead"),
        (build("HEARTBEAT"), "other_messages"),
    ],
)
def test_unusable_readings_are_counted_not_delivered(frame: MavlinkFrame, count: str) -> None:
    """Intact on the wire, but no measurement."""
    host = protocol()
    assert host.receive_data(serialise(frame), 0) == []
    assert host.counts[count] == 1


def test_nan_in_an_axis_that_claims_to_be_new_is_refused() -> None:
    """Only the axes named by fields_updated count, and these must be numbers."""
    host = protocol()
    bad = build("HIGHRES_IMU", fields_updated=0b111000, xgyro=nan)
    good = build("HIGHRES_IMU", sequence=1, fields_updated=0b100000, xgyro=nan, zgyro=0.5)
    (sample,) = host.receive_data(serialise(bad) + serialise(good), 0)
    assert same(sample.gyro_rps, (nan, nan, -0.5))
    assert host.counts["not_finite"] == 1


def test_lost_packets_are_counted_by_their_numbers() -> None:
    """Across the wrap of the sequence number too."""
    host = protocol()
    for sequence in (250, 251, 254, 255, 0, 0, 3):
        host.receive_data(serialise(highres_imu(sequence, 1, 0, gyro_rps=(0.0, 0.0, 1.0))), 0)
    assert (host.counts["lost"], host.counts["repeated"]) == (4, 1)


def test_a_reboot_of_the_board_begins_a_new_epoch() -> None:
    """Once, for all of its sensors; and so does reopening the port, or a clock that runs away."""
    device, host = board(), protocol()
    epochs = [s.epoch for s in host.receive_data(device.data_to_send(1000 * MS), 1000 * MS)]
    device.reboot(1001 * MS)
    epochs += [s.epoch for s in host.receive_data(device.data_to_send(1100 * MS), 1100 * MS)]
    assert (epochs.count(0), epochs.count(1)) == (len(epochs) - 50, 50)
    assert host.counts["reboots"] == 1
    host.connection_made(1200 * MS)
    assert {s.epoch for s in host.receive_data(device.data_to_send(1200 * MS), 1200 * MS)} == {2}
    late = serialise(highres_imu(0, 10_000_000, 0, gyro_rps=(0.0, 0.0, 1.0)))
    assert [s.epoch for s in host.receive_data(late, 1205 * MS)] == [3]


def test_a_reboot_after_a_short_life_is_seen_too() -> None:
    """The board's clock went back by less than the second that may pass unnoticed."""
    device, host = board(), protocol()
    host.receive_data(device.data_to_send(50 * MS), 50 * MS)
    device.reboot(51 * MS)
    assert {s.epoch for s in host.receive_data(device.data_to_send(70 * MS), 70 * MS)} == {1}
    assert host.counts["reboots"] == 1


def test_another_component_with_its_own_clock_is_left_out() -> None:
    """Samples of two clocks are never mixed."""
    host = protocol()
    frames = [build("RAW_IMU", system=1, component=c, xacc=1, time_usec=t) for c, t in ((1, 500), (2, 3), (1, 600))]
    samples = host.receive_data(b"".join(map(serialise, frames)), 0)
    assert [s.device_time_us for s in samples] == [500, 600]
    assert host.counts["other_source"] == 1
    assert host.counts["reboots"] == 0


def test_a_real_vehicles_stream_is_read_whole(recordings: Path) -> None:
    """35912 frames, in reads of any size; the sums of RAW_IMU; the dead SCALED_IMU2 left out."""
    data = (recordings / "mavlink" / "sub_small.serial.bin").read_bytes()
    stream = MavlinkStream(Counter())
    frames = [f for i in range(0, len(data), 977) for f, _ in stream.receive(data[i : i + 977], i)]
    assert len(frames) == 35912
    names = Counter(f.message for f in frames)
    assert (names["ATTITUDE"], names["RAW_IMU"]) == (5245, 528)
    raw = [f.fields() for f in frames if f.message == "RAW_IMU"]
    sums = {name: sum(r[name] for r in raw) for name in ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro")}
    assert sums == {"xacc": 17303, "yacc": 12991, "zacc": -527492, "xgyro": 2606, "ygyro": 1119, "zgyro": -103}
    host = protocol()
    seen = Counter(s.message for s in host.receive_data(data, 0))
    assert seen == {"ATTITUDE": 5245, "RAW_IMU": 528}
    assert host.counts["dead"] == names["SCALED_IMU2"] == 528
    assert host.counts["skipped_bytes"] == host.counts["bad_crc"] == 0
