"""The ray caster against brute force over all triangles and boxes."""

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.raycast import cast
from simulator.terrain import Course, Terrain, build_terrain

Array = NDArray[np.float64]

RANGE_MAX_M = 12.0


def random_terrain(seed: int) -> Terrain:
    random = np.random.default_rng(seed)
    low = random.uniform(-4.0, 4.0, (6, 3)) * (1.0, 1.0, 0.3)
    boxes = np.hstack([low, low + random.uniform(0.1, 1.5, (6, 3))])
    heights = random.normal(0.0, 0.3, (17, 13))
    return Terrain("random", seed, heights, -4.5, -6.0, 0.75, boxes, Course(0, 0, 0, 1, 1))


def brute_force(terrain: Terrain, origin: Array, direction: Array) -> float:
    """Nearest hit by the determinant form of ray against triangle, over everything there is."""
    corners = []
    ny, nx = terrain.heights.shape
    for i in range(ny - 1):
        for j in range(nx - 1):
            p = [
                np.array([terrain.x0_m + (j + b) * terrain.cell_m, terrain.y0_m + (i + a) * terrain.cell_m,
                          terrain.heights[i + a, j + b]])
                for a, b in ((0, 0), (0, 1), (1, 1), (1, 0))
            ]  # fmt: skip
            corners += [(p[0], p[1], p[2]), (p[0], p[2], p[3])]
    for low, high in zip(terrain.boxes[:, :3], terrain.boxes[:, 3:], strict=True):
        for axis in range(3):
            u, v = np.eye(3)[(axis + 1) % 3] * (high - low), np.eye(3)[(axis + 2) % 3] * (high - low)
            for start in (low, low + np.eye(3)[axis] * (high - low)):
                corners += [(start, start + u, start + u + v), (start, start + u + v, start + v)]
    a, b, c = (np.array(points) for points in zip(*corners, strict=True))
    solved = np.linalg.solve(
        np.stack([np.broadcast_to(-direction, a.shape), b - a, c - a], axis=2), (origin - a)[..., None]
    )[..., 0]
    t, u, v = solved.T
    hit = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1 + 1e-12) & (t >= 0) & (t <= RANGE_MAX_M)
    return float(t[hit].min()) if hit.any() else float("inf")


@pytest.mark.parametrize("seed", range(4))
def test_a_ray_hits_what_brute_force_finds(seed: int) -> None:
    """Every random ray, from above and below, ends where the nearest triangle or box face is, to rounding."""
    terrain = random_terrain(seed)
    random = np.random.default_rng(seed)
    origins = random.uniform((-6.0, -7.0, -1.0), (6.0, 7.0, 3.0), (250, 3))
    directions = random.normal(size=(250, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    found = cast(terrain, origins, directions, RANGE_MAX_M)
    expected = np.array([brute_force(terrain, o, d) for o, d in zip(origins, directions, strict=True)])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert 20 < np.isfinite(found).sum() < 250


def test_rays_along_axes_borders_and_diagonals_are_not_lost() -> None:
    """Rays that run exactly in cell borders, along the diagonals, or straight down still find the ground."""
    terrain = random_terrain(9)
    terrain = Terrain("random", 9, terrain.heights, -4.5, -6.0, 0.75, np.zeros((0, 6)), terrain.course)
    origins, directions = [], []
    for x in (-3.0, -2.25, 0.0, 0.75):
        for towards in ((1, 0, -0.3), (-1, 0, -0.3), (0, 1, -0.3), (0, -1, -0.3), (1, 1, -0.4), (0, 0, -1)):
            origins.append((x, 0.0, 2.0))
            directions.append(np.array(towards) / np.linalg.norm(towards))
    o, d = np.array(origins), np.array(directions)
    expected = [brute_force(terrain, a, b) for a, b in zip(o, d, strict=True)]
    np.testing.assert_allclose(cast(terrain, o, d, RANGE_MAX_M), expected, atol=1e-9)


def test_no_ray_that_ends_below_ground_slips_through() -> None:
    """200,000 rays aimed from above the rough scene at points below it all hit."""
    terrain = build_terrain("rough")
    random = np.random.default_rng(3)
    start = random.uniform((-12, -8, 3), (12, 18, 4), (200_000, 3))
    end = random.uniform((-12, -8, -3), (12, 18, -2), (200_000, 3))
    way = end - start
    length = np.linalg.norm(way, axis=1)
    distances = cast(terrain, start, way / length[:, None], 60.0)
    assert (distances < length).all()


def test_hits_lie_on_the_top_surface_or_on_a_vertical_face() -> None:
    """What a steep ray hits on the stairs is at the terrain's height there."""
    terrain = build_terrain("stairs")
    random = np.random.default_rng(4)
    origins = random.uniform((0, -3, 4), (6, 3, 5), (5000, 3))
    directions = np.tile((0.0, 0.0, -1.0), (5000, 1))
    hits = origins[:, 2] - cast(terrain, origins, directions, 30.0)
    np.testing.assert_allclose(hits, terrain.height(origins[:, 0], origins[:, 1]), atol=1e-12)


def test_a_level_ray_meets_the_riser_of_a_stair() -> None:
    """Vertical faces are real: a level ray 7 cm above the ground stops exactly at the first riser."""
    distance = cast(build_terrain("stairs"), np.array([[0.5, 0.0, 0.07]]), np.array([[1.0, 0.0, 0.0]]), 30.0)
    assert distance[0] == pytest.approx(3.0, abs=1e-12)


def test_beyond_the_range_there_is_nothing() -> None:
    """A hit farther than range_max is +inf."""
    terrain = build_terrain("flat")
    origin, down = np.array([[0.0, 0.0, 5.0]]), np.array([[0.0, 0.0, -1.0]])
    assert np.isinf(cast(terrain, origin, down, 4.999)[0])
    assert cast(terrain, origin, down, 5.0)[0] == 5.0
