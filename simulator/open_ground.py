"""Rolling open ground and a long random drive over it: stops, spins, reversals (SMF section 13's scenario)."""

from collections.abc import Iterator
from math import atan2, cos, hypot, pi, remainder, sin

import numpy as np
from numpy.typing import NDArray

from simulator.terrain import Course, Manoeuvre, Terrain, smoothed

HALF_SIDE_M = 60.0
HOME_RADIUS_M = 40.0
"""Further out than this the robot turns back."""
CELL_M = 0.25
HILLS = ((9.0, 1.0), (3.0, 0.16))
"""(wavelength m, share of the height)."""
CRUISE_MPS = 0.9
RAMP_S = 3.0
"""Gentle: the accelerometers are declared to feel no more than 0.07 g beside gravity."""


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
        cruise_mps=CRUISE_MPS,
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
    """Forward, stop, spin, now and then reverse; home again when too far out (planned as if on a plane)."""
    x = y = elapsed = 0.0
    while elapsed < duration_s:
        far = hypot(x, y) > HOME_RADIUS_M
        aim = remainder(atan2(-y, -x) - heading, 2 * pi) if far else float(random.uniform(-2.2, 2.2))
        if not far and random.random() < 0.15:
            drive = Manoeuvre(float(random.uniform(7.0, 10.0)), speed=-float(random.uniform(0.45, 0.8)))
        else:
            drive = Manoeuvre(float(random.uniform(8.0, 30.0)), speed=float(random.uniform(0.45, 1.0)))
        spin_s = max(abs(aim) / 0.5, RAMP_S) + RAMP_S
        moves = (Manoeuvre(spin_s, spin_rps=aim / (spin_s - RAMP_S)), drive)
        for move in moves:
            yield move
            elapsed += move.duration_s
        heading += aim
        way = CRUISE_MPS * drive.speed * (drive.duration_s - RAMP_S)
        x, y = x + way * cos(heading), y + way * sin(heading)
        if random.random() < 0.2:
            yield Manoeuvre(4.0)
            elapsed += 4.0
