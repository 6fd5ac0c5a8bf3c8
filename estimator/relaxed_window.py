"""A window some of whose fixes may be wrong: what all but q of the newest M say of yaw and position (SMF 7.5).

At most q of any M fixes in succession leave their boxes. Then, wherever the robot is, at least M - q of the windows's
boxes for its place (SMF equation 23) hold it: the place is in their q-relaxed intersection. No fix is used alone, the
newest included, and nothing has to be detected. For each cell of yaw the fixes that contradict are counted instead of
the cell being dropped at the first.
"""

from math import cos, pi, sin

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.chaining import Chain, chain
from estimator.gps_window import GpsWindow
from estimator.interval import add, down, mid, reach, sub, up, widen
from estimator.odometry_block import Blocks, put_fix
from estimator.paving import place_by

CELLS = 16
ROUNDS = 6
"""Of paving at most, each with cells as fine as the last one left them."""
Floats = NDArray[np.float64]


class RelaxedWindow(GpsWindow):
    """The newest fixes, all of them, of which up to `wrong` may be anywhere; heights too."""

    def __init__(self, bias_drift: float, wrong: int, of: int) -> None:
        """At most `wrong` of any `of` fixes in succession."""
        super().__init__(bias_drift)
        self._wrong, self._of = wrong, of
        self._heights = np.zeros((of, 2))
        """[k] of base_link on Earth when fix k was the newest, if that fix is right."""
        self._rises = np.zeros((of, 2))
        """[k] since then, to the next fix or to now."""
        self._slope = np.nan
        """The last step's axis upward; NaN before the block's first."""

    def extend(self, step: Floats, axis: Floats, heading: Floats, quantum: float, bias: Floats, now_s: float) -> None:
        """As GpsWindow's; heights go along. A count's error is paid for where the axis changes, see tracks.travel."""
        if self.count:
            k, slope = self.count - 1, float(axis[2])
            bent = 0.0 if np.isnan(self._slope) else up(quantum * up(abs(slope - self._slope)))
            rise = (self._rises[k, 0], self._rises[k, 1])
            self._rises[k], self._slope = widen(add(rise, (step[2, 0], step[2, 1])), bent), slope
        super().extend(step, axis, heading, quantum, bias, now_s)

    def narrowed(
        self,
        antenna: Floats,
        offset: Floats,
        heading: Floats,
        seconds: tuple[float, float],
        quantum: float,
        bias: Floats,
        yaw: Floats,
        place: Floats,
    ) -> bool:
        """As GpsWindow's, with antenna, offset and place [3, 2]; False where more than `wrong` must be wrong."""
        k = self.count
        if k:
            self._settle(k - 1, self._since[0])
        put_fix(self._blocks, k, antenna[:2], offset[:2], heading, seconds[0])
        self._heights[k] = sub((antenna[2, 0], antenna[2, 1]), (offset[2, 0], offset[2, 1]))
        if not self._level(place[2], quantum):
            return False
        return contract_by_most(k, self._wrong, self._blocks, seconds[1], quantum, self._drift, bias, yaw, place[:2])

    def _level(self, height: Floats, quantum: float) -> bool:
        """Contract the height [2]."""
        k, rise = self.count, (0.0, 0.0)
        ends = np.empty((k + 1, 2))
        ends[k] = self._heights[k]
        for i in range(k - 1, -1, -1):
            rise = add(rise, widen((self._rises[i, 0], self._rises[i, 1]), quantum))
            ends[i] = add((self._heights[i, 0], self._heights[i, 1]), rise)
        return relaxed(ends, k + 1, k + 1 - self._wrong, height)

    def remember(self, bias: Floats, slack: float, quantum: float, yaw: Floats, place: Floats) -> None:
        """Keep the fix last given to `narrowed`, whole and in any case: the window is of fixes in succession."""
        if self.count == self._of - 1:
            self._let_go_of_the_oldest()
        self._begin_block(bias, slack, quantum)
        k = self.count - 1
        self._rises[k], self._slope = (-slack, slack), np.nan

    def _let_go_of_the_oldest(self) -> None:
        super()._let_go_of_the_oldest()
        self._heights[:-1], self._rises[:-1] = self._heights[1:].copy(), self._rises[1:].copy()


@compiled
def relaxed(ends: Floats, count: int, needed: int, out: Floats) -> bool:
    """The hull of the points that at least `needed` of `count` intervals `ends` [n, 2] hold, cut with `out` [2].

    False, and `out` unchanged, if there is none. None is needed: all of `out`.
    """
    if needed <= 0:
        return True
    lows, highs = np.empty(count), np.empty(count)
    n = 0
    for j in range(count):
        lows[n], highs[n] = max(ends[j, 0], out[0]), min(ends[j, 1], out[1])
        if lows[n] <= highs[n]:
            n += 1
    if n < needed:
        return False
    lows[:n].sort()
    highs[:n].sort()
    # Left of the first end by which `needed` have begun and not yet ended there is nothing; mirrored on the right.
    low, high = np.inf, -np.inf
    ended = 0
    for i in range(n):
        while highs[ended] < lows[i]:
            ended += 1
        if i + 1 - ended >= needed:
            low = lows[i]
            break
    begun = n - 1
    for i in range(n - 1, -1, -1):
        while lows[begun] > highs[i]:
            begun -= 1
        if begun + 1 - i >= needed:
            high = highs[i]
            break
    if not low <= high:
        return False
    out[0], out[1] = low, high
    return True


