"""Counters that wrap and units that restart: what is believed is true, and what isn't sure is told."""

from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.track_encoders.odometer import Odometer, Reading, TrackLimits

MS = 1_000_000
RATE = 5000.0
"""Ticks a second: 1 m/s at 0.2 mm."""


def odometer(bits: int = 16, rate: float | None = RATE, restart_ms: float = 100.0) -> tuple[Odometer, Counter[str]]:
    """Both tracks alike; readings up to 4 ms late."""
    counts = Counter[str]()
    limits = TrackLimits(bits, rate)
    return Odometer(limits, limits, 4 * MS, round(restart_ms * MS), counts), counts


def reading(left: int, right: int, t_ns: int, bits: int = 16) -> Reading:
    """What the unit sends."""
    return Reading(left % (1 << bits), right % (1 << bits), t_ns, t_ns)


drives = st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.integers(1, 90)), min_size=1, max_size=60)


@given(st.sampled_from([12, 16, 24, 32]), drives, st.integers(0, 2**32))
def test_no_tick_is_lost_or_invented_within_the_declared_speed(
    bits: int, drive: list[tuple[float, float, int]], start: int
) -> None:
    """Whatever the tracks do below their greatest speed, over any wrap: counts of one epoch differ as they truly do."""
    counter, counts = odometer(bits)
    left = right = start
    t_ms = 0
    pairs = [(c, left, right) for c in counter.take(reading(left, right, 0, bits))]
    for share_left, share_right, step_ms in drive:
        t_ms += step_ms
        left += int(share_left * RATE * step_ms * 1e-3)
        right += int(share_right * RATE * step_ms * 1e-3)
        pairs += [(count, left, right) for count in counter.take(reading(left, right, t_ms * MS, bits))]
    assert len(pairs) == len(drive) + 1
    assert counts["jumps"] == counts["restarts"] == 0
    for (a, left_a, right_a), (b, left_b, right_b) in pairwise(pairs):
        if a.epoch == b.epoch:
            assert (b.left - a.left, b.right - a.right) == (left_b - left_a, right_b - right_a)


@given(st.integers(0, 65535), st.integers(0, 65535), st.integers(0, 50))
def test_a_restart_is_never_taken_for_a_wrap(left: int, right: int, moved: int) -> None:
    """Silent for its restart time, then from zero: a new epoch, wherever the counters stood."""
    counter, _ = odometer()
    before = counter.take(reading(left, right, 0))[-1]
    (after,) = counter.take(reading(moved, moved, 101 * MS))
    assert after.epoch == before.epoch + 1
    assert (after.left, after.right) == (moved, moved)


@given(st.integers(0, 65535), st.integers(0, 65535))
def test_a_restart_without_silence_is_seen_by_its_jump(left: int, right: int) -> None:
    """Unless both counts stood where the tracks could have run from anyhow, which no count can tell."""
    counter, counts = odometer()
    counter.take(reading(left, right, 0))
    first, second = counter.take(reading(0, 0, 10 * MS)), counter.take(reading(10, 10, 20 * MS))
    far = any(min(raw, 65536 - raw) > 2 * RATE * 0.014 + 2 for raw in (left, right))
    if far:
        assert first == []
        assert [(c.left, c.right, c.epoch) for c in second] in ([(0, 0, 1), (10, 10, 1)], [(0, 0, 1), (10, 10, 2)])
        assert counts["restarts"] + counts["gaps"] == 1
    else:
        assert [c.epoch for c in first + second] == [0, 0]


def test_a_narrow_counter_is_trusted_as_long_as_it_cannot_have_wrapped_unseen() -> None:
    """8 bits at 5000 ticks a second: 10 ms are up to 72 ticks, 30 ms may be more than half the range."""
    counter, counts = odometer(bits=8)
    told = []
    for t_ms, raw in ((0, 250), (10, 40), (20, 90), (50, 200), (60, 250)):
        told += [(c.left, c.epoch) for c in counter.take(reading(raw, raw, t_ms * MS, 8))]
    assert told == [(250, 0), (296, 0), (346, 0), (200, 1), (250, 1)]
    assert counts["gaps"] == 1


@pytest.mark.parametrize("bits", [8, 16, 24, 32])
def test_counters_begin_just_before_their_wrap(bits: int) -> None:
    """FAULTS: start 100 before 2^8, 2^16, 2^32; the distance is exact."""
    counter, counts = odometer(bits)
    start = (1 << bits) - 100
    told = [c for i in range(60) for c in counter.take(reading(start + 20 * i, start - 7 * i, 10 * i * MS, bits))]
    assert told[-1].left - told[0].left == 20 * 59
    assert told[-1].right - told[0].right == -7 * 59
    assert {c.epoch for c in told} == {0}
    assert sum(counts.values()) == 0


def test_without_a_known_speed_a_quarter_of_a_wide_range_is_a_jump() -> None:
    """As in a file of which nobody knows the robot."""
    counter, counts = odometer(rate=None, restart_ms=1e9)
    told = []
    for t, raw in ((0, 60_000), (1000, 5_000), (2000, 30_000), (3000, 30_010), (4000, 35_000)):
        told += [(c.left, c.epoch) for c in counter.take(reading(raw, raw, t * MS))]
    assert told == [(60_000, 0), (70_536, 0), (30_000, 1), (30_010, 1), (35_000, 1)]
    assert counts["jumps"] == counts["restarts"] == 1
