"""What the laser's parser costs, and what its checksum can't see.

Run alone with `python -m bench.laser`; `make bench` puts the section into RESULTS.md.
"""

import sys
import time
from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bench.wires import SERVING_RECORD, live_laser, scans, streaming_laser
from drivers.checksums import lms_crc
from drivers.sick_lms.framing import FrameReader
from drivers.sick_lms.telegrams import Mode, answer
from simulator.emulators.sick_lms import FACTORY_RECORD, SickLmsEmulator

SECONDS = 20
FULL_RATE = 75
BYTES_PER_S = 50_000
READ_BYTES = (16, 50, 512)
"""A USB adapter with its latency timer at 1 ms gives 50 bytes a read at 500000 baud."""

COST_TEXT = """## The laser's parser

Bytes to scans in the live driver, CPU of one core. Scans: 181 beams, 75 a second. Worst garbage: 500000 baud of nothing
but the headers of a scan, as the driver expects them, so that each is a candidate.

| bytes a read | scans at full rate | worst garbage | noise |
|---|---|---|---|
"""
CHECKSUM_TEXT = """
The scanner's checksum is weak, and what it can't see, while header, count, unit, status and layout stay plausible, no
driver can. Damaged scans that were delivered, of {count} each, by kind of damage:

| damage | delivered |
|---|---|
"""
DAMAGED = 20_000
START_TEXT = """
From the opening of the port to the first scan, 500000 baud wanted, in the time of an emulated scanner that keeps the
manual's delays (a real one may take longer to switch modes, and up to a minute to boot):

| the scanner | first scan after | EEPROM writes |
|---|---|---|
"""
STARTS: dict[str, tuple[Callable[[SickLmsEmulator], None], bytes]] = {
    "streams at 500000 baud, left by a crash": (lambda e: e.leave_streaming(500000), SERVING_RECORD),
    "streams at 9600": (lambda e: e.leave_streaming(9600), SERVING_RECORD),
    "streams at 38400": (lambda e: e.leave_streaming(38400), SERVING_RECORD),
    "streams at 19200": (lambda e: e.leave_streaming(19200), SERVING_RECORD),
    "in installation mode at 9600": (lambda e: e.leave_streaming(9600, Mode.INSTALLATION), SERVING_RECORD),
    "just switched on, boots for 500 ms": (lambda e: None, SERVING_RECORD),
    "just switched on, configured otherwise": (lambda e: None, FACTORY_RECORD),
}
"""What the driver finds, and what the EEPROM holds."""


def section() -> str:
    """All tables."""
    costs = "".join(_cost_row(size) for size in READ_BYTES)
    return COST_TEXT + costs + _checksum_table() + START_TEXT + "".join(_start_row(name) for name in STARTS)


def _start_row(name: str) -> str:
    protocol, first_scan_ns = streaming_laser(*STARTS[name])
    return f"| {name} | {first_scan_ns / 1e9:.2f} s | {protocol.counts['configuration_writes']} |\n"


def _cost_row(read_bytes: int) -> str:
    frames = [frame for frame, _ in scans(1, FULL_RATE)]
    header = frames[0][:7]
    noise = np.random.default_rng(2).bytes(BYTES_PER_S)
    seconds_of = (b"".join(frames), header * (BYTES_PER_S // len(header)), noise)
    shares = [f"{100 * _cpu_share(data, read_bytes):.2f} %" for data in seconds_of]
    return f"| {read_bytes} | {' | '.join(shares)} |\n"


def _cpu_share(second: bytes, read_bytes: int) -> float:
    """CPU seconds for each second of the line; the least of several, as the machine is shared."""
    least = float("inf")
    for _ in range(SECONDS):
        receive = live_laser()
        began = time.thread_time()
        for at in range(0, len(second), read_bytes):
            receive(second[at : at + read_bytes])
        least = min(least, time.thread_time() - began)
    return least


def _checksum_table() -> str:
    rng = np.random.default_rng(3)
    rows = []
    for name, strike in (
        ("one bit", _one_bit),
        ("two bits anywhere", _two_bits),
        ("bit k of a byte and bit k+1 of the next", _neighbours),
        ("8 bytes overwritten", _burst),
    ):
        passed = sum(_delivers(strike(_any_scan(rng), rng)) for _ in range(DAMAGED))
        rows.append(f"| {name} | {passed} |\n")
    return CHECKSUM_TEXT.format(count=f"{DAMAGED:,}") + "".join(rows)


def _any_scan(rng: np.random.Generator) -> NDArray[np.uint8]:
    payload = b"\xb0\xb5\x40" + rng.integers(0, 0x8000, 181).astype("<u2").tobytes() + b"\x10"
    return np.frombuffer(answer(payload), np.uint8).copy()


def _delivers(frame: NDArray[np.uint8]) -> int:
    """Does a driver that streams take it?"""
    size = frame.size
    if lms_crc(frame.tobytes(), 0, size - 2) != int(frame[-2]) | int(frame[-1]) << 8:
        return 0  # the same checksum, without the rest of the driver around it
    reader = FrameReader(Counter())
    reader.scan_headers, reader.source = frozenset({(366, 0x40B5)}), 0x10
    return len(reader.receive_data(frame.tobytes(), 0))


def _one_bit(frame: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    frame[rng.integers(frame.size)] ^= 1 << rng.integers(8)
    return frame


def _two_bits(frame: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    for bit in rng.choice(8 * frame.size, 2, replace=False):
        frame[bit // 8] ^= 1 << bit % 8
    return frame


def _neighbours(frame: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    at, bit = rng.integers(frame.size - 1), rng.integers(7)
    frame[at] ^= 1 << bit
    frame[at + 1] ^= 2 << bit
    return frame


def _burst(frame: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    at = rng.integers(frame.size - 8)
    frame[at : at + 8] = rng.integers(0, 256, 8)
    return frame


if __name__ == "__main__":
    sys.stdout.write(section())
