"""The robot's wires as the benches see them: frames that a device would send, and a driver's end that reads them.

A frame travels with a key that tells what it says; a driver gives back the keys of what it delivers. Who adds a wire
adds a row to WIRES: `bench/line_faults.py` and `bench/prove_parsers.py` do the rest.
"""

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from bench import encoder_wire, gps_wire, imu_wire
from drivers.config import LaserConfig
from drivers.samples import Scan
from drivers.sick_lms.measurements import MM
from drivers.sick_lms.protocol import SickLmsProtocol
from drivers.sick_lms.range_telegrams import RangeTelegram
from drivers.sick_lms.stream import LmsStreamDecoder
from drivers.sick_lms.telegrams import answer
from simulator.emulators.sick_lms import FACTORY_RECORD, SickLmsEmulator
from simulator.line_faults import LINES, LineFormat

MS = 1_000_000

Receive: TypeAlias = Callable[[bytes], Iterable[Hashable]]
"""Bytes of one read in, keys of what they complete out; b"" means that the line was silent for a while."""


@dataclass(frozen=True, slots=True)
class Wire:
    """One wire and one driver for it."""

    name: str
    line: LineFormat
    frames: Callable[[int, int], list[tuple[bytes, Hashable]]]
    """frames(seed, count): what a device sends, each with its key."""
    receiver: Callable[[], Receive]
    """A new driver, ready to read."""
    unseen: Callable[[bytes, Mapping[bytes, Hashable]], set[Hashable]] = lambda stream, sent: set()
    """Keys of what in a damaged stream was not sent, and yet no check of the wire can tell it."""
    once: bool = False
    """Does a frame that comes twice say nothing new?"""


def scans(seed: int, count: int) -> list[tuple[bytes, Hashable]]:
    """Scans of 181 beams: walls, and any other distances; every fourth has values that spell headers."""
    rng = np.random.default_rng(seed)
    frames: list[tuple[bytes, Hashable]] = []
    for k in range(count):
        codes = rng.integers(0, 0x7FF0, 181).astype(np.uint16)
        if k % 2:
            codes[:] = 2000 + k % 1000 + np.arange(181)
        if k % 4 == 0:
            codes[20:24] = 0x0002, 0x6E80, 0xB001, 0x40B5
            codes[60:64] = 0x8002, 0x016E, 0xB5B0, 0x0040
        frames.append((answer(RangeTelegram(codes, MM).serialise()), (codes & 0x7FFF).tobytes()))
    return frames


def live_laser() -> Receive:
    """A driver that has set up an emulated scanner, and hears what is put on the line from then on.

    Its clock stands still, but for silences: or it would, rightly, set up anew a scanner that sends dirt alone.
    """
    protocol, started_ns = streaming_laser(lambda emulator: emulator.leave_streaming(500000))

    def receive(data: bytes) -> list[Hashable]:
        if not data:
            protocol.advance(started_ns + 100 * MS)
        found = protocol.receive_data(data, started_ns)
        assert protocol.streaming, protocol.state
        return [_key(scan) for scan in found]

    return receive


SERVING_RECORD = FACTORY_RECORD[:5] + b"\x06" + FACTORY_RECORD[6:]
"""A scanner's EEPROM after our driver has been there."""


def streaming_laser(
    prepare: Callable[[SickLmsEmulator], None], record: bytes = SERVING_RECORD
) -> tuple[SickLmsProtocol, int]:
    """A driver just as the first scan has come, and when that was; it began at time 0 with a scanner as prepared."""

    def no_echo(shots_ns: NDArray[np.int64], angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.full(len(angles_rad), np.nan)

    now_ns = 0
    rng = np.random.default_rng(4)
    emulator = SickLmsEmulator(no_echo, start_ns=now_ns, record=record)
    prepare(emulator)
    protocol = SickLmsProtocol(LASER)
    protocol.connection_made(now_ns)
    while not protocol.counts["scans"]:
        now_ns += 2 * MS
        data = emulator.data_to_send(now_ns)
        protocol.receive_data(data if emulator.baud == protocol.baud else rng.bytes(len(data)), now_ns)
        protocol.advance(now_ns)
        if request := protocol.data_to_send():
            emulator.receive_data(request if emulator.baud == protocol.baud else rng.bytes(len(request)), now_ns)
    return protocol, now_ns


def recorded_laser() -> Receive:
    """A recording that somebody else made."""
    decoder = LmsStreamDecoder(measuring_mode=0x06)
    return lambda data: [_key(scan) for scan in (decoder.receive_data(data) if data else decoder.finish())]


def _key(scan: Scan) -> Hashable:
    return np.rint(np.nan_to_num(scan.ranges_m, nan=0.0, posinf=0.0) * 1000).astype(np.uint16).tobytes()


LASER = LaserConfig(
    port="",
    latency_ms=(0.0, 11.0),
    range_bound_m=0.066,
    angle_bound_deg=0.45,
    mount_x_m=0.0,
    mount_y_m=0.0,
    mount_z_m=0.468,
    mount_pitch_deg=-10.0,
    mount_position_bound_m=0.0,
    mount_angle_bound_deg=0.0,
)
WIRES = (
    Wire("laser", LINES["lms"], scans, live_laser),
    Wire("laser, recorded", LINES["lms"], scans, recorded_laser),
    Wire("encoders, slcan", LINES["encoders"], encoder_wire.lines, encoder_wire.driver, encoder_wire.unseen),
    Wire("inertial packets", LINES["imu"], imu_wire.packets, imu_wire.driver, imu_wire.unseen),
    Wire("gps", LINES["gps"], gps_wire.sentences, gps_wire.driver, gps_wire.unseen, once=True),
)
