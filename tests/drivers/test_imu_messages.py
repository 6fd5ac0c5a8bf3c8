"""Every inertial message, as other people's MAVLink writes and reads it, on lines of every kind."""

import importlib.util
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from math import isnan, nan
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import drivers.imu
from drivers.imu.codec import MavlinkFrame, MavlinkStream, build, serialise, x25
from drivers.imu.dialect import DEFINITIONS
from drivers.imu.messages import READINGS, attitude, dual_axis_acceleration, dual_axis_tilt, highres_imu
from drivers.imu.protocol import ImuProtocol
from drivers.samples import InertialSample
from service.passive import imu_config
from simulator.line_faults import KINDS, LINES, Fault, damage

DIALECT = Path(drivers.imu.__file__).with_name("terrabound.xml")

AXES: dict[str, Any] = {"xacc": 12, "yacc": -3, "zacc": -1000, "xgyro": 7, "ygyro": -250, "zgyro": 40}
FIELDS: dict[str, dict[str, Any]] = {
    "HIGHRES_IMU": {"time_usec": 1 << 40, "xacc": 0.5, "zacc": -9.75, "zgyro": 0.25, "fields_updated": 0x3F, "id": 3},
    "SCALED_IMU": AXES | {"time_boot_ms": 4_000_000_000},
    "SCALED_IMU2": AXES | {"time_boot_ms": 1},
    "SCALED_IMU3": AXES | {"time_boot_ms": 77},
    "RAW_IMU": AXES | {"time_usec": 5, "id": 2, "temperature": 2_650},
    "ATTITUDE": {"time_boot_ms": 9, "roll": 0.1, "pitch": -0.2, "yaw": nan, "yawspeed": 0.5},
    "DUAL_AXIS_ACCELERATION": {"time_usec": 1 << 50, "xacc": 1.5, "yacc": -0.25, "bound": 0.25, "temperature": 2_105},
    "DUAL_AXIS_TILT": {"time_usec": 8, "roll": -0.5, "pitch": 0.25, "bound": 0.002, "temperature": -1_000, "id": 1},
}
STANDARD = [name for name in FIELDS if not name.startswith("DUAL_")]


def signed(frame: bytes, crc_extra: int) -> bytes:
    """The frame with a signature, which nobody can check."""
    body = bytearray(frame[1:-2])
    body[1] |= 1
    return b"\xfd" + bytes(body) + x25(bytes(body) + bytes((crc_extra,))).to_bytes(2, "little") + bytes(range(13))


def on_the_wire(message: str, form: str, sequence: int = 0) -> bytes:
    """One frame of the message, in version 1, 2, or 2 with a signature."""
    frame = serialise(build(message, version=1 if form == "v1" else 2, sequence=sequence, **FIELDS[message]))
    if form != "signed":
        return frame
    extra = {own.msgname: own.crc_extra for own in DEFINITIONS}
    return signed(
        frame,
        extra[message]
        if message in extra
        else next(m.crc_extra for m in mavlink.mavlink_map.values() if m.msgname == message),
    )


def host() -> ImuProtocol:
    """The driver, whatever the board's quality."""
    return ImuProtocol(imu_config())


def read(chunks: list[bytes]) -> list[InertialSample]:
    """All samples in these reads."""
    protocol = host()
    return [sample for chunk in chunks for sample in protocol.receive_data(chunk, 0)] + protocol.finish()


def told(samples: list[InertialSample]) -> list[str]:
    """Samples as text: NaN equals NaN there."""
    return [repr(sample) for sample in samples]


def test_every_message_that_is_read_is_tested_here() -> None:
    """A message added to the driver must be added to these tests."""
    assert set(FIELDS) == set(READINGS)


@pytest.mark.parametrize("form", ["v1", "v2", "signed"])
@pytest.mark.parametrize("message", FIELDS)
def test_every_message_arrives_whole_cut_anywhere_and_with_dirt_around_it(message: str, form: str) -> None:
    """One sample, the same one, wherever a read ends and whatever stands before and behind."""
    if form == "v1" and message not in STANDARD:
        pytest.skip("version 1 knows no message numbers beyond 255")
    frame = on_the_wire(message, form)
    expected = told(read([frame]))
    assert len(expected) == 1
    for cut in range(1, len(frame)):
        assert told(read([frame[:cut], frame[cut:]])) == expected
    assert told(read([frame[i : i + 1] for i in range(len(frame))])) == expected
    for dirt in (
        b"\xfd",
        b"\xfe",
        b"\xfd\xfd\xfe",
        b"\x00\xff" * 9,
        frame[:9],
        frame[: -14 if form == "signed" else -1],
        b"\xfe\x1c\x00\x01\x01\x1e",
    ):
        assert told(read([dirt + frame + dirt])) == expected
        assert told(read([dirt, frame, dirt])) == expected


