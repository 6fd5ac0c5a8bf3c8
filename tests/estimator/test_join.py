"""Two explanations of what was measured become one set: it holds both, and holds the truth from then on."""

from collections import Counter
from dataclasses import replace
from functools import cache
from math import cos, radians, sin

import numpy as np
import pymap3d
import pytest

from bench.fault_drive import RATES, RTK, Reading, declared, inside, world_of
from drivers.samples import Fix
from estimator.config import FilterConfig, SetName
from estimator.pose_set import PoseSet
from simulator.faults import METRES_PER_DEGREE
from simulator.sample_stream import sample_stream

LAW, SEED, SECONDS = "switching", 3, 34.0
SENSORS = ("gps", "encoders", "gyro", "tilt", "accelerometer", "imu_clock", "imu_latency")
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


def ahead(fix: Fix, metres: float) -> Fix:
    """The fix so far ahead of where it was, along the way that the robot drives then."""
    world = world_of(LAW, SEED, SECONDS)
    yaw = world.pose(fix.stamp.mid_ns)[5]
    north, east = metres * sin(yaw) / METRES_PER_DEGREE, metres * cos(yaw) / METRES_PER_DEGREE
    return replace(fix, lat_deg=fix.lat_deg + north, lon_deg=fix.lon_deg + east / cos(radians(fix.lat_deg)))


def holds(poses: PoseSet) -> bool:
    """Is the true place on Earth in the newest box? Its origin is the first fix."""
    world, now_ns = world_of(LAW, SEED, SECONDS), poses.horizon_ns or 0
    low, high = boxes(poses, np.array([now_ns]), on_earth=True)
    first = next(sample for _, samples in readings() for sample in samples if isinstance(sample, Fix))
    x, y, z = world.pose(now_ns)[:3]
    place = pymap3d.enu2geodetic(x, y, z, *world.origin)
    true = pymap3d.geodetic2enu(*place, first.lat_deg, first.lon_deg, first.alt_m)[:2]
    return bool(np.all((low[0, :2] <= true) & (true <= high[0, :2])))


@pytest.mark.parametrize("misled_first", [True, False])
def test_what_only_one_of_both_explanations_holds_goes_on_after_the_join(misled_first: bool) -> None:
    """Fixes drifted away for three seconds. Who believed them lost the truth; who didn't has it, and so does the join.

    Not only where they were joined: from there on by the tracks alone, whichever of them takes the other in.
    """
    together = begin("box")
    feed(together, 0, 700)
    misled = together.copy(Counter(), frozenset({"encoders"}))
    right = together.copy(Counter(), frozenset({"gps"}))
    for step in range(700, 850):
        for sample in readings()[step][1]:
            misled.accept(ahead(sample, 0.003 * (step - 700)) if isinstance(sample, Fix) else sample)
            right.accept(sample)
    assert misled.journal.contradiction is None
    assert not holds(misled)
    assert holds(right)
    joined, other = (misled, right) if misled_first else (right, misled)
    joined.join(other)
    joined.ignored = frozenset()
    for _, samples in readings()[850:890]:
        for sample in samples:
            if not isinstance(sample, Fix):
                joined.accept(sample)
        assert holds(joined)
