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
from drivers.imu.messages import attitude, dual_axis_acceleration, dual_axis_tilt, highres_imu
from drivers.imu.protocol import ImuProtocol
from drivers.samples import InertialSample, Stamp
from simulator.emulators.imu import ImuEmulator

MS = 1_000_000


def protocol(**declared: Any) -> ImuProtocol:
    """The host's end."""
    common: dict[str, Any] = {
        "port": "imu",
        "latency_ms": (1.0, 4.0),
        "clock_drift_ppm": 50,
        "gyro_bias_bound_dps": 0.5,
        "gyro_bias_drift_dps2": 0.001,
        "gyro_noise_bound_dps": 0.1,
        "gyro_scale_bound": 0.005,
        "tilt_bound_deg": 1.0,
        "accel_bound_mps2": 0.5,
    }
    return ImuProtocol(ImuConfig(**common | declared))


def board(**settings: Any) -> ImuEmulator:
    """A board whose readings tell when they were taken."""
    return ImuEmulator(
        lambda t0, t1: (t0 / 1e9, t1 / 1e9, 0.5),
        lambda t, sensor: (t / 1e9, float(sensor)),
        lambda t: (t / 1e9, -t / 2e9),
        **settings,
    )


def same(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    """Equal but for float32's precision and the last bit's jitter, NaN where NaN."""
    return all((isnan(x) and isnan(y)) or x == pytest.approx(y, rel=1e-6, abs=2e-6) for x, y in zip(a, b, strict=True))


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


def test_a_sample_tells_that_packets_were_lost_before_it() -> None:
    """Perhaps it was its own sensor's that got lost; a reading that was refused was one of its own surely."""
    host = protocol()

    def told(sequence: int, sensor: int, ahead: float = 0.1) -> list[bool]:
        frame = highres_imu(sequence, 1000 * sequence, sensor, accel_mps2=(ahead, 0.2, 0.3))
        return [sample.after_loss for sample in host.receive_data(serialise(frame), sequence * MS)]

    assert told(10, 1) == told(11, 2) == told(12, 1) == [False]
    assert told(15, 1) == [True]
    assert told(16, 1) == [False]
    assert told(17, 2) == [True]
    assert told(18, 2, ahead=inf) == []
    assert told(19, 1) == [False]
    assert told(20, 2) == [True]
    assert told(21, 2) == [False]


def test_losses_are_counted_for_each_source() -> None:
    """Every component of a vehicle counts its own frames."""
    host = protocol()
    for component, sequence in ((1, 5), (2, 9), (1, 8), (2, 10), (2, 12)):
        host.receive_data(serialise(build("HEARTBEAT", component=component, sequence=sequence)), 0)
    assert (host.counts["lost"], host.counts["lost_1_1"], host.counts["lost_1_2"]) == (3, 2, 1)


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
    """Samples of two clocks are never mixed; once the first is silent for a second, the other is listened to."""
    host = protocol()
    frames = [build("RAW_IMU", system=1, component=c, xacc=1, time_usec=t) for c, t in ((1, 500), (2, 3), (1, 600))]
    samples = host.receive_data(b"".join(map(serialise, frames)), 0)
    assert [s.device_time_us for s in samples] == [500, 600]
    assert host.counts["other_source"] == 1
    assert host.counts["reboots"] == 0
    (sample,) = host.receive_data(serialise(frames[1]), 1001 * MS)
    assert (sample.device_time_us, sample.epoch) == (3, 1)


def test_a_gimbal_that_speaks_first_is_not_the_robots_tilt_where_the_board_is_declared() -> None:
    """Whoever else speaks is told, with the keys to set; then never listened to, even if the board is silent."""
    gimbal, tilt = serialise(build("ATTITUDE", component=154, roll=0.7)), serialise(build("ATTITUDE", roll=0.1))
    host = protocol()
    assert not host.findings
    (wrong,) = host.receive_data(gimbal, 0)
    assert wrong.tilt_rad[0] == pytest.approx(0.7)
    assert host.receive_data(tilt, MS) == []
    (finding,) = host.findings
    assert "from system 1 component 1, too" in finding
    assert "devices.imu.system and .component" in finding
    host = protocol(system=1, component=1)
    assert host.receive_data(gimbal, 0) == []
    (sample,) = host.receive_data(tilt, MS)
    assert sample.tilt_rad[0] == pytest.approx(0.1)
    assert host.receive_data(gimbal, 10_000 * MS) == []
    assert host.counts["other_source"] == 2
    assert not host.findings


def test_a_message_with_a_clock_of_its_own_tells_no_device_time() -> None:
    """As where RAW_IMU carries calendar time and the rest counts since boot: one clock is the board's, the first."""
    host = protocol()
    samples: list[InertialSample] = []
    for i in range(20):
        inertial = highres_imu(2 * i, 5000 * i, 0, gyro_rps=(0.0, 0.1, i / 100))
        calendar = build("RAW_IMU", sequence=2 * i + 1, time_usec=1_700_000_000_000_000 + 5000 * i, xacc=i + 1)
        samples += host.receive_data(serialise(inertial) + serialise(calendar), 5 * MS * i)
    assert [s.device_time_us for s in samples if s.message == "HIGHRES_IMU"] == [5000 * i for i in range(20)]
    assert {s.device_time_us for s in samples if s.message == "RAW_IMU"} == {None}
    assert (host.counts["other_clock"], host.counts["reboots"]) == (20, 0)
    # The first falls silent: the other's clock is then the board's.
    (sample,) = host.receive_data(serialise(build("RAW_IMU", time_usec=1_700_000_009_000_000, xacc=1)), 9000 * MS)
    assert (sample.device_time_us, sample.epoch) == (1_700_000_009_000_000, 1)


def test_a_wrap_of_the_boards_milliseconds_is_no_reboot() -> None:
    """After 49.7 days the time goes on, also beside one in microseconds; a true reboot there is seen all the same."""
    host, wrap_ms = protocol(), 1 << 32
    times_ms = [wrap_ms - 20, wrap_ms - 10, wrap_ms, wrap_ms + 10]
    samples: list[InertialSample] = []
    for i, t in enumerate(times_ms):
        tilt = build("ATTITUDE", time_boot_ms=t % wrap_ms, roll=0.1 + i, sequence=2 * i)
        gyro = highres_imu(2 * i + 1, 1000 * t, 0, gyro_rps=(0.0, 0.1, 0.2 + i))
        samples += host.receive_data(serialise(tilt) + serialise(gyro), 10 * MS * i)
    assert [s.device_time_us for s in samples] == [1000 * t for t in times_ms for _ in range(2)]
    assert {s.epoch for s in samples} == {0}
    (again,) = host.receive_data(serialise(build("ATTITUDE", time_boot_ms=30, roll=0.5)), 3000 * MS)
    assert (again.device_time_us, again.epoch, host.counts["reboots"]) == (30_000, 1, 1)


def test_milliseconds_that_wrapped_before_we_listened_are_set_right_by_microseconds() -> None:
    """The first message counts 32 bits only; the next tells that they had wrapped: one new epoch, then one clock."""
    host, late_ms = protocol(), (1 << 32) + 777
    samples: list[InertialSample] = []
    for i in range(4):
        tilt = build("ATTITUDE", time_boot_ms=777 + 10 * i, roll=0.1 + i, sequence=2 * i)
        gyro = highres_imu(2 * i + 1, 1000 * (late_ms + 10 * i), 0, gyro_rps=(0.0, 0.1, 0.2 + i))
        samples += host.receive_data(serialise(tilt) + serialise(gyro), 10 * MS * i)
    assert [s.epoch for s in samples] == [0, 1, 1, 1, 1, 1, 1, 1]
    assert [s.device_time_us for s in samples[1:]] == [1000 * (late_ms + 10 * i) for i in range(4) for _ in range(2)][
        1:
    ]


def test_a_packet_that_was_held_up_is_placed_by_the_punctual_ones() -> None:
    """Its stamp ends where the quickest packet so far, and the clocks' drift, say that it surely was acquired."""
    host = protocol()  # latency 1 to 4 ms, 50 ppm
    arrivals_ms = [1.0, 103.5, 201.0, 304.0, 30_003.9]
    samples: list[InertialSample] = []
    for i, t in enumerate(arrivals_ms):
        device_us = (0, 100_000, 200_000, 300_000, 30_000_000)[i]
        packet = highres_imu(i, device_us, 0, gyro_rps=(0.0, 0.1, i / 100))
        samples += host.receive_data(serialise(packet), round(t * MS))
    ends_ms = [s.stamp.latest_ns / MS for s in samples]
    assert ends_ms == pytest.approx([0.0, 100.0, 200.0, 300.0, 30_000.0 + 1.5], abs=0.02)
    for i, sample in enumerate(samples):  # all were acquired at their device time
        true_ns = (0, 100, 200, 300, 30_000)[i] * MS
        assert sample.stamp.earliest_ns <= true_ns <= sample.stamp.latest_ns


@given(
    st.floats(-1.0, 1.0),
    st.lists(st.tuples(st.integers(0, 200_000_000), st.sampled_from([1.0, 2.5, 4.0])), min_size=1, max_size=40),
    st.booleans(),
)
def test_stamps_hold_the_acquisition_whatever_latencies_and_drift_do(
    drift: float, packets: list[tuple[int, float]], milliseconds: bool
) -> None:
    """Each packet between the least and the most latency, the board's clock anywhere inside its drift."""
    host = protocol()
    true_ns = 50 * MS
    for i, (pause_ns, latency_ms) in enumerate(packets):
        true_ns += pause_ns + 5 * MS
        device_us = int(true_ns * (1.0 + drift * 50e-6) / 1000)
        if milliseconds and i % 2:
            frame = attitude(i % 256, device_us // 1000, 0.1, i / 100)
        else:
            frame = highres_imu(i % 256, device_us, 0, gyro_rps=(0.0, 0.1, i / 100))
        (sample,) = host.receive_data(serialise(frame), true_ns + round(latency_ms * MS))
        assert sample.stamp.earliest_ns <= true_ns <= sample.stamp.latest_ns
        assert sample.epoch == 0


@pytest.mark.parametrize(("always_noisy", "used"), [(True, 20), (False, 119)])
def test_a_stuck_sensor_is_told_and_where_noise_is_declared_never_used(always_noisy: bool, used: int) -> None:
    """From its first repeated reading on: what a sensor says that lives is always new. The others go on."""
    device, host = board(), protocol(always_noisy=always_noisy)
    samples = host.receive_data(device.data_to_send(100 * MS), 100 * MS)
    device.stuck = True
    for t in range(105, 600, 5):
        samples += host.receive_data(device.data_to_send(t * MS), t * MS)
    gyro = [s for s in samples if (s.message, s.sensor_id) == ("HIGHRES_IMU", 0)]
    assert len(gyro) == used
    assert host.counts["stuck"] == 0
    for t in range(600, 700, 5):
        samples = host.receive_data(device.data_to_send(t * MS), t * MS)
        assert (samples == []) is always_noisy
    assert host.counts["stuck"] == 20 + 3 * 10
    assert host.identity is not None
    assert "HIGHRES_IMU 0 (stuck)" in host.identity.sensors
    device.stuck = False
    assert host.receive_data(device.data_to_send(700 * MS), 700 * MS)
    assert "HIGHRES_IMU 0 (stuck)" not in host.identity.sensors


@pytest.mark.parametrize(
    "frame",
    [
        dual_axis_acceleration(0, 5, 0, (0.5, 0.25), temperature_cdegc=5100),
        dual_axis_tilt(0, 5, 0, (0.5, 0.25), temperature_cdegc=-2100),
        build("RAW_IMU", xacc=100, temperature=5001),
        build("SCALED_IMU2", xacc=100, temperature=-2001),
        build("HIGHRES_IMU", fields_updated=0b1_0000_0000_0111, xacc=1.0, zacc=-9.8, temperature=55.0),
    ],
)
def test_beyond_the_declared_temperature_no_bound_is_claimed(frame: MavlinkFrame) -> None:
    """Where the owner declares a range and the packet tells; an owner who declares none gets the reading."""
    careful = protocol(temperature_range_degc=(-20.0, 50.0))
    assert careful.receive_data(serialise(frame), 0) == []
    assert careful.counts["out_of_temperature"] == 1
    assert len(protocol().receive_data(serialise(frame), 0)) == 1


def test_a_temperature_within_the_range_or_untold_is_no_fault() -> None:
    """Also in messages that have no field for it."""
    host = protocol(temperature_range_degc=(-20.0, 50.0))
    frames = [
        dual_axis_acceleration(0, 5, 0, (0.5, 0.25), temperature_cdegc=5000),
        dual_axis_tilt(1, 5, 0, (0.5, 0.25)),
        build("RAW_IMU", sequence=2, xacc=100),
        attitude(3, 0, 0.1, 0.2),
        highres_imu(4, 6, 0, gyro_rps=(0.1, 0.2, 0.3)),
    ]
    assert len(host.receive_data(b"".join(map(serialise, frames)), 0)) == 5


def test_a_board_that_vouches_for_less_than_its_owner_is_not_believed() -> None:
    """Its own bound above the declared one: the declared bound may not hold, so the reading is not used."""
    host = protocol()  # 0.5 m/s^2 and 1 degree
    frames = [
        dual_axis_acceleration(0, 5, 0, (0.5, 0.25), bound_mps2=0.5),
        dual_axis_acceleration(1, 6, 0, (0.5, 0.26), bound_mps2=0.51),
        dual_axis_acceleration(2, 7, 0, (0.5, 0.27), bound_mps2=nan),
        dual_axis_tilt(3, 8, 0, (0.5, 0.25), bound_rad=0.0174),
        dual_axis_tilt(4, 9, 0, (0.5, 0.26), bound_rad=0.0175),
    ]
    samples = host.receive_data(b"".join(map(serialise, frames)), 0)
    assert [s.device_time_us for s in samples] == [5, 8]
    assert host.counts["beyond_declared"] == 3


def test_a_board_may_speak_our_own_messages() -> None:
    """Accelerometers and tilt in the dialect, the gyroscope in HIGHRES_IMU: the same readings."""
    device, host = board(own_messages=True), protocol()
    samples = host.receive_data(device.data_to_send(20 * MS), 20 * MS)
    assert {(s.message, s.sensor_id) for s in samples} == {
        ("HIGHRES_IMU", 0), ("DUAL_AXIS_ACCELERATION", 1), ("DUAL_AXIS_ACCELERATION", 2), ("DUAL_AXIS_TILT", 0)
    }  # fmt: skip
    (tilt,) = [s for s in samples if s.message == "DUAL_AXIS_TILT" and s.device_time_us == 20_000]
    assert same(tilt.tilt_rad, (0.020, -0.010))
    (accel,) = [s for s in samples if s.sensor_id == 2 and s.device_time_us == 20_000]
    assert same(accel.accel_mps2, (0.020, 2.0, nan))


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
