"""What the inertial packets' parser costs, as a share of one core at full rate; and on garbage.

Run alone with `python -m bench.imu_cost`; `make bench` puts the section into RESULTS.md.
"""

import os
import sys
from math import sin

from bench.can_gps_cost import cost
from bench.imu_wire import protocol
from drivers.imu.codec import build, serialise
from simulator.emulators.imu import ImuEmulator

SECONDS = 20
"""Of traffic, at full rate."""
BYTES_PER_S = 23_000
TEXT = """## The inertial packets' parser

Bytes to samples, CPU of one core, the quietest of several runs. Worst garbage: nothing but headers of known messages
that announce the longest payload, so that each is a candidate whose checksum must be tried.

| traffic | bytes a read | CPU, share of a core |
|---|---|---|
"""


def section() -> str:
    """The table."""
    packets = emulated()
    header = serialise(build("HIGHRES_IMU"))[:1] + b"\xff\x00\x00\x00\x01\x01\x69\x00\x00"
    size = BYTES_PER_S * SECONDS
    rows = [
        ("200 gyroscope, 150 other packets a second", packets, len(packets) // (200 * SECONDS)),
        ("the same, a packet in two reads", packets, 33),
        ("the same, byte by byte", packets, 1),
        ("as many random bytes", os.urandom(size), 115),
        ("as much of the worst garbage", header * (size // len(header)), 115),
        ("the same, in reads of 4096 bytes", header * (size // len(header)), 4096),
    ]
    return TEXT + "".join(
        f"| {name} | {read_bytes} | {100 * cost(data, protocol().receive_data, SECONDS, read_bytes, 5):.2f} % |\n"
        for name, data, read_bytes in rows
    )


def emulated() -> bytes:
    """What the emulated board sends in SECONDS."""
    board = ImuEmulator(
        lambda begin, end: (sin(end), 0.2, 0.3),
        lambda t, sensor: (sin(t), 0.1),
        lambda t: (0.1, sin(t)),
        accel_period_ns=20_000_000,
        tilt_period_ns=20_000_000,
    )
    return board.data_to_send(SECONDS * 1_000_000_000)


if __name__ == "__main__":
    sys.stdout.write(section())
