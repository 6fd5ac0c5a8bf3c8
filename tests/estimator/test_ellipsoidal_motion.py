"""One step of the ellipsoid against drives whose rates, slips and counts are at the corners of their bounds."""

import inspect
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator import ellipsoid as el
from estimator import ellipsoidal_motion as em
from estimator.frames import Tilt, columns, tilted
from estimator.tracks import Tracked

COMPILED = "from drivers.compiled import compiled_bare"
PLAIN = "compiled_bare = lambda function: function"
MS = 1e-3
STEP, LAG = 20, 3
"""Milliseconds from reading to reading, and from a reading to the gyro node after it."""
ERRORS = np.array([0.03, 0.01, 0.04, 0.01, 1e-4])
"""Slip, lateral slip, turning centre (m), normal slip; of the yaw's change (rad)."""
QUANTUM = 1e-3


def axes(roll: float, pitch: float, yaw: float) -> tuple[NDArray[np.float64], ...]:
    """Columns of R."""
    frame = ((roll, roll), (pitch, pitch), (yaw, yaw))
    return tuple(np.array(axis).mean(axis=1) for axis in columns(frame))


class Drive:
    """A true drive on a grid of milliseconds, and what the sensors say of each of its steps."""

    def __init__(self, rng: np.random.Generator, steps: int, half: NDArray[np.float64], flips: bool) -> None:
        """`half` [4]: half-widths of the ellipsoid's box at the beginning; `flips`: rates change sign in the steps."""
        n = steps * STEP + LAG + 1
        self.bias = rng.choice([-1.0, 1.0]) * 0.005
        grain = rng.integers(1, 8) if flips else n
        slip, lateral_slip, centre_m, normal, error = ERRORS * rng.integers(0, 2, 5)  # each there or not
        quantum = QUANTUM if rng.integers(2) else 1e-9
        v = 0.8 * np.repeat(rng.choice([-1.0, 1.0], n), grain)[:n]
        w = 0.6 * np.repeat(rng.choice([-1.0, 1.0], n), grain)[:n]
        self.tilt_half = 10.0 ** rng.uniform(-6.0, -1.5)
        self.tilt = rng.uniform(-0.4, 0.4, 2)
        at = self.tilt + rng.choice([-1.0, 1.0], 2) * self.tilt_half
        signs = rng.choice([-1.0, 1.0], 4)
        self.yaw = rng.uniform(-3.0, 3.0) + np.concatenate([[0.0], np.cumsum(w) * MS])
        self.place = np.zeros((n + 1, 2))
        for t in range(n):
            ahead, left, up = axes(at[0], at[1], 0.5 * (self.yaw[t] + self.yaw[t + 1]))
            lateral = signs[0] * (lateral_slip * abs(v[t]) + centre_m * abs(w[t]))
            moved = v[t] * ahead + lateral * left + signs[1] * normal * abs(v[t]) * up
            self.place[t + 1] = self.place[t] + MS * moved[:2]
        tracked = np.concatenate([[0.0], np.cumsum(v / (1.0 + slip * signs[2])) * MS])
        counted = np.floor(tracked / quantum + rng.random()) * quantum
        self.headings, self.travels = list[em.HeadingStep](), list[tuple[Tracked, float, float]]()
        for k in range(steps):
            a, b, m, after = k * STEP, (k + 1) * STEP, k * STEP + LAG, (k + 1) * STEP + LAG
            seconds = STEP * MS
            turned = self.yaw[after] - self.yaw[m]
            measured = turned + self.bias * seconds + signs[3] * error
            seen = self.yaw[a : after + 1] - self.yaw[m]
            self.headings.append(
                em.HeadingStep(measured, -seconds, error, (seen.min(), seen.max()), (-0.006, 0.006), 1e-9)
            )
            distance = counted[b] - counted[a]
            path = np.sum(np.abs(v[a:b])) * MS
            spare = slip * np.sum(np.abs(v[a:b] / (1.0 + slip * signs[2]))) * MS + 1e-12
            sideways = lateral_slip * path + centre_m * np.sum(np.abs(w[a:after])) * MS
            way = Tracked((distance - spare, distance + spare), path, quantum, counted=True)
            self.travels.append((way, sideways, normal * path))
        self.half = half

    def ellipsoid(self, rng: np.random.Generator) -> el.Ellipsoid:
        """One that has the true start on its boundary."""
        truth = self.at(0)
        root = rng.normal(size=(4, 4)) * self.half[:, None] / 2.0
        u = rng.normal(size=4)
        e = el.point(truth - root @ (u / np.linalg.norm(u)) * (1.0 - 1e-9), em.UNITS)
        e.shape[:] = root @ root.T + np.diag(self.half**2 * 1e-9)
        return e

    def at(self, k: int) -> NDArray[np.float64]:
        """The true state at reading k."""
        return np.array([*self.place[k * STEP], self.yaw[k * STEP + LAG], self.bias])

    def tilt_box(self) -> Tilt:
        """Roll and pitch, as intervals."""
        roll, pitch = ((float(a - self.tilt_half), float(a + self.tilt_half)) for a in self.tilt)
        return tilted(roll, pitch)


