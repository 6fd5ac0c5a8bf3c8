"""The attitude chain: a box of the angles at the true time of each gyro packet, and the gyro's bias box.

Yaw is kept twice, counted from the map's x axis and from east (rows MAP_YAW and EARTH_YAW): the anchor's yaw ties them.
"""

from math import cos, isnan, radians

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from drivers.config import ImuConfig
from drivers.samples import InertialSample, Stamp, Vector3
from estimator.config import FilterConfig, RobotConfig
from estimator.gyro_packets import BEGAN_NS, EARLIEST_NS, LATEST_NS, REMEMBERED, GyroPackets, board_clock
from estimator.gyro_step import CONTRADICTS, DONE, LOST_YAW, MUST_WAIT, TOO_EARLY, gyro_step, tilt_step
from estimator.inconsistency import Journal, least_excess
from estimator.interval import Interval, add, down, is_empty, mag, meet, up, widen
from estimator.motion import (
    QUANTUM,
    STEEPEST,
    UNKNOWN_TILT,
    UNKNOWN_YAW,
    GyroBounds,
    aged_bias,
    excursion,
    relative_yaw,
    relative_yaw_between,
)
from estimator.tube import Tube

MAP_YAW, EARTH_YAW = 2, 3
LONGEST_BRIDGE_NS = 50_000_000
"""The first encoder reading may come this long before the first gyro packet; else a later one begins the map."""


