"""The recent past as a tube: boxes at nodes whose true times are known as intervals, and all that lies between.

A node is an instant (of a gyro packet, of an encoder reading) inside [earliest, latest], with a box for some
coordinates then; `swing` says how far a coordinate can leave the hull of two neighbouring boxes between them. The
true order of nodes is the order of their numbers, so their stamps are kept rising.
"""

from copy import copy

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_bare
from estimator.interval import down, up

PER_NODE = ("times", "box", "swing", "net", "local", "heading", "effort")
"""The arrays of a tube."""


class Tube:
    """Nodes [begin, end) of growing arrays; the oldest are let go when they are older than the history."""

    def __init__(self, history_ns: int, capacity: int = 4096, coordinates: int = 3) -> None:
        self._history_ns = history_ns
        self.times = np.zeros((capacity, 2), dtype=np.int64)
        """[n, 2] earliest, latest."""
        self.box = np.zeros((capacity, coordinates, 2))
        self.swing = np.zeros((capacity, coordinates))
        """[n, c] of the step that ends at the node."""
        self.net = np.zeros((capacity, 3, 2))
        """[n, 3, 2] encloses the change over the step that ends at the node, in the map (positions only)."""
        self.local = np.zeros((capacity, 3, 3))
        """[n, 3, 3] low, high and swing of the same, seen along the heading of the step (positions only)."""
        self.heading = np.zeros((capacity, 3))
        """[n, 3] the heading up to here (attitudes), or the one of the step (positions); see motion.relative_yaw."""
        self.effort = np.zeros((capacity, 3), dtype=np.int64)
        """[n, 3] variation of the body rates from the beginning to here, in QUANTUM (attitudes only)."""
        self.begin = 1
        self.end = 1

    def __deepcopy__(self, memo: dict[int, object]) -> "Tube":
        """The nodes that are still needed; the rest of the arrays is memory not yet touched, and costs nothing."""
        new = copy(self)
        if len(self):
            new.begin = self._first_since(int(self.times[self.newest, 0]) - self._history_ns)
        for name in PER_NODE:
            old = getattr(self, name)
            mine = np.zeros(old.shape, old.dtype)
            mine[new.begin : new.end] = old[new.begin : new.end]
            setattr(new, name, mine)
        return new

    def __len__(self) -> int:
        return self.end - self.begin

    @property
    def newest(self) -> int:
        """Index of the newest node."""
        return self.end - 1

    @property
    def newest_ns(self) -> int:
        """The newest node is surely not before then."""
        return self.times.item(self.end - 1, 0)

    def push(self, earliest_ns: int, latest_ns: int) -> int:
        """Index of a new node at the end, stamped; its box and the rest are the caller's to fill.

        A true time is not before its predecessor's, and the predecessor's not after it.
        """
        i = self.room(earliest_ns)
        put_in_order(self.times, self.begin, i, earliest_ns, latest_ns)
        self.end = i + 1
        return i

    def room(self, earliest_ns: int) -> int:
        """Index of the node that comes next; it is the caller's to stamp (`put_in_order`), and to raise `end`."""
        if self.end == len(self.times):
            self._make_room(earliest_ns - self._history_ns)
        return self.end

    def prepend(self, time_ns: int) -> int:
        """Index of a new node before the first one, at one exact time."""
        self.begin -= 1
        self.times[self.begin] = time_ns
        self.effort[self.begin] = 0
        return self.begin

    def _first_since(self, keep_from_ns: int) -> int:
        """The newest node that is surely not after then; the oldest if there is none."""
        return min(max(self.before(keep_from_ns), self.begin), self.end - 1)

    def _make_room(self, keep_from_ns: int) -> None:
        """Move what is still needed to the front, or double the arrays where nearly all is."""
        first = self._first_since(keep_from_ns)
        size = self.end - first
        capacity = len(self.times) * (2 if size > len(self.times) // 2 else 1)
        for name in PER_NODE:
            old = getattr(self, name)
            new = np.zeros((capacity, *old.shape[1:]), dtype=old.dtype)
            new[1 : size + 1] = old[first : self.end]
            setattr(self, name, new)
        self.begin, self.end = 1, size + 1

    def join(self, other: "Tube") -> int:
        """Grow to the hull of both, over as many of the newest nodes as both have: how many. The rest is let go."""
        k = min(len(self), len(other))
        mine, theirs = slice(self.end - k, self.end), slice(other.end - k, other.end)
        self.begin = self.end - k
        for name in ("box", "net", "local"):
            own, its = getattr(self, name)[mine], getattr(other, name)[theirs]
            np.minimum(own[..., 0], its[..., 0], out=own[..., 0])
            np.maximum(own[..., 1:], its[..., 1:], out=own[..., 1:])
        np.maximum(self.swing[mine], other.swing[theirs], out=self.swing[mine])
        steps = np.maximum(np.diff(self.effort[mine], axis=0), np.diff(other.effort[theirs], axis=0))
        self.effort[self.begin + 1 : self.end] = self.effort[self.begin] + np.cumsum(steps, axis=0)
        np.minimum(self.times[mine, 0], other.times[theirs, 0], out=self.times[mine, 0])
        np.maximum(self.times[mine, 1], other.times[theirs, 1], out=self.times[mine, 1])
        return k

    def before(self, time_ns: int) -> int:
        """Index of the last node that is surely not after `time_ns`; begin - 1 if there is none."""
        return last_not_after(self.times, self.begin, self.end, time_ns)

    def after(self, time_ns: int) -> int:
        """Index of the first node that is surely not before `time_ns`; end if there is none."""
        return first_not_before(self.times, self.begin, self.end, time_ns)

    def reaches(self, time_ns: int) -> bool:
        """Is the newest node surely not before `time_ns`?"""
        return self.end > self.begin and self.times.item(self.end - 1, 0) >= time_ns

    def hull(self, first: int, last: int) -> NDArray[np.float64]:
        """[c, 2] all that the coordinates can be from node `first` to node `last`."""
        out = np.empty(self.box.shape[1:])
        hull_between(self.box, self.swing, first, last, out)
        return out


@compiled_bare
def put_in_order(times: NDArray[np.int64], begin: int, i: int, earliest_ns: int, latest_ns: int) -> None:
    """Stamp node i, after nodes [begin, i): it is not before any of them, and none of them after it."""
    if i > begin:
        earliest_ns = max(earliest_ns, times[i - 1, 0])
        latest_ns = max(latest_ns, earliest_ns)
    times[i, 0], times[i, 1] = earliest_ns, latest_ns
    j = i - 1
    while j >= begin and times[j, 1] > latest_ns:
        times[j, 1] = latest_ns
        j -= 1


@compiled_bare
def last_not_after(times: NDArray[np.int64], begin: int, end: int, time_ns: int) -> int:
    """Largest i in [begin, end) with latest[i] <= time_ns, else begin - 1; latest never falls."""
    low = begin
    high = end
    while low < high:
        middle = (low + high) // 2
        if times[middle, 1] <= time_ns:
            low = middle + 1
        else:
            high = middle
    return low - 1


@compiled_bare
def first_not_before(times: NDArray[np.int64], begin: int, end: int, time_ns: int) -> int:
    """Smallest i in [begin, end) with earliest[i] >= time_ns, else end; earliest never falls."""
    low = begin
    high = end
    while low < high:
        middle = (low + high) // 2
        if times[middle, 0] >= time_ns:
            high = middle
        else:
            low = middle + 1
    return low


@compiled_bare
def hull_between(
    box: NDArray[np.float64], swing: NDArray[np.float64], first: int, last: int, out: NDArray[np.float64]
) -> None:
    """Hull of the nodes first..last and of the steps between them, with their swings."""
    for c in range(len(out)):
        low = box[first, c, 0]
        high = box[first, c, 1]
        for i in range(first + 1, last + 1):
            s = swing[i, c]
            low = min(low, down(min(box[i - 1, c, 0], box[i, c, 0]) - s))
            high = max(high, up(max(box[i - 1, c, 1], box[i, c, 1]) + s))
        out[c, 0] = low
        out[c, 1] = high


@compiled
def poses_between(
    places: NDArray[np.int64],
    place_box: NDArray[np.float64],
    place_swing: NDArray[np.float64],
    place_begin: int,
    place_end: int,
    turns: NDArray[np.int64],
    turn_box: NDArray[np.float64],
    turn_swing: NDArray[np.float64],
    turn_begin: int,
    turn_end: int,
    earliest_ns: NDArray[np.int64],
    latest_ns: NDArray[np.int64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    place: int = 0,
    yaw: int = 2,
) -> int:
    """Pose boxes over m stretches of time; how many could not be given (their rows are NaN).

    x, y, z are the coordinates from `place` on; roll and pitch the first two of the turns, yaw the one named.
    """
    missing = 0
    where = np.empty(place_box.shape[1:])
    how = np.empty(turn_box.shape[1:])
    for k in range(len(earliest_ns)):
        i = last_not_after(places, place_begin, place_end, earliest_ns[k])
        j = first_not_before(places, place_begin, place_end, latest_ns[k])
        a = last_not_after(turns, turn_begin, turn_end, earliest_ns[k])
        b = first_not_before(turns, turn_begin, turn_end, latest_ns[k])
        if i < place_begin or j >= place_end or a < turn_begin or b >= turn_end or earliest_ns[k] > latest_ns[k]:
            missing += 1
            low[k, :] = np.nan
            high[k, :] = np.nan
            continue
        hull_between(place_box, place_swing, i, j, where)
        hull_between(turn_box, turn_swing, a, b, how)
        for c in range(3):
            low[k, c] = where[place + c, 0]
            high[k, c] = where[place + c, 1]
            angle = c if c < 2 else yaw
            low[k, 3 + c] = how[angle, 0]
            high[k, 3 + c] = how[angle, 1]
    return missing
