"""The position chain: a box of (x, y, z) at the true time of each encoder reading."""

from collections import Counter
from math import nan

import numpy as np
from numpy.typing import NDArray

from drivers.config import EncodersConfig
from drivers.samples import WheelTicks
from estimator.attitude import UNKNOWN_TILT, UNKNOWN_YAW, AttitudeChain
from estimator.config import FilterConfig, RobotConfig
from estimator.inconsistency import Contradictions
from estimator.interval import down, hull, meet, mig, up, widen
from estimator.motion import QUANTUM, TrackBounds, travel
from estimator.tube import Tube


class PositionChain:
    """Predicted by the tracks, with the attitudes of the other chain; the origin is where the map begins."""

    def __init__(
        self,
        robot: RobotConfig,
        config: FilterConfig,
        encoders: EncodersConfig,
        attitude: AttitudeChain,
        counts: Counter[str],
        contradictions: Contradictions,
    ) -> None:
        half_gauge = 0.5 * robot.track_gauge_m
        self.tracks = TrackBounds(
            slip=robot.slip_ratio,
            lateral=robot.lateral_slip_ratio,
            turning_centre=robot.turning_centre_m,
            normal=robot.normal_slip_ratio,
            quantum_left=abs(encoders.left_metres_per_tick) * encoders.quantisation_ticks,
            quantum_right=abs(encoders.right_metres_per_tick) * encoders.quantisation_ticks,
            most_speed=robot.max_speed_mps,
            most_acceleration=robot.max_acceleration_mps2,
            most_track_acceleration=(robot.max_acceleration_mps2 + half_gauge * attitude.gyro.most_acceleration)
            / max(1.0 - robot.slip_ratio, 0.1),
        )
        self._left_m, self._right_m = encoders.left_metres_per_tick, encoders.right_metres_per_tick
        self._attitude = attitude
        self._counts, self._contradictions = counts, contradictions
        self.tube = Tube(int(config.history_s * 1e9))
        self.last_ticks: WheelTicks | None = None
        self._core = np.zeros((3, 2))  # see motion.travel
        self._axis = np.zeros(3)
        self._pending_quantum = np.zeros(3)
        self._fresh_count = True
        self._turned_until = 0  # effort of the gyro node after the newest reading

    def begin(self, ticks: WheelTicks) -> bool:
        """Here x = y = z = yaw = 0; False if the attitude chain doesn't reach back so far."""
        nodes = self._attitude.begin_map(ticks.stamp)
        if nodes is None:
            return False
        turns = self._attitude.tube
        i = self.tube.push(ticks.stamp.earliest_ns, ticks.stamp.latest_ns)
        self.tube.box[i] = self.tube.net[i] = self.tube.swing[i] = 0.0
        self._turned_until = int(turns.effort[nodes[1], 2])
        slack = up(self.tracks.turning_centre * (turns.effort[nodes[1], 2] - turns.effort[nodes[0], 2]) * QUANTUM)
        self._core[:] = -slack, slack
        self.last_ticks = ticks
        return True

    def predict(self, ticks: WheelTicks) -> None:
        """travel: one node further, at the true time of this encoder reading."""
        stamp, tube = ticks.stamp, self._attitude.tube
        last = self.last_ticks
        assert last is not None, "begin comes first"
        time_high = up((stamp.latest_ns - int(self.tube.times[self.tube.newest, 0])) * 1e-9)
        a, b = tube.before(int(self.tube.times[self.tube.newest, 0])), tube.after(stamp.latest_ns)
        covered = a >= tube.begin
        turning = up(self._attitude.gyro.most_rate * time_high)
        telescoped = turning
        attitude = np.array([[-UNKNOWN_TILT, UNKNOWN_TILT]] * 2 + [[-UNKNOWN_YAW, UNKNOWN_YAW]])
        until = max(self._turned_until, int(tube.effort[b, 2]))
        if covered:
            attitude = tube.hull(a, b)
            turning = min(turning, (tube.effort[b, 2] - tube.effort[a, 2]) * QUANTUM)
            telescoped = (until - self._turned_until) * QUANTUM
        else:
            self._counts["attitude_history_missed"] += 1
            telescoped = up(turning + (until - self._turned_until) * QUANTUM)
        net, swing = np.empty((3, 2)), np.empty(3)
        counted = ticks.epoch == last.epoch
        step = (
            (ticks.left - last.left) * self._left_m if counted else nan,
            (ticks.right - last.right) * self._right_m if counted else nan,
        )

        def go(counted: bool) -> bool:
            return travel(
                attitude, *step, counted, time_high, turning, telescoped, self.tracks,
                self._axis, self._fresh_count, self._core, net, swing, self._pending_quantum,
            )  # fmt: skip

        if not go(counted):
            self._contradictions.report("encoders", stamp.mid_ns)
            counted = go(False) and False
        self._fresh_count = not counted
        self._turned_until = until
        self.last_ticks = ticks
        i = self.tube.push(stamp.earliest_ns, stamp.latest_ns)
        self.tube.net[i], self.tube.swing[i] = net, swing
        for c in range(3):
            self.tube.box[i, c] = widen((self._core[c, 0], self._core[c, 1]), self._pending_quantum[c])

    def contract(self, narrowed: NDArray[np.float64]) -> None:
        """The newest node's box is inside narrowed [3, 2]."""
        n, turns = self.tube.newest, self._attitude.tube
        here = self.tube.box[n]
        here[:] = narrowed
        # what is still to come after node n, see motion.travel: the count's error, and the turning around the node
        m = turns.before(int(self.tube.times[n, 0]))
        if m < turns.begin:
            return
        slack = up(self.tracks.turning_centre * (self._turned_until - int(turns.effort[m, 2])) * QUANTUM)
        for c in range(3):
            future = widen((here[c, 0], here[c, 1]), up(self._pending_quantum[c] + slack))
            self._core[c] = meet((self._core[c, 0], self._core[c, 1]), future)

    def travelled_since(self, i: int, j: int, n: int) -> NDArray[np.float64]:
        """[3, 2] p_n - p(τ) for any τ between the nodes i and j: j to n by its net, i to j by its variation."""
        net = self.tube.net
        out = np.zeros((3, 2))
        for c in range(3):
            total, variation = (0.0, 0.0), 0.0
            for k in range(i + 1, j + 1):
                step = (net[k, c, 0], net[k, c, 1])
                total = down(total[0] + step[0]), up(total[1] + step[1])
                variation = up(variation + up(2.0 * self.tube.swing[k, c] + mig(step)))
            total = meet(total, (-variation, variation))
            inside = widen(hull((0.0, 0.0), total), up(0.5 * max(0.0, variation - mig(total))))
            for k in range(j + 1, n + 1):
                inside = down(inside[0] + net[k, c, 0]), up(inside[1] + net[k, c, 1])
            out[c] = inside
        return out
