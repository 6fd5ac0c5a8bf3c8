"""Two explanations of what was measured become one set: it holds both, and holds the truth from then on."""

from collections import Counter
from functools import cache

import numpy as np
import pytest

from bench.fault_drive import RATES, RTK, Reading, declared, inside, world_of
from estimator.config import FilterConfig, SetName
from estimator.pose_set import PoseSet
from simulator.sample_stream import sample_stream

LAW, SEED, SECONDS = "switching", 3, 34.0
SENSORS = ("gps", "encoders", "gyro", "tilt", "accelerometer", "imu_clock")
TRIALS = 8


@cache
def readings() -> list[tuple[int, list[Reading]]]:
    """One drive without a fault."""
    return list(sample_stream(world_of(LAW, SEED, SECONDS), RTK, RATES))


def begin(kept: SetName) -> PoseSet:
    """A pose set that knows nothing yet."""
    robot, devices = declared()
    return PoseSet(
        robot,
        FilterConfig(set=kept, history_s=3.0, standstill_s=0.5, standstill_rate_dps=0.02),
        devices.encoders,
        devices.imu,
        devices.gps,
        Counter(),
    )


def feed(poses: PoseSet, first: int, last: int) -> None:
    """Steps first to last of the drive."""
    for _, samples in readings()[first:last]:
        for sample in samples:
            poses.accept(sample)


def boxes(poses: PoseSet, times: np.ndarray, on_earth: bool) -> tuple[np.ndarray, np.ndarray]:
    """Pose boxes at those instants."""
    low, high = np.empty((len(times), 6)), np.empty((len(times), 6))
    assert poses.poses_over(times, times, low, high, on_earth) == 0
    return low, high


@pytest.mark.parametrize("kept", ["box", "ellipsoid"])
def test_a_join_holds_both_and_then_the_truth(kept: SetName) -> None:
    """Sets that went apart at random, each without the word of some sensors: no pose of either is lost."""
    random, world = np.random.default_rng(7), world_of(LAW, SEED, SECONDS)
    start = world.pose(world.start_ns)
    parts = sorted(int(step) for step in random.integers(600, 1200, TRIALS))
    together, driven = begin(kept), 0
    for apart in parts:
        feed(together, driven, apart)
        driven = apart
        length = int(random.integers(1, 300))
        without = [
            frozenset(str(sensor) for sensor in random.choice(SENSORS, int(random.integers(0, 4)), replace=False))
            for _ in range(2)
        ]
        one, other = (together.copy(Counter(), ignored) for ignored in without)
        feed(one, apart, apart + length)
        feed(other, apart, apart + length)
        joined = one.copy(Counter())
        joined.join(other)
        joined.ignored = frozenset()
        ends = [(poses.oldest_ns or 0, poses.horizon_ns or 0) for poses in (one, other, joined)]
        first, last = max(a for a, _ in ends), min(b for _, b in ends)
        assert last - first > 5e7 or length < 5
        times = random.integers(first, last + 1, 40)
        for on_earth in (False, True):
            low, high = boxes(joined, times, on_earth)
            for poses in (one, other):
                its_low, its_high = boxes(poses, times, on_earth)
                assert np.all(low <= its_low)
                assert np.all(its_high <= high)
        anchor = joined.anchor
        for poses in (one, other):
            its = poses.anchor
            if its is not None and anchor is not None:
                assert np.all(anchor.low <= its.low)
                assert np.all(its.high <= anchor.high)
        for step in range(apart + length, apart + length + 250, 10):
            feed(joined, step, step + 10)
            now_ns = joined.horizon_ns or 0
            now = boxes(joined, np.array([now_ns]), on_earth=False)
            assert inside(world.pose(now_ns), start, now[0][0], now[1][0])
        assert joined.journal.contradiction is None
