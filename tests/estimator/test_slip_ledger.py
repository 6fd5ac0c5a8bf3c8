"""What the gyroscope proves of the tracks' slip, held against slips at the corners of their bounds."""

from collections import Counter
from math import floor, nan

import numpy as np
import pytest

from bench.fault_drive import declared
from drivers.samples import InertialSample, Stamp
from estimator.attitude import AttitudeChain
from estimator.config import FilterConfig
from estimator.inconsistency import Journal
from estimator.motion import TrackBounds
from estimator.slip_ledger import Mark, SlipLedger, enter
from estimator.tracks import slipping

STEP_NS, STEP_S = 20_000_000, 0.02
ROBOT, DEVICES = declared()
TICK_M = DEVICES.encoders.left_metres_per_tick
TRACKS = TrackBounds(
    slip=ROBOT.slip_ratio, lateral=0.0, turning_centre=0.0, normal=0.0, quantum_left=TICK_M, quantum_right=TICK_M,
    most_speed=ROBOT.max_speed_mps, most_acceleration=1.0, most_track_acceleration=5.0,
)  # fmt: skip


def drive(law: str, seed: int, gauge_m: tuple[float, float] | None = (0.35, 0.35)) -> tuple[float, float, float]:
    """A weaving way of the robot: how far the slips of its middle add up, their bounds, the credit.

    The distance of its turning centres is at one end of gauge_m to the left, at the other to the right.
    """
    random = np.random.default_rng(seed)
    attitude = AttitudeChain(ROBOT, FilterConfig(), DEVICES.imu, Journal(Counter()))
    ledger = SlipLedger(gauge_m, TRACKS, attitude)
    signs = {"alike": np.ones(2), "opposite": np.array([1.0, -1.0])}.get(law, random.choice([-1.0, 1.0], 2))
    bias, noise = np.radians(0.3) * random.choice([-1.0, 1.0]), np.radians(0.05)
    speed, ran, counted = float(random.choice([-0.6, 0.4, 0.7])), np.array([0.3, 0.7]) * TICK_M, np.zeros(2)
    since: Mark | None = None
    running = np.zeros(2, np.bool_)
    slipped = bound = 0.0
    for k in range(20 + 25):
        turning = 0.3 * np.sin(0.2 * k + seed) if law != "opposite" else 0.0
        rate = turning + bias + noise * random.choice([-1.0, 1.0])
        stamp = Stamp(k * STEP_NS, k * STEP_NS)
        attitude.predict(InertialSample(stamp, "HIGHRES_IMU", 0, k * 20_000, (nan, nan, nan), (0.0, 0.0, rate)))
        if law == "corners":
            signs = random.choice([-1.0, 1.0], 2)
        gauge = ROBOT.track_gauge_m if gauge_m is None else gauge_m[int(turning > 0.0)]
        ground = (speed + np.array([-1.0, 1.0]) * 0.5 * gauge * turning) * STEP_S
        run = ground / (1.0 + 0.999999 * ROBOT.slip_ratio * signs)
        ran = ran + run
        count = np.array([floor(way / TICK_M) for way in ran]) * TICK_M
        left, right = (count - counted).tolist()
        slid = slipping(left, right, abs(turning) * STEP_S, STEP_S, TRACKS, running)
        ledger.step(stamp, left, right, k > 0, slid, abs(turning) * STEP_S, STEP_S)
        if since is not None:
            slipped += speed * STEP_S - 0.5 * float(run.sum())
            bound += 0.5 * ROBOT.slip_ratio * slid
        counted = count
        if k == 19:
            since = ledger.mark()
    # what the counts' errors add to the slip is paid for once, at the end of a stretch
    return slipped, bound + ROBOT.slip_ratio * TICK_M, ledger.credit(since)


@pytest.mark.parametrize("law", ["alike", "opposite", "constant", "corners"])
def test_the_middle_never_slips_by_more_than_the_bounds_less_the_credit(law: str) -> None:
    """Slips at their bounds, alike, opposite, of constant signs, of random ones; the gyroscope at its bounds, too."""
    for seed in range(25):
        slipped, bound, credit = drive(law, seed)
        assert abs(slipped) <= bound - credit, seed
        assert credit >= 0.0


def test_turning_centres_that_change_their_distance_earn_no_credit_that_is_not_due() -> None:
    """One distance in left turns, another in right ones: to and fro they add up, though the robot ends as it began."""
    for seed in range(25):
        for law in ("alike", "corners"):
            slipped, bound, credit = drive(law, seed, gauge_m=(0.30, 0.50))
            assert abs(slipped) <= bound - credit, (law, seed)


def test_tracks_that_slip_to_opposite_sides_leave_next_to_nothing_open() -> None:
    """Straight on, by their bounds: the credit is all but the counts' and the gyroscope's errors. Alike: nothing."""
    for seed in range(5):
        _, bound, credit = drive("opposite", seed)
        assert credit > 0.6 * bound
        assert drive("alike", seed)[2] < 0.1 * bound


def test_what_is_not_paid_for_of_the_bounds_is_not_credited_either() -> None:
    """In a run one way the slip of a quantum is paid for once; bounds of each step alone would have it every time."""
    sums, running = np.zeros(4), np.zeros(2, np.bool_)
    for k in range(50):
        slid = slipping(0.01, 0.01, 0.0, STEP_S, TRACKS, running)
        enter(sums, 0.01, 0.01, True, slid, 0.0, STEP_S, tuple(TRACKS))
        assert sums[2] == pytest.approx(k * TRACKS.slip * TICK_M, rel=1e-9, abs=1e-12)


def test_without_a_declared_distance_of_the_turning_centres_nothing_is_proved() -> None:
    """Then a turn says nothing of the tracks."""
    assert drive("opposite", 1, gauge_m=None)[2] == 0.0
