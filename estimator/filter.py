"""The set-membership pose filter: samples in, a box that surely holds the pose out.

Two chains of nodes, each on its own unknown-but-bounded time base, so that the uncertainty of a stamp never adds up:

    attitude   a node per gyro packet       (roll, pitch, yaw), and the gyro's bias box
    position   a node per encoder reading   (x, y, z), the attitude taken from the other chain's tube

    predict    gyro packet: rotate -> turn                     encoder reading: travel
    correct    tilt, accelerometers -> the newest attitude;    standstill -> bias;    GPS -> position and anchor

Map frame: gravity aligned, x = y = z = yaw = 0 at the true time of the first encoder reading (of the first one that
the attitude chain reaches). Times are host monotonic ns and come with the samples.
"""

from collections import Counter, deque
from math import isfinite, isnan, nan, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.config import EncodersConfig, GpsConfig, ImuConfig
from drivers.samples import Fix, InertialSample, Stamp, WheelTicks
from estimator.bounded_pose import Anchor, BoundedPose, Guarantee
from estimator.config import FilterConfig, RobotConfig
from estimator.geodesy import TangentPlane
from estimator.inconsistency import Contradictions
from estimator.interval import down, hull, is_empty, meet, mig, up, widen
from estimator.motion import QUANTUM, GyroBounds, TrackBounds, add_effort, excursion, rotate, travel, turn
from estimator.observations import anchored, anchored_by_all, contract_tilt, lever
from estimator.tube import Tube, poses_between

UNKNOWN_TILT = 1.5707963267948968
"""Roll and pitch are taken to stay within 90 degrees."""
UNKNOWN_YAW = 3.1415926535897936
CLOCK_STEP_US = {"HIGHRES_IMU": 1, "RAW_IMU": 1}
"""Resolution of a message's device time; the others count milliseconds."""
MILLISECOND_US = 1000
DONE, CONTRADICTS = 0, 1
"""What contract_tilt says."""
LEARNING_PACKETS = 8
"""Gyro packets until the shortest interval seen is taken for the board's period."""
LONGEST_BRIDGE_NS = 50_000_000
"""The first encoder reading may come this long before the first gyro packet; else a later one begins the map."""
PENDING = 4096
"""Samples that may wait for the chain they depend on; the oldest are dropped."""
ANYWHERE_M = 1e8
REMEMBERED = 24
"""Early fixes that are applied to the anchor again and again."""
REMEMBER_EVERY_M = 0.4
STANDING_FIXES = 8


class _Packet(NamedTuple):
    """What later corrections need of a gyro packet."""

    stamp: Stamp
    epoch: int
    device_us: int | None
    resolution_us: int
    effort: NDArray[np.int64]
    """[3] summed variation of the body rates up to here."""
    rate: tuple[float, float, float]
    began_ns: int
    """Its mean surely covers nothing before this."""


