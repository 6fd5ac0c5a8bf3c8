"""The set-membership pose filter: samples in, a box that surely holds the pose out, and what it does when that fails.

While no measurement contradicts the others there is one pose set, on the word of all sensors (estimator/pose_set.py).
Checkpoints of it, and the samples since, are kept for a while. A contradiction proves that a bound is broken. Then
each sensor that may have broken it is tried as its only explanation: the checkpoint is driven again without that
sensor. Hypotheses that contradict themselves are cleared; the rest go on side by side, the pose is the hull of all,
and after `fault_length_s` the sensor is believed again. What that guarantees stands in docs/faults.md.
"""

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import replace
from math import nan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.config import EncodersConfig, GpsConfig, ImuConfig
from drivers.samples import Fix, InertialSample, Stamp, WheelTicks
from estimator.bounded_pose import INTACT, Anchor, BoundedPose, Guarantee, PlanarEllipsoid, Status
from estimator.config import FilterConfig, RobotConfig
from estimator.inconsistency import SENSORS, SUSPECTS, Fault
from estimator.pose_set import PoseSet

Reading: TypeAlias = WheelTicks | InertialSample | Fix
EVERY_SENSOR = frozenset(SENSORS)
MOST_FAULTS = 256
"""So many of the newest faults are remembered."""


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
        self.faults: deque[Fault] = deque(maxlen=MOST_FAULTS)
        """The newest last."""
        self.guarantee: Guarantee = INTACT
        """Intact until measurements contradict their bounds; then void since the first fault may have begun."""
        self._start_ns = round(config.fault_start_s * 1e9)
        self._length_ns = round(config.fault_length_s * 1e9)
        self._hypotheses = [PoseSet(robot, config, encoders, imu, gps, self.counts)]
        self._until_ns: int | None = None
        """While a fault lasts: when its sensor is believed again."""
        self._now_ns = 0
        self._older = self._newer = self._hypotheses[0].copy(Counter())
        self._newer_ns: int | None = None
        self._before_newer: list[Reading] = []
        self._since_newer: list[Reading] = []
        self._frame: Stamp | None = None
        """At which reading the map frame began; known once a fault has been found, and it began."""

    # ---------------------------------------------------------------- samples in

    def accept(self, sample: Reading) -> None:
        """Take one sample. One that comes out of order, or can't be used, is dropped and counted."""
        self._now_ns = max(self._now_ns, sample.stamp.mid_ns)
        self._since_newer.append(sample)
        contradicted: list[PoseSet] = []
        for poses in self._hypotheses:
            poses.accept(sample)
            if poses.journal.contradiction is not None:
                contradicted.append(poses)
        if contradicted:
            self._explain(contradicted)
        elif self._until_ns is not None and self._now_ns >= self._until_ns:
            self._believe_again()
        if self._frame is None and len(self._hypotheses) > 1:
            self._share_frame()
        if self._until_ns is None and (self._newer_ns is None or self._now_ns - self._newer_ns >= self._start_ns):
            self._checkpoint()

    def _checkpoint(self) -> None:
        """The newest pose set becomes one to come back to; the older of the two that are kept goes."""
        self._older, self._newer = self._newer, self._hypotheses[0].copy(Counter())
        self._before_newer, self._since_newer = self._since_newer, []
        self._newer_ns = self._now_ns

    # ---------------------------------------------------------------- faults

    def _explain(self, contradicted: list[PoseSet]) -> None:
        """Clear the hypotheses that contradict themselves; where none is left, try every sensor as the one to blame."""
        found = contradicted[0].journal.contradiction
        assert found is not None
        left = [poses for poses in self._hypotheses if poses not in contradicted]
        first = self._until_ns is None
        self._frame = self._frame or contradicted[0].began
        since_ns = min(self._older.settled_ns or 0, found.time_ns)
        if not left and first:
            left = self._without_each(SUSPECTS[found.sensor])
        if not left:
            left = [self._driven_again(EVERY_SENSOR)]
        self._hypotheses = left
        left[0].journal.counts = self.counts
        suspects = tuple(sensor for poses in left for sensor in poses.ignored if poses.ignored != EVERY_SENSOR)
        if first:
            self.counts["faults"] += 1
        else:
            found, since_ns = self.faults[-1].contradiction, self.faults[-1].void_since_ns
            self.faults.pop()
        stuck = any(poses.gyro_repeats_itself for poses in contradicted)
        self.faults.append(Fault(found, likeliest(found.sensor, suspects, stuck), suspects, since_ns))
        if first or not suspects:
            self._until_ns = self._now_ns + self._length_ns
        self._void(self.faults[-1])

    def _void(self, fault: Fault) -> None:
        """The guarantee is void since the first fault may have begun, in the name of whom that turns out to be."""
        status = Status.DEGRADED if fault.suspects else Status.LOST
        if self.counts["faults"] == 1:
            found = fault.contradiction
            self.guarantee = Guarantee(
                fault.void_since_ns, fault.sensor, found.excess, found.unit, status, contradicted_ns=found.time_ns
            )
        else:
            self.guarantee = replace(self.guarantee, status=status, restored_ns=None)

    def _share_frame(self) -> None:
        """A fault came before the map did: then it begins for all hypotheses where it first does for one."""
        self._frame = next((poses.began for poses in self._hypotheses if poses.began is not None), None)
        if self._frame is not None:
            self._hypotheses = [
                poses if poses.began == self._frame else self._driven_again(poses.ignored)
                for poses in self._hypotheses
            ]  # fmt: skip
            self._hypotheses[0].journal.counts = self.counts

    def _without_each(self, sensors: Iterable[str]) -> list[PoseSet]:
        """The pose sets that one sensor less makes consistent."""
        driven = [self._driven_again(frozenset({sensor})) for sensor in sensors]
        return [poses for poses in driven if poses.journal.contradiction is None]

    def _driven_again(self, ignored: frozenset[str]) -> PoseSet:
        """From the older checkpoint to now without the word of some sensors, or to the first contradiction.

        Poses stay in the frame that the map began in, where that came after the checkpoint, even if its sensors alone
        would not have told enough to begin one there.
        """
        poses = self._driven(self._older.copy(Counter(), ignored))
        if self._frame not in (None, poses.began) and poses.journal.contradiction is None:
            poses = self._driven(self._older.copy(Counter(), ignored, self._frame))
        return poses

    def _driven(self, poses: PoseSet) -> PoseSet:
        """A copy of the older checkpoint, given all samples since, or those up to the first contradiction."""
        for samples in (self._before_newer, self._since_newer):
            for sample in samples:
                poses.accept(sample)
                if poses.journal.contradiction is not None:
                    return poses
        return poses

    def _believe_again(self) -> None:
        """The fault is taken to be over: one pose set again, on the word of all sensors."""
        # Where not all know of a map frame no pose was given, and those that know of none begin it.
        poses, *others = sorted(self._hypotheses, key=lambda one: one.begun)
        for other in others:
            poses.join(other)
        poses.believe_all(self.counts)
        self._hypotheses = [poses]
        self._until_ns = None
        self.guarantee = replace(self.guarantee, status=Status.NOMINAL, restored_ns=self._now_ns)
        self.faults.append(self.faults.pop()._replace(restored_ns=self._now_ns))
        self._checkpoint()
        self._older, self._before_newer = self._newer, []

    # ---------------------------------------------------------------- poses out

    @property
    def horizon_ns(self) -> int | None:
        """Poses can be given for stretches of time that end by here."""
        if len(self._hypotheses) == 1:
            return self._hypotheses[0].horizon_ns
        ends = [poses.horizon_ns for poses in self._hypotheses]
        return min((end for end in ends if end is not None), default=None) if None not in ends else None

    @property
    def oldest_ns(self) -> int | None:
        """... and that begin no earlier than here."""
        begins = [poses.oldest_ns for poses in self._hypotheses]
        return max((begin for begin in begins if begin is not None), default=None) if None not in begins else None

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
        missing = self._poses_over(earliest_ns, latest_ns, low, high, on_earth=False)
        if missing:
            self.counts["poses_refused"] += missing
        return missing == 0

    def _poses_over(
        self,
        earliest_ns: NDArray[np.int64],
        latest_ns: NDArray[np.int64],
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        on_earth: bool,
    ) -> int:
        """The hull of all hypotheses; how many rows are NaN."""
        if not all(poses.begun for poses in self._hypotheses):
            low[:] = nan
            high[:] = nan
            return len(earliest_ns)
        missing = self._hypotheses[0].poses_over(earliest_ns, latest_ns, low, high, on_earth)
        for poses in self._hypotheses[1:]:
            least, most = np.empty_like(low), np.empty_like(high)
            missing = max(missing, poses.poses_over(earliest_ns, latest_ns, least, most, on_earth))
            np.minimum(low, least, out=low)
            np.maximum(high, most, out=high)
        return missing

    def pose_over(self, earliest_ns: int, latest_ns: int) -> BoundedPose | None:
        """The pose during one stretch of time; None outside of [oldest_ns, horizon_ns]."""
        return self._pose_over(earliest_ns, latest_ns, on_earth=False)

    def pose_on_earth(self, earliest_ns: int, latest_ns: int) -> BoundedPose | None:
        """The pose during one stretch of time in the anchor's ENU frame; None before a fix, as `pose_over` besides."""
        return None if self.anchor is None else self._pose_over(earliest_ns, latest_ns, on_earth=True)

    def _pose_over(self, earliest_ns: int, latest_ns: int, on_earth: bool) -> BoundedPose | None:
        low, high = np.empty((1, 6)), np.empty((1, 6))
        times = np.array([[earliest_ns], [latest_ns]], dtype=np.int64)
        missing = self._poses_over(times[0], times[1], low, high, on_earth)
        if missing:
            self.counts["poses_refused"] += 1
            return None
        return BoundedPose(earliest_ns, latest_ns, low[0], high[0], self.guarantee)

    def latest(self) -> BoundedPose | None:
        """The newest pose there is, at the horizon."""
        now = self.horizon_ns
        pose = None if now is None or now < (self.oldest_ns or 0) else self.pose_over(now, now)
        return None if pose is None else replace(pose, ellipsoid=self.ellipsoid())

    def ellipsoid(self, on_earth: bool = False) -> PlanarEllipsoid | None:
        """(x, y, yaw) at the newest encoder reading, with `[filter] set = "ellipsoid"`; None while a fault lasts."""
        return None if len(self._hypotheses) > 1 else self._hypotheses[0].ellipsoid(on_earth)

    @property
    def anchor(self) -> Anchor | None:
        """Where the map frame stands on Earth; None before the first fix."""
        anchors = [poses.anchor for poses in self._hypotheses]
        known = [anchor for anchor in anchors if anchor is not None]
        if not known or len(known) < len(anchors):
            return None
        low = np.min([anchor.low for anchor in known], axis=0)
        high = np.max([anchor.high for anchor in known], axis=0)
        return replace(known[0], low=low, high=high, guarantee=self.guarantee)


def likeliest(reported: str, suspects: tuple[str, ...], stuck_gyro: bool = False) -> str:
    """Whom to name: a gyroscope that says the same again and again; else who was found, but for GPS.

    Wheels slip oftener than a receiver drifts; so GPS is named only where nothing else explains it.
    """
    if stuck_gyro and "gyro" in suspects:
        return "gyro"
    if reported in suspects and reported != "gps":
        return reported
    for sensor in ("encoders", "gyro", "tilt", "accelerometer", "imu_clock", "imu_latency", "gps"):
        if sensor in suspects:
            return sensor
    return reported
