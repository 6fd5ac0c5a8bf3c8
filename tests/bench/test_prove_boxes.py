"""A slice of what `make prove` does with boxes and cells."""

import numpy as np
import pytest

from bench.attained import attained
from bench.prove_boxes import ANGLES, LASER, LEVELS, Score, a_case, check, corners, hits, prove, uniform
from mapper.projection import project


def test_points_are_inside_their_boxes_and_cells_and_hard_enough_to_find_others_outside() -> None:
    """At every level: 0 outside; and many of the same corners are outside the first-order box."""
    for level, (metres, degrees) in enumerate(LEVELS):
        case, at_corners, inside = a_case(metres, degrees, level), Score(), Score()
        check(case, corners(case, 12, 1), at_corners)
        check(case, uniform(case, 4, 1), inside)
        assert at_corners.outside_box == at_corners.outside_cell == inside.outside_box == inside.outside_cell == 0
        assert at_corners.outside_first_order > 0.03 * at_corners.points


def test_the_proof_says_that_it_held() -> None:
    """The tables of a small run, with mpmath's interval arithmetic in it."""
    text, sound = prove(40_000, 40)
    assert sound
    assert text.count("| corners |") == len(LEVELS)


@pytest.mark.parametrize(("level", "largest"), [(0, 1.5), (1, 1.5), (2, 1.8)])
def test_boxes_hold_the_farthest_points_there_are_and_are_hardly_wider(level: int, largest: float) -> None:
    """Up to 20 cm and 1 degree: the farthest points inside, 1 % wider in the mean along each axis, none much more."""
    case, some = a_case(*LEVELS[level], level), np.s_[::10]
    boxes = project(case.scan, LASER, case.low, case.high, case.index)
    least, most = attained(hits, case.middle[some], case.half[some], ANGLES)
    assert np.all(boxes.low[some] <= least)
    assert np.all(most <= boxes.high[some])
    excess = 100 * ((boxes.high - boxes.low)[some] / (most - least) - 1)
    assert np.all(excess.mean(axis=0) < 1.0)
    assert excess.max() < largest


def test_boxes_hold_what_lies_between_the_ends_of_yaw() -> None:
    """Yaw known to 28 degrees, little else unknown: along the beam the farthest point is between yaw's ends."""
    case, some = a_case(0.001, 0.01, 9), np.s_[::10]
    case.low[:, 5] -= 0.48
    case.high[:, 5] += 0.48
    case.half[:, 5] += 0.48 * (1 - 1e-12)
    boxes = project(case.scan, LASER, case.low, case.high, case.index)
    least, most = attained(hits, case.middle[some], case.half[some], ANGLES)
    assert np.all(boxes.low[some] <= least)
    assert np.all(most <= boxes.high[some])
    assert np.all(((boxes.high - boxes.low)[some] / (most - least)).mean(axis=0) < 1.08)
