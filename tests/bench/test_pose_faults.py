"""The bench of broken sensors: who is named, how soon, and what it counts as outside."""

import numpy as np
import pytest

from bench.pose_faults import Case, Outcome, Row, break_it, cases
from service.config import load
from service.shipped import shipped_config
from simulator.faults import GpsJump

CONFIG = load(shipped_config("demo.toml")).config
CASES = {case.name: case for case in cases(CONFIG)}


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
    """The right one, within a second or a metre; from then on no true pose is outside."""
    case = CASES[name]
    outcome = break_it(case, CONFIG, "constant", 1, 24.0)
    assert outcome.named == case.sensor
    assert not outcome.too_early
    assert outcome.after_s <= 1.0 or outcome.after_m <= 1.0
    assert outcome.flagged == 0
    assert outcome.unflagged <= 10 * outcome.after_s + 1


def test_nobody_is_named_where_nothing_is_broken() -> None:
    """The same drive without a fault: intact, and every pose inside."""
    outcome = break_it(Case("none", "-", lambda t: GpsJump(1e9, 1e9)), CONFIG, "constant", 1, 24.0)
    assert outcome.named is None
    assert outcome.unflagged == outcome.flagged == 0
    assert outcome.checks > 200


def test_the_table_tells_what_it_saw() -> None:
    """Names with their drives, the median and the most, and who was in time."""
    late = Outcome(named="gps", after_s=3.0, after_m=2.0, unflagged=4, checks=10, restored_s=1.0)
    soon = Outcome(named="gps", after_s=0.5, after_m=0.1, checks=10)
    text = Row([late, soon, Outcome(checks=10)]).text(CASES["GPS jumps 2 m"])
    assert "gps 2, nobody 1" in text
    assert "1.8 (3.0) s" in text
    assert "1 of 3" in text
    assert "| 4 | 0 | 30 | 1 of 2, 1.0 s |" in text
    assert not np.isnan(soon.after_s)
