"""What the encoders' and the receiver's parsers cost, as a share of one core at full rate; and on garbage.

Run alone with `python -m bench.can_gps_cost`; `make bench` puts the section into RESULTS.md.
"""

import os
import sys
import time
from collections.abc import Callable
from random import Random

from bench import encoder_wire, gps_wire

SECONDS = 20
"""Of traffic, at full rate."""
MS = 1_000_000
TEXT = """## The encoders' and the receiver's parsers

Bytes to samples, CPU of one core, the quietest of three runs.

| wire | traffic | bytes/s | CPU, share of a core |
|---|---|---|---|
"""


def cost(
    data: bytes, receive: Callable[[bytes, int], object], seconds: float, read_bytes: int, repeats: int = 3
) -> float:
    """CPU seconds a second of traffic, the quietest of a few runs; a read gives `read_bytes`."""
    pieces = [data[i : i + read_bytes] for i in range(0, len(data), read_bytes)]
    step_ns = round(seconds * 1e9 / len(pieces))
    best = float("inf")
    for _ in range(repeats):
        begin = time.thread_time()
        for i, piece in enumerate(pieces):
            receive(piece, i * step_ns)
        best = min(best, time.thread_time() - begin)
    return best / seconds


def rows() -> list[tuple[str, str, float, float]]:
    """(wire, traffic, bytes a second, share of a core)."""
    found = []
    busy = encoder_wire.busy_lines(1, 100 * SECONDS)
    epochs = gps_wire.full_epochs(1, 10 * SECONDS)
    random = Random(1)
    garbage = random.randbytes(len(busy))
    letters = bytes(random.choice(b"tTrR0123456789ABCDEF") for _ in range(len(busy)))
    dollars = b"".join(b"$GPGGA," + b"1" * random.randint(0, 500) for _ in range(len(epochs) // 250))
    for name, data, read_bytes in (
        ("100 TRACKS among 1000 frames a second, a frame a read", busy, 26),
        ("the same, read every 4 ms", busy, 104),
        ("as many random bytes", garbage, 26),
        ("as many frame letters and digits without an end", letters, 26),
    ):
        host = encoder_wire.protocol()
        found.append(("encoders, slcan", name, len(data) / SECONDS, cost(data, host.receive_data, SECONDS, read_bytes)))
    for name, data, read_bytes in (
        ("10 epochs a second of 20 sentences, a read every 4 ms", epochs, 60),
        ("as many random bytes", os.urandom(len(epochs)), 60),
        ("sentences that never end", dollars, 60),
    ):
        receiver = gps_wire.protocol()
        found.append(("gps", name, len(data) / SECONDS, cost(data, receiver.receive_data, SECONDS, read_bytes)))
    return found


def section() -> str:
    """The table."""
    return TEXT + "".join(
        f"| {wire} | {name} | {rate:.0f} | {100 * share:.2f} % |\n" for wire, name, rate, share in rows()
    )


if __name__ == "__main__":
    sys.stdout.write(section())