class Filter:
    """Guaranteed pose from tracks, inertial board and GPS. One thread; samples in the order of their stamps."""

    def __init__(
        self,
        robot: RobotConfig,
        config: FilterConfig,
        encoders: EncodersConfig,
        imu: ImuConfig,
        gps: GpsConfig | None,
    ) -> None:
        self._gyro = GyroBounds(
            noise=up(radians(imu.gyro_noise_bound_dps)),
            scale=imu.gyro_scale_bound,
            most_rate=up(radians(robot.max_turn_rate_dps)),
            most_acceleration=up(radians(robot.max_turn_acceleration_dps2)),
            most_bias=up(radians(imu.gyro_bias_bound_dps)),
            bias_drift=up(radians(imu.gyro_bias_drift_dps2)),
        )
        half_gauge = 0.5 * robot.track_gauge_m
        self._tracks = TrackBounds(
            slip=robot.slip_ratio,
            lateral=robot.lateral_slip_ratio,
            turning_centre=robot.turning_centre_m,
            normal=robot.normal_slip_ratio,
            quantum_left=abs(encoders.left_metres_per_tick) * encoders.quantisation_ticks,
            quantum_right=abs(encoders.right_metres_per_tick) * encoders.quantisation_ticks,
            most_speed=robot.max_speed_mps,
            most_acceleration=robot.max_acceleration_mps2,
            most_track_acceleration=(robot.max_acceleration_mps2 + half_gauge * self._gyro.most_acceleration)
            / max(1.0 - robot.slip_ratio, 0.1),
        )
        self._left_m, self._right_m = encoders.left_metres_per_tick, encoders.right_metres_per_tick
        self._drift = imu.clock_drift_ppm * 1e-6
        self._tilt_bound = up(radians(imu.tilt_bound_deg))
        self._accel_bound = up(imu.accel_bound_mps2 + robot.max_acceleration_mps2)
        self._still_ns = None if config.standstill_s is None else int(config.standstill_s * 1e9)
        self._still_rate = up(radians(config.standstill_rate_dps))
        self._arm = np.array([gps.antenna_x_m, gps.antenna_y_m, gps.antenna_z_m] if gps else [0.0, 0.0, 0.0])

        self.counts: Counter[str] = Counter()
        self._contradictions = Contradictions(self.counts)

        history_ns = int(config.history_s * 1e9)
        self._attitude = Tube(history_ns)
        self._bias = np.array([[-self._gyro.most_bias, self._gyro.most_bias]] * 3)
        self._turned, self._varied, self._swing = np.zeros((3, 2)), np.zeros(3), np.zeros(3)
        self._gyro_source: tuple[str, int] | None = None
        self._packets: deque[_Packet] = deque(maxlen=PENDING)
        self._period_s = np.inf
        self._intervals_seen = 0
        self._level = False  # is the newest attitude a verified box?
        self._yaw_zeroed = False

        self._position = Tube(history_ns)
        self._core = np.zeros((3, 2))  # see motion.travel
        self._axis = np.zeros(3)
        self._pending_quantum = np.zeros(3)
        self._fresh_count = True
        self._turned_until = 0  # effort of the gyro node after the newest reading
        self._last_ticks: WheelTicks | None = None
        self._still: tuple[WheelTicks, int] | None = None  # first reading of the present counts, newest's earliest

        self._tilts: deque[InertialSample] = deque(maxlen=PENDING)
        self._ticks: deque[WheelTicks] = deque(maxlen=PENDING)
        self._fixes: deque[Fix] = deque(maxlen=PENDING)

        self._plane: TangentPlane | None = None
        self._antennas, self._points = np.zeros((REMEMBERED, 3, 2)), np.zeros((REMEMBERED, 3, 2))
        self._remembered = 0
        self._anchor = np.array([[-ANYWHERE_M, ANYWHERE_M]] * 3 + [[-UNKNOWN_YAW, UNKNOWN_YAW]])

    # ---------------------------------------------------------------- samples in

    def accept(self, sample: WheelTicks | InertialSample | Fix) -> None:
        """Take one sample. One that comes out of order, or can't be used, is dropped and counted."""
        if isinstance(sample, InertialSample):
            if not all(map(isnan, sample.gyro_rps)):
                self._predict_attitude(sample)
            if not (all(map(isnan, sample.tilt_rad)) and all(map(isnan, sample.accel_mps2[:2]))):
                self._queue(self._tilts, sample)
            while self._tilts and self._correct_tilt(self._tilts[0]):
                self._tilts.popleft()
        elif isinstance(sample, WheelTicks):
            newest = self._ticks[-1] if self._ticks else self._last_ticks
            if newest is not None and (
                sample.stamp.mid_ns < newest.stamp.mid_ns or sample.stamp.latest_ns < newest.stamp.earliest_ns
            ):
                self.counts["encoders_out_of_order"] += 1
                return
            self._queue(self._ticks, sample)
        elif isinstance(sample, Fix):
            if not all(map(isfinite, (sample.lat_deg, sample.lon_deg, sample.alt_m, *sample.bound_m))):
                self.counts["fix_unusable"] += 1
                return
            self._queue(self._fixes, sample)
        while self._ticks and self._attitude.reaches(self._ticks[0].stamp.latest_ns) and self._level_since_start():
            self._predict_position(self._ticks.popleft())
        while self._fixes and self._position.reaches(self._fixes[0].stamp.latest_ns):
            self._correct_by_fix(self._fixes.popleft())

    def _queue(self, queue: "deque[InertialSample] | deque[WheelTicks] | deque[Fix]", sample: object) -> None:
        """Wait in a bounded queue."""
        if len(queue) == queue.maxlen:
            self.counts["dropped_waiting"] += 1
        queue.append(sample)  # type: ignore[arg-type]  # each queue is given its own kind

    # ---------------------------------------------------------------- attitude

    def _predict_attitude(self, sample: InertialSample) -> None:
        """rotate -> turn: one node further, at the true time of this gyro packet."""
        source = (sample.message, sample.sensor_id)
        if self._gyro_source is None:
            self._gyro_source = source
        if source != self._gyro_source:
            self.counts["second_gyro"] += 1
            return
        resolution = CLOCK_STEP_US.get(sample.message, MILLISECOND_US)
        last = self._packets[-1] if self._packets else None
        if last is None:
            self._append_attitude(sample, sample.stamp, resolution, np.zeros(3), sample.stamp.earliest_ns)
            return
        if sample.stamp.latest_ns < last.stamp.earliest_ns or (
            sample.device_time_us is not None
            and last.device_us is not None
            and sample.epoch == last.epoch
            and sample.device_time_us <= last.device_us
        ):
            self.counts["gyro_out_of_order"] += 1
            return
        low, high, stamp, gap = self._interval(last, sample, resolution)
        turned, varied, swing = self._turned, self._varied, self._swing
        if not rotate(np.array(sample.gyro_rps), self._bias, low, high, gap, self._gyro, turned, varied):
            self._contradictions.report("gyro", sample.stamp.mid_ns)
        box = self._attitude.box[self._attitude.newest].copy()
        was_level = self._level
        self._level = self._level and turn(box, turned, varied, swing)
        i = self._append_attitude(sample, stamp, resolution, varied, last.stamp.earliest_ns)
        if self._level:
            self._attitude.box[i], self._attitude.swing[i] = box, swing
        elif was_level:
            self.counts["attitude_lost"] += 1
            yaw = 0.5 * (box[2, 0] + box[2, 1])
            self._attitude.box[i, 2] = min(box[2, 0], yaw - UNKNOWN_YAW), max(box[2, 1], yaw + UNKNOWN_YAW)
        else:
            self._attitude.box[i, 2] = self._attitude.box[i - 1, 2]

    def _append_attitude(
        self, sample: InertialSample, stamp: Stamp, resolution_us: int, varied: NDArray[np.float64], began_ns: int
    ) -> int:
        """A node whose tilt is not known yet."""
        effort = np.empty(3, dtype=np.int64)
        add_effort(self._packets[-1].effort if self._packets else np.zeros(3, dtype=np.int64), varied, effort)
        i = self._attitude.push(stamp.earliest_ns, stamp.latest_ns)
        self._attitude.effort[i] = effort
        self._attitude.box[i, :2] = -UNKNOWN_TILT, UNKNOWN_TILT
        self._attitude.box[i, 2] = -UNKNOWN_YAW, UNKNOWN_YAW
        self._attitude.swing[i] = 0.0
        self._packets.append(
            _Packet(stamp, sample.epoch, sample.device_time_us, resolution_us, effort, sample.gyro_rps, began_ns)
        )
        return i

    def _interval(self, last: _Packet, sample: InertialSample, resolution: int) -> tuple[float, float, Stamp, bool]:
        """Least and most seconds between two gyro packets, the second's stamp made tighter by them, and: is it a gap?

        The board's clock says how long it was, to within its resolution and drift; the host's stamps bound it too.
        """
        stamp = sample.stamp
        low = max(0, stamp.earliest_ns - last.stamp.latest_ns)
        high = stamp.latest_ns - last.stamp.earliest_ns
        if sample.device_time_us is None or last.device_us is None or sample.epoch != last.epoch:
            self._intervals_seen = 0
            return down(low * 1e-9), up(high * 1e-9), stamp, True
        between = sample.device_time_us - last.device_us
        device_low = int(max(0, between - resolution) * 1000 * (1.0 - self._drift)) - 1
        device_high = int((between + resolution) * 1000 / (1.0 - self._drift)) + 2
        self._intervals_seen += 1
        if self._intervals_seen > 1:  # the first one after a start may be anything
            self._period_s = min(self._period_s, between * 1e-6)
        gap = self._intervals_seen <= LEARNING_PACKETS or between * 1e-6 > 1.5 * self._period_s
        if gap and self._intervals_seen > LEARNING_PACKETS:
            self.counts["gyro_gaps"] += 1
        if device_low > high or device_high < low:
            self._contradictions.report("imu_clock", stamp.mid_ns)
            return down(low * 1e-9), up(high * 1e-9), stamp, True
        low, high = max(low, device_low, 0), min(high, device_high)
        stamp = Stamp(
            max(stamp.earliest_ns, last.stamp.earliest_ns + low), min(stamp.latest_ns, last.stamp.latest_ns + high)
        )
        return max(0.0, down(low * 1e-9)), up(high * 1e-9), stamp, gap

    def _correct_tilt(self, sample: InertialSample) -> bool:
        """Contract roll and pitch of the newest node by a reading of a little before; False if it must wait.

        Between the reading and the node the angles move no further than the variation of the rates allows.
        """
        around = self._packets_around(sample)
        if around is None:
            return False
        earlier, newest = around
        if earlier is None:
            self.counts["tilt_too_early"] += 1
            return True
        i = self._attitude.newest
        outcome = contract_tilt(
            self._attitude.box[i], self._level, *sample.tilt_rad, self._tilt_bound, *sample.accel_mps2[:2],
            self._accel_bound, newest.effort, earlier.effort,
        )  # fmt: skip
        if outcome == CONTRADICTS:
            by_tilt = not all(isnan(angle) for angle in sample.tilt_rad)
            self._contradictions.report("tilt" if by_tilt else "accelerometer", sample.stamp.mid_ns)
        if outcome != DONE:
            return True
        if not self._level:
            self._level = True
            if not self._yaw_zeroed:
                self._look_back(i)
        return True

    def _packets_around(self, sample: InertialSample) -> tuple[_Packet | None, _Packet] | None:
        """The last gyro packet surely not after the reading (or None), and the newest, surely not before it.

        By the board's own clock where both have it, else by the host's stamps. None while the newest may be before.
        """
        if not self._packets:
            return None
        newest = self._packets[-1]
        if sample.epoch < newest.epoch:
            return None, newest
        if not _surely_not_after(sample, newest, backward=True):
            return None
        for packet in reversed(self._packets):
            if _surely_not_after(sample, packet, backward=False):
                return packet, newest
        return None, newest

    def _look_back(self, newest: int) -> None:
        """The tilt is known for the first time: what it, and a yaw of zero here, say of the nodes before."""
        tube = self._attitude
        box = tube.box[newest]
        box[2] = 0.0, 0.0
        moved = np.empty(3)
        for i in range(newest - 1, tube.begin - 1, -1):
            varied = radians_of(tube.effort[newest] - tube.effort[i])
            if not excursion((box[0, 0], box[0, 1]), (box[1, 0], box[1, 1]), varied, moved):
                tube.begin = i + 1
                break
            for c in range(3):
                tube.box[i, c] = widen((box[c, 0], box[c, 1]), moved[c])
            tube.swing[i + 1] = 0.0  # node i's box holds all that comes between it and the newest

    def _level_since_start(self) -> bool:
        """May positions be predicted? Once they have begun, always; they then bear an unknown attitude too."""
        return self._level or len(self._position) > 0

    # ---------------------------------------------------------------- bias at standstill

    def _watch_standstill(self, ticks: WheelTicks, last: WheelTicks) -> None:
        """No tick for standstill_s before and after: the true rate is within standstill_rate, the rest is bias.

        The robot may begin to move, or come to rest, within a tick; so both ends of the stretch are left out.
        """
        if self._still_ns is None:
            return
        same = (ticks.left, ticks.right, ticks.epoch) == (last.left, last.right, last.epoch)
        if not same or ticks.stamp.earliest_ns - last.stamp.latest_ns > self._still_ns:
            self._still = None
            return
        first, used_until = self._still if self._still else (last, 0)
        begin = first.stamp.latest_ns + self._still_ns
        end = ticks.stamp.earliest_ns - self._still_ns
        if end > max(begin, used_until):
            for packet in reversed(self._packets):
                if packet.began_ns < begin or packet.stamp.latest_ns <= used_until:
                    break
                if packet.stamp.latest_ns <= end:
                    self._correct_bias(packet)
            used_until = end
        self._still = (first, used_until)

    def _correct_bias(self, packet: _Packet) -> None:
        """bias = measured - true ± noise ± scale |true|, some time ago: wider by the drift since then."""
        age = (self._packets[-1].stamp.latest_ns - packet.began_ns) * 1e-9
        error = self._gyro.noise + self._still_rate * (1.0 + self._gyro.scale) + self._gyro.scale * self._gyro.most_bias
        error = up(up(error + up(self._gyro.bias_drift * age)) * (1.0 + 1e-12))
        for axis, rate in enumerate(packet.rate):
            if isnan(rate):
                continue
            narrowed = meet((self._bias[axis, 0], self._bias[axis, 1]), widen((rate, rate), error))
            if is_empty(narrowed):
                self._contradictions.report("gyro", packet.stamp.mid_ns)
            else:
                self._bias[axis] = narrowed

    # ---------------------------------------------------------------- position

    def _predict_position(self, ticks: WheelTicks) -> None:
        """travel: one node further, at the true time of this encoder reading."""
        stamp, tube = ticks.stamp, self._attitude
        last = self._last_ticks
        if last is None:
            self._begin_map(ticks)
            return
        time_high = up((stamp.latest_ns - int(self._position.times[self._position.newest, 0])) * 1e-9)
        a, b = tube.before(int(self._position.times[self._position.newest, 0])), tube.after(stamp.latest_ns)
        covered = a >= tube.begin
        turning = up(self._gyro.most_rate * time_high)
        telescoped = turning
        attitude = np.array([[-UNKNOWN_TILT, UNKNOWN_TILT]] * 2 + [[-UNKNOWN_YAW, UNKNOWN_YAW]])
        until = max(self._turned_until, int(tube.effort[b, 2]))
        if covered:
            attitude = tube.hull(a, b)
            turning = min(turning, (tube.effort[b, 2] - tube.effort[a, 2]) * QUANTUM)
            telescoped = (until - self._turned_until) * QUANTUM
        else:
            self.counts["attitude_history_missed"] += 1
            telescoped = up(turning + (until - self._turned_until) * QUANTUM)
        self._watch_standstill(ticks, last)
        net, swing = np.empty((3, 2)), np.empty(3)
        counted = ticks.epoch == last.epoch
        step = (
            (ticks.left - last.left) * self._left_m if counted else nan,
            (ticks.right - last.right) * self._right_m if counted else nan,
        )

        def go(counted: bool) -> bool:
            return travel(
                attitude, *step, counted, time_high, turning, telescoped, self._tracks,
                self._axis, self._fresh_count, self._core, net, swing, self._pending_quantum,
            )  # fmt: skip

        if not go(counted):
            self._contradictions.report("encoders", stamp.mid_ns)
            counted = go(False) and False
        self._fresh_count = not counted
        self._turned_until = until
        self._last_ticks = ticks
        i = self._position.push(stamp.earliest_ns, stamp.latest_ns)
        self._position.net[i], self._position.swing[i] = net, swing
        for c in range(3):
            self._position.box[i, c] = widen((self._core[c, 0], self._core[c, 1]), self._pending_quantum[c])

    def _begin_map(self, ticks: WheelTicks) -> None:
        """Here x = y = z = yaw = 0: subtract what the yaw (counted from the first known tilt) can be now."""
        tube, stamp = self._attitude, ticks.stamp
        oldest = int(tube.times[tube.begin, 1])
        if stamp.earliest_ns < oldest:
            moved = self.counts["encoders_before_attitude"] > 0
            if moved or oldest - stamp.earliest_ns > LONGEST_BRIDGE_NS or len(self._packets) < 2:
                self.counts["encoders_before_attitude"] += 1
                return
            self._bridge(stamp.earliest_ns, oldest)
        a, b = tube.before(stamp.earliest_ns), tube.after(stamp.latest_ns)
        zero = tube.hull(a, b)[2]
        span = slice(tube.begin, tube.end)
        tube.box[span, 2] = np.stack(
            [_down(tube.box[span, 2, 0] - zero[1]), _up(tube.box[span, 2, 1] - zero[0])], axis=1
        )
        self._yaw_zeroed = True
        i = self._position.push(stamp.earliest_ns, stamp.latest_ns)
        self._position.box[i] = self._position.net[i] = self._position.swing[i] = 0.0
        self._turned_until = int(tube.effort[b, 2])
        slack = up(self._tracks.turning_centre * (tube.effort[b, 2] - tube.effort[a, 2]) * QUANTUM)
        self._core[:] = -slack, slack
        self._last_ticks = ticks

    def _bridge(self, time_ns: int, oldest_ns: int) -> None:
        """A node at the first encoder reading, before the gyro's first packet: rates can't have been far from the next.

        The mean rate of the second packet was the true one at some instant between the first and the second.
        """
        tube = self._attitude
        packet = self._packets[1]
        gap = up((oldest_ns - time_ns) * 1e-9)
        longest = up((packet.stamp.latest_ns - time_ns) * 1e-9)
        varied = np.empty(3)
        for axis, rate in enumerate(packet.rate):
            error = (
                self._gyro.noise
                + self._gyro.most_bias
                + self._gyro.scale * (self._gyro.most_rate + self._gyro.most_bias)
            )
            most = self._gyro.most_rate
            if not isnan(rate):
                most = min(most, up(up(abs(rate) + error) + up(self._gyro.most_acceleration * longest)))
            varied[axis] = up(most * gap)
        moved = np.full(3, UNKNOWN_TILT)
        first = tube.begin
        box = tube.box[first].copy()
        close = excursion((box[0, 0], box[0, 1]), (box[1, 0], box[1, 1]), varied, moved)
        effort = np.ceil(varied / QUANTUM).astype(np.int64) + 1
        i = tube.prepend(time_ns)
        tube.effort[i] = tube.effort[first] - effort
        tube.swing[first] = 0.0  # the new node's box holds all that comes between
        for c in range(3):
            limit = UNKNOWN_YAW if c == 2 else UNKNOWN_TILT
            tube.box[i, c] = widen((box[c, 0], box[c, 1]), moved[c]) if close else (-limit, limit)

    # ---------------------------------------------------------------- GPS

    def _correct_by_fix(self, fix: Fix) -> None:
        """antenna = t + Rz(Ψ)(p(τ) + R arm): contract the newest position, and the anchor (t, Ψ).

        p(τ) is the newest position less what was travelled since (SMF equation 26, with the signs kept).
        """
        places, turns, stamp = self._position, self._attitude, fix.stamp
        i, j, n = places.before(stamp.earliest_ns), places.after(stamp.latest_ns), places.newest
        a, b = turns.before(stamp.earliest_ns), turns.after(stamp.latest_ns)
        if i < places.begin or a < turns.begin or b >= turns.end:
            self.counts["fix_too_old"] += 1
            return
        if self._plane is None:
            self._plane = TangentPlane(fix.lat_deg, fix.lon_deg, fix.alt_m)
        arm = np.empty((3, 2))
        lever(turns.hull(a, b), self._arm, arm)
        since = self._travelled_since(i, j, n)
        offset = np.stack([_down(arm[:, 0] - since[:, 1]), _up(arm[:, 1] - since[:, 0])], axis=1)
        here = places.box[n]
        point = np.stack([_down(here[:, 0] + offset[:, 0]), _up(here[:, 1] + offset[:, 1])], axis=1)
        anchor, points, antenna = self._anchor.copy(), self._points.copy(), self._plane.antenna(fix)
        agree = anchored_by_all(self._antennas, points, self._remembered, anchor)
        if not agree or not anchored(antenna, anchor, point):
            self._contradictions.report("gps", stamp.mid_ns)
            return
        narrowed = np.empty((3, 2))
        for c in range(3):
            seen = (down(point[c, 0] - offset[c, 1]), up(point[c, 1] - offset[c, 0]))
            narrowed[c] = meet((here[c, 0], here[c, 1]), seen)
        if np.any(narrowed[:, 0] > narrowed[:, 1]):
            self._contradictions.report("gps", stamp.mid_ns)
            return
        self._anchor, self._points = anchor, points
        self._remember(antenna, point)
        here[:] = narrowed
        # what is still to come after node n, see motion.travel: the count's error, and the turning around the node
        m = turns.before(int(places.times[n, 0]))
        if m < turns.begin:
            return
        slack = up(self._tracks.turning_centre * (self._turned_until - int(turns.effort[m, 2])) * QUANTUM)
        for c in range(3):
            future = widen((here[c, 0], here[c, 1]), up(self._pending_quantum[c] + slack))
            self._core[c] = meet((self._core[c, 0], self._core[c, 1]), future)

    def _remember(self, antenna: NDArray[np.float64], point: NDArray[np.float64]) -> None:
        """Keep the first fixes for later: where the robot stood at first, then one every little way."""
        k = self._remembered
        if k == REMEMBERED:
            return
        if k >= STANDING_FIXES:
            way = np.abs(np.mean(point - self._points[k - 1], axis=1))
            if max(way[0], way[1]) < REMEMBER_EVERY_M:
                return
        self._antennas[k], self._points[k] = antenna, point
        self._remembered += 1

    def _travelled_since(self, i: int, j: int, n: int) -> NDArray[np.float64]:
        """[3, 2] p_n - p(τ) for any τ between the nodes i and j: j to n by its net, i to j by its variation."""
        net = self._position.net
        out = np.zeros((3, 2))
        for c in range(3):
            total, variation = (0.0, 0.0), 0.0
            for k in range(i + 1, j + 1):
                step = (net[k, c, 0], net[k, c, 1])
                total = down(total[0] + step[0]), up(total[1] + step[1])
                variation = up(variation + up(2.0 * self._position.swing[k, c] + mig(step)))
            total = meet(total, (-variation, variation))
            inside = widen(hull((0.0, 0.0), total), up(0.5 * max(0.0, variation - mig(total))))
            for k in range(j + 1, n + 1):
                inside = down(inside[0] + net[k, c, 0]), up(inside[1] + net[k, c, 1])
            out[c] = inside
        return out

    # ---------------------------------------------------------------- poses out

    @property
    def guarantee(self) -> Guarantee:
        """Intact until measurements contradicted their bounds."""
        return self._contradictions.guarantee

    @property
    def horizon_ns(self) -> int | None:
        """Poses can be given for stretches of time that end by here."""
        if not self._yaw_zeroed:
            return None
        places, turns = self._position, self._attitude
        return int(min(places.times[places.newest, 0], turns.times[turns.newest, 0]))

    @property
    def oldest_ns(self) -> int | None:
        """... and that begin no earlier than here."""
        if not self._yaw_zeroed:
            return None
        places, turns = self._position, self._attitude
        return int(max(places.times[places.begin, 1], turns.times[turns.begin, 1]))

    def poses_over(
        self,
        earliest_ns: NDArray[np.int64],
        latest_ns: NDArray[np.int64],
        low: NDArray[np.float64],
        high: NDArray[np.float64],
    ) -> bool:
        """Boxes [m, 6] that hold the true pose at every instant of the m stretches [earliest_ns, latest_ns].

        False, the row NaN and counted, where a stretch is not inside [oldest_ns, horizon_ns].
        """
        if not self._yaw_zeroed:
            low[:] = nan
            high[:] = nan
            missing = len(earliest_ns)
        else:
            p, t = self._position, self._attitude
            missing = poses_between(
                p.times, p.box, p.swing, p.begin, p.end, t.times, t.box, t.swing, t.begin, t.end,
                earliest_ns, latest_ns, low, high,
            )  # fmt: skip
        if missing:
            self.counts["poses_refused"] += missing
        return missing == 0

    def pose_over(self, earliest_ns: int, latest_ns: int) -> BoundedPose | None:
        """The pose during one stretch of time; None outside of [oldest_ns, horizon_ns]."""
        low, high = np.empty((1, 6)), np.empty((1, 6))
        times = np.array([[earliest_ns], [latest_ns]], dtype=np.int64)
        if not self.poses_over(times[0], times[1], low, high):
            return None
        return BoundedPose(earliest_ns, latest_ns, low[0], high[0], self.guarantee)

    def latest(self) -> BoundedPose | None:
        """The newest pose there is, at the horizon."""
        now = self.horizon_ns
        return None if now is None or now < (self.oldest_ns or 0) else self.pose_over(now, now)

    @property
    def anchor(self) -> Anchor | None:
        """Where the map frame stands on Earth; None before the first fix."""
        if self._plane is None or self._anchor[0, 1] >= ANYWHERE_M:
            return None
        plane = self._plane
        low, high = self._anchor[:, 0].copy(), self._anchor[:, 1].copy()
        return Anchor(plane.lat_deg, plane.lon_deg, plane.alt_m, low, high, self.guarantee)


def _surely_not_after(sample: InertialSample, packet: _Packet, backward: bool) -> bool:
    """Was the gyro packet surely not after the reading (backward: the reading surely not after the packet)?"""
    if sample.epoch == packet.epoch and sample.device_time_us is not None and packet.device_us is not None:
        resolution = packet.resolution_us + CLOCK_STEP_US.get(sample.message, MILLISECOND_US)
        between = sample.device_time_us - packet.device_us
        return -between >= resolution if backward else between >= resolution
    if backward:
        return sample.stamp.latest_ns <= packet.stamp.earliest_ns
    return packet.stamp.latest_ns <= sample.stamp.earliest_ns


def radians_of(effort: NDArray[np.int64]) -> NDArray[np.float64]:
    """Summed variations in rad; exact."""
    return np.asarray(effort * QUANTUM, dtype=np.float64)


def _down(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Elementwise `down`."""
    return np.nextafter(x, -np.inf)


def _up(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Elementwise `up`."""
    return np.nextafter(x, np.inf)
