"""Rolling open ground and a long random drive over it: stops, spins, reversals (SMF section 13's scenario)."""

from collections.abc import Iterator
from math import atan2, copysign, cos, hypot, pi, remainder, sin

import numpy as np
from numpy.typing import NDArray

from simulator.terrain import Course, Manoeuvre, Terrain, smoothed

HALF_SIDE_M = 60.0
HOME_RADIUS_M = 40.0
"""Further out than this the robot turns back."""
CELL_M = 0.25
HILLS = ((9.0, 1.0), (3.0, 0.16))
"""(wavelength m, share of the height)."""
FASTEST_MPS, SLOWEST_MPS = 1.0, 0.4
LEAST_SPIN_RAD = 0.3
"""No robot creeps round so slowly that its counters, and whoever reads them, must take it for standing still."""
RAMP_S = 3.3
"""Gentle: the accelerometers are declared to feel no more than 0.07 g beside gravity."""
STOP_S = 4.0
RESTS_S = 3.0
"""The robot stands for so long in all before and after its manoeuvres (robot.motion_profile)."""


def open_ground(seed: int, rms_slope_deg: float = 5.0, duration_s: float = 600.0) -> Terrain:
    """Random ground of the given rms slope, 120 m square, and manoeuvres for `duration_s` that stay on it."""
    random = np.random.default_rng(seed)
    heights = _hills(random, np.tan(np.radians(rms_slope_deg)))
    heading = float(random.uniform(-pi, pi))
    course = Course(
        0.0,
        0.0,
        heading,
        straight_m=1e9,
        circle_radius_m=1.0,
        weave_rad=0.15,
        weave_length_m=7.0,
        cruise_mps=FASTEST_MPS,
        manoeuvres=tuple(_wander(random, heading, duration_s)),
        manoeuvre_ramp_s=RAMP_S,
        reach_m=HALF_SIDE_M - 1.0,
    )
    return Terrain("open", seed, heights, -HALF_SIDE_M, -HALF_SIDE_M, CELL_M, np.zeros((0, 6)), course)


def _hills(random: np.random.Generator, rms_slope: float) -> NDArray[np.float64]:
    """Heights with hills of several wavelengths, scaled to the slope."""
    count = round(2 * HALF_SIDE_M / CELL_M) + 1
    heights: NDArray[np.float64] = np.zeros((count, count))
    for wavelength_m, share in HILLS:
        hills = smoothed(random.standard_normal((count, count)), 0.25 * wavelength_m / CELL_M)
        heights += share * hills / hills.std()
    slopes = np.gradient(heights, CELL_M)
    heights *= rms_slope / np.sqrt(np.mean(slopes[0] ** 2 + slopes[1] ** 2))
    return heights


def _wander(random: np.random.Generator, heading: float, duration_s: float) -> Iterator[Manoeuvre]:
    """Legs of 0.4 to 1 m/s; between them a spin, a stop or a short way back (planned as if on a plane).

    Home again, by a spin, when too far out. The last move ends with the drive, gently.
    """
    x = y = elapsed = 0.0
    while elapsed < duration_s - RESTS_S:
        speed, lasts_s = float(random.uniform(SLOWEST_MPS, FASTEST_MPS)), float(random.uniform(8.0, 30.0))
        chance, aim = random.random(), float(random.uniform(-2.2, 2.2))
        if hypot(x, y) > HOME_RADIUS_M:
            chance, aim = 0.0, remainder(atan2(-y, -x) - heading, 2 * pi)
        if chance < 0.6:
            aim = copysign(max(abs(aim), LEAST_SPIN_RAD), aim)
            spin_s = max(abs(aim) / 0.5, RAMP_S) + RAMP_S
            between = Manoeuvre(spin_s, spin_rps=aim / (spin_s - RAMP_S))
            heading += aim
        elif chance < 0.8:
            between = Manoeuvre(STOP_S)
        else:
            between = Manoeuvre(0.4 * lasts_s + RAMP_S, speed=-0.8 * speed / FASTEST_MPS)
        for move in (between, Manoeuvre(lasts_s, speed=speed / FASTEST_MPS)):
            left_s = duration_s - RESTS_S - elapsed
            if left_s < move.duration_s:
                slower = min(left_s / (2.0 * RAMP_S), 1.0)
                yield Manoeuvre(left_s, slower * move.speed, slower * move.spin_rps)
                return
            yield move
            elapsed += move.duration_s
            way = FASTEST_MPS * move.speed * (move.duration_s - RAMP_S)
            x, y = x + way * cos(heading), y + way * sin(heading)
