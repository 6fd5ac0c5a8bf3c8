"""Counts that come no more: poses go on without them, and when they come back it is as if they had not been away."""

from dataclasses import replace
from math import nan

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.fault_drive import RTK, Reading, declared, inside, settings, world_of
from drivers.samples import Fix, WheelTicks
from estimator.filter import Filter
from simulator.sample_stream import Rates, sample_stream

SECONDS = 16.0
FROM_S, TO_S = 4.0, 11.0
RATES = Rates(steps_per_fix=5)


def drive(
    law: str, seed: int, fixes: bool, to_s: float = TO_S, seconds: float = SECONDS, jump_s: float = nan, **changes: str
) -> tuple[Filter, NDArray[np.float64]]:
    """A drive without counts from FROM_S to `to_s`, all poses held against the truth; [n, 7] time and widths."""
    world, (robot, devices) = world_of(law, seed, seconds), declared()
    poses = Filter(robot, settings(**changes), devices.encoders, devices.imu, devices.gps)
    start, rows = world.pose(world.start_ns), []

    def heard(reading: Reading, t_s: float) -> Reading | None:
        if isinstance(reading, WheelTicks) and FROM_S <= t_s < to_s:
            return None
        if isinstance(reading, Fix) and t_s >= jump_s:
            return replace(reading, alt_m=reading.alt_m + 50.0)
        return reading

    for k, (now_ns, readings) in enumerate(sample_stream(world, RTK if fixes else None, RATES)):
        t_s = (now_ns - world.start_ns) * 1e-9
        for reading in readings:
            told = heard(reading, t_s)
            if told is not None:
                poses.accept(told)
        newest = poses.latest() if k % 5 == 0 else None
        past_ns = now_ns - 2_700_000_000
        past = poses.pose_over(past_ns, past_ns) if newest is not None and t_s >= 3.0 else None
        for pose in (newest, past):
            if pose is not None:
                assert inside(world.pose(pose.latest_ns), start, pose.low, pose.high), t_s
        if newest is not None:
            rows.append([(newest.latest_ns - world.start_ns) * 1e-9, *(newest.high - newest.low)])
        if past is not None and FROM_S + 0.1 < t_s - 2.7 < FROM_S + 0.4:
            # Of the beginning of the silence no more is unknown than the way since then.
            assert past.high[0] - past.low[0] < 2.0 * robot.max_speed_mps
    return poses, np.array(rows)


def between(rows: NDArray[np.float64], begin_s: float, end_s: float) -> NDArray[np.float64]:
    """[n, 6] widths of poses in that time: there must be some in each half second."""
    times = rows[:, 0]
    for begin in np.arange(begin_s, end_s - 0.5, 0.5):
        assert np.any((times >= begin) & (times < begin + 0.5)), f"no pose between {begin} and {begin + 0.5} s"
    return rows[(times >= begin_s) & (times < end_s), 1:]


ALL = [("box", "constant"), ("box", "corners"), ("box", "switching"), ("ellipsoid", "constant")]


@pytest.mark.parametrize(("kept", "law"), ALL)
@pytest.mark.parametrize("fixes", [False, True], ids=["alone", "with fixes"])
def test_without_counts_the_place_grows_and_with_them_it_is_as_if_they_had_not_been_away(
    kept: str, law: str, fixes: bool
) -> None:
    """Poses come again after three seconds, no wider than the way that the robot may have gone; nobody is accused."""
    poses, rows = drive(law, 1, fixes, set=kept)
    assert poses.guarantee.intact
    before, silent = between(rows, FROM_S - 1.0, FROM_S), between(rows, FROM_S + 3.2, TO_S)
    after = between(rows, TO_S + 0.5, SECONDS)
    robot, _ = declared()
    assert before[-1, :2].max() < silent[-1, :2].max() < 2.0 * 1.1 * robot.max_speed_mps * (TO_S - FROM_S) + 1.0
    assert after[0, :2].max() < 0.8 * silent[-1, :2].max()
    assert silent[:, 3:5].max() < np.radians(2.0)


@pytest.mark.parametrize(("to_s", "jump_s"), [(TO_S, 9.0), (40.0, 24.0)])
def test_a_fix_that_is_wrong_while_no_counts_come_is_told_at_once(to_s: float, jump_s: float) -> None:
    """Not when they are back; and whoever is suspected, the poses hold."""
    poses, _ = drive("constant", 1, True, to_s, jump_s + 4.0, jump_s)
    assert poses.guarantee.sensor == "gps"
    assert poses.faults[0].suspects == ("gps",)
    contradicted_ns = poses.faults[0].contradiction.time_ns
    assert contradicted_ns == world_of("constant", 1, jump_s + 4.0).start_ns + round(jump_s * 1e9)
