"""A drive's samples as arrays, a sensor each, and the stretches of time in which the robot is declared to stand."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from math import isfinite, isnan

import numpy as np
from numpy.typing import NDArray

from drivers.samples import Fix, InertialSample, Sample, Scan, WheelTicks

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

MOST_SCANS = 1500
"""Scans kept of a standing robot: each a few hundred distances."""


@dataclass(frozen=True, slots=True, eq=False)
class Stamps:
    """When readings were taken: each surely in [earliest, latest]."""

    earliest_ns: Whole
    latest_ns: Whole

    @classmethod
    def of(cls, samples: Iterable[Sample]) -> "Stamps":
        """Of samples in the order they came."""
        pairs = [(sample.stamp.earliest_ns, sample.stamp.latest_ns) for sample in samples]
        table = np.array(pairs, np.int64).reshape(-1, 2)
        return cls(table[:, 0].copy(), table[:, 1].copy())

    @property
    def mid_ns(self) -> Whole:
        """Middles."""
        return (self.earliest_ns + self.latest_ns) // 2

    def __getitem__(self, chosen: NDArray[np.bool_] | Whole | slice) -> "Stamps":
        return Stamps(self.earliest_ns[chosen], self.latest_ns[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """Readings of one kind of the inertial board."""

    stamps: Stamps
    device_us: Array
    """[n] the board's clock, NaN where it doesn't say."""
    epoch: Whole
    values: Array
    """[n, axes] gyro rad/s, accelerometers m/s^2 (ahead, left), or tilt rad (roll, pitch)."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Everything that a drive's sensors said."""

    gyro: Inertial
    tilt: Inertial
    accelerometers: dict[tuple[str, int], Inertial]
    """By message and sensor."""
    packets: Inertial
    """Every inertial packet, no values: for its clock."""
    ticks: Stamps
    counts: Whole
    """[n, 2] left, right."""
    count_epoch: Whole
    fixes: list[Fix]
    fix_stamps: Stamps
    utc_s: Array
    """[n] NaN where the receiver didn't say."""
    scans: list[Scan]
    """Of the standing robot, some of them."""


def record(samples: Iterable[Sample], still_ns: int) -> Recording:
    """Sort samples into arrays. Scans are kept only after `still_ns` without a tick."""
    gyro: list[InertialSample] = []
    tilt: list[InertialSample] = []
    packets: list[InertialSample] = []
    accelerometers: dict[tuple[str, int], list[InertialSample]] = {}
    ticks: list[WheelTicks] = []
    fixes: list[Fix] = []
    scans: list[Scan] = []
    still_since: WheelTicks | None = None
    for sample in samples:
        if isinstance(sample, InertialSample):
            packets.append(sample)
            source = (sample.message, sample.sensor_id)
            if not all(map(isnan, sample.gyro_rps)) and (not gyro or source == (gyro[0].message, gyro[0].sensor_id)):
                gyro.append(sample)
            if not all(map(isnan, sample.tilt_rad)):
                tilt.append(sample)
            if not all(map(isnan, sample.accel_mps2[:2])):
                accelerometers.setdefault(source, []).append(sample)
        elif isinstance(sample, WheelTicks):
            if still_since is None or _counts(still_since) != _counts(sample):
                still_since = sample
            ticks.append(sample)
        elif isinstance(sample, Fix):
            if all(map(isfinite, (sample.alt_m, *sample.bound_m))):
                fixes.append(sample)
        elif (
            len(scans) < MOST_SCANS
            and still_since is not None
            and sample.stamp.earliest_ns - still_since.stamp.latest_ns > still_ns
        ):
            scans.append(sample)
    return Recording(
        gyro=_inertial(gyro, [sample.gyro_rps for sample in gyro], 3),
        tilt=_inertial(tilt, [sample.tilt_rad for sample in tilt], 2),
        accelerometers={
            source: _inertial(found, [sample.accel_mps2[:2] for sample in found], 2)
            for source, found in accelerometers.items()
        },
        packets=_inertial(packets, [() for _ in packets], 0),
        ticks=Stamps.of(ticks),
        counts=np.array([(sample.left, sample.right) for sample in ticks], np.int64).reshape(-1, 2),
        count_epoch=np.array([sample.epoch for sample in ticks], np.int64),
        fixes=fixes,
        fix_stamps=Stamps.of(fixes),
        utc_s=np.array([_utc_seconds(fix.utc) for fix in fixes], float),
        scans=scans,
    )


def standing(recording: Recording, still_ns: int) -> list[tuple[int, int]]:
    """Stretches [begin, end] in which the robot is declared to stand: no tick for `still_ns` before and after."""
    ticks, counts = recording.ticks, recording.counts
    if len(counts) < 2:
        return []
    same = np.all(counts[1:] == counts[:-1], axis=1) & (recording.count_epoch[1:] == recording.count_epoch[:-1])
    same &= ticks.earliest_ns[1:] - ticks.latest_ns[:-1] <= still_ns
    breaks = np.flatnonzero(~same)
    stretches = []
    for before, after in pairwise([-1, *breaks.tolist(), len(counts) - 1]):
        begin, end = int(ticks.latest_ns[before + 1]) + still_ns, int(ticks.earliest_ns[after]) - still_ns
        if end > begin:
            stretches.append((begin, end))
    return stretches


def within(stretches: list[tuple[int, int]], stamps: Stamps) -> Whole:
    """[n] which stretch a reading is surely in; -1: none."""
    found = np.full(len(stamps.earliest_ns), -1, np.int64)
    for k, (begin, end) in enumerate(stretches):
        found[(stamps.earliest_ns >= begin) & (stamps.latest_ns <= end)] = k
    return found


def _counts(ticks: WheelTicks) -> tuple[int, int, int]:
    return ticks.left, ticks.right, ticks.epoch


def _inertial(samples: list[InertialSample], values: list[tuple[float, ...]], axes: int) -> Inertial:
    device = [np.nan if sample.device_time_us is None else float(sample.device_time_us) for sample in samples]
    return Inertial(
        Stamps.of(samples),
        np.array(device, float),
        np.array([sample.epoch for sample in samples], np.int64),
        np.array(values, float).reshape(len(samples), axes),
    )


def _utc_seconds(utc: str | None) -> float:
    try:
        return np.nan if utc is None else datetime.fromisoformat(utc).timestamp()
    except ValueError:
        return np.nan
