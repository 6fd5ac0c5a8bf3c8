"""How the sensors err in the paper's simulation: white, drifting, at the corners of their bounds, and beyond them.

Errors are told as shares of the bound: [n, 3] for place, pitch and range.
"""

from collections.abc import Callable
from itertools import product
from math import exp, sqrt

import numpy as np
from numpy.typing import NDArray

from bench.baselines.normal_table import PLACES_PER_UNIT, REACH, VALUES
from bench.paper.profile_drive import RATE_HZ

Floats = NDArray[np.float64]
Law = Callable[[np.random.Generator, int, int], Floats]
"""(random numbers, number of the run, measurements) to errors."""

MEMORY_S = (5.0, 0.5, 0.0)
"""How long errors of place, pitch and range last, where they drift: Ornstein and Uhlenbeck's process."""
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


def uniform(rng: np.random.Generator, run: int, count: int) -> Floats:
    """Anywhere within the bound, anew each time."""
    return rng.uniform(-1.0, 1.0, (count, 3))


def drifting_uniform(rng: np.random.Generator, run: int, count: int) -> Floats:
    """Anywhere within the bound, and for a while near there."""
    places = (_drifting_normal(rng, count) + REACH) * PLACES_PER_UNIT
    probabilities: Floats = np.interp(places, np.arange(VALUES.size), VALUES)
    return 2.0 * probabilities - 1.0


def gaussian(rng: np.random.Generator, run: int, count: int) -> Floats:
    """Normal with the bound at three sigma, cut off there."""
    return np.clip(uncut_gaussian(rng, run, count), -1.0, 1.0)


def drifting_gaussian(rng: np.random.Generator, run: int, count: int) -> Floats:
    """The same, lasting."""
    return np.clip(_drifting_normal(rng, count) / 3.0, -1.0, 1.0)


def corners(rng: np.random.Generator, run: int, count: int) -> Floats:
    """The whole bound, one way or the other, anew each time."""
    return rng.choice([-1.0, 1.0], (count, 3))


def bias(rng: np.random.Generator, run: int, count: int) -> Floats:
    """The whole bound, the same all the time: a calibration error. The eight corners take turns."""
    return np.tile(_CORNERS[run % len(_CORNERS)], (count, 1))


def uncut_gaussian(rng: np.random.Generator, run: int, count: int) -> Floats:
    """Normal with the bound at three sigma: 0.3 % of the errors are beyond it."""
    return rng.normal(0.0, 1.0 / 3.0, (count, 3))


def wide_gaussian(rng: np.random.Generator, run: int, count: int) -> Floats:
    """Normal with the bound at one sigma: a third of the errors is beyond it."""
    return rng.normal(0.0, 1.0, (count, 3))


def _drifting_normal(rng: np.random.Generator, count: int) -> Floats:
    """[count, 3] standard normal, each axis with its memory."""
    values = rng.normal(0.0, 1.0, (count, 3))
    for axis, memory_s in enumerate(MEMORY_S):
        if memory_s:
            keep = exp(-1.0 / (RATE_HZ * memory_s))
            values[:, axis] = _remember(values[:, axis], keep)
    return values


def _remember(white: Floats, keep: float) -> Floats:
    """y[n] = keep y[n-1] + sqrt(1 - keep^2) white[n], y[0] = white[0]."""
    fresh, y = sqrt(1.0 - keep * keep), np.empty_like(white)
    last = y[0] = white[0]
    for n, value in enumerate((fresh * white[1:]).tolist(), 1):
        y[n] = last = keep * last + value
    return y


HOLDING: dict[str, Law] = {
    "uniform": uniform,
    "uniform, drifting": drifting_uniform,
    "Gaussian": gaussian,
    "Gaussian, drifting": drifting_gaussian,
    "corners": corners,
    "constant bias": bias,
}
"""Laws under which every error is within its bound."""
BROKEN: dict[str, tuple[Law, float]] = {
    "Gaussian, not cut off (0.3 % beyond)": (uncut_gaussian, 1.0),
    "Gaussian, sigma = bound": (wide_gaussian, 1.0),
    "uniform, drifting, 0.9 of the bound declared": (drifting_uniform, 0.9),
    "uniform, drifting, 0.8 of the bound declared": (drifting_uniform, 0.8),
    "uniform, drifting, 0.67 of the bound declared": (drifting_uniform, 0.67),
}
"""Laws that break it, and the share of the true bound that is declared."""
