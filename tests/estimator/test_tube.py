"""The tube of nodes: what lies between them, which of them surround a time, and how the old ones go."""

from copy import deepcopy

import numpy as np

from estimator.tube import Tube, poses_between


def tube_of(stamps: list[tuple[int, int]], history_ns: int = 10**9, capacity: int = 4096) -> Tube:
    """A tube whose node k has coordinate c in [k, k + 0.5] + 10 c."""
    tube = Tube(history_ns, capacity)
    for k, (earliest, latest) in enumerate(stamps):
        i = tube.push(earliest, latest)
        tube.box[i] = [[k + 10.0 * c, k + 10.0 * c + 0.5] for c in range(3)]
        tube.swing[i] = 0.25
    return tube


def test_between_two_nodes_the_coordinates_may_swing_beyond_both() -> None:
    """The hull of two nodes is wider than their boxes by the swing of the step between them, at both ends."""
    tube = tube_of([(0, 5), (10, 15), (20, 25)])
    hull = tube.hull(1, 2)
    assert hull[0, 0] <= -0.25
    assert hull[0, 1] >= 1.75
    assert np.allclose(hull[2], [19.75, 21.75])
    assert np.array_equal(tube.hull(2, 2), tube.box[2])


def test_a_time_is_surrounded_by_nodes_surely_before_and_surely_after() -> None:
    """A node counts as before only with its latest time, and as after only with its earliest."""
    tube = tube_of([(0, 5), (10, 15), (20, 25)])
    assert [tube.before(t) for t in (4, 5, 14, 15, 99)] == [0, 1, 1, 2, 3]
    assert [tube.after(t) for t in (0, 1, 10, 11, 20, 21)] == [1, 2, 2, 3, 3, 4]
    assert tube.reaches(20)
    assert not tube.reaches(21)


def test_a_copy_has_the_same_nodes_and_a_life_of_its_own() -> None:
    """A checkpoint says what the tube said then, whatever the tube is told since."""
    tube = tube_of([(0, 5), (10, 15), (20, 25)])
    then = deepcopy(tube)
    hull, times = tube.hull(1, 3), tube.times[1:4].copy()
    tube.box[tube.push(22, 23)] = 99.0
    tube.box[2] = -99.0
    assert len(then) == 3
    assert np.array_equal(then.hull(1, 3), hull)
    assert np.array_equal(then.times[1:4], times)
    assert then.push(30, 35) == 4


def test_a_later_node_bounds_the_times_of_those_before() -> None:
    """True times rise: an early `latest` makes the earlier nodes' stamps tighter, a late `earliest` the new one's."""
    tube = tube_of([(0, 30), (1, 32), (2, 10), (1, 40)])
    assert tube.times[1:5, 1].tolist() == [10, 10, 10, 40]
    assert tube.times[1:5, 0].tolist() == [0, 1, 2, 2]


def test_only_what_is_older_than_the_history_is_let_go() -> None:
    """However many nodes came, those of the last `history` are all there, with one before them."""
    for history in (100, 1000, 10_000):
        tube = tube_of([(10 * k, 10 * k + 3) for k in range(5000)], history_ns=history, capacity=64)
        newest = 10 * 4999
        assert tube.times[tube.newest, 0] == newest
        assert tube.times[tube.begin, 1] <= max(newest - history, 3)
        assert np.all(np.diff(tube.times[tube.begin : tube.end, 0]) == 10)
        assert tube.box[tube.newest, 0, 0] == 4999.0
        assert len(tube.times) <= max(64, 4 * history // 10 + 8)


def test_poses_take_places_from_one_tube_and_turns_from_the_other() -> None:
    """Rows that one of the two tubes does not surround are NaN and counted; the others hold both hulls."""
    places, turns = tube_of([(0, 5), (100, 105)]), tube_of([(0, 1), (50, 51), (90, 91)])
    earliest, latest = np.array([10, 10, 0, 60]), np.array([20, 95, 20, 50])
    low, high = np.empty((4, 6)), np.empty((4, 6))
    missing = poses_between(
        places.times, places.box, places.swing, places.begin, places.end,
        turns.times, turns.box, turns.swing, turns.begin, turns.end, earliest, latest, low, high,
    )  # fmt: skip
    assert missing == 3
    assert np.isnan(low[1:]).all()
    assert np.isnan(high[1:]).all()
    assert np.allclose(low[0], [-0.25, 9.75, 19.75, -0.25, 9.75, 19.75])
    assert np.allclose(high[0], [1.75, 11.75, 21.75, 1.75, 11.75, 21.75])


def test_a_pose_holds_every_node_that_may_be_next() -> None:
    """Where stamps overlap, a time may lie in any of several steps: from the last surely before to the first after."""
    tube = tube_of([(0, 0), (10, 30), (20, 40), (50, 50)])
    low, high = np.empty((1, 6)), np.empty((1, 6))
    now = np.array([25])
    assert poses_between(
        tube.times, tube.box, tube.swing, tube.begin, tube.end,
        tube.times, tube.box, tube.swing, tube.begin, tube.end, now, now, low, high,
    ) == 0  # fmt: skip
    assert low[0, 0] <= -0.25
    assert high[0, 0] >= 3.75
    assert high[0, 5] >= 23.75
