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
from math import isfinite, isnan, nan

import numpy as np
from numpy.typing import NDArray

from drivers.config import EncodersConfig, GpsConfig, ImuConfig
from drivers.samples import Fix, InertialSample, WheelTicks
from estimator.anchoring import Anchoring
from estimator.attitude import EARTH_YAW, AttitudeChain
from estimator.bounded_pose import Anchor, BoundedPose, Guarantee
from estimator.config import FilterConfig, RobotConfig
from estimator.ellipsoidal_position import EllipsoidalPosition
from estimator.inconsistency import Contradictions
from estimator.position import EARTH, PositionChain
from estimator.standstill import Standstill
from estimator.tube import poses_between

PENDING = 4096
"""Samples that may wait for the chain they depend on; the oldest are dropped."""


POSITION_CHAINS: dict[str, type[PositionChain]] = {"box": PositionChain, "ellipsoid": EllipsoidalPosition}
"""The sets a pose can be kept as."""


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
        self.counts: Counter[str] = Counter()
        self._contradictions = Contradictions(self.counts)
        self._attitude = AttitudeChain(robot, config, imu, self.counts, self._contradictions)
        chain = POSITION_CHAINS[config.set]
        self._position = chain(robot, config, encoders, self._attitude, self.counts, self._contradictions)
        self._standstill = Standstill(config.standstill_s, self._attitude)
        self._anchoring = Anchoring(gps, self._attitude, self._position, self.counts, self._contradictions)
        self._tilts: deque[InertialSample] = deque(maxlen=PENDING)
        self._ticks: deque[WheelTicks] = deque(maxlen=PENDING)
        self._fixes: deque[Fix] = deque(maxlen=PENDING)

    # ---------------------------------------------------------------- samples in

    def accept(self, sample: WheelTicks | InertialSample | Fix) -> None:
        """Take one sample. One that comes out of order, or can't be used, is dropped and counted."""
        if isinstance(sample, InertialSample):
            if not all(map(isnan, sample.gyro_rps)):
                self._attitude.predict(sample)
            if not (all(map(isnan, sample.tilt_rad)) and all(map(isnan, sample.accel_mps2[:2]))):
                self._queue(self._tilts, sample)
            while self._tilts and self._attitude.correct_tilt(self._tilts[0]):
                self._tilts.popleft()
        elif isinstance(sample, WheelTicks):
            self._take_in_order(sample)
        elif all(map(isfinite, (sample.lat_deg, sample.lon_deg, sample.alt_m, *sample.bound_m))):
            self._queue(self._fixes, sample)
        else:
            self.counts["fix_unusable"] += 1
        while self._ticks and self._attitude.tube.reaches(self._ticks[0].stamp.latest_ns) and self._may_travel():
            self._travel(self._ticks.popleft())
        while self._fixes and self._position.tube.reaches(self._fixes[0].stamp.latest_ns):
            self._anchoring.correct(self._fixes.popleft())

    def _take_in_order(self, ticks: WheelTicks) -> None:
        """Readings go back neither in their middles nor surely."""
        newest = self._ticks[-1] if self._ticks else self._position.last_ticks
        if newest is not None and (
            ticks.stamp.mid_ns < newest.stamp.mid_ns or ticks.stamp.latest_ns < newest.stamp.earliest_ns
        ):
            self.counts["encoders_out_of_order"] += 1
        else:
            self._queue(self._ticks, ticks)

    def _queue(self, queue: "deque[InertialSample] | deque[WheelTicks] | deque[Fix]", sample: object) -> None:
        """Wait in a bounded queue."""
        if len(queue) == queue.maxlen:
            self.counts["dropped_waiting"] += 1
        queue.append(sample)  # type: ignore[arg-type]  # each queue is given its own kind

    def _may_travel(self) -> bool:
        """Once positions have begun, always; they then bear an unknown attitude too."""
        return self._attitude.level or len(self._position.tube) > 0

    def _travel(self, ticks: WheelTicks) -> None:
        """The map begins at the first reading; then each is a node further."""
        if self._position.last_ticks is None and not self._position.begin(ticks):
            return
        self._standstill.watch(ticks)
        if self._position.last_ticks is not ticks:
            self._position.predict(ticks)

    # ---------------------------------------------------------------- poses out

    @property
    def guarantee(self) -> Guarantee:
        """Intact until measurements contradicted their bounds."""
        return self._contradictions.guarantee

    @property
    def horizon_ns(self) -> int | None:
        """Poses can be given for stretches of time that end by here."""
        if not self._attitude.zeroed:
            return None
        places, turns = self._position.tube, self._attitude.tube
        return int(min(places.times[places.newest, 0], turns.times[turns.newest, 0]))

    @property
    def oldest_ns(self) -> int | None:
        """... and that begin no earlier than here."""
        if not self._attitude.zeroed:
            return None
        places, turns = self._position.tube, self._attitude.tube
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
        if not self._attitude.zeroed:
            low[:] = nan
            high[:] = nan
            missing = len(earliest_ns)
        else:
            p, t = self._position.tube, self._attitude.tube
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

    def pose_on_earth(self, earliest_ns: int, latest_ns: int) -> BoundedPose | None:
        """The pose during one stretch of time in the anchor's ENU frame; None before a fix, as `pose_over` besides."""
        if self.anchor is None:
            return None
        low, high = np.empty((1, 6)), np.empty((1, 6))
        times = np.array([[earliest_ns], [latest_ns]], dtype=np.int64)
        p, t = self._position.tube, self._attitude.tube
        if poses_between(
            p.times, p.box, p.swing, p.begin, p.end, t.times, t.box, t.swing, t.begin, t.end,
            times[0], times[1], low, high, EARTH.start, EARTH_YAW,
        ):  # fmt: skip
            return None
        return BoundedPose(earliest_ns, latest_ns, low[0], high[0], self.guarantee)

    def latest(self) -> BoundedPose | None:
        """The newest pose there is, at the horizon."""
        now = self.horizon_ns
        return None if now is None or now < (self.oldest_ns or 0) else self.pose_over(now, now)

    @property
    def anchor(self) -> Anchor | None:
        """Where the map frame stands on Earth; None before the first fix."""
        return self._anchoring.anchor()
