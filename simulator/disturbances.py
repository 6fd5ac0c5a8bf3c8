"""What a laser sees that is no terrain: drops of rain or fog in the air, and people who walk by.

Each takes the true distances of a scan and shortens those of the beams that meet it: it stands in front of the ground,
never behind. Truth about the terrain is not changed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Droplets:
    """Drops that send an echo back, spread evenly through the air: rain with few, fog with many."""

    echoes_per_metre: float
    """How many a beam meets on its way, in the mean."""
    seed: int

    def seen(self, origins: Array, directions: Array, distances: Array, time_ns: int) -> Array:
        """Distances [n] to what each beam meets first."""
        random = np.random.default_rng([self.seed, time_ns])
        return np.minimum(distances, random.exponential(1.0 / self.echoes_per_metre, distances.shape))


@dataclass(frozen=True, slots=True)
class Walker:
    """A person as an upright cylinder, walking straight on."""

    x_m: float
    y_m: float
    """Where at time 0."""
    vx_mps: float
    vy_mps: float
    foot_m: float = -0.5
    head_m: float = 1.7
    radius_m: float = 0.2

    def seen(self, origins: Array, directions: Array, distances: Array, time_ns: int) -> Array:
        """Distances [n] to what each beam meets first. origins, directions: [n, 3]."""
        seconds = time_ns * 1e-9
        off = origins[:, :2] - [self.x_m + self.vx_mps * seconds, self.y_m + self.vy_mps * seconds]
        a = np.sum(directions[:, :2] ** 2, axis=1)
        b = np.sum(off * directions[:, :2], axis=1)
        c = np.sum(off**2, axis=1) - self.radius_m**2
        with np.errstate(invalid="ignore", divide="ignore"):
            reached = (-b - np.sqrt(b * b - a * c)) / a
        z = origins[:, 2] + reached * directions[:, 2]
        meets = (reached > 0.0) & (z >= self.foot_m) & (z <= self.head_m)  # False for NaN
        return np.where(meets, np.minimum(distances, reached), distances)


Disturbance = Droplets | Walker
