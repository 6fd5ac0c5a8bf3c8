"""Fans hold every sum of their segments, however often they are turned, and little more."""

from math import cos, pi, sin

import numpy as np

from estimator.fan import DIRECTIONS, add_box, add_segment, add_turned, support


def test_a_fan_reaches_as_far_as_its_segments_in_every_direction_and_hardly_farther() -> None:
    """Against the exact support of the segments; a segment gets a tenth of its length wider across."""
    random = np.random.default_rng(1)
    for _ in range(200):
        segments = random.normal(size=(random.integers(1, 6), 2)) * 10.0 ** random.uniform(-6, 3)
        segments[random.random(len(segments)) < 0.2, random.integers(2)] = 0.0  # along an axis
        fan = np.zeros(DIRECTIONS)
        for x, y in segments:
            add_segment(fan, x, y)
        for angle in random.uniform(-pi, pi, 20):
            far = float(np.abs(segments @ (cos(angle), sin(angle))).sum())
            reached = support(fan, cos(angle), sin(angle))
            assert far <= reached <= far + 0.1 * float(np.hypot(*segments.T).sum())


def test_a_turned_fan_holds_the_turned_segments_at_every_angle_within_the_sway() -> None:
    """Also after several turns, whole ones among them; and a box holds its corners."""
    random = np.random.default_rng(2)
    for _ in range(200):
        corner = random.normal(size=2)
        fan, angles = np.zeros(DIRECTIONS), random.choice([0.3, -2.0, pi, 0.5 * pi, 7.0, -40.0, 0.0], 3)
        sway = float(random.choice([0.0, 0.02, 0.5]))
        add_box(fan, abs(corner[0]), abs(corner[1]))
        for angle in angles:
            before, fan = fan, np.zeros(DIRECTIONS)
            add_turned(fan, before, float(angle), sway)
        turned = float(angles.sum()) + float(random.choice([-1.0, 1.0, 0.1])) * 3.0 * sway
        c, s = cos(turned), sin(turned)
        x, y = c * corner[0] - s * corner[1], s * corner[0] + c * corner[1]
        for direction in random.uniform(-pi, pi, 20):
            assert x * cos(direction) + y * sin(direction) <= support(fan, cos(direction), sin(direction)) + 1e-13