class AttitudeChain:
    """Predicted by the gyroscope, corrected by tilt sensor and accelerometers; yaw is zero where the map begins."""

    def __init__(
        self,
        robot: RobotConfig,
        config: FilterConfig,
        imu: ImuConfig,
        journal: Journal,
    ) -> None:
        self.gyro = GyroBounds(
            noise=up(radians(imu.gyro_noise_bound_dps)),
            scale=imu.gyro_scale_bound,
            most_rate=up(radians(robot.max_turn_rate_dps)),
            most_acceleration=up(radians(robot.max_turn_acceleration_dps2)),
            most_bias=up(radians(imu.gyro_bias_bound_dps)),
            bias_drift=up(radians(imu.gyro_bias_drift_dps2)),
            most_tilt_rate=up(radians(robot.max_tilt_rate_dps or robot.max_turn_rate_dps)),
        )
        self._tilt_bound = up(radians(imu.tilt_bound_deg))
        self._accel_bound = up(imu.accel_bound_mps2 + robot.max_acceleration_mps2)
        self._still_rate = up(radians(config.standstill_rate_dps or 0.0))
        self._journal = journal
        self._room = np.empty(8)
        """For what comes between the operations of a step."""
        self.tube = Tube(int(config.history_s * 1e9), coordinates=4)
        self.packets = GyroPackets(imu.clock_drift_ppm, journal)
        self.bias = np.array([[-self.gyro.most_bias, self.gyro.most_bias]] * 3)
        self.level = False
        """Is the newest attitude a verified box?"""
        self.zeroed = False
        """Has the map begun?"""

    # ---------------------------------------------------------------- predict

    def predict(self, sample: InertialSample) -> None:
        """rotate -> turn: one node further, at the true time of this gyro packet."""
        packets, tube, stamp, was_level = self.packets, self.tube, sample.stamp, self.level
        if not len(packets):
            self._begin(sample)
            return
        i = tube.room(stamp.earliest_ns)
        device_us, resolution_us = board_clock(sample)
        newer, sound, self.level, lost, clock_off_s = gyro_step(
            i, tube.begin, stamp.earliest_ns, stamp.latest_ns, sample.epoch, device_us, resolution_us, sample.gyro_rps,
            packets.end - 1, packets.numbers, packets.rates, packets.learnt, packets.drift, sample.after_loss,
            was_level, tuple(self.gyro), self.bias, tube.times, tube.box, tube.swing, tube.net, tube.heading,
            tube.effort, self._room,
        )  # fmt: skip
        if clock_off_s > 0.0:
            self._journal.report("imu_clock", stamp.mid_ns, clock_off_s, "s")
        if not newer:
            self._journal.counts["gyro_out_of_order"] += 1
            return
        tube.end = i + 1
        packets.appended()
        if lost:
            self._journal.counts["gyro_gaps"] += 1
        if not sound:
            self._journal.report("gyro", stamp.mid_ns, self._too_fast(sample.gyro_rps), "rad/s")
        if was_level and not self.level:
            self._journal.counts["attitude_lost"] += 1

    def untold(self, stamp: Stamp) -> InertialSample:
        """A packet that says only when it was made."""
        return InertialSample(stamp, "", 0, None, epoch=self.packets.newest_epoch, after_loss=True)

    def _too_fast(self, rate: Vector3) -> float:
        """By how much a packet's rate is beyond the declared one, bias left out."""
        most = self.gyro.most_rate * (1.0 + self.gyro.scale) + self.gyro.most_bias + self.gyro.noise
        return max(0.0, float(np.nanmax(np.abs(rate))) - most)

    def _begin(self, sample: InertialSample) -> None:
        """The first node, of which nothing is known yet."""
        i = self.tube.push(sample.stamp.earliest_ns, sample.stamp.latest_ns)
        self.tube.effort[i] = 1
        self.tube.box[i, :2] = -UNKNOWN_TILT, UNKNOWN_TILT
        self.tube.box[i, 2:] = -UNKNOWN_YAW, UNKNOWN_YAW
        self.packets.begin_with(sample)

    def bias_since(self, node: int) -> Interval:
        """Bias of ω_z at any time from a node on."""
        times, bias = self.tube.times, (self.bias[2, 0], self.bias[2, 1])
        return aged_bias(bias, self.gyro.bias_drift, times[node, 0], times[self.tube.newest, 1])

    def yaw_between(self, first: int, last: int, to: int | None = None) -> Interval:
        """Yaw at all that lies between two nodes less yaw at node `to`, not before them (default: at the first)."""
        tube, bias = self.tube, self.bias_since(first)
        start = tube.heading[first if to is None else to]
        return relative_yaw_between(tube.heading, tube.swing, first, last, start, bias)

    # ---------------------------------------------------------------- correct

    def correct_tilt(self, sample: InertialSample) -> bool:
        """Contract roll and pitch of the newest node by a reading of its time or a little before; False: it must wait.

        Between the reading and the node the angles move no further than the variation of the rates allows.
        """
        i = self.tube.newest
        outcome = self._contract(self.tube.box[i], sample, 0.0, 0.0)
        if outcome == MUST_WAIT:
            return False
        if outcome == DONE:
            if not self.level:
                self.level = True
                if not self.zeroed:
                    self._look_back(i)
        elif outcome == CONTRADICTS:
            self._report_tilt(sample)
        elif outcome == TOO_EARLY:
            self._journal.counts["tilt_too_early"] += 1
        return True

    def _contract(self, box: NDArray[np.float64], sample: InertialSample, tilt_wider: float, accel_wider: float) -> int:
        """Roll and pitch of box [c, 2], by a reading whose bounds are as much wider; what tilt_step says."""
        packets, stamp, (ahead, left, _) = self.packets, sample.stamp, sample.accel_mps2
        device_us, resolution_us = board_clock(sample)
        return tilt_step(
            box, self.level, sample.tilt_rad, self._tilt_bound + tilt_wider, ahead, left,
            self._accel_bound + accel_wider, stamp.earliest_ns, stamp.latest_ns, sample.epoch, device_us, resolution_us,
            packets.numbers, packets.begin, packets.end, packets.drift, self.gyro.most_rate,
            min(self.gyro.most_rate, self.gyro.most_tilt_rate), self._room,
        )  # fmt: skip

    def _report_tilt(self, sample: InertialSample) -> None:
        """By how much the reading is off."""
        by_tilt, box = not all(map(isnan, sample.tilt_rad)), self.tube.box[self.tube.newest]

        def agrees(wider: float) -> bool:
            bounds = (wider, 0.0) if by_tilt else (0.0, wider)
            return self._contract(box.copy(), sample, *bounds) != CONTRADICTS

        sensor, unit = ("tilt", "rad") if by_tilt else ("accelerometer", "m/s^2")
        self._journal.report(sensor, sample.stamp.mid_ns, least_excess(agrees, 1e-3), unit)

    def _look_back(self, newest: int) -> None:
        """The tilt is known for the first time: what it, and a yaw of zero here, say of the nodes before."""
        tube = self.tube
        box = tube.box[newest]
        box[2] = 0.0, 0.0
        moved = np.empty(3)
        for i in range(newest - 1, tube.begin - 1, -1):
            varied = radians_of(tube.effort[newest] - tube.effort[i])
            if not excursion((box[0, 0], box[0, 1]), (box[1, 0], box[1, 1]), varied, moved):
                tube.begin = i + 1
                break
            for c in range(4):
                tube.box[i, c] = widen((box[c, 0], box[c, 1]), moved[min(c, 2)])
            tube.swing[i + 1] = 0.0  # node i's box holds all that comes between it and the newest

    def narrow_yaw(self, first: int, last: int, node: int, change: Interval, time_ns: int) -> None:
        """Yaw at `node` is yaw at some instant between nodes `first` and `last`, and [change]. So all later ones, too.

        Not where yaw is so little known that another turn than the one before may have been taken for it meanwhile.
        """
        tube, bias, before = self.tube, self.bias_since(node), self.tube.hull(first, last)
        if tube.heading[node, 2] - tube.heading[first, 2] >= LOST_YAW:
            return
        for row in (MAP_YAW, EARTH_YAW):
            if before[row, 1] - before[row, 0] > UNKNOWN_YAW:
                continue
            yaw = meet((tube.box[node, row, 0], tube.box[node, row, 1]), add((before[row, 0], before[row, 1]), change))
            if is_empty(yaw):
                self._journal.report("gyro", time_ns, yaw[0] - yaw[1], "rad")
                return
            for i in range(node, tube.end):
                later = add(yaw, relative_yaw(tube.heading[i], tube.heading[node], bias))
                later = meet((tube.box[i, row, 0], tube.box[i, row, 1]), later)
                if not is_empty(later):
                    tube.box[i, row] = later

    def hold_yaw(self, begin_ns: int, end_ns: int) -> None:
        """The robot stood still from begin to end: yaw changed by no more than a standing robot's rate allows.

        |ψ'| = |sin φ ω_y + cos φ ω_z| / cos θ, at most √2 times the rate / cos θ.
        """
        tube = self.tube
        first, after, node = tube.before(begin_ns), tube.after(begin_ns), tube.before(end_ns)
        if first < tube.begin or after >= node or not self.level:
            return
        pitch = mag((float(tube.box[node, 1, 0]), float(tube.box[node, 1, 1])))
        seconds = up((int(tube.times[node, 1]) - begin_ns) * 1e-9)
        steepest = up(pitch + up(self._still_rate * 2.0 * seconds))
        if steepest < STEEPEST:
            change = up(1.4143 * up(self._still_rate * seconds) / down(cos(steepest)))
            self.narrow_yaw(first, after, node, (-change, change), end_ns)

    def learn_bias(self, begin_ns: int, end_ns: int, used_until_ns: int) -> None:
        """The robot stood still: what packets of [begin, end] measured since the last call was bias."""
        packets, gyro = self.packets, self.gyro
        off, off_ns = bias_at_rest(
            packets.numbers, packets.rates, packets.begin, packets.end, begin_ns, end_ns, used_until_ns,
            self._still_rate, tuple(gyro), self.bias,
        )  # fmt: skip
        if off_ns:
            self._journal.report("gyro", off_ns, off, "rad/s")

    def join(self, other: "AttitudeChain") -> None:
        """Grow to the hull of both chains, which have the same newest nodes; yaw before is not related to yaw after."""
        k = self.tube.join(other.tube)
        self.bias = np.stack(
            [np.minimum(self.bias[:, 0], other.bias[:, 0]), np.maximum(self.bias[:, 1], other.bias[:, 1])], axis=1
        )
        self.level = self.level and other.level
        self.tube.heading[self.tube.end - k : self.tube.end, 2] += LOST_YAW * np.arange(1, k + 1)
        if len(self.packets):
            self.packets.begin_anew(self.tube.effort[self.tube.newest], other.packets)

    # ---------------------------------------------------------------- the beginning

    def begin_map(self, stamp: Stamp) -> tuple[int, int] | None:
        """Yaw is zero at this stamp: subtract what the yaw (counted from the first known tilt) can be now.

        The nodes before and after the stamp; None if the chain began too late for that.
        """
        tube = self.tube
        oldest = int(tube.times[tube.begin, 1])
        if stamp.earliest_ns < oldest:
            moved = self._journal.counts["encoders_before_attitude"] > 0
            known = 2 <= len(self.packets) == len(tube)  # so that the second packet is the second node
            if moved or oldest - stamp.earliest_ns > LONGEST_BRIDGE_NS or not known:
                self._journal.counts["encoders_before_attitude"] += 1
                return None
            self._bridge(stamp.earliest_ns, oldest)
        a, b = tube.before(stamp.earliest_ns), tube.after(stamp.latest_ns)
        zero = tube.hull(a, b)[2]
        span = slice(tube.begin, tube.end)
        low = np.nextafter(tube.box[span, 2, 0] - zero[1], -np.inf)
        high = np.nextafter(tube.box[span, 2, 1] - zero[0], np.inf)
        tube.box[span, 2] = np.stack([low, high], axis=1)
        self.zeroed = True
        return a, b

    def _bridge(self, time_ns: int, oldest_ns: int) -> None:
        """A node at the first encoder reading, before the gyro's first packet: rates can't have been far from the next.

        The mean rate of the second packet was the true one at some instant between the first and the second.
        """
        tube = self.tube
        packet = self.packets[1]
        gap = up((oldest_ns - time_ns) * 1e-9)
        longest = up((packet.stamp.latest_ns - time_ns) * 1e-9)
        varied = np.empty(3)
        for axis, rate in enumerate(packet.rate):
            most = self.gyro.most_rate
            if not isnan(rate):
                error = self.gyro.noise + self.gyro.most_bias + self.gyro.scale * max(abs(rate), most)
                most = min(most, up(up(abs(rate) + error) + up(self.gyro.most_acceleration * longest)))
            varied[axis] = up(most * gap)
        moved = np.full(3, UNKNOWN_TILT)
        first = tube.begin
        box = tube.box[first].copy()
        close = excursion((box[0, 0], box[0, 1]), (box[1, 0], box[1, 1]), varied, moved)
        effort = np.ceil(varied / QUANTUM).astype(np.int64) + 1
        i = tube.prepend(time_ns)
        tube.effort[i] = tube.effort[first] - effort
        tube.net[first, :, 0], tube.net[first, :, 1] = -varied, varied
        tube.swing[first] = 0.0  # the new node's box holds all that comes between
        tube.heading[i] = tube.heading[first] - (0.0, 0.0, up(moved[2]) if close else LOST_YAW)
        for c in range(4):
            limit = UNKNOWN_TILT if c < 2 else UNKNOWN_YAW
            tube.box[i, c] = widen((box[c, 0], box[c, 1]), moved[min(c, 2)]) if close else (-limit, limit)


