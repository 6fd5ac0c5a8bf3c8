"""The polygon of places: nothing of it is lost when it is cut and moved, and it knows when nothing is left."""

from math import cos, pi, sin

import numpy as np
import pytest

from estimator.chaining import chain
from estimator.fan import add_segment, support
from estimator.odometry_block import BLOCK
from estimator.place_polygon import SIDE_EAST, SIDE_NORTH, SIDES, cut_polygon, moved_polygon, polygon_of


def strip(x: float, y: float, low: float, high: float) -> np.ndarray:
    """A polygon without bounds but for two opposite sides, along direction number `x` of y."""
    polygon = np.full(SIDES, 1e3)
    side = round(x / (2.0 * pi) * SIDES) % SIDES
    polygon[side], polygon[(side + SIDES // 2) % SIDES] = high + y, -(low + y)
    return polygon


def test_a_box_keeps_its_points_and_its_size() -> None:
    """Every corner is inside every side, and some corner is on each."""
    box = np.array([[1.0, 3.0], [-7.0, -6.5]])
    polygon = np.empty(SIDES)
    polygon_of(box, polygon)
    corners = np.array([[x, y] for x in box[0] for y in box[1]])
    reach = np.max(corners @ np.array([SIDE_EAST, SIDE_NORTH]), axis=0)
    assert np.all(polygon >= reach)
    assert np.all(polygon <= reach + 1e-9)


@pytest.mark.parametrize("direction", [pi / 4, 3 * pi / 4, 5 * pi / 8])
def test_a_strip_that_passes_a_boxs_corner_leaves_nothing(direction: float) -> None:
    """The box of the two overlaps on both axes; only together do they contradict. A hair nearer they don't."""
    x, y = abs(cos(direction)), abs(sin(direction))
    corner = x + y  # how far the unit box reaches in that direction
    for beyond, left in ((1e-6, False), (-1e-6, True)):
        box = np.array([[-1.0, 1.0], [-1.0, 1.0]])
        assert cut_polygon(strip(direction, 0.0, corner + beyond, corner + 1.0), box) == left
        if left:
            assert np.max(box[:, 1] - box[:, 0]) < 1e-4


def test_no_point_of_a_cut_is_lost() -> None:
    """Random strips through a random point, and boxes around it, one after the other."""
    random = np.random.default_rng(3)
    for _ in range(200):
        point, polygon, box = random.uniform(-50, 50, 2), np.full(SIDES, 1e3), np.empty((2, 2))
        for _ in range(4):
            side = int(random.integers(SIDES))
            polygon[side] = min(
                polygon[side], SIDE_EAST[side] * point[0] + SIDE_NORTH[side] * point[1] + random.choice([1e-12, 0.5])
            )
            box[:, 0], box[:, 1] = point - random.choice([0.0, 1.0], 2), point + random.choice([0.0, 1.0], 2)
            assert cut_polygon(polygon, box)
            assert np.all((box[:, 0] <= point) & (point <= box[:, 1]))
            assert np.all(SIDE_EAST * point[0] + SIDE_NORTH * point[1] <= polygon)


def test_a_way_with_errors_at_their_bounds_stays_inside_and_along_it_nothing_is_given_away() -> None:
    """Yaw off by up to 3 degrees, 2 % along, 0.5 % across: across the yaw's 5 cm show, along it the 2 % alone."""
    random = np.random.default_rng(5)
    for trial in range(300):
        yaw_true, way = random.uniform(-pi, pi), 1.0
        half = np.radians(random.choice([0.0, 3.0]))
        yaw = np.array([yaw_true - half, yaw_true + half]) - random.choice([-1.0, 0.0, 1.0]) * half
        blocks = np.zeros(2, BLOCK)
        fan = blocks["error"][0]
        add_segment(fan, 0.02, 0.0)
        add_segment(fan, 0.0, 0.005)
        start, out = np.empty(SIDES), np.empty(SIDES)
        box = np.array([[-0.02, 0.02], [-0.03, 0.03]])
        polygon_of(box, start)
        blocks["way"][0] = way, 0.0
        moved_polygon(start, chain(1, blocks, 0.0, 0.0, 0.0, 0.0, 0.0), yaw[0], yaw[1], out)
        local = np.array([way + 0.02 * random.choice([-1, 1]), 0.005 * random.choice([-1, 1])])
        c, s = cos(yaw_true), sin(yaw_true)
        from_ = np.array([random.choice(axis) for axis in box])
        point = from_ + np.array([c * local[0] - s * local[1], s * local[0] + c * local[1]])
        assert np.all(SIDE_EAST * point[0] + SIDE_NORTH * point[1] <= out), trial
        middle = 0.5 * (yaw[0] + yaw[1])
        along = round(middle / (2.0 * pi) * SIDES) % SIDES
        if half == 0.0:
            x, y = cos(along * 2.0 * pi / SIDES - middle), sin(along * 2.0 * pi / SIDES - middle)
            assert out[along] <= start[along] + way * x + support(fan, x, y) + 1e-9
