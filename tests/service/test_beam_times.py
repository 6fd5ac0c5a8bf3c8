"""Which beams share a pose."""

import numpy as np
from numpy.typing import NDArray

from drivers.samples import Scan, Stamp
from service.beam_times import STRETCH_NS, beam_times


def a_scan(offset_ns: NDArray[np.int64]) -> Scan:
    return Scan(Stamp(5_000, 6_000), offset_ns, 0.0, 0.01, np.ones(offset_ns.size), 0)


def test_every_beam_lies_in_its_stretch_and_no_stretch_is_longer_than_it_may() -> None:
    """Whatever the pattern of shots: sorted, interlaced, all at once, or far apart."""
    random = np.random.default_rng(1)
    patterns = [random.integers(0, 40_000_000, 300), np.zeros(5, np.int64), np.arange(361) * 7_000_000]
    for offset in patterns:
        times = beam_times(a_scan(offset))
        assert np.all(times.latest_ns - times.earliest_ns <= STRETCH_NS + 1_000)
        assert np.all(times.earliest_ns[times.pose_index] <= offset + 5_000)
        assert np.all(offset + 6_000 <= times.latest_ns[times.pose_index])
        assert np.array_equal(np.unique(times.pose_index), np.arange(len(times.earliest_ns)))


def test_two_half_turns_of_the_mirror_take_four_poses() -> None:
    """A scan of 0.5 degrees over 180: two sights of 6.67 ms, 6.67 ms apart, each cut in two."""
    turn_ns = 1_000_000_000 // 75
    half = np.arange(181) * (turn_ns // 2) // 180
    offset = np.empty(361, np.int64)
    offset[::2], offset[1::2] = half, turn_ns + half[:180]
    times = beam_times(a_scan(offset))
    assert len(times.earliest_ns) == 4
    assert not times.pose_index.flags.writeable
