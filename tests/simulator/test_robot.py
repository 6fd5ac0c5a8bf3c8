"""The robot's true motion keeps its own laws and all limits that are declared for it."""

import functools

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.errors import LAWS, ErrorLaw
from simulator.robot import STEP_NS, Drive, RobotModel, exceeded_limits, plan_drive, rotations
from simulator.terrain import build_terrain

MODEL = RobotModel()
SCENES = ("flat", "ramp", "stairs", "rough", "yard")
H = STEP_NS * 1e-9


@functools.cache
def drive(scene: str, law: str = "corners", seed: int = 1, duration_s: float = 40.0) -> Drive:
    return plan_drive(MODEL, build_terrain(scene, seed), ErrorLaw(law, seed), duration_s)


def exponential(turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n, 3, 3] rotations about vectors [n, 3] (Rodrigues)."""
    angle = np.linalg.norm(turns, axis=1)[:, None, None]
    x, y, z = turns.T
    zero = np.zeros_like(x)
    k = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), 2, 0)
    safe = np.where(angle > 0, angle, 1.0)
    rotation: NDArray[np.float64] = np.eye(3) + np.sin(angle) / safe * k + (1 - np.cos(angle)) / safe**2 * (k @ k)
    return rotation


@pytest.mark.parametrize("scene", SCENES)
def test_integrated_gyro_increments_arrive_at_the_true_attitude(scene: str) -> None:
    """A strapdown integration of the true increments ends within 1e-6 rad of the true attitude after 40 s."""
    truth = drive(scene)
    steps = exponential(np.diff(truth.turned, axis=0))
    attitude = rotations(truth.pose[:1])[0]
    for step in steps:
        attitude = attitude @ step
    expected = rotations(truth.pose[-1:])[0]
    assert np.abs(attitude - expected).max() < 1e-6
    assert np.abs(truth.pose[-1, 3:] - truth.pose[0, 3:]).max() > 0.1


@pytest.mark.parametrize("scene", SCENES)
def test_integrated_body_velocity_arrives_at_the_true_position(scene: str) -> None:
    """R (v, v_l, v_n) integrated over the drive is the way from the first to the last pose."""
    truth = drive(scene)
    way = 0.5 * H * (truth.velocity[1:] + truth.velocity[:-1]).sum(axis=0)
    np.testing.assert_allclose(way, truth.pose[-1, :3] - truth.pose[0, :3], atol=1e-6)
    in_body = np.einsum("nji,nj->ni", rotations(truth.pose), truth.velocity)
    np.testing.assert_allclose(in_body[:, 0], truth.speed, atol=1e-12)


@pytest.mark.parametrize("scene", SCENES)
def test_increments_obey_the_euler_kinematics(scene: str) -> None:
    """Body rates turned into Euler rates (SMF equation 1) give each step of roll, pitch and yaw to 1e-7 rad."""
    truth = drive(scene)
    roll, pitch = truth.pose[:, 3], truth.pose[:, 4]
    x, y, z = truth.rate.T
    euler = np.column_stack(
        [
            x + np.tan(pitch) * (y * np.sin(roll) + z * np.cos(roll)),
            y * np.cos(roll) - z * np.sin(roll),
            (y * np.sin(roll) + z * np.cos(roll)) / np.cos(pitch),
        ]
    )
    steps = 0.5 * H * (euler[1:] + euler[:-1])
    assert np.abs(np.diff(truth.pose[:, 3:], axis=0) - steps).max() < 1e-7


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("scene", SCENES)
def test_no_limit_is_exceeded(scene: str, law: str) -> None:
    """Speed, acceleration, turn rate and turn acceleration keep a tenth away from what is declared."""
    assert exceeded_limits(MODEL, drive(scene, law), margin=0.9) == []


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("scene", SCENES)
def test_side_and_normal_slip_stay_in_their_bounds(scene: str, law: str) -> None:
    """|v_l| <= lateral |v| + centre |w_z| and |v_n| <= normal |v| hold at every millisecond."""
    truth = drive(scene, law)
    in_body = np.einsum("nji,nj->ni", rotations(truth.pose), truth.velocity)
    side = MODEL.lateral_slip_ratio * np.abs(truth.speed) + MODEL.turning_centre_m * np.abs(truth.rate[:, 2])
    assert (np.abs(in_body[:, 1]) <= side + 1e-13).all()
    assert (np.abs(in_body[:, 2]) <= MODEL.normal_slip_ratio * np.abs(truth.speed) + 1e-13).all()


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("scene", SCENES)
def test_track_slip_stays_in_its_bound_on_every_interval(scene: str, law: str) -> None:
    """|ground - encoder| <= slip_ratio |encoder| over steps, tenths of seconds, and (forward) the whole drive."""
    truth = drive(scene, law)
    for stride in (1, 10, 100, 1000, len(truth.ground) - 1)[: 3 if scene == "yard" else 5]:
        ground = truth.ground[stride:] - truth.ground[:-stride]
        tracks = truth.tracks[stride:] - truth.tracks[:-stride]
        assert (np.abs(ground - tracks) <= MODEL.slip_ratio * np.abs(tracks) + 1e-13).all()


def test_constant_slip_touches_its_bound() -> None:
    """Under the constant law each track slips by exactly the declared ratio."""
    truth = drive("flat", "constant")
    ratio = np.abs(truth.ground[-1] / truth.tracks[-1] - 1.0)
    np.testing.assert_allclose(ratio, MODEL.slip_ratio, rtol=1e-6)


@pytest.mark.parametrize("scene", SCENES)
def test_ground_travel_of_the_tracks_is_speed_and_turn(scene: str) -> None:
    """The tracks' mean travel is the integral of v; their difference is the turned angle times the gauge."""
    truth = drive(scene)
    np.testing.assert_allclose(truth.ground.mean(axis=1), truth.travelled, atol=1e-12)
    np.testing.assert_allclose(np.diff(truth.ground)[:, 0], MODEL.track_gauge_m * truth.turned[:, 2], atol=1e-12)


