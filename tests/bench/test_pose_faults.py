"""The bench of broken sensors: who is named, how soon, and what it counts as outside."""

import numpy as np
import pytest

from bench.fault_drive import world_of
from bench.pose_faults import NOTHING, Outcome, Row, break_it, cases, when
from bench.soonest import soonest_s
from simulator.faults import WrongTracks

CASES = {case.name: case for case in cases()}


@pytest.mark.parametrize(
    "name",
    [
        "GPS jumps 20 m",
        "gyroscope stuck in a turn",
        "one track slips by 50 %",
        "both tracks spin by 0.3 m/s",
        "tilt spike of 6 degrees, 0.2 s",
    ],
)
def test_a_broken_sensor_is_named_in_time(name: str) -> None:
    """The right one, within a second or a metre; no true pose is outside from then on, or stays promised."""
    case = CASES[name]
    outcome = break_it(case, "constant", 2, 50.0) if case.turning else break_it(case, "constant", 1, 24.0)
    assert outcome.named == case.sensor
    assert not outcome.too_early
    assert outcome.after_s <= 1.0 or outcome.after_m <= 1.0
    assert outcome.told == 0
    assert outcome.not_taken_back == 0
    assert outcome.untold <= 10 * outcome.after_s + 1


def test_a_scale_that_is_wrong_by_twice_the_slip_is_named_though_one_track_makes_up_for_it() -> None:
    """One track slips so that its count stays within its bound. The gyroscope tells that the other doesn't."""
    outcome = break_it(CASES["both wheels' scale wrong by 4 %, for 20 s"], "constant", 1, 30.0)
    assert outcome.named == "encoders"
    assert outcome.after_m < 6.0
    assert outcome.not_taken_back == 0


def test_nobody_is_named_where_nothing_is_broken() -> None:
    """The same drive without a fault: intact, and every pose inside."""
    outcome = break_it(NOTHING, "constant", 1, 24.0)
    assert outcome.named is None
    assert outcome.untold == outcome.told == 0
    assert outcome.checks > 200


def test_the_table_tells_what_it_saw() -> None:
    """Names with their drives, the median and the most, and who was in time."""
    late = Outcome(named="gps", after_s=3.0, after_m=2.0, untold=4, not_taken_back=1, checks=10, restored_s=1.0)
    soon = Outcome(named="gps", after_s=0.5, after_m=0.1, checks=10, soonest_m=3.0)
    text = Row([late, soon, Outcome(checks=10)]).text(CASES["GPS jumps 2 m"])
    assert "gps 2, nobody 1" in text
    assert "1.8 (3.0) s" in text
    assert "1 of 3" in text
    assert "3.0 (3.0) m" in text
    assert "| 4 | 0 | 1 | 30 | 1 of 2, 1.0 (1.0) s |" in text
    assert not np.isnan(soon.after_s)


@pytest.mark.parametrize("law", ["constant", "uniform"])
def test_nobody_could_contradict_a_true_scale_and_a_false_one_not_at_once(law: str) -> None:
    """The bound that nobody beats: never without a fault; the sooner, the more the scale is wrong."""
    world = world_of(law, 1, 24.0)
    begin_s = when(world, turning=False)
    assert soonest_s(world, WrongTracks(begin_s, 1e9, (1.0, 1.0))) == np.inf
    times = [soonest_s(world, WrongTracks(begin_s, 1e9, (scale, scale))) for scale in (1.04, 1.1, 1.5)]
    assert begin_s < times[2] <= times[1] <= times[0]