@compiled
def contract_by_most(
    count: int,
    wrong: int,
    blocks: Blocks,
    now_s: float,
    quantum: float,
    drift: float,
    bias: Floats,
    yaw: Floats,
    place: Floats,
) -> bool:
    """Chain, and pave; see RelaxedWindow.narrowed."""
    if count < wrong:
        return True
    ways = chain(count, blocks, now_s, quantum, bias[0], bias[1], drift)
    for _ in range(ROUNDS):
        width = yaw[1] - yaw[0]
        if not pave_relaxed(count, wrong, blocks, ways, yaw, place):
            return False
        if yaw[1] - yaw[0] > 0.9 * width:
            break
    return True


@compiled
def pave_relaxed(
    count: int,
    wrong: int,
    blocks: Blocks,
    ways: Chain,
    yaw: Floats,
    place: Floats,
) -> bool:
    """As paving.pave, where up to `wrong` of the count + 1 fixes may contradict; False if no cell is left.

    A yaw that may be anything is paved once around; what is left of the circle is the arc beside its widest gap.
    """
    around = yaw[1] - yaw[0] >= 2.0 * pi
    begin = mid((yaw[0], yaw[1])) - pi if around else yaw[0]
    width = ((2.0 * pi + 1e-12) if around else yaw[1] - yaw[0]) / CELLS
    left = np.zeros(CELLS, np.bool_)
    hull = np.array([[np.inf, -np.inf], [np.inf, -np.inf]])
    ends = np.empty((count + 1, 2, 2))
    room = np.empty((2, 2))
    for cell in range(CELLS):
        first, last = begin + cell * width, begin + (cell + 1) * width
        if cell == CELLS - 1 and not around:
            last = yaw[1]
        for j in range(count + 1):
            boxes_at(j, mid((first, last)), reach((first, last), mid((first, last))), blocks, ways, ends)
        room[:] = place
        if agreed(ends, count + 1, wrong, room):
            left[cell] = True
            for c in range(2):
                hull[c, 0], hull[c, 1] = min(hull[c, 0], room[c, 0]), max(hull[c, 1], room[c, 1])
    if not left.any():
        return False
    place[:] = hull
    first_cell, cells = longest_rest(left) if around else span(left)
    if not around or cells < CELLS:
        low, high = begin + first_cell * width, begin + (first_cell + cells) * width
        if not around:
            low, high = max(low, yaw[0]), min(high, yaw[1])
            if first_cell + cells == CELLS:
                high = yaw[1]
        yaw[0], yaw[1] = down(low), up(high)
    return True


@compiled
def boxes_at(j: int, psi: float, w: float, blocks: Blocks, ways: Chain, ends: Floats) -> None:
    """ends[j] [2, 2], where base_link is by fix j, for yaw in psi ± w."""
    if j < ways.oldest:
        ends[j, :, 0], ends[j, :, 1] = -np.inf, np.inf
        return
    ends[j, 0], ends[j, 1] = place_by(j, cos(psi), sin(psi), w, blocks, ways)


@compiled
def agreed(ends: Floats, count: int, wrong: int, room: Floats) -> bool:
    """Contract room [2, 2] to what all but `wrong` of the boxes ends [n, 2, 2] have in common, outer; False if nothing.

    A box that misses the room contradicts, and leaves one less that may; what is left is relaxed axis by axis.
    """
    alive = np.ones(count, np.bool_)
    kept = np.empty((count, 2))
    n = count
    while True:
        before = n
        for j in range(count):
            if alive[j] and (
                max(ends[j, 0, 0], room[0, 0]) > min(ends[j, 0, 1], room[0, 1])
                or max(ends[j, 1, 0], room[1, 0]) > min(ends[j, 1, 1], room[1, 1])
            ):
                alive[j] = False
                n -= 1
        if count - n > wrong:
            return False
        size = (room[0, 1] - room[0, 0]) + (room[1, 1] - room[1, 0])
        for c in range(2):
            k = 0
            for j in range(count):
                if alive[j]:
                    kept[k, 0], kept[k, 1] = ends[j, c, 0], ends[j, c, 1]
                    k += 1
            if not relaxed(kept, k, count - wrong, room[c]):
                return False
        if n == before and (room[0, 1] - room[0, 0]) + (room[1, 1] - room[1, 0]) > 0.99 * size:
            return True


@compiled
def span(left: NDArray[np.bool_]) -> tuple[int, int]:
    """The first cell that is left, and how many there are from it to the last."""
    first, last = 0, len(left) - 1
    while not left[first]:
        first += 1
    while not left[last]:
        last -= 1
    return first, last + 1 - first


@compiled
def longest_rest(left: NDArray[np.bool_]) -> tuple[int, int]:
    """On a circle: the first cell after its longest gap, and how many there are from it to that gap."""
    n = len(left)
    longest, after = 0, 0
    for start in range(n):
        if left[start]:
            gap = 0
            while gap < n and not left[start - 1 - gap]:
                gap += 1
            if gap > longest:
                longest, after = gap, start
    return after, n - longest
