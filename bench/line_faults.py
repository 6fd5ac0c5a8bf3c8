"""What bad lines cost: every kind of line fault on a fifth of the frames of every wire.

Run alone with `python -m bench.line_faults`; `make bench` puts the section into RESULTS.md.
"""

import sys
from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass

from bench.wires import WIRES, Wire
from simulator.line_faults import KINDS, Fault, damage

FRAMES = 5000
TEXT = """## Bad lines

Each kind of fault strikes a fifth of the frames (`simulator/line_faults.py`). Intact: frames of which every byte
reached the driver, one behind the other; delivered: those that came out; false: what came out and was not sent so;
unseen: the same, where no check of the wire could tell it (slcan has no checksum; NMEA's is an XOR).

| wire | fault | sent | intact | delivered | false | unseen |
|---|---|---|---|---|---|---|
"""


@dataclass(frozen=True, slots=True)
class Result:
    """One wire under one fault."""

    wire: str
    fault: str
    sent: int
    intact: int
    delivered: int
    false: int
    unseen: int


def measure(wire: Wire, kind: str, count: int = FRAMES, seed: int = 1) -> Result:
    """`count` frames over a line with such faults."""
    frames = wire.frames(seed, count)
    key_of = dict(frames)
    damaged = damage([frame for frame, _ in frames], wire.line, [Fault(kind)], seed)
    receive = wire.receiver()
    found: Counter[Hashable] = Counter(key for chunk in damaged.chunks if chunk for key in receive(chunk))
    found.update(receive(b""))
    intact = Counter(key_of[frame] for frame in damaged.intact([frame for frame, _ in frames]))
    if wire.once:
        intact = Counter(set(intact))
    delivered = (found & intact).total()
    # A frame that is struck where it doesn't matter, in its line end, may come out: it says what was sent.
    invented = found - (intact | Counter(set(key_of.values())))
    untold = wire.unseen(b"".join(damaged.chunks), key_of)
    unseen = sum(times for key, times in invented.items() if key in untold)
    return Result(wire.name, kind, count, intact.total(), delivered, invented.total() - unseen, unseen)


def results(count: int = FRAMES) -> list[Result]:
    """All faults that a wire can have, on all wires."""
    return [
        measure(wire, kind, count)
        for wire in WIRES
        for kind in KINDS
        if kind != "wrong-length" or wire.line.length_at is not None
    ]


def section() -> str:
    """The table."""
    rows = [
        f"| {r.wire} | {r.fault} | {r.sent} | {r.intact} | {r.delivered} | {r.false} | {r.unseen} |\n"
        for r in results()
    ]
    return TEXT + "".join(rows)


if __name__ == "__main__":
    sys.stdout.write(section())
