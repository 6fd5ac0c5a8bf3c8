"""The ellipsoids over (x, y, yaw, gyro bias) of both frames, beside a position chain's boxes: step, strips, outer box.

They stand in plain arrays, and each step is one call of machine code for both (docs/decisions/0046).
"""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_bare, plain_or_compiled
from estimator.attitude import EARTH_YAW, MAP_YAW
from estimator.ellipsoid import EMPTY, Ellipsoid, box, extent, half_width, meet_axis, stored
from estimator.ellipsoidal_motion import BIAS, UNITS, YAW, HeadingStep, X, Y, memory, travel_ellipsoid
from estimator.frames import tilted
from estimator.interval import ULP, Interval, add, mid, reach, sub, up, widen
from estimator.motion import TrackBounds, aged_bias, relative_yaw, relative_yaw_between
from estimator.position import ANYWHERE_M, EARTH, MAP
from estimator.tracks import tracked
from estimator.tube import first_not_before

FRAMES = range(2)
"""In the map, and on Earth."""
PLACES, YAWS = (MAP.start, EARTH.start), (MAP_YAW, EARTH_YAW)
"""The first of their rows among the places, and their row of the turns."""
WIDEST_YAW = 1.0
"""rad: beyond this half-width there is no ellipsoid."""

ABSENT, UNTOLD, TOO_WIDE, CONTRADICTED = 1, 2, 4, 8
"""What became of an ellipsoid in a step, if it is not just a step further and shown: there is none, but one may begin;
how far the robot turned isn't known, and it stands where it did; its yaw is too wide; its bias can't be where the
gyroscope's is."""
BITS = 4


class PlanarSets:
    """An ellipsoid in the map and one on Earth, where there is one."""

    def __init__(self) -> None:
        self.rows = np.zeros((2, 3 * len(UNITS) + 10, len(UNITS)))
        """[2, 22, 4] see ellipsoid.stored."""
        self.kept = np.zeros((2, len(memory())))
        """[2, 10] see ellipsoidal_motion.memory."""
        self.known = np.zeros(2, dtype=np.bool_)
        """[2] is there one?"""
        self.fresh = np.zeros(2, dtype=np.bool_)
        """[2] has it not gone a step yet?"""

    def begin(self, frame: int, x: Interval, y: Interval, yaw: Interval, bias: Interval) -> None:
        """Anew, around a box; none if that is too wide, or empty."""
        axes = (x, y, yaw, bias)
        middle = np.array([mid(axis) for axis in axes])
        half = np.array([reach(axis, c) for axis, c in zip(axes, middle, strict=True)])
        self.known[frame] = half.min() >= 0.0 and half[YAW] < WIDEST_YAW and max(half[X], half[Y]) < ANYWHERE_M
        if self.known[frame]:
            around, e = box(middle, half, UNITS), stored(self.rows[frame])
            e.centre[:], e.shape[:], e.units[:] = around.centre, around.shape, UNITS
            self.kept[frame], self.fresh[frame] = memory(), True


@compiled_bare
def planar_step(
    rows: NDArray[np.float64],
    kept: NDArray[np.float64],
    known: NDArray[np.bool_],
    fresh: NDArray[np.bool_],
    fresh_count: bool,
    before: int,
    after: int,
    attitude: NDArray[np.float64],
    left: float,
    right: float,
    counted: bool,
    slid: float,
    time_high: float,
    turning: float,
    telescoped: float,
    bounds: tuple[float, ...],
    turned_until: int,
    turned_until_now: int,
    times: NDArray[np.int64],
    turns: NDArray[np.float64],
    swing: NDArray[np.float64],
    headings: NDArray[np.float64],
    effort: NDArray[np.int64],
    begin: int,
    end: int,
    biases: NDArray[np.float64],
    drift: float,
    place_times: NDArray[np.int64],
    places: NDArray[np.float64],
    here: int,
    core: NDArray[np.float64],
    pending: NDArray[np.float64],
) -> tuple[int, int, Interval]:
    """Both ellipsoids a step further, up to the place node `here`, their yaw to the gyro node after it, and shown.

    rows to fresh: of PlanarSets. before to telescoped: of the Step; `fresh_count`: it starts from a count whose error
    is zero by definition. `bounds`: TrackBounds, as a plain tuple. The gyro nodes after the reading before and after
    this one are those with efforts turned_until, turned_until_now. times to end: the gyro nodes; biases [3, 2].

    Returns: what became of them, BITS for each; the gyro node after the reading; the bias of ω_z during the step.
    """
    told, before, start, after, bias, aged = turned_over(
        times, headings, effort, begin, end, place_times[here - 1, 0], turned_until, turned_until_now, before, after,
        biases, drift,
    )  # fmt: skip
    tracks = TrackBounds(*bounds)
    way = tracked(left, right, counted, slid, time_high, tracks)
    heading = turned_so(headings, swing, before, start, after, bias, aged)
    tilt = tilted((attitude[0, 0], attitude[0, 1]), (attitude[1, 0], attitude[1, 1]))
    sideways = up(up(tracks.lateral * way.path) + up(tracks.turning_centre * telescoped))
    outcomes = 0
    for frame in range(2):
        if known[frame] and told:
            e, first = stored(rows[frame]), fresh_count or fresh[frame]
            travel_ellipsoid(e, heading, way, sideways, up(tracks.normal * way.path), tilt, first, kept[frame])
            fresh[frame] = False
            sound = meet_axis(e, BIAS, bias[0], bias[1]) != EMPTY
            shown = show(e, kept[frame], frame, places[here], core, pending, turns, headings, after, end - 1, bias)
            outcome = (0 if shown else TOO_WIDE) | (0 if sound else CONTRADICTED)
        elif known[frame]:
            outcome = UNTOLD
        else:
            outcome = ABSENT if may_begin(turns, end - 1, frame) else 0
        outcomes |= outcome << (BITS * frame)
    return outcomes, after, bias


