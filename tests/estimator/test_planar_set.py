"""One step of both ellipsoids in one call, against the same step taken set by set with the operations of one set."""

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator import planar_set as ps
from estimator.ellipsoid import box, extent, half_width, meet_axis, stored
from estimator.ellipsoidal_motion import BIAS, UNITS, YAW, HeadingStep, travel_ellipsoid
from estimator.frames import tilted
from estimator.interval import add, up, widen
from estimator.motion import QUANTUM, TrackBounds, relative_yaw, relative_yaw_between
from estimator.planar_set import ABSENT, BITS, CONTRADICTED, TOO_WIDE, UNTOLD
from estimator.tracks import tracked

Array = NDArray[np.float64]
NODES, MS = 8, 1_000_000
BEFORE, START, AFTER = 2, 3, 6
TRACKS = TrackBounds(0.03, 0.01, 0.04, 0.01, 1e-3, 1e-3, 1.2, 1.0, 2.0, 0.001, 7.0)
DRIFT, TELESCOPED, TURNING, TIME_HIGH, SLID = 1e-5, 0.012, 0.02, 0.021, 0.05


class Step:
    """A step between two counts, seen by gyro nodes 5 ms apart; both ellipsoids before it."""

    def __init__(self, seed: int, half: Array) -> None:
        """`half` [4]: of the boxes that the ellipsoids begin around."""
        rng = np.random.default_rng(seed)
        self.times = np.repeat(np.arange(NODES)[:, None] * 5 * MS, 2, axis=1) + np.array([0, MS])
        self.heading = np.cumsum(rng.normal(size=(NODES, 3)) * (2e-3, 0.0, 0.0) + (0.0, -0.005, 1e-5), axis=0)
        self.effort = np.cumsum(np.full((NODES, 3), round(3e-3 / QUANTUM)), axis=0)
        self.turns, self.swing = np.sort(rng.normal(size=(NODES, 4, 2))), np.full((NODES, 4), 1e-4)
        self.biases = np.array([[-0.01, 0.01]] * 3)
        self.attitude = np.sort(rng.uniform(-0.3, 0.3, size=(4, 2)))
        self.places, self.place_times = np.zeros((3, 6, 2)), np.repeat(np.array([[0], [11], [29]]) * MS, 2, axis=1)
        self.core, self.pending = np.zeros((9, 2)), np.zeros(9)
        self.left, self.right = rng.uniform(-0.02, 0.02, size=2)
        self.sets = ps.PlanarSets()
        for frame in ps.FRAMES:
            centre = rng.normal(size=4) * (10.0, 10.0, 1.0, 0.002)
            self.sets.begin(frame, *zip(centre - half, centre + half, strict=True))
            self.sets.kept[frame] = rng.normal(size=10) * 1e-3

    def take(self, turned_until: int | None = None) -> tuple[int, int, tuple[float, float]]:
        """Both sets, in one call."""
        sets, efforts = self.sets, (int(self.effort[START, 2]), int(self.effort[AFTER, 2]))
        return ps.planar_step(
            sets.rows, sets.kept, sets.known, sets.fresh, False, BEFORE, AFTER, self.attitude, self.left, self.right,
            True, SLID, TIME_HIGH, TURNING, TELESCOPED, tuple(TRACKS), turned_until or efforts[0], efforts[1],
            self.times, self.turns, self.swing, self.heading, self.effort, 0, NODES, self.biases, DRIFT,
            self.place_times, self.places, 2, self.core, self.pending,
        )  # fmt: skip

    def take_one(self, frame: int) -> None:
        """One set of the two, operation by operation."""
        seconds = up((int(self.times[NODES - 1, 1]) - int(self.times[BEFORE, 0])) * 1e-9)
        bias = widen((self.biases[2, 0], self.biases[2, 1]), up(DRIFT * seconds))
        aged = up(DRIFT * up((int(self.times[AFTER, 1]) - int(self.times[START, 0])) * 1e-9))
        change, slope, error = self.heading[AFTER] - self.heading[START]
        error = up(up(abs(error)) + up(2.0**-52 * (abs(change) + abs(slope) * max(abs(bias[0]), abs(bias[1])))))
        inside = relative_yaw_between(self.heading, self.swing, BEFORE, AFTER, self.heading[START], bias)
        way = tracked(self.left, self.right, True, SLID, TIME_HIGH, TRACKS)
        roll, pitch = ((float(low), float(high)) for low, high in self.attitude[:2])
        e, kept = stored(self.sets.rows[frame]), self.sets.kept[frame]
        travel_ellipsoid(
            e, HeadingStep(float(change), float(slope), error, inside, bias, aged), way,
            up(up(TRACKS.lateral * way.path) + up(TRACKS.turning_centre * TELESCOPED)), up(TRACKS.normal * way.path),
            tilted(roll, pitch), bool(self.sets.fresh[frame]), kept,
        )  # fmt: skip
        meet_axis(e, BIAS, *bias)
        for i, row in enumerate((3 * frame, 3 * frame + 1)):
            self.core[row], self.pending[row] = extent(e, i), kept[8 + i]
            self.places[2, row] = widen(extent(e, i), kept[8 + i])
        for node in range(AFTER, NODES):
            yaw = add(extent(e, YAW), relative_yaw(self.heading[node], self.heading[AFTER], bias))
            self.turns[node, 2 + frame] = yaw

    def state(self) -> list[Array]:
        """All that a step may change, but for the room that it works in."""
        ellipsoids = [array for frame in ps.FRAMES for array in stored(self.sets.rows[frame])[:2]]
        return [*ellipsoids, self.sets.kept, self.core, self.pending, self.places, self.turns]


