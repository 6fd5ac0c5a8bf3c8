"""Places yaw by yaw: the truth stays in its slice whatever the errors, and a yaw known badly gives little away."""

from math import cos, pi, sin

import numpy as np
import pytest

from bench.pose_faults import break_it, cases
from estimator.chaining import chain
from estimator.fan import add_segment, support
from estimator.odometry_block import BLOCK, bend_to, empty_block, extend_block
from estimator.place_by_yaw import SLICE, PlaceByYaw, cut_anew, halved
from estimator.place_polygon import SIDE_EAST, SIDE_NORTH, SIDES, polygon_of

QUANTUM = 0.002
SLIP, LATERAL = 0.02, 0.005
FIX_M = 0.05


def way(heading: float, turned: float, noise: float) -> np.ndarray:
    """Blocks of half a metre straight on, told by counts; then yaw has turned by so much, give or take the noise."""
    blocks = np.zeros(2, BLOCK)
    blocks["way"][0] = 0.5, 0.0
    blocks["last"][0] = 1.0, 0.0, 0.0, 0.0
    add_segment(blocks["error"][0], 0.5 * SLIP, 0.0)
    add_segment(blocks["error"][0], 0.0, 0.5 * LATERAL)
    blocks["heading"][0] = heading, 0.0, 0.0
    blocks["heading"][1] = heading + turned, 0.0, noise
    return blocks


@pytest.mark.parametrize("known", [pi, 0.6, 0.03])
@pytest.mark.parametrize("law", ["constant", "corners", "late"])
def test_the_truth_is_never_cut_off(known: float, law: str) -> None:
    """Slips, counts and fixes at the ends of their bounds; yaw known or not, over ways that wind round and round."""
    random = np.random.default_rng([int(known * 100), len(law)])
    for _ in range(12):
        places, at, yaw_true = PlaceByYaw(), random.uniform(-5, 5, 2), random.uniform(-pi, pi)
        yaw = yaw_true + np.array([-known, known]) * (1.0 if known < pi else 1.01)
        heading, ahead, off_by, blocks = 0.3, random.choice([-1.0, 1.0], 2), 0.0, np.zeros(2, BLOCK)
        for fix in range(60):
            box = fix_of(at, law, fix, random)
            assert places.narrowed(blocks, 0.0, QUANTUM, 0.0, np.zeros(2), yaw, box) if fix else True
            assert np.all((box[:, 0] <= at) & (at <= box[:, 1])), fix
            miss = (yaw_true - 0.5 * (yaw[0] + yaw[1]) + pi) % (2 * pi) - pi
            assert abs(miss) <= 0.5 * (yaw[1] - yaw[0]) + 1e-9, fix
            places.go_on(QUANTUM, yaw, box)
            turned, noise = random.uniform(-0.5, 0.7), 0.002
            blocks = way(heading, turned, noise)
            slipped = ahead if law == "constant" else random.choice([-1.0, 1.0], 2)
            before, off_by = off_by, 0.5 * QUANTUM * (1.0 if law == "constant" else random.choice([-1.0, 0.0, 1.0]))
            along, across = 0.5 + 0.5 * SLIP * slipped[0] + off_by - before, 0.5 * LATERAL * slipped[1]
            c, s = cos(yaw_true), sin(yaw_true)
            at = at + np.array([c * along - s * across, s * along + c * across])
            off = noise * random.choice([-1.0, 1.0])
            yaw_true, heading = yaw_true + turned + off, heading + turned
            yaw = yaw + turned + np.array([-noise, noise])


def fix_of(at: np.ndarray, law: str, fix: int, random: np.random.Generator) -> np.ndarray:
    """A box [2, 2] that holds the place, just."""
    error = (
        np.array([1.0, -1.0]) if law == "constant" or (law == "late" and fix < 30) else random.choice([-1.0, 1.0], 2)
    )
    off = (FIX_M - 1e-9) * error
    return np.stack([at + off - FIX_M, at + off + FIX_M], axis=1)


def test_yaw_that_was_unknown_is_found_between_fixes() -> None:
    """Some metres of a straight way, with no other help, tell yaw to a few degrees."""
    places, at, yaw = PlaceByYaw(), np.zeros(2), np.array([-pi, pi])
    for fix in range(10):
        box = np.stack([at - FIX_M, at + FIX_M], axis=1)
        assert not fix or places.narrowed(way(0.0, 0.0, 0.0), 0.0, QUANTUM, 0.0, np.zeros(2), yaw, box)
        places.go_on(QUANTUM, yaw, box)
        at = at + 0.5 * np.array([cos(0.7), sin(0.7)])
    assert yaw[0] <= 0.7 <= yaw[1]
    assert yaw[1] - yaw[0] < 0.2


