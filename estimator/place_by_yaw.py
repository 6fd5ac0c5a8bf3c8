"""Where the robot can be on Earth for each yaw that it can have: a polygon for every slice of yaw, from fix to fix.

A yaw known to 2 degrees moves a polygon's points across the way by 3.5 cm a metre, each step anew: its error is taken
to change at will. But it is the same all along, but for the gyroscope. So yaw is sliced, each slice has a polygon of
its own (place_polygon.py), and goes on with the gyroscope: what the fixes say along the way, across it and of yaw hangs
together. Slices overlap as the gyroscope's errors grow, are halved as others find no place, and are cut anew when they
overlap too much.
"""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.chaining import chain
from estimator.fan import add_box
from estimator.interval import Interval, add, cosine, hull, is_empty, mag, sine, up, widen
from estimator.motion import relative_yaw
from estimator.observations import nearest_copy
from estimator.odometry_block import Blocks, bend_to
from estimator.place_polygon import SIDES, cut_polygon, moved_polygon, polygon_of

MOST_SLICES = 32
THINNEST = 1e-4
"""rad: slices are not cut thinner."""
MOST_OVERLAP = 2.0
"""So wide may all slices be together in proportion to what they cover."""
WIDEST_M = 1e3
"""A box wider than this is not worth a polygon."""

SLICE = np.dtype([("yaw", np.float64, (2,)), ("polygon", np.float64, (SIDES,))], align=True)
"""For yaw in here (of the newest gyro node, modulo a turn): base_link, less the count's error ahead, is in the polygon.

A difference of any two counts is off by a quantum at most: so it is paid for where fixes meet the polygon, not on each
way between them (tracks.travel)."""


