"""The paper's set: an ellipsoid over (x, y, yaw, gyro bias) in the place of boxes (extended set-membership filter).

The same chains, stamps and contractors as with boxes; only x, y and yaw come from an ellipsoid, one in the map and one
on Earth: its linear step keeps how they hang together, and so a fix also says something of yaw and bias. In return a
step's remainder is that of a linearisation. A window of fixes beside it contradicts where it can, but takes no part.

While yaw isn't known to within a radian no linear map says where the robot goes. Then (before the first fixes, on
Earth; after the attitude was lost) there is no ellipsoid, and the boxes go on, which hold at any yaw, with the window
of fixes, which finds it again; the ellipsoid begins anew from them. So the set stays finite whatever happens: it never
grows by more than the way that the robot can have come.
"""

from math import inf

import numpy as np
from numpy.typing import NDArray

from drivers.config import EncodersConfig
from drivers.samples import WheelTicks
from estimator.attitude import AttitudeChain
from estimator.bounded_pose import PlanarEllipsoid
from estimator.config import FilterConfig, RobotConfig
from estimator.ellipsoid import image, stored
from estimator.gps_window import GpsWindow
from estimator.inconsistency import Journal
from estimator.interval import Interval, meet, mid, reach, sub, up, widen
from estimator.motion import relative_yaw
from estimator.planar_set import (
    BITS,
    CONTRADICTED,
    FRAMES,
    PLACES,
    TOO_WIDE,
    UNTOLD,
    YAWS,
    PlanarSets,
    correct,
    may_begin,
    node_of,
    planar_step,
    show_all,
)
from estimator.position import PositionChain, Step
from estimator.slip_ledger import SlipLedger