@compiled
def bias_at_rest(
    numbers: NDArray[np.int64],
    rates: NDArray[np.float64],
    begin: int,
    end: int,
    begin_ns: int,
    end_ns: int,
    used_until_ns: int,
    still: float,
    bounds: tuple[float, ...],
    bias: NDArray[np.float64],
) -> tuple[float, int]:
    """Contract bias [3, 2] by what packets in [begin_ns, end_ns], after `used_until_ns`, measured of a robot at rest.

    bias = measured ± (still + noise + scale error), some time ago: wider by the drift since then. The scale error is
    that of the reading or of what is read, bias and all. `bounds`: GyroBounds as a plain tuple. By how much the first
    of them contradicts it, and the middle of its stamp; else 0, 0.
    """
    gyro = GyroBounds(*bounds)
    now_ns = numbers[(end - 1) % REMEMBERED, LATEST_NS]
    off, off_ns = 0.0, 0
    for k in range(end - 1, begin - 1, -1):
        packet, rate = numbers[k % REMEMBERED], rates[k % REMEMBERED]
        if packet[BEGAN_NS] < begin_ns or packet[LATEST_NS] <= used_until_ns:
            break
        if packet[LATEST_NS] > end_ns:
            continue
        aged = up(gyro.bias_drift * up((now_ns - packet[BEGAN_NS]) * 1e-9))
        for axis in range(3):
            if isnan(rate[axis]):
                continue
            read = up(up(abs(rate[axis]) + gyro.noise) / down(1.0 - gyro.scale))
            aged_error = up(aged + up(up(still + gyro.noise) + up(gyro.scale * max(read, still))))
            narrowed = meet((bias[axis, 0], bias[axis, 1]), widen((rate[axis], rate[axis]), aged_error))
            if not is_empty(narrowed):
                bias[axis, 0], bias[axis, 1] = narrowed
            elif off_ns == 0:
                off = max(0.0, narrowed[0] - narrowed[1])
                off_ns = packet[EARLIEST_NS] + (packet[LATEST_NS] - packet[EARLIEST_NS]) // 2
    return off, off_ns


def radians_of(effort: NDArray[np.int64]) -> NDArray[np.float64]:
    """Summed variations in rad; exact."""
    return np.asarray(effort * QUANTUM, dtype=np.float64)