NARROW = np.array([0.5, 0.3, 0.1, 0.004])


@pytest.mark.parametrize("known", [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("half", [NARROW, NARROW * 1e-3, NARROW * (20.0, 30.0, 2.0, 1.0)], ids=["", "tiny", "wide"])
def test_a_step_of_both_at_once_is_the_step_of_each(known: tuple[bool, bool], half: Array) -> None:
    """Bit for bit the same sets, boxes and memory; where there is none nothing is touched; told where one may begin."""
    began = set()
    for seed in range(20):
        at_once, in_turn = Step(seed, half), Step(seed, half)
        at_once.sets.known[:] = known
        outcomes, after, _ = at_once.take()
        for frame in ps.FRAMES:
            if known[frame]:
                in_turn.take_one(frame)
        assert after == AFTER
        narrow = np.diff(at_once.turns[-1, 2:])[:, 0] < 2.0 * ps.WIDEST_YAW
        absent = [frame for frame in ps.FRAMES if not known[frame]]
        assert outcomes == sum(ABSENT << (BITS * frame) for frame in absent if narrow[frame])
        began |= {bool(narrow[frame]) for frame in absent}
        for one, other in zip(at_once.state(), in_turn.state(), strict=True):
            np.testing.assert_array_equal(one, other)
        assert at_once.sets.fresh.tolist() == [not there for there in known]
    assert began == (set() if all(known) else {True, False})


def test_what_stands_in_the_way_of_a_step_is_told_of_each_set() -> None:
    """A turn that isn't known leaves both as they were; a bias beyond the gyroscope's, a yaw too wide are told."""
    step, before = Step(1, NARROW), Step(1, NARROW).state()
    assert step.take(turned_until=7)[0] == UNTOLD | UNTOLD << BITS
    for one, other in zip(step.state(), before, strict=True):
        np.testing.assert_array_equal(one, other)

    step = Step(1, NARROW)
    stored(step.sets.rows[1]).centre[BIAS] = 0.1
    assert step.take()[0] == CONTRADICTED << BITS

    step = Step(1, NARROW)
    stored(step.sets.rows[0]).shape[YAW, YAW] = 1.1
    assert step.take()[0] == TOO_WIDE


def test_a_fix_that_misses_one_of_the_sets_is_told() -> None:
    """Each is cut by its own rows of the places and its own yaw."""
    step = Step(2, NARROW)
    core = np.tile([-1e9, 1e9], (9, 1))
    yaws = np.tile([-1e9, 1e9], (2, 1))
    assert ps.correct(step.sets.rows, step.sets.known, core, yaws, (0.0, 0.0))
    e = stored(step.sets.rows[1])
    core[4] = e.centre[1], e.centre[1] + 0.01
    wide = half_width(e, 1)
    assert ps.correct(step.sets.rows, step.sets.known, core, yaws, (0.0, 0.0))
    assert half_width(e, 1) < 0.2 * wide
    yaws[1] = e.centre[YAW] + 1.0, e.centre[YAW] + 2.0
    assert not ps.correct(step.sets.rows, step.sets.known, core, yaws, (0.0, 0.0))
    assert ps.correct(step.sets.rows, step.sets.known, core, yaws, (1.0, 2.0))
    step.sets.known[1] = False
    assert ps.correct(step.sets.rows, step.sets.known, core, yaws, (0.0, 0.0))


def test_sets_begin_around_boxes_that_are_not_too_wide() -> None:
    """The ellipsoid of that box, in its rows; none around an empty box or one that spans more than a radian of yaw."""
    sets = ps.PlanarSets()
    axes = (0.0, 1.0), (2.0, 3.0), (-0.2, 0.2), (-0.01, 0.01)
    sets.begin(1, *axes)
    e, plain = stored(sets.rows[1]), box(np.array([0.5, 2.5, 0.0, 0.0]), np.array([0.5, 0.5, 0.2, 0.01]), UNITS)
    assert sets.known.tolist() == [False, True]
    np.testing.assert_allclose(e.centre, plain.centre, atol=1e-12)
    np.testing.assert_allclose(e.shape, plain.shape, rtol=1e-12)
    for yaw in ((-1.1, 1.1), (0.1, -0.1)):
        sets.begin(1, axes[0], axes[1], yaw, axes[3])
        assert not sets.known[1]
