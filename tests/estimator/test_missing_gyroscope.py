"""A gyroscope, or its whole board, that says nothing any more or never did: sets grow, and nothing breaks."""

from collections.abc import Callable
from dataclasses import replace
from math import inf, radians
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.fault_drive import RTK, Reading, declared, inside, settings, world_of
from drivers.samples import ABSENT3, InertialSample, Stamp
from estimator.bounded_pose import BoundedPose
from estimator.filter import Filter
from estimator.gyro_silence import GyroSilence
from simulator.sample_stream import Rates, sample_stream

SECONDS = 14.0
FROM_S, TO_S = 4.0, 9.0
RATES = Rates(steps_per_tilt=1, steps_per_fix=5)

Missing = Callable[[Reading, float], Reading | None]


class Seen(NamedTuple):
    """A pose, asked for at the time of the newest readings."""

    t_s: float
    pose: BoundedPose | None


def gyro_between(begin_s: float, end_s: float) -> Missing:
    """The board goes on to tell the rest, tilt ten times a second, in packets of another kind."""

    def missing(reading: Reading, t_s: float) -> Reading | None:
        if not isinstance(reading, InertialSample) or not begin_s <= t_s < end_s:
            return reading
        return replace(reading, message="DUAL_AXIS_TILT", gyro_rps=ABSENT3) if round(t_s * 50) % 5 == 0 else None

    return missing


def board_between(begin_s: float, end_s: float) -> Missing:
    """The board says nothing at all."""

    def missing(reading: Reading, t_s: float) -> Reading | None:
        return None if isinstance(reading, InertialSample) and begin_s <= t_s < end_s else reading

    return missing


def drive(missing: Missing, law: str, seed: int, fixes: bool = True, **changes: str) -> list[Seen]:
    """One drive; whatever is seen holds the truth, and nobody is accused."""
    world, (robot, devices) = world_of(law, seed, SECONDS), declared()
    poses = Filter(robot, settings(**changes), devices.encoders, devices.imu, devices.gps)
    start, counted_ns, seen = None, [], []
    for k, (now_ns, readings) in enumerate(sample_stream(world, RTK if fixes else None, RATES)):
        t_s = (now_ns - world.start_ns) * 1e-9
        counted_ns.append(now_ns)
        for reading in readings:
            left = missing(reading, t_s)
            if left is not None:
                poses.accept(left)
        if start is None and poses.horizon_ns is not None:
            start = world.pose(counted_ns[poses.counts["encoders_before_attitude"]])
        if k % 5 == 0 and start is not None:
            pose = poses.pose_over(now_ns, now_ns)
            assert pose is None or inside(world.pose(now_ns), start, pose.low, pose.high), t_s
            seen.append(Seen(t_s, pose))
    assert poses.guarantee.intact
    return seen


def widths(seen: list[Seen], begin_s: float, end_s: float) -> NDArray[np.float64]:
    """[n, 6] of all there is to be seen in that time: it must be there."""
    there = [pose.high - pose.low for t_s, pose in seen if begin_s <= t_s < end_s and pose is not None]
    assert len(there) >= len([t_s for t_s, _ in seen if begin_s <= t_s < end_s]) > 0
    return np.array(there)


ALL = [("box", "constant"), ("box", "corners"), ("box", "switching"), ("ellipsoid", "constant")]


@pytest.mark.parametrize(("kept", "law"), ALL)
def test_while_the_gyroscope_is_silent_roll_and_pitch_are_as_the_tilt_sensor_says(kept: str, law: str) -> None:
    """A pose at every tilt reading; roll and pitch within two of its bounds then, and all as before when it is back."""
    seen = drive(gyro_between(FROM_S, TO_S), law, 1, set=kept)
    tilt = 2.0 * radians(declared()[1].imu.tilt_bound_deg)
    before, silent = widths(seen, FROM_S - 1.0, FROM_S), widths(seen, FROM_S + 1.2, TO_S)
    after = widths(seen, TO_S + 0.5, SECONDS)
    assert silent[:, 3:5].max() <= 1.01 * tilt
    assert silent[-1, 5] > 2.0 * before[-1, 5]
    assert after[:, 3:5].max() <= 1.01 * tilt
    assert np.all(np.isfinite(after))