@pytest.mark.parametrize("scene", SCENES)
def test_the_robot_stands_still_for_two_seconds_at_both_ends_it_rests(scene: str) -> None:
    """The first two seconds and the last one are free of any motion, exactly."""
    truth = drive(scene)
    assert (truth.pose[:2001] == truth.pose[0]).all()
    assert (truth.pose[-1000:] == truth.pose[-1]).all()
    assert (truth.rate[:2001] == 0.0).all()


def test_the_robot_climbs_the_stairs_at_an_angle() -> None:
    """In 25 s it gets onto the landing, 0.84 m up, with its nose up by more than 20 degrees on the way."""
    truth = drive("stairs", duration_s=25.0)
    assert truth.pose[-1, 2] == pytest.approx(0.84, abs=0.02)
    assert np.degrees(truth.pose[:, 4].min()) < -20
    assert np.degrees(truth.pose[0, 5]) == pytest.approx(6.9, abs=0.1)


def test_a_slower_robot_drives_slower() -> None:
    """Where the declared limits are tight, the drive is slowed down until all of them hold."""
    careful = RobotModel(max_speed_mps=0.3, max_turn_rate_dps=12.0)
    truth = plan_drive(careful, build_terrain("stairs"), ErrorLaw("corners", 1), 30.0)
    assert exceeded_limits(careful, truth) == []
    assert 0.05 < truth.speed.max() < 0.3


def test_a_robot_that_cannot_drive_the_scene_is_refused() -> None:
    """Impossible limits are named."""
    with pytest.raises(ValueError, match="max_turn_rate_dps"):
        plan_drive(RobotModel(max_turn_rate_dps=0.1), build_terrain("stairs"), ErrorLaw(), 10.0)


def test_specific_force_is_gravity_at_rest() -> None:
    """Standing on level ground an accelerometer feels (0, 0, g)."""
    np.testing.assert_allclose(drive("flat").specific_force[0], (0.0, 0.0, 9.80665), atol=1e-12)


def test_a_drive_repeats_by_its_seed() -> None:
    """Same seed, same drive; another seed, another slip."""
    terrain = build_terrain("rough", 4)
    one, two, other = (plan_drive(MODEL, terrain, ErrorLaw("uniform", s), 8.0) for s in (4, 4, 5))
    np.testing.assert_array_equal(one.pose, two.pose)
    np.testing.assert_array_equal(one.tracks, two.tracks)
    assert (one.tracks[-1] != other.tracks[-1]).any()


def test_in_the_yard_tracks_turn_against_each_other_and_backwards() -> None:
    """The robot spins both ways in place and reverses, in 45 s, and never leaves the walls."""
    truth = drive("yard", duration_s=45.0)
    left, right = np.diff(truth.ground, axis=0).T / H
    spinning = np.abs(truth.speed[:-1]) < 1e-12
    assert (left[spinning] < -0.03).any()
    assert (left[spinning] > 0.03).any()
    assert (left[spinning] * right[spinning] <= 1e-9).all()
    assert truth.speed.min() < -0.2
    assert truth.speed.max() > 0.2
    assert np.abs(truth.pose[:, :2]).max() < 6.0


def test_turning_centres_sinking_and_slip_keep_what_is_declared_of_them() -> None:
    """The tracks differ by the turn times a distance within [least, most]; normal speed and slip stay within ratios."""
    model = RobotModel(turning_gauge_m=(0.4, 0.6), pulled=True, sinks=True, normal_slip_ratio=0.1, slip_ratio=0.2)
    truth = plan_drive(model, build_terrain("yard", 2), ErrorLaw("corners", 2), 20.0)
    apart, turn = np.diff(truth.ground[:, 1] - truth.ground[:, 0]), np.diff(truth.turned[:, 2])
    least, most = np.minimum(0.4 * turn, 0.6 * turn), np.maximum(0.4 * turn, 0.6 * turn)
    assert np.all((least - 1e-15 <= apart) & (apart <= most + 1e-15))
    assert np.ptp(apart[np.abs(turn) > 1e-6] / turn[np.abs(turn) > 1e-6]) > 0.19
    normal = np.einsum("nji,nj->ni", rotations(truth.pose), truth.velocity)[:, 2]
    assert np.all(np.abs(normal) <= 0.1 * np.abs(truth.speed) + 1e-12)
    assert np.abs(normal).max() > 0.05 * np.abs(truth.speed).max()
    slipped, way = np.diff(truth.ground - truth.tracks, axis=0), np.diff(truth.tracks, axis=0)
    assert np.all(np.abs(slipped) <= 0.2 * np.abs(way) + 1e-15)
