"""Bad lines to the encoders and the receiver: every intact frame comes out, and none that was not sent."""

from collections import Counter
from collections.abc import Hashable

import pytest

from bench import encoder_wire, gps_wire
from simulator.line_faults import KINDS, LINES, Fault, damage

FRAMES = 1500
BLIND = {"bit-flip", "burst", "dropped", "inserted"}
"""slcan has no checksum: a digit changed into another is a count like any other, if a track could have run there."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [1, 2])
def test_every_intact_count_is_delivered_and_no_other(kind: str, seed: int) -> None:
    """A fifth of the lines struck; a count that was never sent comes out only of a line that looks like one."""
    frames = encoder_wire.lines(seed, FRAMES)
    struck = damage([line for line, _ in frames], LINES["encoders"], [Fault(kind)], seed)
    receive = encoder_wire.driver()
    found = Counter(key for chunk in struck.chunks if chunk for key in receive(chunk))
    found.update(receive(b""))
    key_of = dict(frames)
    intact = Counter(key_of[line] for line in struck.intact([line for line, _ in frames]))
    assert intact <= found
    false = sum(count for key, count in found.items() if key not in set(key_of.values()))
    looks = [any(encoder_wire.unseen(line) for line in b"".join(a.chunks).split(b"\r")) for a in struck.arrivals]
    damaged = sum(look and a.copies == 0 for look, a in zip(looks, struck.arrivals, strict=True))
    assert false <= (damaged if kind in BLIND else 0)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "wrong-length"])
@pytest.mark.parametrize("seed", [1, 2])
def test_every_intact_fix_is_delivered_and_no_other(kind: str, seed: int) -> None:
    """A fifth of the sentences struck; a sentence that came twice is one epoch."""
    frames = gps_wire.sentences(seed, FRAMES)
    struck = damage([line for line, _ in frames], LINES["gps"], [Fault(kind)], seed)
    receive = gps_wire.driver()
    found: Counter[Hashable] = Counter(key for chunk in struck.chunks if chunk for key in receive(chunk))
    found.update(receive(b""))
    key_of = dict(frames)
    intact = {key_of[line] for line in struck.intact([line for line, _ in frames])}
    assert intact <= set(found)
    assert set(found) <= set(key_of.values())
    assert max(found.values()) == 1
