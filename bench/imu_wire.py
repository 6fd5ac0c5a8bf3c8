"""The inertial board's wire for the benches: MAVLink packets of every kind, and the driver that reads them."""

from collections.abc import Callable, Hashable, Mapping
from random import Random

from pymavlink.dialects.v20.ardupilotmega import mavlink_map

from drivers.imu.codec import build, serialise, x25
from drivers.imu.dialect import DEFINITIONS
from drivers.imu.messages import READINGS, attitude, dual_axis_acceleration, dual_axis_tilt, highres_imu
from drivers.imu.protocol import ImuProtocol
from drivers.samples import InertialSample
from service.passive import imu_config

_EXTRA = {m.id: m.crc_extra for m in (*mavlink_map.values(), *DEFINITIONS) if m.msgname in READINGS}
"""The checksum's last byte, by message number."""


def packets(seed: int, count: int) -> list[tuple[bytes, Hashable]]:
    """Gyroscope, accelerometer, tilt, an autopilot's integers in version 1 and a signed packet, in turn."""
    random, frames = Random(seed), list[tuple[bytes, Hashable]]()
    for i in range(count):
        x, y, z = (random.uniform(-1.0, 1.0) for _ in range(3))
        sequence, time_us = i % 256, 5000 * i
        match i % 6:
            case 0 | 1:
                data = serialise(highres_imu(sequence, time_us, i % 3, gyro_rps=(x, y, z)))
            case 2:
                data = serialise(dual_axis_acceleration(sequence, time_us, 1, (x, y), 0.1, 2000))
            case 3:
                data = serialise(attitude(sequence, time_us // 1000, x, y))
            case 4:
                axes = {"xacc": i, "yacc": round(1000 * y), "zacc": -1000, "zgyro": round(1000 * z)}
                data = serialise(build("RAW_IMU", sequence=sequence, version=1, time_usec=time_us, **axes))
            case _:
                data = _signed(serialise(dual_axis_tilt(sequence, time_us, 2, (x, y))), random)
        (sample,) = protocol().receive_data(data, 0)
        frames.append((data, _key(sample)))
    return frames


def protocol() -> ImuProtocol:
    """A driver."""
    return ImuProtocol(imu_config(latency_ms=(0.0, 20.0)))


def driver() -> Callable[[bytes], list[Hashable]]:
    """A driver that gives keys; silence means that nothing more comes."""
    host = protocol()
    return lambda data: [_key(sample) for sample in (host.receive_data(data, 0) if data else host.finish())]


def unseen(stream: bytes, sent: Mapping[bytes, Hashable]) -> set[Hashable]:
    """What passes for a packet that nobody sent: one damaged packet in 65536 has a right checksum."""
    passing = (_passes(stream, at) for at in range(len(stream)))
    return {key for frame in passing if frame is not None and frame not in sent for key in driver()(frame)}


def _passes(stream: bytes, at: int) -> bytes | None:
    """The bytes that pass for a packet at this place, as MAVLink's own description of the wire has it."""
    first, length = stream[at : at + 1], stream[at + 1 : at + 2]
    if not length or first not in (b"\xfd", b"\xfe"):
        return None
    v2 = first == b"\xfd"
    head = 10 if v2 else 6
    number = int.from_bytes(stream[at + 7 : at + 10] if v2 else stream[at + 5 : at + 6], "little")
    end = at + head + length[0]
    if number not in _EXTRA or end + 2 > len(stream):
        return None
    if x25(stream[at + 1 : end] + bytes((_EXTRA[number],))) != int.from_bytes(stream[end : end + 2], "little"):
        return None
    return stream[at : end + 2 + (13 if v2 and stream[at + 2] & 1 else 0)]


def _signed(frame: bytes, random: Random) -> bytes:
    body = bytearray(frame[1:-2])
    body[1] |= 1
    extra = DEFINITIONS[1].crc_extra
    return b"\xfd" + bytes(body) + x25(bytes(body) + bytes((extra,))).to_bytes(2, "little") + random.randbytes(13)


def _key(sample: InertialSample) -> Hashable:
    """What it says; as text, since NaN equals nothing."""
    return repr((sample.message, sample.sensor_id, sample.accel_mps2, sample.gyro_rps, sample.tilt_rad))
