"""The position chain: a box of (x, y, z), in the map and on Earth, at the true time of each encoder reading."""

from dataclasses import replace
from math import nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from drivers.config import EncodersConfig
from drivers.samples import WheelTicks
from estimator.attitude import EARTH_YAW, MAP_YAW, AttitudeChain
from estimator.bounded_pose import PlanarEllipsoid
from estimator.config import FilterConfig, RobotConfig
from estimator.encoder_step import encoder_step
from estimator.gps_window import GpsWindow
from estimator.inconsistency import Journal
from estimator.interval import add, meet, up, widen
from estimator.motion import QUANTUM, TrackBounds
from estimator.relaxed_window import RelaxedWindow
from estimator.slip_ledger import SlipLedger
from estimator.tracks import telescoping_quantum
from estimator.travelled import travelled_since
from estimator.tube import Tube

NO_EPOCH = -1
"""Of counts that nothing may be subtracted from."""
MAP, EARTH, LOCAL = slice(0, 3), slice(3, 6), slice(6, 9)
"""Rows of what a step is followed with: in the map, on Earth (east, north, up), and along its own heading."""
ANYWHERE_M = 1e8
NO_AXIS = np.zeros(3)
"""Of a step that no counts tell of: there the error of the last count is paid for, and the next one's begins."""


class Step(NamedTuple):
    """The way from one encoder reading to the next, as far as the sensors tell."""

    before: int
    """The gyro node surely not after the earlier reading (the later node, where the history is too short);"""
    after: int
    """... and the one surely not before the later."""
    attitude: NDArray[np.float64]
    """[4, 2] all of the time: roll, pitch, yaw in the map, yaw on Earth."""
    left: float
    right: float
    """Travel of the tracks in metres;"""
    counted: bool
    """... if the counter didn't restart."""
    slid: float
    """What they slip in proportion to, both together (tracks.slipping)."""
    time_high: float
    """Seconds, at most."""
    turning: float
    """Variation of the yaw rate's integral, and the one that telescopes: see tracks.travel."""
    telescoped: float


