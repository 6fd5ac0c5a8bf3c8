"""The two places of the paper's experiments (doi 10.5772/57293, section 6), as far as its text tells: stairs and snow.

Sizes of the steps, speed, cell size and the extent of the snow are the paper's; everything else (how many steps, the
shape of the snow, how much of the light comes back) is ours.
"""

from math import radians

import numpy as np
from numpy.typing import NDArray

from simulator.terrain import STEP_RISE_M, STEP_TREAD_M, Course, Terrain, smoothed

Array = NDArray[np.float64]

STAIRS_FIRST_M = 3.4
STAIRS_STEPS = 5
STAIRS_HEADING_DEG = 6.0
SNOW_AHEAD_M = 2.0
"""Where the 4 m by 6 m of snow begin, in front of the robot."""
LOST_IN_SNOW = 0.15


def paper_stairs(seed: int) -> Terrain:
    """Steps of 14 cm by 34 cm, a landing and a wall; the robot comes at 10 cm/s, not quite at right angles."""
    boxes = []
    for k in range(STAIRS_STEPS):
        x = STAIRS_FIRST_M + k * STEP_TREAD_M
        far = x + STEP_TREAD_M if k < STAIRS_STEPS - 1 else x + 1.5
        boxes.append((x, -3.0, -0.5, far, 3.0, (k + 1) * STEP_RISE_M))
    wall = STAIRS_FIRST_M + (STAIRS_STEPS - 1) * STEP_TREAD_M + 1.5
    boxes.append((wall, -3.0, -0.5, wall + 0.3, 3.0, STAIRS_STEPS * STEP_RISE_M + 1.0))
    course = Course(
        0.0,
        -0.15,
        radians(STAIRS_HEADING_DEG),
        straight_m=6.0,
        circle_radius_m=5.0,
        weave_rad=0.01,
        cruise_mps=0.1,
        reach_m=7.0,
    )
    return Terrain("paper_stairs", seed, np.zeros((25, 25)), -30.0, -30.0, 2.5, np.array(boxes), course)


def paper_snow(seed: int) -> Terrain:
    """A passage between two walls of snow, uneven, with heaps that hide what is behind; some beams never come back."""
    cell, low_x, low_y, rows, columns = 0.05, -3.0, -6.0, 241, 321
    x, y = np.meshgrid(low_x + cell * np.arange(columns), low_y + cell * np.arange(rows))
    random = np.random.default_rng([seed, 7])
    coarse, fine = (_bumps(random, (rows, columns), length_m / cell) for length_m in (0.9, 0.25))
    ground = 0.05 * coarse + 0.012 * fine
    # The walls' feet waver about 0.75 m to either side; each rises by 0.9 m within 0.3 m, its crest is uneven.
    along = 0.12 * np.sin(1.3 * x) + 0.08 * np.sin(3.1 * x + 1.0)
    crest = 0.9 + 0.15 * coarse[::-1] + 0.03 * fine[::-1]
    begins = np.clip((x - SNOW_AHEAD_M) / 0.4, 0.0, 1.0)
    for side in (-1.0, 1.0):
        share = np.clip((side * y - 0.75 - along) / 0.3, 0.0, 1.0)
        ground = ground + begins * crest * share**2 * (3.0 - 2.0 * share)
    for at_x, at_y, height_m, radius_m in ((4.3, 0.45, 0.38, 0.22), (5.6, -0.4, 0.30, 0.25), (6.9, 0.15, 0.55, 0.30)):
        ground = ground + height_m * np.exp(-((((x - at_x) ** 2 + (y - at_y) ** 2) / radius_m**2) ** 2))
    course = Course(0.0, 0.0, 0.02, straight_m=8.0, circle_radius_m=5.0, weave_rad=0.03, cruise_mps=0.2, reach_m=12.0)
    no_boxes: Array = np.zeros((0, 6))
    return Terrain("paper_snow", seed, ground, low_x, low_y, cell, no_boxes, course, lost_echoes=LOST_IN_SNOW)


def _bumps(random: np.random.Generator, shape: tuple[int, int], wavelength_cells: float) -> Array:
    """Random ground of one wavelength and standard deviation 1."""
    bumps = smoothed(random.standard_normal(shape), 0.25 * wavelength_cells)
    return np.asarray(bumps / bumps.std())
