"""A slice of the long proof over robots that nobody has built."""

import pytest

from bench.prove_robots import prove_robot
from bench.random_robot import random_robot


@pytest.mark.parametrize("seed", [16, 20, 22, 34, 70018])
def test_no_robot_s_truth_is_outside(seed: int) -> None:
    """Whatever the robot, its sensors and how they are read: poses hold the truth, and nothing is called broken."""
    score = prove_robot(seed)
    assert score.sound, score.notes
    assert score.checks > 80
    assert score.nearest > 0.3, "an easy drive shows nothing"


def test_a_seed_is_a_robot() -> None:
    """What is found broken once can be driven again."""
    assert random_robot(5).devices == random_robot(5).devices
    assert random_robot(5).behaviour == random_robot(5).behaviour
    assert random_robot(5).devices != random_robot(6).devices
