"""`[filter] wrong_fixes`: some fixes may be anywhere, and the pose holds without any of them being found out."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bench.fault_drive import FaultDrive, drive, world_of
from estimator.config import FilterConfig, SetName
from estimator.relaxed_window import RelaxedWindow, longest_rest, relaxed
from simulator.faults import FalseFixes, GpsJump, Reading

SECONDS = 20.0


def followed(
    config: FilterConfig, meddle: Callable[[Reading, float], Reading], law: str = "constant", seed: int = 1
) -> FaultDrive:
    """A drive with fixes of 5 cm at 10 Hz, some of which are meddled with."""
    return drive(meddle, config, world_of(law, seed, SECONDS))


def test_the_relaxed_intersection_is_the_hull_of_what_enough_intervals_hold() -> None:
    """Held against counting, point by point: ends that touch, intervals that are empty or unbounded, none needed."""
    random = np.random.default_rng(0)
    for _ in range(2000):
        n = int(random.integers(1, 9))
        ends = random.integers(-5, 6, (n, 2)).astype(float)
        ends[random.random(n) < 0.1] = -np.inf, np.inf
        needed = int(random.integers(0, n + 1))
        out = np.array([-4.0, 4.0])
        points = np.arange(-4.0, 4.25, 0.5)
        held = ((ends[:, 0, None] <= points) & (points <= ends[:, 1, None])).sum(axis=0) >= needed
        assert relaxed(ends, n, needed, out) == held.any()
        if held.any():
            assert out.tolist() == [points[held].min(), points[held].max()]


def test_a_yaw_that_is_all_around_is_what_lies_beside_the_widest_gap() -> None:
    """Cells to either side of the cut belong together."""
    left = np.zeros(16, np.bool_)
    left[[14, 15, 0, 3]] = True
    assert longest_rest(left) == (14, 6)
    left[:] = True
    assert longest_rest(left)[1] == 16


@pytest.mark.parametrize("law", ["constant", "switching"])
@pytest.mark.parametrize(
    "fault",
    [
        FalseFixes(0.0, 1e9, share=0.08),
        FalseFixes(0.0, 1e9, most=3, at_once=True, together=True),
        FalseFixes(0.0, 1e9, most=2, at_once=True, nearest=30.0),
    ],
    ids=["eight percent", "three in a row to one side", "pairs far away"],
)
def test_no_pose_is_false_however_wrong_some_fixes_are(fault: FalseFixes, law: str) -> None:
    """1.5 to 30 times their bound, the newest among them: nothing outside, nothing told, and the pose stays tight."""
    fault = replace(fault, seed=5)
    outcome = followed(
        FilterConfig(wrong_fixes=fault.most, standstill_s=0.5, standstill_rate_dps=0.02), fault.changed, law
    )
    assert fault.count >= 5
    assert outcome.false_ns == []
    assert outcome.filter.guarantee.intact
    earth = outcome.on_earth
    assert earth is not None
    assert max(earth.high[:2] - earth.low[:2]) < 0.3
    assert earth.high[5] - earth.low[5] < 0.8


@pytest.mark.parametrize("kept", ["box", "ellipsoid"])
def test_both_sets_bear_false_fixes(kept: SetName) -> None:
    """The ellipsoid is cut by what most fixes agree on, as the box is."""
    fault = FalseFixes(0.0, 1e9, most=2, at_once=True, seed=2)
    outcome = followed(FilterConfig(set=kept, wrong_fixes=2, standstill_s=0.5, standstill_rate_dps=0.02), fault.changed)
    assert fault.count > 15
    assert outcome.false_ns == []
    assert outcome.filter.guarantee.intact


def test_where_every_fix_is_trusted_the_same_fixes_are_a_fault() -> None:
    """Without wrong_fixes the first false fix is told: the tests above can fail."""
    fault = FalseFixes(0.0, 1e9, share=0.08, seed=5)
    assert (
        followed(FilterConfig(standstill_s=0.5, standstill_rate_dps=0.02), fault.changed).filter.guarantee.sensor
        == "gps"
    )


def test_more_false_fixes_than_declared_are_a_fault() -> None:
    """A receiver that is off for good contradicts, in spite of the one fix of twenty that may be wrong."""

    jump = GpsJump(14.0, 1e9, 20.0)
    outcome = followed(FilterConfig(wrong_fixes=1, standstill_s=0.5, standstill_rate_dps=0.02), jump.changed)
    assert outcome.filter.guarantee.sensor == "gps"
    assert outcome.untold == 0


def test_the_way_since_the_last_fix_is_as_uncertain_as_its_steps() -> None:
    """A metre whose every step is at its bound: where two older fixes and that way leave the robot holds the truth."""
    window = RelaxedWindow(0.0, 1, 8)
    known, axis, heading = np.zeros(2), np.array([1.0, 0.0, 0.0]), np.zeros(3)
    true_m = 0.0
    for number, (steps, error_m) in enumerate(((0, 0.0), (1, 0.001), (10, 0.005))):
        for _ in range(steps):
            step = np.array([[0.1 - error_m, 0.1 + error_m], [-0.001, 0.001], [-0.001, 0.001]])
            window.extend(step, axis, heading, 0.0, known, float(number))
            true_m += 0.1 + error_m
        antenna = np.array([true_m, 0.0, 0.0])[:, None] + np.array([-0.002, 0.002])
        yaw, place = np.array([-1e-6, 1e-6]), np.array([[-9.0, 9.0]] * 3)
        seconds = float(number), float(number)
        assert window.narrowed(antenna, np.zeros((3, 2)), heading, seconds, 0.0, known, yaw, place)
        assert place[0, 0] <= true_m <= place[0, 1]
        window.remember(known, 0.0, 0.0, yaw, place)
    assert place[0, 1] - place[0, 0] < 0.12