class PositionChain:
    """Predicted by the tracks, with the attitudes of the other chain; the origin is where the map begins."""

    def __init__(
        self,
        robot: RobotConfig,
        config: FilterConfig,
        encoders: EncodersConfig,
        attitude: AttitudeChain,
        journal: Journal,
    ) -> None:
        least_gauge, most_gauge = robot.turning_gauge_m or (robot.track_gauge_m, robot.track_gauge_m)
        not_slipping = max(1.0 - robot.slip_ratio, 0.1)
        self.tracks = TrackBounds(
            slip=robot.slip_ratio,
            lateral=robot.lateral_slip_ratio,
            turning_centre=robot.turning_centre_m,
            normal=robot.normal_slip_ratio,
            quantum_left=abs(encoders.left_metres_per_tick) * encoders.quantisation_ticks,
            quantum_right=abs(encoders.right_metres_per_tick) * encoders.quantisation_ticks,
            most_speed=robot.max_speed_mps,
            most_acceleration=robot.max_acceleration_mps2,
            most_track_acceleration=up(
                up(robot.max_acceleration_mps2 + 0.25 * (least_gauge + most_gauge) * attitude.gyro.most_acceleration)
                / not_slipping
            ),
            turning_spread=up(0.25 * (most_gauge - least_gauge) / not_slipping),
            most_turn_acceleration=attitude.gyro.most_acceleration,
        )
        self.quantum = telescoping_quantum(self.tracks)
        """How far the mean of two differences of counts is off, in metres, and the slip for that reason."""
        self._bounds = tuple(self.tracks)
        self._left_m, self._right_m = encoders.left_metres_per_tick, encoders.right_metres_per_tick
        self._attitude = attitude
        self._journal = journal
        self.tube = Tube(int(config.history_s * 1e9), coordinates=6)
        drift, wrong = attitude.gyro.bias_drift, config.wrong_fixes
        self.ledger = SlipLedger(robot.turning_gauge_m, self.tracks, attitude)
        self.window = RelaxedWindow(drift, wrong, config.wrong_fixes_of) if wrong else GpsWindow(drift, self.ledger)
        """The way since the fixes that are remembered."""
        self.last_ticks: WheelTicks | None = None
        self._core = np.zeros((9, 2))  # see tracks.travel
        self._axis, self._pending = np.zeros(9), np.zeros(9)
        self._swept = np.zeros((4, 2))
        """Attitudes of the step."""
        self._running = np.zeros(2, np.bool_)  # see tracks.slipping
        self._lost_at: tuple[int, NDArray[np.float64]] | None = None
        """While counts tell of no step: the earliest time of the last reading that one told of, and its box."""
        self._fresh_count = True
        self._turned_until = 0  # effort of the gyro node after the newest reading

    def begin(self, ticks: WheelTicks) -> bool:
        """Here x = y = z = yaw = 0; False if the attitude chain doesn't reach back so far."""
        nodes = self._attitude.begin_map(ticks.stamp)
        if nodes is None:
            return False
        turns = self._attitude.tube
        i = self.tube.push(ticks.stamp.earliest_ns, ticks.stamp.latest_ns)
        self.tube.box[i, EARTH] = -ANYWHERE_M, ANYWHERE_M
        self._turned_until = int(turns.effort[nodes[1], 2])
        slack = self.turned_around(nodes[0])
        self._core[MAP] = -slack, slack
        self._core[EARTH] = -ANYWHERE_M, ANYWHERE_M
        self.last_ticks = ticks
        self.ledger.step(ticks.stamp, 0.0, 0.0, False, 0.0, 0.0, 0.0)
        return True

    def predict(self, ticks: WheelTicks) -> Step:
        """travel: one node further, at the true time of this encoder reading."""
        places, attitude, last = self.tube, self._attitude, self.last_ticks
        assert last is not None, "begin comes first"
        turns, i = attitude.tube, places.room(ticks.stamp.earliest_ns)
        counted = ticks.epoch == last.epoch
        left = (ticks.left - last.left) * self._left_m if counted else nan
        right = (ticks.right - last.right) * self._right_m if counted else nan
        a, b, remembered, sound, slid, time_high, turning, telescoped, self._turned_until = encoder_step(
            i, places.begin, ticks.stamp.earliest_ns, ticks.stamp.latest_ns, left, right, counted, self._fresh_count,
            self._turned_until, self._bounds, turns.begin, turns.end, turns.times, turns.box, turns.swing,
            turns.heading, turns.effort, attitude.bias, attitude.gyro.bias_drift, attitude.gyro.most_rate,
            places.times, places.box, places.swing, places.net, places.local, places.heading, self._swept, self._core,
            self._axis, self._pending, self._running,
        )  # fmt: skip
        places.end = i + 1
        if not remembered:
            self._journal.counts["attitude_history_missed"] += 1
        if not sound:
            excess = 0.5 * abs(left + right) - self.tracks.most_speed * time_high
            self._journal.report("encoders", ticks.stamp.mid_ns, excess, "m")
            counted = False
        self._fresh_count = not counted
        self.last_ticks = ticks
        self.ledger.step(ticks.stamp, left, right, counted, slid, turning, time_high)
        self.window.extend(
            self._core[LOCAL], self._axis[LOCAL] if counted else NO_AXIS, places.heading[i], self.quantum,
            attitude.bias[2], int(turns.times[turns.newest, 1]) * 1e-9,
        )  # fmt: skip
        return Step(a, b, self._swept, left, right, counted, slid, time_high, turning, telescoped)

    def stay_in_reach(self, counted: bool) -> None:
        """Steps that no counts tell of, one after the other, lead no farther than their time in all allows.

        Each alone may be as long as its stamps are wide: many readings that were read late, at once, would add up to
        many times the way that the robot can have come.
        """
        places, turns, here = self.tube, self._attitude.tube, self.tube.newest
        if counted or (self._lost_at is None and here - 1 < places.begin):
            self._lost_at = None
        elif self._lost_at is None:
            self._lost_at = int(places.times[here - 1, 0]), places.box[here - 1].copy()
        else:
            began_ns, before = self._lost_at
            ended_ns = int(places.times[here, 1])
            seconds = up((ended_ns - began_ns) * 1e-9)
            a, b = turns.before(began_ns), turns.after(ended_ns)
            turned = up(self._attitude.gyro.most_rate * seconds)
            if a >= turns.begin and b < turns.end:
                turned = min(turned, up(int(turns.effort[b, 2] - turns.effort[a, 2]) * QUANTUM))
            ahead = up(self.tracks.most_speed * seconds)
            way = up(ahead * up(up(1.0 + self.tracks.lateral) + self.tracks.normal))
            way = up(way + up(self.tracks.turning_centre * turned))
            box = places.box[here]
            low = np.maximum(box[:, 0], np.nextafter(before[:, 0] - way, -np.inf))
            high = np.minimum(box[:, 1], np.nextafter(before[:, 1] + way, np.inf))
            if np.all(low <= high) and (np.any(low > box[:, 0]) or np.any(high < box[:, 1])):
                self.contract(np.stack([low, high], axis=1), turns.box[turns.newest, MAP_YAW:].copy())

    def place_at(self, time_ns: int) -> NDArray[np.float64] | None:
        """[3, 2] the place in the map then; None without nodes around it."""
        first, last = self.tube.before(time_ns), self.tube.after(time_ns)
        known = self.tube.begin <= first and last < self.tube.end
        return self.tube.hull(first, last)[MAP] if known else None

    def hold_place(self, box: NDArray[np.float64], time_ns: int, way: float) -> None:
        """base_link was within `way` of box [3, 2] of the map at that time: contract the newest place by it."""
        places = self.tube
        first, last, here = places.before(time_ns), places.after(time_ns), places.newest
        if first < places.begin or last > here:
            return
        since = travelled_since(places.net, places.swing, first, last, here)
        narrowed = places.box[here].copy()
        for c in range(3):
            there = add(widen((box[c, 0], box[c, 1]), way), (since[c, 0], since[c, 1]))
            narrowed[c] = meet((narrowed[c, 0], narrowed[c, 1]), there)
        beyond = float((narrowed[:, 0] - narrowed[:, 1]).max())
        if beyond > 0.0:
            self._journal.report("encoders", time_ns, beyond, "m")
        else:
            turns = self._attitude.tube
            self.contract(narrowed, turns.box[turns.newest, MAP_YAW:].copy())

    def contract(self, narrowed: NDArray[np.float64], yaws: NDArray[np.float64]) -> bool:
        """The newest place is in narrowed [6, 2], the newest yaws in [2, 2]; False, and all stays, if that can't be."""
        self._core[:] = self._foreseen(narrowed)
        self.tube.box[self.tube.newest] = narrowed
        turns = self._attitude.tube
        turns.box[turns.newest, MAP_YAW:] = yaws
        return True

    def _foreseen(self, narrowed: NDArray[np.float64]) -> NDArray[np.float64]:
        """The core [9, 2], once the newest place is inside narrowed [6, 2]."""
        turns, core = self._attitude.tube, self._core.copy()
        m = turns.before(int(self.tube.times[self.tube.newest, 0]))
        if m >= turns.begin:
            foresee(narrowed, self._pending, self.turned_around(m), core)
        return core

    def join(self, other: "PositionChain") -> None:
        """Grow to the hull of both chains, which have the same newest nodes; counts and window begin anew."""
        self.window.clear()
        if not self.tube.join(other.tube) or self.last_ticks is None:
            return
        self.last_ticks = replace(self.last_ticks, epoch=NO_EPOCH)
        self._turned_until = max(self._turned_until, int(self._attitude.tube.effort[self._attitude.tube.newest, 2]))
        turns, began_ns = self._attitude.tube, int(self.tube.times[self.tube.newest, 0])
        before = turns.before(began_ns)
        slack = self.turned_around(max(before, turns.begin))
        if before < turns.begin:
            seconds = up((int(turns.times[turns.begin, 1]) - began_ns) * 1e-9)
            slack = up(slack + up(self.tracks.turning_centre * up(self._attitude.gyro.most_rate * seconds)))
        box = self.tube.box[self.tube.newest]
        self._core[:6, 0] = np.nextafter(box[:, 0] - slack, -np.inf)
        self._core[:6, 1] = np.nextafter(box[:, 1] + slack, np.inf)
        self._fresh_count, self._lost_at = True, None

    def remember(self) -> None:
        """Keep the fix last given to the window, if the way since the one before is long enough."""
        around = self._attitude.tube.before(int(self.tube.times[self.tube.newest, 0]))
        turns = self._attitude.tube
        self.window.remember(
            self._attitude.bias[2], self.turned_around(around), self.quantum, turns.box[turns.newest, EARTH_YAW],
            self.tube.box[self.tube.newest, EARTH][:2],
        )  # fmt: skip

    def ellipsoid(self, on_earth: bool) -> PlanarEllipsoid | None:
        """Boxes know of none."""
        return None

    def turned_around(self, before: int) -> float:
        """How far the turning centre may have moved (m) between gyro node `before` and the end of the newest step."""
        turned = (self._turned_until - int(self._attitude.tube.effort[before, 2])) * QUANTUM
        return up(self.tracks.turning_centre * turned)


@compiled
def foresee(box: NDArray[np.float64], pending: NDArray[np.float64], turning: float, core: NDArray[np.float64]) -> None:
    """core [9, 2] is inside the newest box and what is still to come after it: the count's error, and the turning."""
    for c in range(len(box)):
        future = widen((box[c, 0], box[c, 1]), up(pending[c] + turning))
        core[c, 0], core[c, 1] = meet((core[c, 0], core[c, 1]), future)