class NewestFixOnly(GpsWindow):
    """A window that remembers nothing."""

    def remember(
        self,
        bias: NDArray[np.float64],
        slack: float,
        quantum: float,
        yaw: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> None:
        """Not even this one."""


class Witness(NewestFixOnly):
    """Only the newest fix contracts; a whole window beside it contradicts, and contracts while it is `alone`."""

    def __init__(self, bias_drift: float, ledger: SlipLedger) -> None:
        super().__init__(bias_drift)
        self._whole = GpsWindow(bias_drift, ledger)
        self.alone = True

    def clear(self) -> None:
        """Forget all fixes."""
        self._whole.clear()

    def extend(
        self,
        step: NDArray[np.float64],
        axis: NDArray[np.float64],
        heading: NDArray[np.float64],
        quantum: float,
        bias: NDArray[np.float64],
        now_s: float,
    ) -> None:
        """As GpsWindow's."""
        self._whole.extend(step, axis, heading, quantum, bias, now_s)

    def narrowed(
        self,
        antenna: NDArray[np.float64],
        offset: NDArray[np.float64],
        heading: NDArray[np.float64],
        seconds: tuple[float, float],
        quantum: float,
        bias: NDArray[np.float64],
        yaw: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> bool:
        """As GpsWindow's; False where the whole window leaves nothing."""
        seen = (bias, yaw, place) if self.alone else (bias.copy(), yaw.copy(), place.copy())
        return self._whole.narrowed(antenna, offset, heading, seconds, quantum, *seen) and (
            self.alone or super().narrowed(antenna, offset, heading, seconds, quantum, bias, yaw, place)
        )

    def remember(
        self,
        bias: NDArray[np.float64],
        slack: float,
        quantum: float,
        yaw: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> None:
        """Keep it for the whole window."""
        self._whole.remember(bias, slack, quantum, yaw, place)


class EllipsoidalPosition(PositionChain):
    """As PositionChain, with x, y and yaw from ellipsoids."""

    def __init__(
        self,
        robot: RobotConfig,
        config: FilterConfig,
        encoders: EncodersConfig,
        attitude: AttitudeChain,
        journal: Journal,
    ) -> None:
        super().__init__(robot, config, encoders, attitude, journal)
        self._witness = None if config.wrong_fixes else Witness(attitude.gyro.bias_drift, self.ledger)
        self.window = self._witness or self.window
        self.sets = PlanarSets()
        self._undone = np.zeros_like(self._pending)

    def begin(self, ticks: WheelTicks) -> bool:
        """Here x = y = z = yaw = 0; False if the attitude chain doesn't reach back so far."""
        begun = super().begin(ticks)
        if begun:
            node = self._gyro_node()
            assert node is not None, "the map begins among the nodes"
            self._begin_sets(node, self._attitude.bias_since(node))
        return begun

    def predict(self, ticks: WheelTicks) -> Step:
        """travel, with boxes and with ellipsoids: one node further, at the true time of this encoder reading."""
        sets, places, attitude, turns = self.sets, self.tube, self._attitude, self._attitude.tube
        turned_until, fresh_count = self._turned_until, self._fresh_count
        self._undone[:] = self._pending
        step = super().predict(ticks)
        outcomes, after, bias = planar_step(
            sets.rows, sets.kept, sets.known, sets.fresh, fresh_count, *step, self._bounds, turned_until,
            self._turned_until, turns.times, turns.box, turns.swing, turns.heading, turns.effort, turns.begin,
            turns.end, attitude.bias, attitude.gyro.bias_drift, places.times, places.box, places.newest, self._core,
            self._pending,
        )  # fmt: skip
        if outcomes:
            self._look_after(outcomes, ticks)
            self._begin_sets(after, bias)
        return step

    def _look_after(self, outcomes: int, ticks: WheelTicks) -> None:
        """Ellipsoids that don't go on, or contradict the gyroscope."""
        undone = self._undone + self._pending
        for frame in FRAMES:
            outcome = outcomes >> (BITS * frame)
            if outcome & UNTOLD:
                self._let_go(frame, undone)
            if outcome & CONTRADICTED:
                self._journal.report("gyro", ticks.stamp.mid_ns, inf, "rad/s")
            if outcome & TOO_WIDE:
                self._too_wide(frame)

    def contract(self, narrowed: NDArray[np.float64], yaws: NDArray[np.float64]) -> bool:
        """The newest place is in narrowed [6, 2], the newest yaws in [2, 2]; False, and all stays, if that can't be."""
        sets, turns, after = self.sets, self._attitude.tube, self._gyro_node()
        if after is None:
            for frame in FRAMES:
                if sets.known[frame]:
                    self._let_go(frame, self._pending.copy())
            return super().contract(narrowed, yaws)
        bias = self._attitude.bias_since(after)
        ahead = relative_yaw(turns.heading[turns.newest], turns.heading[after], bias)
        before = sets.rows.copy()
        if not correct(sets.rows, sets.known, self._foreseen(narrowed), yaws, ahead):
            sets.rows[:] = before
            return False
        super().contract(narrowed, yaws)
        self._begin_sets(after, bias)
        self._show(after, bias)
        here = self.tube.box[self.tube.newest]
        here[:, 0], here[:, 1] = np.maximum(here[:, 0], narrowed[:, 0]), np.minimum(here[:, 1], narrowed[:, 1])
        return True

    def ellipsoid(self, on_earth: bool) -> PlanarEllipsoid | None:
        """At the newest reading: what is still to come after it, and the yaw's change since, are undone."""
        frame, turns, here = int(on_earth), self._attitude.tube, self.tube.newest
        if not self.sets.known[frame]:
            return None
        earliest_ns, latest_ns = (int(time) for time in self.tube.times[here])
        around, node = turns.before(earliest_ns), self._gyro_node()
        if around < turns.begin or node is None:
            return None
        turned = self._attitude.yaw_between(around, max(around, node), node)
        back = mid(turned)
        e = stored(self.sets.rows[frame].copy())
        rest = np.array([*self.sets.kept[frame, 8:], reach(turned, back), 0.0])
        image(e, np.eye(4), np.array([0.0, 0.0, back, 0.0]), np.zeros((4, 0)), rest)
        return PlanarEllipsoid(earliest_ns, latest_ns, e.centre[:3].copy(), e.shape[:3, :3].copy())

    def join(self, other: PositionChain) -> None:
        """Grow to the hull of both chains; the ellipsoids begin anew from the boxes."""
        super().join(other)
        self.sets.known[:] = False

    def remember(self) -> None:
        """As PositionChain's. While yaw is lost to the ellipsoids, the window finds it again."""
        super().remember()
        if self._witness is not None:
            self._witness.alone = not self.sets.known.all()

    def _gyro_node(self) -> int | None:
        """Index of the node at which the ellipsoids' yaw stands, the first one after the newest reading.

        None if there was no reading for so long that the node is out of the history.
        """
        turns = self._attitude.tube
        node = node_of(turns.effort, turns.begin, turns.end, self._turned_until)
        return node if node >= turns.begin else None

    def _begin_sets(self, node: int, bias: Interval) -> None:
        """Ellipsoids around the boxes, where there are none and yaw is known; the count's error begins anew."""
        if self.sets.known.all():
            return
        turns, here = self._attitude.tube, self.tube.newest
        around = turns.before(int(self.tube.times[here, 0]))
        if around < turns.begin:
            return
        slack = up(self.turned_around(around) + self.tracks.slip * self.quantum)
        ahead = relative_yaw(turns.heading[turns.newest], turns.heading[node], bias)
        for frame in FRAMES:
            if not self.sets.known[frame] and may_begin(turns.box, turns.newest, frame):
                yaw, newest = turns.box[node, YAWS[frame]], turns.box[turns.newest, YAWS[frame]]
                x, y = self.tube.box[here, PLACES[frame] : PLACES[frame] + 2]
                self.sets.begin(
                    frame,
                    widen((x[0], x[1]), slack),
                    widen((y[0], y[1]), slack),
                    meet((yaw[0], yaw[1]), sub((newest[0], newest[1]), ahead)),
                    bias,
                )

    def _show(self, node: int, bias: Interval) -> None:
        """The ellipsoids' boxes are the chains'. One whose yaw got too wide is let go."""
        sets, turns, here = self.sets, self._attitude.tube, self.tube.box[self.tube.newest]
        outcomes = show_all(
            sets.rows, sets.kept, sets.known, here, self._core, self._pending, turns.box, turns.heading, node,
            turns.newest, bias,
        )  # fmt: skip
        for frame in FRAMES:
            if outcomes >> (BITS * frame) & TOO_WIDE:
                self._too_wide(frame)

    def _too_wide(self, frame: int) -> None:
        """Nothing linear can be said of its yaw any more."""
        self._journal.counts["ellipsoid_let_go"] += 1
        self._let_go(frame, self._pending.copy())

    def _let_go(self, frame: int, undone: NDArray[np.float64]) -> None:
        """The boxes go on from here, the count's error anew. The newest place is within `undone` of the core."""
        self.sets.known[frame] = False
        for row in (PLACES[frame], PLACES[frame] + 1):
            self._pending[row] = up(self.quantum * abs(self._axis[row]))
            core = self._core[row]
            self._core[row] = widen((core[0], core[1]), up(up(undone[row]) + self._pending[row]))
            self.tube.box[self.tube.newest, row] = self._core[row]