@pytest.mark.parametrize(("kept", "law"), ALL)
def test_while_the_whole_board_is_silent_the_place_grows_with_the_way(kept: str, law: str) -> None:
    """Of roll, pitch, yaw nothing is known soon; the place is as far off as the robot may have come. Then it ends."""
    robot, _ = declared()
    seen = drive(board_between(FROM_S, TO_S), law, 2, fixes=False, set=kept)
    silent, after = widths(seen, FROM_S + 1.2, TO_S), widths(seen, TO_S + 0.5, SECONDS)
    assert silent[-1, :3].max() < 2.0 * 1.5 * robot.max_speed_mps * (TO_S - FROM_S)
    assert silent[-1, 3] > radians(90.0)
    assert after[:, 3:5].max() < radians(3.0)


@pytest.mark.parametrize("kept", ["box", "ellipsoid"])
def test_a_robot_whose_gyroscope_never_speaks_has_poses_all_the_same(kept: str) -> None:
    """A board that starts is given ten seconds; then the map begins without."""
    seen = drive(gyro_between(-inf, inf), "constant", 3, set=kept)
    assert widths(seen, 11.0, SECONDS)[:, 3:5].max() < radians(3.0)


def test_a_gyroscope_that_speaks_seldom_is_not_taken_for_a_silent_one() -> None:
    """One packet in two seconds: no step is made of anything else."""
    world, (robot, devices) = world_of("constant", 1, SECONDS), declared()
    poses = Filter(robot, settings(), devices.encoders, devices.imu, devices.gps)
    for now_ns, readings in sample_stream(world, RTK, Rates(step_ns=20_000_000, steps_per_tilt=1)):
        for reading in readings:
            if isinstance(reading, InertialSample) and (now_ns - world.start_ns) % 2_000_000_000:
                reading = replace(reading, message="DUAL_AXIS_TILT", gyro_rps=ABSENT3)
            poses.accept(reading)
    horizon_ns = poses.horizon_ns
    assert horizon_ns is not None
    assert (horizon_ns - world.start_ns) % 2_000_000_000 == 0


def test_the_first_packet_after_a_silence_is_not_taken_for_the_last_step_alone() -> None:
    """Its mean may be of all that time; from the second on they are believed again."""
    silence, millisecond = GyroSilence(), 1_000_000
    for ms in range(0, 500, 10):
        assert not silence.ends(Stamp(ms * millisecond, ms * millisecond))
    steps = [silence.step_by_board(Stamp(ms * millisecond, ms * millisecond)) for ms in range(500, 2000, 100)]
    assert steps == [ms > 1490 for ms in range(500, 2000, 100)]
    back = [silence.ends(Stamp(ms * millisecond, ms * millisecond)) for ms in (2000, 2010, 2020)]
    assert back == [True, False, False]
    assert not silence.step_by_board(Stamp(2100 * millisecond, 2100 * millisecond))


def test_a_packet_that_ends_a_silence_out_of_order_leaves_the_next_one_untold() -> None:
    """It comes after a tilt reading that was made later: the packet after it tells of more than the step since then."""
    poses = Filter(declared()[0], settings(), declared()[1].encoders, declared()[1].imu, None)

    def hear(ms: int, gyro: bool) -> None:
        stamp, rate = Stamp(ms * 1_000_000, ms * 1_000_000), (1e-4, 1e-4, 1e-4)
        kind = "HIGHRES_IMU" if gyro else "DUAL_AXIS_TILT"
        poses.accept(InertialSample(stamp, kind, 0, None, gyro_rps=rate if gyro else ABSENT3, tilt_rad=(0.0, 0.0)))

    for ms in range(0, 500, 10):
        hear(ms, gyro=True)
    hear(2000, gyro=False)
    packets = poses._hypotheses[0]._attitude.packets
    for ms, told in ((1995, False), (2005, False), (2015, True)):
        hear(ms, gyro=True)
        assert np.isfinite(packets[len(packets) - 1].rate).all() == told, ms
