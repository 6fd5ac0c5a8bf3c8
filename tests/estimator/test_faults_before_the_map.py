"""A sensor that breaks its bound before the first count: whoever is suspected, there is one map, with one beginning."""

from dataclasses import replace
from math import radians

import pytest

from bench.fault_drive import RTK, Reading, declared, inside, settings, world_of
from drivers.samples import ABSENT3, InertialSample, WheelTicks
from estimator.filter import Filter
from simulator.sample_stream import Rates, sample_stream

SECONDS = 14.0
FIRST_COUNT_S, FIRST_ACCEL_S = 1.0, 8.0


def tilted_deg(t_s: float) -> float:
    """By how much the tilt sensor is wrong: as if it tilted by 30 degrees a second, which only the gyroscope denies."""
    return max(0.0, 30.0 * min(t_s - 0.3, 0.9 - t_s))


def heard(reading: Reading, t_s: float) -> Reading | None:
    """Counts come late, accelerometers later; the tilt sensor jumps by ten degrees at first, then is right."""
    if isinstance(reading, WheelTicks):
        return reading if t_s >= FIRST_COUNT_S else None
    if isinstance(reading, InertialSample):
        roll, pitch = reading.tilt_rad
        accel = reading.accel_mps2 if t_s >= FIRST_ACCEL_S else ABSENT3
        return replace(reading, accel_mps2=accel, tilt_rad=(roll, pitch + radians(tilted_deg(t_s))))
    return reading


@pytest.mark.parametrize("kept", ["box", "ellipsoid"])
def test_hypotheses_that_know_their_tilt_at_different_times_begin_one_map(kept: str) -> None:
    """Without the tilt sensor's word the attitude is known only seconds after the others have begun to drive."""
    world, (robot, devices) = world_of("constant", 1, SECONDS), declared()
    poses = Filter(robot, settings(set=kept, history_s=0.5), devices.encoders, devices.imu, devices.gps)
    start, checked = None, 0
    for k, (now_ns, readings) in enumerate(sample_stream(world, RTK, Rates(steps_per_tilt=1, steps_per_fix=5))):
        t_s = (now_ns - world.start_ns) * 1e-9
        for reading in readings:
            told = heard(reading, t_s)
            if isinstance(told, WheelTicks) and start is None:
                start = world.pose(now_ns)
            if told is not None:
                poses.accept(told)
        assert len({one.began for one in poses._hypotheses if one.began is not None}) < 2, t_s
        pose = poses.pose_over(now_ns, now_ns) if k % 5 == 0 else None
        if pose is not None and start is not None:
            assert inside(world.pose(now_ns), start, pose.low, pose.high), t_s
            checked += 1
    assert "tilt" in poses.faults[0].suspects
    assert checked > 50
