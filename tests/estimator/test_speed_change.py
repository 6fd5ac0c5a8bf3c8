"""Counts whose pace changes: what a robot within its limits never does, and wheels that begin to spin do at once."""

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator.motion import QUANTUM, TrackBounds
from estimator.speed_change import LONGEST, follow

Array = NDArray[np.float64]
STEP_NS, STEPS = 20_000_000, 1500
GAUGE_M, TICK_M, SLIP, MOST_MPS2 = 0.35, 2e-4, 0.02, 1.0
TRACKS = TrackBounds(
    slip=SLIP, lateral=0.0, turning_centre=0.0, normal=0.0, quantum_left=TICK_M, quantum_right=TICK_M,
    most_speed=2.0, most_acceleration=MOST_MPS2, most_track_acceleration=5.0,
)  # fmt: skip
NOISE_RPS = 1e-3
SPIN_AT = 650
"""A step at which the robot drives at 1 m/s and brakes."""


def told_at(
    slips: Array, geared: bool, width_ns: int = 0, scale: float = 1.0, spin_mps: float = 0.0, seed: int = 1
) -> list[int]:
    """Steps at which no speed explains the counts: a robot that speeds up and brakes as hard as it may, and reverses.

    slips [n, 2] in [-1, 1]. Each stamp is `width_ns` wide, the truth at one of its ends. From SPIN_AT on both tracks
    count `scale` times too much, and `spin_mps` besides.
    """
    random = np.random.default_rng(seed)
    nodes = STEPS + 4
    at_ns = np.arange(1, STEPS + 1) * STEP_NS
    fine_s = np.arange(0.0, nodes * STEP_NS * 1e-9, 1e-4)
    speed = 0.25 - 1.25 * MOST_MPS2 * (np.abs((fine_s / 2.5) % 2.0 - 1.0) * 2.0 - 1.0)  # a triangle, -1 to 1.5 m/s
    went = np.concatenate([[0.0], np.cumsum(0.5e-4 * (speed[1:] + speed[:-1]))])
    yaw = 0.2 * fine_s - 0.1 * np.sin(2.0 * fine_s)

    times = np.repeat(np.arange(nodes)[:, np.newaxis] * STEP_NS, 2, axis=1)
    turned = np.diff(np.interp(times[:, 0] * 1e-9, fine_s, yaw))
    read = turned + NOISE_RPS * STEP_NS * 1e-9 * random.choice([-1.0, 1.0], nodes - 1)
    net, effort = np.zeros((nodes, 3, 2)), np.zeros((nodes, 3), dtype=np.int64)
    spread = NOISE_RPS * STEP_NS * 1e-9 * 1.0001
    net[1:, 2, 0], net[1:, 2, 1] = read - spread, read + spread
    effort[1:, 2] = np.cumsum(np.abs(read) + spread + 1e-4) / QUANTUM

    ground = (
        np.interp(at_ns * 1e-9, fine_s, went)[:, np.newaxis]
        + np.array([-0.5, 0.5]) * GAUGE_M * (np.interp(at_ns * 1e-9, fine_s, yaw)[:, np.newaxis])
    )
    moved = np.diff(ground, axis=0, prepend=ground[:1])
    ran = moved / (1.0 + SLIP * slips[:STEPS] * (np.abs(moved) > 1e-3))  # none where a track turns round
    ran[SPIN_AT:] = ran[SPIN_AT:] * scale + spin_mps * STEP_NS * 1e-9
    counts = np.floor(np.cumsum(ran, axis=0) / TICK_M) * TICK_M

    early = random.integers(0, 2, STEPS) * width_ns
    steps, stamps, speeds = np.zeros((LONGEST + 1, 4)), np.zeros((LONGEST + 1, 2), np.int64), np.zeros((LONGEST + 1, 2))
    gauge, known, told = (GAUGE_M, GAUGE_M), 0, []
    for k in range(1, STEPS):
        left, right = (counts[k] - counts[k - 1]).tolist()
        earliest = int(at_ns[k] - early[k])
        seconds = (2 * width_ns + STEP_NS) * 1e-9
        known, beyond = follow(
            steps, stamps, speeds, known, left, right, seconds, seconds, earliest, earliest + width_ns, tuple(TRACKS),
            geared, gauge, times, net, effort, 0, k + 4,
        )  # fmt: skip
        if beyond > 0.0:
            told.append(k)
    return told


def slips_by(law: str, seed: int) -> Array:
    """[n, 2] of the tracks, in [-1, 1]."""
    random = np.random.default_rng(seed)
    if law == "uniform":
        return random.uniform(-1.0, 1.0, (STEPS + 1, 2))
    if law == "corners":
        return random.choice([-1.0, 1.0], (STEPS + 1, 2))
    if law == "together":
        return np.repeat(random.choice([-1.0, 1.0], (STEPS + 1, 1)), 2, axis=1)
    return np.full((STEPS + 1, 2), (1.0, -1.0)) * (-1.0) ** seed


@pytest.mark.parametrize("law", ["uniform", "corners", "together", "opposed"])
@pytest.mark.parametrize("geared", [True, False])
@pytest.mark.parametrize("width_ns", [0, 11_000_000])
def test_a_robot_within_its_limits_is_never_told_off(law: str, geared: bool, width_ns: int) -> None:
    """It speeds up and brakes as hard as declared, all the time; slips jump from bound to bound; stamps are wide."""
    for seed in range(4):
        assert told_at(slips_by(law, seed), geared, width_ns, seed=seed) == []


@pytest.mark.parametrize("geared", [True, False])
def test_both_tracks_spinning_are_told_in_the_same_step(geared: bool) -> None:
    """0.3 m/s more from one count to the next is no motion of a robot that takes a third of a second for it."""
    for seed in range(4):
        told = told_at(slips_by("uniform", seed), geared, spin_mps=0.3)
        assert told
        assert 0 <= told[0] - SPIN_AT <= 1


def test_wide_stamps_only_delay_it() -> None:
    """Counts that are up to 11 ms old tell of a spin within the longest stretch."""
    for seed in range(4):
        told = told_at(slips_by("uniform", seed), geared=True, width_ns=11_000_000, spin_mps=0.4)
        assert told
        assert 0 <= told[0] - SPIN_AT <= LONGEST


def test_the_gyroscope_leaves_opposed_slips_no_room_for_a_wrong_scale() -> None:
    """8 % more of both tracks at once, half of which their slips might explain, were it not for the turn."""
    slips = slips_by("opposed", 0)
    assert 0 <= told_at(slips, geared=True, scale=1.08)[0] - SPIN_AT <= 1
    assert told_at(slips, geared=False, scale=1.08)[0] - SPIN_AT > 1