@pytest.mark.parametrize("message", STANDARD)
def test_pymavlink_says_the_same(message: str) -> None:
    """Their fields of our bytes are our fields, in both versions, also where trailing zeros were cut off."""
    for version in (1, 2):
        for fields in (FIELDS[message], {"time_usec" if "USEC" in message else next(iter(FIELDS[message])): 1}):
            ours = build(message, version=version, **fields)
            parser = mavlink.MAVLink(None)
            (theirs,) = parser.parse_buffer(bytearray(serialise(ours)))
            assert theirs.get_type() == message
            for name, value in ours.fields().items():
                their_value = getattr(theirs, name)
                assert their_value == value or (isnan(their_value) and isnan(value))


@pytest.mark.parametrize("kept", range(14))
def test_a_signature_that_is_cut_short_costs_the_next_packet_nothing(kept: int) -> None:
    """No checksum covers it: what stands in its place may be a packet, and is delivered; a whole one is no dirt."""
    packets = [on_the_wire("RAW_IMU", "signed", sequence) for sequence in range(3)]
    protocol = host()
    samples = protocol.receive_data(packets[0][: len(packets[0]) - 13 + kept] + packets[1] + packets[2], 0)
    assert len(samples) == 3
    assert protocol.counts["skipped_bytes"] == 0


def test_a_payload_may_be_cut_or_longer_than_we_know() -> None:
    """Zeros at the end may be left out; fields that a later definition adds are passed over."""
    whole = build("DUAL_AXIS_TILT", time_usec=5, roll=0.25, pitch=0.0)
    assert len(serialise(whole)) < 12 + len(whole.payload)
    (sample,) = read([serialise(whole)])
    assert (sample.tilt_rad, sample.device_time_us) == ((0.25, 0.0), 5)
    longer = MavlinkFrame("ATTITUDE", 0, 1, 1, build("ATTITUDE", roll=0.5).payload + b"\x01\x02\x03")
    (sample,) = read([serialise(longer)])
    assert sample.tilt_rad == (0.5, 0.0)


