"""A receiver's velocity says of yaw what it may, and nothing where the robot may stand, whichever way it drives."""

from math import atan2, cos, pi, remainder, sin

import numpy as np

from estimator.ground_velocity import off_mean, yaw_by_velocity
from estimator.interval import is_empty

SECONDS, ACCELERATION, BOUND_MPS = 0.04, 0.7, 0.1


def test_yaw_by_velocity_holds_the_true_yaw_forwards_backwards_and_sliding() -> None:
    """Velocities that change as fast as declared, at either end of the stretch, and receivers off by all they may."""
    random, told, worst = np.random.default_rng(1), 0, 0.0
    off = off_mean(SECONDS, ACCELERATION, 0.0, 0.0)
    for _ in range(20_000):
        yaw = float(random.uniform(-pi, pi))
        middle = random.uniform(-1.0, 1.0, 2) * (1.0, 0.3)
        change = ACCELERATION * float(random.choice([-1.0, 1.0])) * np.array([1.0, float(random.choice([-1.0, 1.0]))])
        way = middle * SECONDS
        now = middle + float(random.choice([-0.5, 0.5, 0.1])) * change * SECONDS
        c, s = cos(yaw), sin(yaw)
        said = np.array([c * now[0] - s * now[1], s * now[0] + c * now[1]])
        said = said + BOUND_MPS * random.choice([-1.0, 1.0], 2)
        box = ((way[0], way[0]), (way[1], way[1]))
        seen = yaw_by_velocity(float(said[0]), float(said[1]), BOUND_MPS, box, off)
        if is_empty(seen):
            continue
        told += 1
        half = 0.5 * (seen[1] - seen[0])
        used = abs(remainder(yaw - 0.5 * (seen[0] + seen[1]), 2 * pi)) / half
        assert used <= 1.0
        worst = max(worst, used)
    assert told > 5000
    assert worst > 0.9  # the errors were as bad as they may be


def test_a_robot_that_may_stand_tells_no_yaw() -> None:
    """Neither a velocity within its bound of zero, nor a way that may be none, has a direction."""
    still, way = ((-1e-4, 1e-4), (-1e-4, 1e-4)), ((0.02, 0.021), (0.0, 0.0))
    assert is_empty(yaw_by_velocity(0.09, -0.05, BOUND_MPS, way, 0.0))
    assert is_empty(yaw_by_velocity(0.5, 0.5, BOUND_MPS, still, 0.0))
    assert is_empty(yaw_by_velocity(0.5, 0.5, BOUND_MPS, way, 0.03))
    seen = yaw_by_velocity(0.5, 0.5, BOUND_MPS, way, 0.0)
    assert seen[0] < atan2(0.5, 0.5) < seen[1]