class PlaceByYaw:
    """The slices at the last fix that was used, and at the one last tried."""

    def __init__(self) -> None:
        self._slices, self._tried = np.zeros(MOST_SLICES, SLICE), np.zeros(MOST_SLICES, SLICE)
        self._count = self._left = 0
        """None: nothing is known."""

    def clear(self) -> None:
        """Nothing is known any more."""
        self._count = self._left = 0

    def narrowed(
        self,
        blocks: Blocks,
        now_s: float,
        quantum: float,
        drift: float,
        bias: NDArray[np.float64],
        yaw: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> bool:
        """Contract yaw [2] and place [2, 2] by the way since the last fix, which is blocks[0]; blocks[1] is now.

        place is what the newest fix has left. False if nothing is left.
        """
        self._left = 0
        if not self._count:
            return True
        self._left = try_slices(
            self._slices[: self._count], blocks, now_s, quantum, drift, bias, yaw, place, self._tried
        )
        return self._left != 0

    def go_on(self, quantum: float, yaw: NDArray[np.float64], place: NDArray[np.float64]) -> None:
        """From the fix last tried, which left the robot in place [2, 2] with that yaw [2]."""
        self._count = sliced(self._tried, max(self._left, 0), quantum, yaw, place, self._slices)


@compiled
def try_slices(
    slices: NDArray[np.void],
    blocks: Blocks,
    now_s: float,
    quantum: float,
    drift: float,
    bias: NDArray[np.float64],
    yaw: NDArray[np.float64],
    place: NDArray[np.float64],
    out: NDArray[np.void],
) -> int:
    """How many slices are left now, in `out`; yaw [2] and place [2, 2] are contracted to them. -1: no way is known."""
    ways = chain(1, blocks, now_s, 0.0, bias[0], bias[1], drift)
    if ways.oldest > 0:
        return -1
    aged = up(drift * up(now_s - blocks[0].seconds))
    bent = up(quantum * bend_to(blocks[0], blocks[1].heading, (bias[0], bias[1]), aged))
    add_box(ways.fan[0], bent, bent)
    turned = relative_yaw(blocks[1].heading, blocks[0].heading, widen((bias[0], bias[1]), aged))
    box, places = np.empty((2, 2)), np.empty((2, 2))
    yaws, left = (0.0, 0.0), 0
    for k in range(len(slices)):
        now = nearest_copy(add((slices[k].yaw[0], slices[k].yaw[1]), turned), (yaw[0], yaw[1]))
        if is_empty(now):
            continue
        moved_polygon(slices[k].polygon, ways, now[0], now[1], out[left].polygon)
        if not cut_less_ahead(out[left].polygon, place, quantum, now, box):
            continue
        out[left].yaw[0], out[left].yaw[1] = now
        yaws = hull(yaws, now) if left else now
        for axis in range(2):
            low, high = box[axis, 0], box[axis, 1]
            places[axis, 0] = min(places[axis, 0], low) if left else low
            places[axis, 1] = max(places[axis, 1], high) if left else high
        left += 1
    if left:
        found = nearest_copy((yaw[0], yaw[1]), yaws)
        if is_empty(found):
            return 0
        yaw[0], yaw[1] = found
        place[:] = places
    return left


@compiled
def cut_less_ahead(
    polygon: NDArray[np.float64], place: NDArray[np.float64], quantum: float, yaw: Interval, box: NDArray[np.float64]
) -> bool:
    """polygon [SIDES], of base_link less up to a quantum ahead, to where base_link is in place [2, 2]; that is in box.

    False where there is none.
    """
    east, north = up(quantum * mag(cosine(yaw))), up(quantum * mag(sine(yaw)))
    less = widened(place, east, north)
    if not cut_polygon(polygon, less):
        return False
    box[:] = widened(less, east, north)
    for axis in range(2):
        box[axis, 0], box[axis, 1] = max(box[axis, 0], place[axis, 0]), min(box[axis, 1], place[axis, 1])
    return True


@compiled
def widened(place: NDArray[np.float64], east: float, north: float) -> NDArray[np.float64]:
    """place [2, 2] by so much on either side."""
    box = np.empty((2, 2))
    box[0, 0], box[0, 1] = widen((place[0, 0], place[0, 1]), east)
    box[1, 0], box[1, 1] = widen((place[1, 0], place[1, 1]), north)
    return box


@compiled
def sliced(
    tried: NDArray[np.void],
    left: int,
    quantum: float,
    yaw: NDArray[np.float64],
    place: NDArray[np.float64],
    out: NDArray[np.void],
) -> int:
    """Into `out`, and how many: those of the first `left` slices that agree with yaw [2], halved or cut anew.

    One, of all of the place [2, 2], if there are none; none where that is not worth it.
    """
    if not max(place[0, 1] - place[0, 0], place[1, 1] - place[1, 0]) < WIDEST_M:
        return 0
    kept = 0
    for k in range(left):
        now = nearest_copy((tried[k].yaw[0], tried[k].yaw[1]), (yaw[0], yaw[1]))
        if is_empty(now):
            continue
        out[kept].yaw[0], out[kept].yaw[1] = now
        out[kept].polygon[:] = tried[k].polygon
        kept += 1
    if kept == 0:
        out[0].yaw[:] = yaw
        polygon_of(widened(place, quantum, quantum), out[0].polygon)
        kept = 1
    first, last, total = np.inf, -np.inf, 0.0
    for k in range(kept):
        first, last = min(first, out[k].yaw[0]), max(last, out[k].yaw[1])
        total += out[k].yaw[1] - out[k].yaw[0]
    if 2 * kept <= MOST_SLICES and total > kept * 2.0 * THINNEST:
        return halved(out, kept)
    if total > MOST_OVERLAP * (last - first) and kept > 1:
        tried[:kept] = out[:kept]
        return cut_anew(tried[:kept], first, last, out)
    return kept


@compiled
def halved(slices: NDArray[np.void], count: int) -> int:
    """Each of `count` slices as two; how many there are then."""
    for k in range(count - 1, -1, -1):
        low, high = slices[k].yaw[0], slices[k].yaw[1]
        middle = 0.5 * (low + high)
        slices[2 * k + 1].polygon[:] = slices[k].polygon
        slices[2 * k].polygon[:] = slices[k].polygon
        slices[2 * k + 1].yaw[0], slices[2 * k + 1].yaw[1] = middle, high
        slices[2 * k].yaw[0], slices[2 * k].yaw[1] = low, middle
    return 2 * count


@compiled
def cut_anew(slices: NDArray[np.void], first: float, last: float, out: NDArray[np.void]) -> int:
    """[first, last] into slices without overlaps, each the hull of what was known of any yaw in it; how many."""
    width = (last - first) / MOST_SLICES
    count = 0
    for j in range(MOST_SLICES):
        low = first + j * width
        high = last if j == MOST_SLICES - 1 else first + (j + 1) * width
        found = False
        for k in range(len(slices)):
            if slices[k].yaw[0] > high or slices[k].yaw[1] < low:
                continue
            for m in range(SIDES):
                side = slices[k].polygon[m]
                out[count].polygon[m] = max(out[count].polygon[m], side) if found else side
            found = True
        if found:
            out[count].yaw[0], out[count].yaw[1] = low, high
            count += 1
    return count