# ---------------------------------------------------------------- our own dialect


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> ModuleType:
    """What mavgen makes of our dialect: what any other program would use."""
    path = tmp_path_factory.mktemp("dialect") / "terrabound_dialect.py"
    subprocess.run(
        [
            *(sys.executable, "-m", "pymavlink.tools.mavgen", "--lang=Python3", "--wire-protocol=2.0"),
            *(f"--output={path.with_suffix('')}", str(DIALECT)),
        ],
        check=True,
        capture_output=True,
    )
    spec = importlib.util.spec_from_file_location("terrabound_dialect", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["terrabound_dialect"] = module
    spec.loader.exec_module(module)
    return module


def test_the_dialect_in_the_driver_is_that_of_the_xml_file(generated: ModuleType) -> None:
    """Numbers, fields, their order and the checksum of the definition."""
    assert set(generated.mavlink_map) == {own.id for own in DEFINITIONS}
    for own in DEFINITIONS:
        theirs = generated.mavlink_map[own.id]
        assert (own.msgname, own.crc_extra) == (theirs.msgname, theirs.crc_extra)
        assert own.unpacker.format == theirs.unpacker.format
        assert list(own.ordered_fieldnames) == theirs.ordered_fieldnames


def test_no_other_dialect_has_our_message_numbers() -> None:
    """Of all that pymavlink ships."""
    everything = importlib.import_module("pymavlink.dialects.v20.all")
    assert not {own.id for own in DEFINITIONS} & set(everything.mavlink_map)


def test_a_foreign_program_reads_our_dialect_and_we_read_its(generated: ModuleType) -> None:
    """Through the module that mavgen makes, both ways; its axes are MAVLink's."""
    board = generated.MAVLink(None, srcSystem=1, srcComponent=7)
    theirs = board.dual_axis_acceleration_encode(123, 1.5, -0.25, 0.125, 2150, 2)
    (sample,) = read([theirs.pack(board)])
    assert (sample.message, sample.sensor_id, sample.device_time_us) == ("DUAL_AXIS_ACCELERATION", 2, 123)
    assert sample.accel_mps2[:2] == (1.5, 0.25)
    frame = serialise(dual_axis_tilt(0, 77, 1, (0.5, 0.125), bound_rad=0.25, temperature_cdegc=-300))
    (seen,) = generated.MAVLink(None).parse_buffer(bytearray(frame))
    assert (seen.roll, seen.pitch, seen.bound, seen.temperature, seen.id) == (0.5, -0.125, 0.25, -300, 1)


FLOATS = st.floats(-3.0, 3.0, width=32)


@given(FLOATS, FLOATS, FLOATS, st.integers(0, (1 << 63) - 1), st.integers(0, 255))
@settings(max_examples=60)
def test_readings_survive_the_wire(x: float, y: float, z: float, time_us: int, sensor: int) -> None:
    """Whatever is measured comes out as it went in, of every message that we can send."""
    frames = [
        highres_imu(0, time_us, sensor, accel_mps2=(x, y, 9.0), gyro_rps=(y, z, x)),
        dual_axis_acceleration(1, time_us, sensor, (x, y)),
        dual_axis_tilt(2, time_us, sensor, (y, z)),
    ]
    both, accel, tilt = read(list(map(serialise, frames)))
    assert (both.accel_mps2, both.gyro_rps) == ((x, y, 9.0), (y, z, x))
    assert accel.accel_mps2[:2] == (x, y)
    assert tilt.tilt_rad == (y, z)
    assert {s.sensor_id for s in (both, accel, tilt)} == {sensor}
    assert {s.device_time_us for s in (both, accel, tilt)} == {time_us}
    (inclined,) = read([serialise(attitude(0, time_us & 0xFFFF_FFFF, x, y))])
    assert inclined.tilt_rad == (x, y)


# ---------------------------------------------------------------- bad lines


def frames(n: int) -> list[bytes]:
    """Frames of every message and version, all different."""
    kinds: list[Callable[[int], MavlinkFrame]] = [
        lambda i: highres_imu(i % 256, 5000 * i, 0, gyro_rps=(0.1, -0.2, i * 1e-3)),
        lambda i: dual_axis_acceleration(i % 256, 5000 * i, 1, (i * 1e-3, -1.0)),
        lambda i: attitude(i % 256, 5 * i, i * 1e-4, 0.1),
        lambda i: build("RAW_IMU", version=1, sequence=i % 256, time_usec=5000 * i, xacc=i % 1000, zacc=-1000),
        lambda i: build("HEARTBEAT", sequence=i % 256, custom_mode=i),
    ]
    return [serialise(kinds[i % len(kinds)](i)) for i in range(n)]


@pytest.mark.parametrize("kind", KINDS)
def test_every_intact_frame_is_delivered_under_every_fault_and_no_other(kind: str) -> None:
    """One frame in five is struck; what arrives whole comes out, in order, and nothing that was not sent.

    A damaged frame passes a checksum of 16 bits with a chance of 1 in 65536; with these seeds none does.
    """
    sent = frames(600)
    for seed in range(5, 10):
        damaged = damage(sent, LINES["imu"], [Fault(kind, 0.2)], seed)
        stream = MavlinkStream(Counter())
        got = [serialise(f) for chunk in damaged.chunks for f, _ in stream.receive(chunk, 0)]
        got += [serialise(f) for f, _ in stream.finish()]
        assert got == damaged.intact(sent)


def test_a_whole_mixture_of_faults_costs_no_intact_frame() -> None:
    """All kinds at once: two frames in three are struck."""
    sent = frames(3000)
    damaged = damage(sent, LINES["imu"], [Fault(kind, 0.06) for kind in KINDS], 3)
    stream = MavlinkStream(Counter())
    got = [serialise(f) for chunk in damaged.chunks for f, _ in stream.receive(chunk, 0)]
    assert got + [serialise(f) for f, _ in stream.finish()] == damaged.intact(sent)


def test_of_a_real_vehicles_stream_pymavlink_says_the_same(recordings: Path) -> None:
    """All 35912 frames: message, source, sequence; and the fields of those that are read."""
    data = (recordings / "mavlink" / "sub_small.serial.bin").read_bytes()
    stream = MavlinkStream(Counter())
    ours = [frame for frame, _ in stream.receive(data, 0)]
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    theirs = parser.parse_buffer(bytearray(data))
    assert theirs is not None
    assert [(f.message, f.system, f.component, f.sequence) for f in ours] == [
        (m.get_type(), m.get_srcSystem(), m.get_srcComponent(), m.get_seq()) for m in theirs
    ]
    for frame, message in zip(ours, theirs, strict=True):
        if frame.message in READINGS:
            assert {name: getattr(message, name) for name in frame.fields()} == frame.fields()