def nearest(e: el.Ellipsoid, truth: NDArray[np.float64], pending: NDArray[np.float64]) -> float:
    """Least (x-c)ᵀP⁻¹(x-c) over the places within `pending` of the truth: coordinate descent on a convex function."""
    inverse = np.linalg.inv(e.shape)
    middle = truth - e.centre
    x = middle.copy()
    for _ in range(60):
        for i in range(2):
            others = inverse[i] @ x - inverse[i, i] * x[i]
            x[i] = np.clip(-others / inverse[i, i], middle[i] - pending[i], middle[i] + pending[i])
    return float(x @ inverse @ x)


def drive(code: ModuleType, rng: np.random.Generator, steps: int, flips: bool) -> float:
    """Drive, and how far out (1: on the boundary) the truth came to be at most."""
    half = 10.0 ** rng.uniform([-7, -7, -7, -7], [0, 0, -0.3, -2.3])
    world = Drive(rng, steps, half, flips)
    e = world.ellipsoid(rng)
    kept = em.memory()
    worst = 0.0
    for k in range(steps):
        code.travel_ellipsoid(e, world.headings[k], *world.travels[k], world.tilt_box(), k == 0, kept)
        worst = max(worst, nearest(e, world.at(k + 1), kept[8:]))
    return worst


@pytest.mark.parametrize("flips", [False, True])
@pytest.mark.parametrize(("steps", "drives"), [(1, 400), (40, 20)])
def test_the_truth_never_leaves_whatever_the_rates_do_inside_a_step(steps: int, drives: int, flips: bool) -> None:
    """From the boundary of the first ellipsoid on, with all errors at their corners."""
    rng = np.random.default_rng(11 + steps)
    worst = max(drive(em, rng, steps, flips) for _ in range(drives))
    assert worst <= 1.0 + 1e-6
    assert steps > 1 or worst > 0.8  # the enclosure is not idle


BREAKS = {
    "the remainder left out": ("rest[i] = reach(axes[i], k) * tracked.path", "rest[i] = 0.0 * tracked.path", 10),
    "yaw's effect on the place": ("matrix[i, YAW] = a * d", "matrix[i, YAW] = 0.0", 10),
    "its sign": ("matrix[i, YAW] = a * d", "matrix[i, YAW] = -a * d", 10),
    "slip left out": ("columns[i, 0] = k * unsure", "columns[i, 0] = 0.5 * k * unsure", 10),
    "half the lateral slip": ("columns[i, 1] = mid", "columns[i, 1] = 0.5 * mid", 10),
    "the bias's sign": ("matrix[YAW, BIAS] = heading.per_bias", "matrix[YAW, BIAS] = -heading.per_bias", 10),
    "half the gyroscope's noise": ("heading.error + abs", "0.5 * heading.error + abs", 10),
    "heading at the beginning in place of all of the step": ("heading.inside, outward", "(0.0, 0.0), outward", 10),
}


@pytest.mark.parametrize("name", BREAKS)
def test_a_broken_step_is_caught(name: str) -> None:
    """Each of these mistakes, written into the code, loses the truth within 400 drives."""
    right, wrong, steps = BREAKS[name]
    source = inspect.getsource(em)
    assert COMPILED in source
    assert source.count(right) == 1, "the line to break is gone"
    broken = ModuleType("broken")
    plain = source.replace(COMPILED, PLAIN)
    exec(plain.replace(right, wrong), broken.__dict__)
    rng = np.random.default_rng(12)
    assert any(drive(broken, rng, steps, flips=bool(k % 2)) > 1.0 + 1e-3 for k in range(400))
