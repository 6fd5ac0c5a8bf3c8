"""Hostile bytes for every parser: random ones and mutated frames, ten million of each kind, and not one exception.

Run with `python -m bench.prove_parsers`; `--bytes` shortens it. Good frames follow behind, and must come out.
Exit code 1 if any did not, or if anything came out that nobody sent.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from bench.machine import heading
from bench.wires import WIRES, Wire

PAGE = Path(__file__).with_name("PROVED_PARSERS.md")
BYTES = 10_000_000
CHUNK = 4096
LONGEST_FRAME = 600
"""Of those in which a wire's checks may miss something."""
TEXT = """Random bytes, and frames with a fiftieth of their bytes overwritten, lost, doubled or swapped, in reads of any
size. No exception left a parser. `false`: what came out of random bytes, or out of mutated frames without being
one of them; `unseen`: the same, where no check of the wire could tell it (slcan has no checksum; NMEA's XOR doesn't see
two bytes swapped); `after`: good frames that came out behind the last hostile byte, of those sent.

| wire | random bytes | false | mutated bytes | false | unseen | after |
|---|---|---|---|---|---|---|
"""


@dataclass(frozen=True, slots=True)
class Result:
    """One parser under fire."""

    wire: str
    random_bytes: int
    false_of_random: int
    mutated_bytes: int
    false_of_mutated: int
    unseen_of_mutated: int
    good: int
    good_delivered: int

    @property
    def sound(self) -> bool:
        """Nothing false, nothing lost."""
        return self.false_of_random == self.false_of_mutated == 0 and self.good == self.good_delivered


def fire(wire: Wire, count: int, seed: int = 1) -> Result:
    """`count` random bytes and as many mutated ones."""
    rng = np.random.default_rng(seed)
    receive = wire.receiver()
    random_bytes = false_of_random = 0
    while random_bytes < count:
        data = rng.bytes(CHUNK)
        false_of_random += sum(1 for size in reads(rng, data) for _ in receive(size))
        random_bytes += len(data)
    frames = wire.frames(seed, 200)
    key_of = dict(frames)
    sent = set(key_of.values())
    mutated_bytes, before = 0, b""
    invented, untold = Counter[Hashable](), set[Hashable]()
    stream = b"".join(frame for frame, _ in frames)
    while mutated_bytes < count:
        data = mutated(rng, stream)
        invented.update(key for chunk in reads(rng, data) for key in receive(chunk) if key not in sent)
        mutated_bytes += len(data)
        untold |= wire.unseen(before + data, key_of)
        before = data[-LONGEST_FRAME:]
    good = wire.frames(seed + 1, 20)
    found: set[Hashable] = set()
    for chunk in (b"", *(frame for frame, _ in good), b""):
        found.update(receive(chunk))
    delivered = sum(key in found for _, key in good)
    unseen = sum(times for key, times in invented.items() if key in untold)
    false_of_mutated = invented.total() - unseen
    return Result(
        wire.name, random_bytes, false_of_random, mutated_bytes, false_of_mutated, unseen, len(good), delivered
    )


def reads(rng: np.random.Generator, data: bytes) -> list[bytes]:
    """`data` in pieces of any size."""
    cuts = np.sort(rng.integers(0, len(data), max(1, len(data) // 100)))
    edges = [0, *cuts.tolist(), len(data)]
    return [data[a:b] for a, b in pairwise(edges) if b > a]


def mutated(rng: np.random.Generator, data: bytes) -> bytes:
    """`data` with a fiftieth of its bytes overwritten, lost, doubled, or swapped with the next."""
    out = np.frombuffer(data, np.uint8).copy()
    places = rng.integers(0, len(out) - 1, len(out) // 50)
    kinds = rng.integers(0, 4, len(places))
    overwritten, swapped = places[kinds == 0], places[kinds == 1]
    out[overwritten] = rng.integers(0, 256, len(overwritten))
    out[swapped], out[swapped + 1] = out[swapped + 1], out[swapped].copy()
    times = np.ones(len(out), np.int64)
    times[places[kinds == 2]] = 0
    times[places[kinds == 3]] = 2
    return np.repeat(out, times).tobytes()


def main() -> int:
    """All parsers; 0 if all held."""
    parser = argparse.ArgumentParser(prog="python -m bench.prove_parsers", description="hostile bytes for all parsers")
    parser.add_argument("--bytes", type=int, default=BYTES, help="random and mutated bytes for each parser")
    options = parser.parse_args()
    results = []
    for wire in WIRES:
        results.append(fire(wire, options.bytes))
        print(results[-1], file=sys.stderr, flush=True)
    rows = [
        f"| {r.wire} | {r.random_bytes:,} | {r.false_of_random} | {r.mutated_bytes:,} | {r.false_of_mutated} "
        f"| {r.unseen_of_mutated} | {r.good_delivered} of {r.good} |\n"
        for r in results
    ]
    sys.stdout.write(TEXT + "".join(rows))
    if options.bytes >= BYTES:
        page = heading("Parsers under fire", "make prove") + TEXT + "".join(rows)
        PAGE.write_text(page, encoding="utf-8")
    return 0 if all(result.sound for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