def test_slices_that_are_cut_anew_lose_no_place() -> None:
    """Whatever was in an old slice is in a new one at that yaw."""
    random = np.random.default_rng(2)
    for _ in range(100):
        old, new = np.zeros(5, SLICE), np.zeros(32, SLICE)
        points = random.uniform(-1, 1, (5, 2))
        for k in range(5):
            old["yaw"][k] = np.sort(random.uniform(-1, 1, 2))
            polygon_of(np.stack([points[k], points[k]], axis=1), old["polygon"][k])
        first, last = old["yaw"].min(), old["yaw"].max()
        count = cut_anew(old, first, last, new)
        for k in range(5):
            for yaw in random.uniform(old["yaw"][k][0], old["yaw"][k][1], 5):
                holds = [
                    new["yaw"][j][0] <= yaw <= new["yaw"][j][1]
                    and np.all(SIDE_EAST * points[k, 0] + SIDE_NORTH * points[k, 1] <= new["polygon"][j] + 1e-12)
                    for j in range(count)
                ]
                assert any(holds)


def test_halves_are_the_whole() -> None:
    """Side by side, with the same polygon."""
    slices = np.zeros(4, SLICE)
    slices["yaw"][:2] = [[0.0, 1.0], [1.0, 3.0]]
    slices["polygon"][:2] = np.arange(2)[:, None] + np.arange(SIDES)
    assert halved(slices, 2) == 4
    assert slices["yaw"].tolist() == [[0.0, 0.5], [0.5, 1.0], [1.0, 2.0], [2.0, 3.0]]
    assert slices["polygon"][:, 0].tolist() == [0.0, 0.0, 1.0, 1.0]


def test_counts_that_begin_anew_in_the_middle_of_a_way_are_off_twice() -> None:
    """A counter restarts while the robot stands: the last count before it was off, and so is the last after it."""
    block, heading = np.zeros(2, BLOCK), np.zeros(3)
    empty_block(block, 0, np.zeros(2), 0.0)
    ahead = np.array([1.0, 0.0, 0.0])
    for step, axis in ((1.0, ahead), (0.0, np.zeros(3)), (1.0, ahead)):
        box = np.array([[step, step], [0.0, 0.0], [0.0, 0.0]])
        extend_block(block[0], box, axis, heading, QUANTUM, np.zeros(2), 0.0, 0.0)
    block["error"] = block["raw"]
    ways = chain(1, block, 0.0, QUANTUM, 0.0, 0.0, 0.0)
    assert ways.fan[0][0] >= 2.0 * QUANTUM


def test_an_axis_is_as_far_off_as_the_bias_may_be_from_where_the_way_began_with_it() -> None:
    """The bias is known better now, and to one side of what it was taken for; and it may have drifted."""
    blocks, later = np.zeros(1, BLOCK), np.array([0.0, -2.0, 0.0])
    blocks["last"][0] = 1.0, 0.0, 0.0, 0.0
    assert bend_to(blocks[0], later, (0.009, 0.01), 0.0) >= 2.0 * 0.01
    assert bend_to(blocks[0], later, (0.009, 0.01), 0.005) >= 2.0 * 0.015


def test_axes_before_and_after_the_fix_are_as_far_apart_as_the_noise_between_them() -> None:
    """The first step's heading is of a gyro packet before the fix, the second's of one after it; a count wavers."""
    block, noise = np.zeros(1, BLOCK), 0.01
    empty_block(block, 0, np.zeros(2), 0.0)
    for before_or_after in (-noise, noise):
        heading = np.array([0.0, 0.0, before_or_after])
        extend_block(block[0], np.zeros((3, 2)), np.array([1.0, 0.0, 0.0]), heading, QUANTUM, np.zeros(2), 0.0, 0.0)
    assert support(block["raw"][0], 0.0, 1.0) >= QUANTUM * 2.0 * noise
    assert bend_to(block[0], np.array([0.0, 0.0, -noise]), (0.0, 0.0), 0.0) >= 2.0 * noise


def test_a_wheel_scale_twice_beyond_its_bound_is_told_within_a_metre_though_yaw_is_known_to_two_degrees() -> None:
    """As soon as one who knows the true attitude could tell it, but for a fix or two."""
    case = next(case for case in cases() if "scale wrong by 4 %" in case.name)
    outcome = break_it(case, "uniform", 1, 60.0)
    assert outcome.named == "encoders"
    assert outcome.after_m <= 1.0
    assert outcome.soonest_m > 0.5
