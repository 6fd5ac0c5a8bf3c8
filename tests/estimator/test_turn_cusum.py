"""Tracks against gyroscope over every stretch at once: what honest sensors never do, and what broken ones soon do."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.fault_drive import declared
from estimator.motion import QUANTUM, TrackBounds
from estimator.turn_cusum import add_step, begin_sums

Array = NDArray[np.float64]
STEP_NS, STEP_S, STEPS = 20_000_000, 0.02, 3000
GAUGE_M = 0.35
ROBOT, DEVICES = declared()
TICK_M = DEVICES.encoders.left_metres_per_tick
TRACKS = TrackBounds(
    slip=0.02, lateral=0.0, turning_centre=0.0, normal=0.0, quantum_left=TICK_M, quantum_right=TICK_M,
    most_speed=2.0, most_acceleration=1.0, most_track_acceleration=5.0,
)  # fmt: skip
NOISE = 1e-3
"""rad/s"""


def worst_stretch(slips: Array, noise: Array, stuck_at: int, late_ns: int, gauge: tuple[float, float]) -> list[int]:
    """Steps at which a stretch contradicts: a robot that weaves at 1 m/s, its slips [n, 2] and noise [n] in [-1, 1].

    The counts come `late_ns` after the gyroscope's packets; its last packet is repeated from `stuck_at` on.
    """
    times = np.repeat(np.arange(STEPS + 2)[:, np.newaxis] * STEP_NS, 2, axis=1)
    net, effort = np.zeros((STEPS + 2, 3, 2)), np.zeros((STEPS + 2, 3), dtype=np.int64)

    def turned(t_s: NDArray[np.floating[Any]]) -> Array:
        return np.asarray(0.2 - 0.2 * np.cos(t_s), dtype=np.float64)

    at_s = times[:, 0] * 1e-9
    measured = np.diff(turned(at_s)) + NOISE * STEP_S * noise[: STEPS + 1]
    measured[stuck_at:] = measured[min(stuck_at, STEPS)]
    net[1:, 2, 0], net[1:, 2, 1] = measured - NOISE * STEP_S * 1.0001, measured + NOISE * STEP_S * 1.0001
    effort[1:, 2] = np.cumsum(np.abs(measured) + 0.001) / QUANTUM
    yaw = turned(at_s[:-1] + 1e-9 * late_ns)
    centre = gauge[0] + (gauge[1] - gauge[0]) * (np.diff(yaw) > 0.0)  # the turning centres move at every reversal
    ground = STEP_S + np.array([-0.5, 0.5]) * (centre * np.diff(yaw))[:, np.newaxis]
    ran = np.vstack([np.zeros(2), np.cumsum(ground / (1.0 + 0.02 * slips[:STEPS]), axis=0)])
    counts = np.floor(ran / TICK_M) * TICK_M
    sums, told = np.zeros(2), []
    begin_sums(sums)
    for k in range(1, STEPS):
        left, right = (counts[k] - counts[k - 1]).tolist()
        last, now = ((k - 1) * STEP_NS + late_ns, k * STEP_NS + late_ns)
        beyond = add_step(
            sums, left, right, STEP_S, tuple(TRACKS), gauge, times, net, effort, 0, k + 2, last, last, now, now
        )
        if beyond > 0.0:
            told.append(k)
    return told


def slips_by(law: str, seed: int) -> tuple[Array, Array]:
    """[n, 2] of the tracks, and [n] noise, in [-1, 1]."""
    random = np.random.default_rng(seed)
    if law == "uniform":
        return random.uniform(-1.0, 1.0, (STEPS + 1, 2)), random.uniform(-1.0, 1.0, STEPS + 1)
    if law == "corners":
        return random.choice([-1.0, 1.0], (STEPS + 1, 2)), random.choice([-1.0, 1.0], STEPS + 1)
    return np.full((STEPS + 1, 2), (1.0, -1.0)) * (-1.0) ** seed, np.full(STEPS + 1, (-1.0) ** seed)


@pytest.mark.parametrize("law", ["uniform", "corners", "opposed"])
@pytest.mark.parametrize("gauge", [(GAUGE_M, GAUGE_M), (0.30, 0.45)])
@pytest.mark.parametrize("late_ns", [0, 7_000_000])
def test_honest_sensors_contradict_nobody(law: str, gauge: tuple[float, float], late_ns: int) -> None:
    """A minute of slips to opposite sides at their bound, on clocks of their own, with centres that move in [gauge]."""
    for seed in range(4):
        assert worst_stretch(*slips_by(law, seed), STEPS + 1, late_ns, gauge) == []


def test_a_stuck_gyroscope_is_noticed_in_the_worst_of_all_stretches() -> None:
    """White slips lean to one side by chance, for a step or five: 0.4 s at a time it would take twice as long."""
    stuck_at = round(2.0 * np.pi / STEP_S)  # straight ahead; 0.2 rad/s 1.6 s later
    for seed in range(4):
        told = worst_stretch(*slips_by("corners", seed), stuck_at, 0, (GAUGE_M, GAUGE_M))
        assert told
        assert 0 < told[0] - stuck_at < 30
