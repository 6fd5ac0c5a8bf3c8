"""One pose set: the two chains of nodes and what corrects them, on the word of some of the sensors.

Two chains, each on its own unknown-but-bounded time base, so that the uncertainty of a stamp never adds up:

    attitude   a node per gyro packet       (roll, pitch, yaw), and the gyro's bias box
    position   a node per encoder reading   (x, y, z), the attitude taken from the other chain's tube

    predict    gyro packet: rotate -> turn                     encoder reading: travel
    correct    tilt, accelerometers -> the newest attitude;    standstill -> bias;    GPS -> position and anchor

Map frame: gravity aligned, x = y = z = yaw = 0 at the true time of the first encoder reading (of the first one that
the attitude chain reaches). Beside it the same pose is kept on Earth (ENU at the first fix). Times are host monotonic
ns and come with the samples.
"""

from collections import Counter, deque
from copy import deepcopy
from dataclasses import replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from drivers.config import EncodersConfig, GpsConfig, ImuConfig
from drivers.samples import ABSENT3, Fix, InertialSample, Stamp, WheelTicks
from estimator.anchoring import Anchoring
from estimator.attitude import EARTH_YAW, MAP_YAW, AttitudeChain
from estimator.bounded_pose import Anchor, PlanarEllipsoid
from estimator.config import FilterConfig, RobotConfig, SetName
from estimator.ellipsoidal_position import EllipsoidalPosition
from estimator.gyro_silence import GyroSilence
from estimator.inconsistency import Journal
from estimator.position import EARTH, MAP, NO_EPOCH, PositionChain
from estimator.relaxed_anchoring import RelaxedAnchoring
from estimator.speed_change import SpeedChange
from estimator.standstill import Standstill
from estimator.track_yaw import TrackYaw
from estimator.tube import poses_between

PENDING = 4096
"""Samples that may wait for the chain they depend on; the oldest are dropped."""
COUNTS_SILENT_NS = 3_000_000_000
"""Without counts for so long, a set goes on without them;"""
UNTOLD_STEP_NS = 50_000_000
"""... in steps of no less than this."""
HELD_UP_NS = 1_000_000_000
"""So late may packets come that come later than declared; the board's clock then says how far apart they were."""

POSITION_CHAINS: dict[SetName, type[PositionChain]] = {"box": PositionChain, "ellipsoid": EllipsoidalPosition}
"""The sets a pose can be kept as."""


