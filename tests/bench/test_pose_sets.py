"""The race of pose filters: what its table says of containment can be trusted."""

import numpy as np
import pytest

from bench.pose_scenario import GPS_CLASSES
from bench.pose_sets import Score, race


@pytest.mark.parametrize("law", ["constant", "mixed"])
def test_our_boxes_hold_the_truth_in_both_frames_where_the_kalman_filter_loses_it(law: str) -> None:
    """With errors at their bounds three sigma lose the truth; the sets keep it, in the map and on Earth."""
    ours, theirs = Score(), Score()
    race("default", GPS_CLASSES[0], law, 1, 20.0, ours)
    race("EKF 3 sigma", GPS_CLASSES[0], law, 1, 20.0, theirs)
    assert ours.violations == {"map": 0, "Earth": 0}
    assert min(ours.checks.values()) > 90
    assert ours.missing == ours.voided == 0
    assert theirs.violations["Earth"] > 0.5 * theirs.checks["Earth"]


def test_the_default_is_no_wider_than_the_papers_set_and_both_hold() -> None:
    """Mean half-widths from 30 s on, in both frames; for want of a window the ellipsoid is several times as wide."""
    default, paper = Score(), Score()
    race("default", GPS_CLASSES[0], "constant", 1, 45.0, default)
    race("ellipsoid", GPS_CLASSES[0], "constant", 1, 45.0, paper)
    assert default.violations == paper.violations == {"map": 0, "Earth": 0}
    assert paper.missing == paper.voided == 0
    for frame in ("map", "Earth"):
        assert np.all(default.widths(frame) <= paper.widths(frame) * (1.0 + 1e-9))
    assert paper.widths("Earth")[3] < 30.0  # and yet it finds its yaw by itself


def test_a_box_beside_the_truth_is_counted() -> None:
    """The check itself can fail: each axis alone, and yaw only modulo whole turns."""
    truth = np.arange(6.0)
    for axis in range(6):
        score, low, high = Score(), truth - 0.1, truth + 0.1
        low[axis] = truth[axis] + 1e-9
        score.check("map", low, high, truth)
        assert score.violations["map"] == 1
    score = Score()
    turn = np.array([0, 0, 0, 0, 0, 2 * np.pi])
    score.check("map", truth - 0.1 + turn, truth + 0.1 + turn, truth)
    assert score.violations["map"] == 0
