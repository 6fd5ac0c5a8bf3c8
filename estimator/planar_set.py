"""The ellipsoid over (x, y, yaw, gyro bias) of one frame, beside a position chain's boxes: step, strips, outer box."""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.ellipsoid import EMPTY, Ellipsoid, box, extent, half_width, meet_axis
from estimator.ellipsoidal_motion import BIAS, UNITS, YAW, HeadingStep, X, Y, memory, travel_ellipsoid
from estimator.interval import ULP, Interval, add, mid, reach, up, widen
from estimator.motion import TrackBounds, relative_yaw, relative_yaw_between
from estimator.position import ANYWHERE_M
from estimator.tracks import tracked

WIDEST_YAW = 1.0
"""rad: beyond this half-width there is no ellipsoid."""


class PlanarSet:
    """The ellipsoid of one frame: x and y among the places from row `place` on, yaw in row `yaw` of the turns."""

    def __init__(self, place: int, yaw: int) -> None:
        self.place, self.yaw = place, yaw
        self.set: Ellipsoid | None = None
        self.kept = memory()
        self.first = True

    def begin(self, x: Interval, y: Interval, yaw: Interval, bias: Interval) -> None:
        """Anew, around a box; none if that is too wide, or empty."""
        axes = (x, y, yaw, bias)
        middle = np.array([mid(axis) for axis in axes])
        half = np.array([reach(axis, c) for axis, c in zip(axes, middle, strict=True)])
        self.set, self.first = None, True
        if half.min() >= 0.0 and half[YAW] < WIDEST_YAW and max(half[X], half[Y]) < ANYWHERE_M:
            self.set = box(middle, half, UNITS)
            self.kept = memory()


@compiled
def correct(e: Ellipsoid, place: NDArray[np.float64], yaw: Interval) -> bool:
    """E ∩ {x in [place 0]} ∩ {y in [place 1]} ∩ {yaw in [yaw]}, outer, strip by strip; False if that is empty."""
    for i in range(2):
        if meet_axis(e, i, place[i, 0], place[i, 1]) == EMPTY:
            return False
    return meet_axis(e, YAW, yaw[0], yaw[1]) != EMPTY


@compiled
def show(
    e: Ellipsoid,
    kept: NDArray[np.float64],
    place: int,
    yaw: int,
    core: NDArray[np.float64],
    pending: NDArray[np.float64],
    here: NDArray[np.float64],
    turns: NDArray[np.float64],
    headings: NDArray[np.float64],
    node: int,
    newest: int,
    bias: Interval,
) -> bool:
    """E's outer box: in rows `place` and the next of core and pending (see tracks.travel) and of the newest box `here`,
    and in row `yaw` of the turns [n, c, 2] from `node` on, while tied to it. False if that yaw is too wide.
    """
    for i in range(2):
        core[place + i, 0], core[place + i, 1] = extent(e, i)
        pending[place + i] = kept[8 + i]
        here[place + i, 0], here[place + i, 1] = widen(extent(e, i), kept[8 + i])
    for k in range(node, newest + 1):
        if headings[k, 2] - headings[node, 2] < WIDEST_YAW:
            turns[k, yaw, 0], turns[k, yaw, 1] = add(extent(e, YAW), relative_yaw(headings[k], headings[node], bias))
    return half_width(e, YAW) <= WIDEST_YAW


@compiled
def advance(
    e: Ellipsoid,
    kept: NDArray[np.float64],
    headings: NDArray[np.float64],
    swing: NDArray[np.float64],
    before: int,
    start: int,
    after: int,
    bias: Interval,
    aged: float,
    attitude: NDArray[np.float64],
    left: float,
    right: float,
    counted: bool,
    time_high: float,
    turning: float,
    telescoped: float,
    bounds: tuple[float, ...],
    first: bool,
    place: int,
    yaw: int,
    core: NDArray[np.float64],
    pending: NDArray[np.float64],
    here: NDArray[np.float64],
    turns: NDArray[np.float64],
    newest: int,
) -> tuple[bool, bool]:
    """E a step further, its yaw from gyro node `start` to `after`, and shown.

    False, _ if its bias contradicts [bias]; _, False if its yaw has got too wide. `bounds`: TrackBounds, as a plain
    tuple.
    """
    tracks = TrackBounds(*bounds)
    way = tracked(left, right, counted, turning, time_high, tracks)
    slope = headings[after, 1] - headings[start, 1]
    change = headings[after, 0] - headings[start, 0]
    error = up(abs(headings[after, 2] - headings[start, 2]))
    error = up(error + up(ULP * (abs(change) + abs(slope) * max(abs(bias[0]), abs(bias[1])))))
    inside = relative_yaw_between(headings, swing, before, after, headings[start], bias)
    travel_ellipsoid(
        e,
        HeadingStep(change, slope, error, inside, bias, aged),
        way,
        up(up(tracks.lateral * way.path) + up(tracks.turning_centre * telescoped)),
        up(tracks.normal * way.path),
        (attitude[0, 0], attitude[0, 1]),
        (attitude[1, 0], attitude[1, 1]),
        first,
        kept,
    )
    sound = meet_axis(e, BIAS, bias[0], bias[1]) != EMPTY
    return sound, show(e, kept, place, yaw, core, pending, here, turns, headings, after, newest, bias)