class PoseSet:
    """Every pose that the sensors allow, but for those on whose word nothing is taken (`ignored`)."""

    def __init__(
        self,
        robot: RobotConfig,
        config: FilterConfig,
        encoders: EncodersConfig,
        imu: ImuConfig,
        gps: GpsConfig | None,
        counts: Counter[str],
    ) -> None:
        self.journal = Journal(counts)
        self.ignored: frozenset[str] = frozenset()
        """Sensors that count as missing."""
        self.began: Stamp | None = None
        """Of the reading at which the map frame began."""
        self._begins_at: Stamp | None = None
        """The frame is another set's, which began at this reading: whatever is known of the attitude then."""
        self._attitude = AttitudeChain(robot, config, imu, self.journal)
        self._position = POSITION_CHAINS[config.set](robot, config, encoders, self._attitude, self.journal)
        self._track_yaw = TrackYaw(robot.turning_gauge_m, self._position.tracks, self._attitude, self.journal)
        self._speed_change = SpeedChange(robot.turning_gauge_m, self._position.tracks, self._attitude, self.journal)
        self._standstill = Standstill(config, self._attitude, self._position)
        anchoring = RelaxedAnchoring if config.wrong_fixes else Anchoring
        self._anchoring = anchoring(gps, self._attitude, self._position, self.journal)
        self._silence = GyroSilence()
        self._tilts: deque[InertialSample] = deque(maxlen=PENDING)
        self._ticks: deque[WheelTicks] = deque(maxlen=PENDING)
        self._fixes: deque[Fix] = deque(maxlen=PENDING)
        self._uncounted = 0
        self._stand_in: PoseSet | None = None
        """While no counts come: a copy that goes on without, until they do, and tell of all the way since."""

    def copy(
        self, counts: Counter[str], ignored: frozenset[str] | None = None, begins_at: Stamp | None = None
    ) -> "PoseSet":
        """The same set with a life of its own; `ignored`: without the word of other sensors from here on.

        begins_at: the reading at which the map frame began that the poses shall be in; None: where they can be known.
        """
        new = deepcopy(self)
        new._begins_at = begins_at
        new.journal.counts = counts
        new.journal.contradiction = None
        if ignored is not None:
            new.ignored = ignored
            new._stand_in = None  # the next one will ignore them too
            if "gps" in ignored:
                new._fixes.clear()
            if ignored & {"tilt", "accelerometer", "imu_clock"}:
                new._tilts.clear()
            if "encoders" in ignored:
                new._ticks = deque((new._untold(ticks) for ticks in new._ticks), PENDING)
        return new

    def believe_all(self, counts: Counter[str]) -> None:
        """From here on again on the word of all sensors, and the one pose set whose events are counted."""
        self.ignored, self._begins_at, self._stand_in, self.journal.counts = frozenset(), None, None, counts

    # ---------------------------------------------------------------- samples in

    def accept(self, sample: WheelTicks | InertialSample | Fix) -> None:
        """Take one sample. One that comes out of order, or can't be used, is dropped and counted."""
        self._take(sample)
        if isinstance(sample, WheelTicks):
            self._stand_in = None
        elif self._stand_in is not None:
            self._stand_in._go_on_without_counts(sample)
            self.journal.contradiction = self.journal.contradiction or self._stand_in.journal.contradiction
        elif self._since_newest_count_ns(sample.stamp) > COUNTS_SILENT_NS:
            self.journal.counts["encoders_silent"] += 1
            self._stand_in = self.copy(Counter(), begins_at=self._begins_at)
            self._stand_in._go_on_without_counts()

    def _go_on_without_counts(self, sample: InertialSample | Fix | None = None) -> None:
        """As `accept`; nodes of the attitude are steps of the position, of which nothing is told."""
        if sample is not None:
            self._take(sample)
        turns, newest = self._attitude.tube, self._newest_count()
        assert newest is not None, "it stands in for counts"
        first = turns.after(newest.stamp.latest_ns + UNTOLD_STEP_NS)
        for earliest_ns, latest_ns in turns.times[first : turns.end].tolist():
            stamp = Stamp(earliest_ns, latest_ns)
            if self._since_newest_count_ns(stamp) >= UNTOLD_STEP_NS:
                self._take(self._untold(WheelTicks(stamp, 0, 0)))

    def _newest_count(self) -> WheelTicks | None:
        return self._ticks[-1] if self._ticks else self._position.last_ticks

    def _since_newest_count_ns(self, stamp: Stamp) -> int:
        """0 before the first one."""
        newest = self._newest_count()
        return 0 if newest is None else stamp.earliest_ns - newest.stamp.latest_ns

    def _take(self, sample: WheelTicks | InertialSample | Fix) -> None:
        if isinstance(sample, InertialSample):
            self._accept_inertial(sample)
        elif isinstance(sample, WheelTicks):
            if self._silence.step_by_count(sample.stamp):
                self.journal.counts["gyro_silent"] += 1
                self._attitude.predict(self._attitude.untold(sample.stamp))
            self._take_in_order(sample)
        elif not all(map(isfinite, (sample.lat_deg, sample.lon_deg, sample.alt_m, *sample.bound_m))):
            self.journal.counts["fix_unusable"] += 1
        else:
            self._anchoring.begin(sample)
            if "gps" in self.ignored:
                return
            self._queue(self._fixes, sample)
        while self._ticks and self._attitude.tube.reaches(self._ticks[0].stamp.latest_ns) and self._may_travel():
            self._travel(self._ticks.popleft())
        while self._fixes and self._position.tube.reaches(self._fixes[0].stamp.latest_ns):
            self._anchoring.correct(self._fixes.popleft())

    def _accept_inertial(self, sample: InertialSample) -> None:
        """A gyro packet is a step, tilt and accelerometers correct. What is ignored counts as not measured."""
        turns = any_measured(sample.gyro_rps) and self._attitude.packets.heard(sample)
        untold = self._silence.ends(sample.stamp) if turns else self._silence.step_by_board(sample.stamp)
        if untold:
            self.journal.counts["gyro_silent"] += 1
            sample, turns = replace(sample, gyro_rps=ABSENT3, after_loss=True), True
        if self.ignored:
            held_up = "imu_latency" in self.ignored and "imu_clock" not in self.ignored
            sample = replace(
                sample,
                stamp=sample.stamp.shifted(-HELD_UP_NS, 0) if held_up else sample.stamp,
                device_time_us=None if "imu_clock" in self.ignored else sample.device_time_us,
                gyro_rps=ABSENT3 if "gyro" in self.ignored else sample.gyro_rps,
                tilt_rad=ABSENT3[:2] if "tilt" in self.ignored else sample.tilt_rad,
                accel_mps2=ABSENT3 if "accelerometer" in self.ignored else sample.accel_mps2,
            )
        if turns:
            used = self._attitude.packets.end
            self._attitude.predict(sample)
            if untold and self._attitude.packets.end == used:
                self._silence.was_not_used()
        if any_measured(sample.tilt_rad) or any_measured(sample.accel_mps2[:2]):
            self._queue(self._tilts, sample)
        while self._tilts and self._attitude.correct_tilt(self._tilts[0]):
            self._tilts.popleft()

    def _take_in_order(self, ticks: WheelTicks) -> None:
        """Readings go back neither in their middles nor surely. Ignored ones count as those of a restarted counter."""
        newest = self._newest_count()
        if newest is not None and (
            ticks.stamp.mid_ns < newest.stamp.mid_ns or ticks.stamp.latest_ns < newest.stamp.earliest_ns
        ):
            self.journal.counts["encoders_out_of_order"] += 1
            return
        self._queue(self._ticks, self._untold(ticks) if "encoders" in self.ignored else ticks)

    def _untold(self, ticks: WheelTicks) -> WheelTicks:
        """A reading that says only when it was made."""
        self._uncounted += 1
        return replace(ticks, epoch=NO_EPOCH - self._uncounted)

    def _queue(self, queue: "deque[InertialSample] | deque[WheelTicks] | deque[Fix]", sample: object) -> None:
        """Wait in a bounded queue."""
        if len(queue) == queue.maxlen:
            self.journal.counts["dropped_waiting"] += 1
        queue.append(sample)  # type: ignore[arg-type]  # each queue is given its own kind

    def _may_travel(self) -> bool:
        """Once positions have begun, or must, always; they then bear an unknown attitude too."""
        begun = len(self._position.tube) > 0 or (self._begins_at is not None and len(self._attitude.packets) > 1)
        return self._attitude.level or begun

    def _travel(self, ticks: WheelTicks) -> None:
        """The map begins at the first reading; then each is a node further."""
        if self._position.last_ticks is None:
            if self._begins_at not in (None, ticks.stamp) or not self._position.begin(ticks):
                return
            self.began = ticks.stamp
        self._standstill.watch(ticks)
        if self._position.last_ticks is not ticks:
            step = self._position.predict(ticks)
            self._position.stay_in_reach(step.counted)
            self._speed_change.watch(ticks.stamp, step)
            self._track_yaw.watch(ticks.stamp, step)

    # ---------------------------------------------------------------- poses out

    @property
    def gyro_repeats_itself(self) -> bool:
        """Did the gyroscope say the same again and again, last? A standing one may."""
        return self._track_yaw.gyro_repeats_itself

    @property
    def begun(self) -> bool:
        """Is there a map frame?"""
        return self._attitude.zeroed

    @property
    def horizon_ns(self) -> int | None:
        """Poses can be given for stretches of time that end by here."""
        if not self._attitude.zeroed:
            return None
        now = self._stand_in or self
        return min(now._position.tube.newest_ns, now._attitude.tube.newest_ns)

    @property
    def settled_ns(self) -> int | None:
        """Samples to come change no pose that ends before here: they contract the newest nodes alone."""
        if not self.begun:
            return None
        tubes = self._position.tube, self._attitude.tube
        return int(min(tube.times[max(tube.newest - 1, tube.begin), 0] for tube in tubes))

    @property
    def oldest_ns(self) -> int | None:
        """... and that begin no earlier than here."""
        if not self.begun:
            return None
        now = self._stand_in or self
        places, turns = now._position.tube, now._attitude.tube
        return int(max(places.times[places.begin, 1], turns.times[turns.begin, 1]))

    def poses_over(
        self,
        earliest_ns: NDArray[np.int64],
        latest_ns: NDArray[np.int64],
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        on_earth: bool = False,
    ) -> int:
        """Boxes [m, 6] over m stretches of time; how many of them are not inside [oldest_ns, horizon_ns] (NaN)."""
        now = self._stand_in or self
        p, t = now._position.tube, now._attitude.tube
        place, yaw = (EARTH.start, EARTH_YAW) if on_earth else (MAP.start, MAP_YAW)
        return poses_between(
            p.times, p.box, p.swing, p.begin, p.end, t.times, t.box, t.swing, t.begin, t.end,
            earliest_ns, latest_ns, low, high, place, yaw,
        )  # fmt: skip

    def ellipsoid(self, on_earth: bool) -> PlanarEllipsoid | None:
        """(x, y, yaw) at the newest encoder reading as an ellipsoid, where there is one."""
        return (self._stand_in or self)._position.ellipsoid(on_earth)

    @property
    def anchor(self) -> Anchor | None:
        """Where the map frame stands on Earth; None before the first fix."""
        return self._anchoring.anchor()

    def join(self, other: "PoseSet") -> None:
        """Grow to the hull of both: two sets that were given the same samples since they were one."""
        self._attitude.join(other._attitude)
        self._position.join(other._position)
        self._anchoring.join(other._anchoring)
        self._standstill.forget_place()
        self._stand_in = None


def any_measured(axes: tuple[float, ...]) -> bool:
    """Is any of them a number? What was not measured is NaN."""
    for value in axes:  # noqa: SIM110  a generator takes twice as long
        if value == value:
            return True
    return False