@plain_or_compiled
def may_begin(turns: NDArray[np.float64], newest: int, frame: int) -> bool:
    """May an ellipsoid begin, by the newest yaw?"""
    row = YAWS[frame]
    return bool(turns[newest, row, 1] - turns[newest, row, 0] < 2.0 * WIDEST_YAW)


@compiled_bare
def turned_over(
    times: NDArray[np.int64],
    headings: NDArray[np.float64],
    effort: NDArray[np.int64],
    begin: int,
    end: int,
    began_ns: int,
    turned_until: int,
    turned_until_now: int,
    a: int,
    b: int,
    biases: NDArray[np.float64],
    drift: float,
) -> tuple[bool, int, int, int, Interval, float]:
    """Of a step that began at `began_ns`, inside gyro nodes a and b: is its turning known; nodes before, start, after.

    Yaw turned from node `start` to node `after`; during the step the bias of ω_z was in an interval, and drifted by up
    to the last number.
    """
    start = node_of(effort, begin, end, turned_until)
    known = start >= begin and times[a, 1] <= began_ns
    if start < begin:
        start = b
    before = min(a, start)
    after = b if effort[b, 2] == turned_until_now else start
    seconds = up((times[after, 1] - times[start, 0]) * 1e-9)
    bias = aged_bias((biases[2, 0], biases[2, 1]), drift, times[before, 0], times[end - 1, 1])
    known = known and headings[after, 2] - headings[before, 2] < WIDEST_YAW
    return known, before, start, after, bias, up(drift * seconds)


@compiled_bare
def node_of(effort: NDArray[np.int64], begin: int, end: int, turned_until: int) -> int:
    """The gyro node in [begin, end) with that effort of ω_z; before `begin` if there is none. They rise as times do."""
    node = first_not_before(effort[:, 2:], begin, end, turned_until)
    return node if node < end and effort[node, 2] == turned_until else begin - 1


@compiled_bare
def turned_so(
    headings: NDArray[np.float64],
    swing: NDArray[np.float64],
    before: int,
    start: int,
    after: int,
    bias: Interval,
    aged: float,
) -> HeadingStep:
    """What the gyroscope says of yaw from node `start` to node `after`, in a step that began after node `before`."""
    slope = headings[after, 1] - headings[start, 1]
    change = headings[after, 0] - headings[start, 0]
    error = up(abs(headings[after, 2] - headings[start, 2]))
    error = up(error + up(ULP * (abs(change) + abs(slope) * max(abs(bias[0]), abs(bias[1])))))
    inside = relative_yaw_between(headings, swing, before, after, headings[start], bias)
    return HeadingStep(change, slope, error, inside, bias, aged)


@compiled_bare
def correct(
    rows: NDArray[np.float64],
    known: NDArray[np.bool_],
    core: NDArray[np.float64],
    yaws: NDArray[np.float64],
    ahead: Interval,
) -> bool:
    """E ∩ {x, y in [core]} ∩ {yaw in [yaw] - [ahead]} in either frame, outer, strip by strip; False if one is empty."""
    for frame in range(2):
        if known[frame]:
            e, yaw = stored(rows[frame]), sub((yaws[frame, 0], yaws[frame, 1]), ahead)
            for i in range(2):
                row = PLACES[frame] + i
                if meet_axis(e, i, core[row, 0], core[row, 1]) == EMPTY:
                    return False
            if meet_axis(e, YAW, yaw[0], yaw[1]) == EMPTY:
                return False
    return True


@compiled_bare
def show(
    e: Ellipsoid,
    kept: NDArray[np.float64],
    frame: int,
    here: NDArray[np.float64],
    core: NDArray[np.float64],
    pending: NDArray[np.float64],
    turns: NDArray[np.float64],
    headings: NDArray[np.float64],
    node: int,
    newest: int,
    bias: Interval,
) -> bool:
    """E's outer box: in the frame's rows of core and pending (see tracks.travel) and of the newest place `here`, and
    in its row of the turns [n, c, 2] from `node` to `newest`, while tied to it. False if that yaw is too wide.
    """
    place, yaw = PLACES[frame], YAWS[frame]
    for i in range(2):
        core[place + i, 0], core[place + i, 1] = extent(e, i)
        pending[place + i] = kept[8 + i]
        here[place + i, 0], here[place + i, 1] = widen(extent(e, i), kept[8 + i])
    for k in range(node, newest + 1):
        if headings[k, 2] - headings[node, 2] < WIDEST_YAW:
            turns[k, yaw, 0], turns[k, yaw, 1] = add(extent(e, YAW), relative_yaw(headings[k], headings[node], bias))
    return half_width(e, YAW) <= WIDEST_YAW


@compiled_bare
def show_all(
    rows: NDArray[np.float64],
    kept: NDArray[np.float64],
    known: NDArray[np.bool_],
    here: NDArray[np.float64],
    core: NDArray[np.float64],
    pending: NDArray[np.float64],
    turns: NDArray[np.float64],
    headings: NDArray[np.float64],
    node: int,
    newest: int,
    bias: Interval,
) -> int:
    """`show` of those there are. What became of them, as in `planar_step`."""
    outcomes = 0
    for frame in range(2):
        if known[frame]:
            e = stored(rows[frame])
            if not show(e, kept[frame], frame, here, core, pending, turns, headings, node, newest, bias):
                outcomes |= TOO_WIDE << (BITS * frame)
    return outcomes
