"""Gyro packets in the order of their true times, and how much time lies between them.

The board's own clock says how long it was, to within its resolution and drift; the host's stamps bound it too.
"""

from collections import deque
from collections.abc import Iterator
from copy import copy, deepcopy
from math import inf
from typing import NamedTuple, TypeAlias

from drivers.samples import InertialSample, Stamp
from estimator.inconsistency import Journal
from estimator.interval import down, up

CLOCK_STEP_US = {"HIGHRES_IMU": 1, "RAW_IMU": 1, "DUAL_AXIS_ACCELERATION": 1, "DUAL_AXIS_TILT": 1}
"""Resolution of a message's device time; the others count milliseconds."""
MILLISECOND_US = 1000
LEARNING_PACKETS = 8
"""Gyro packets until the shortest interval seen is taken for the board's period."""
REMEMBERED = 4096

Effort: TypeAlias = tuple[int, int, int]
"""Summed variation of the body rates from the beginning on, in motion.QUANTUM."""


class Packet(NamedTuple):
    """What later corrections need of a gyro packet."""

    stamp: Stamp
    epoch: int
    device_us: int | None
    resolution_us: int
    effort: Effort
    """Up to here."""
    rate: tuple[float, float, float]
    began_ns: int
    """Its mean surely covers nothing before this."""


class Elapsed(NamedTuple):
    """From one gyro packet to the next."""

    least_s: float
    most_s: float
    stamp: Stamp
    """Of the second, made tighter by the first."""
    gap: bool
    """Does the second's mean cover only the last part of it?"""


class GyroPackets:
    """The newest packets of the one gyroscope that is used: that which spoke first."""

    def __init__(self, clock_drift_ppm: float, journal: Journal) -> None:
        self._drift = clock_drift_ppm * 1e-6
        self._journal = journal
        self._source: tuple[str, int] | None = None
        self._packets: deque[Packet] = deque(maxlen=REMEMBERED)
        self._period_s = inf
        self._intervals_seen = 0

    def __deepcopy__(self, memo: dict[int, object]) -> "GyroPackets":
        """Packets never change: the copy's list is new, its entries are not."""
        new = copy(self)
        new._journal, new._packets = deepcopy(self._journal, memo), self._packets.copy()
        return new

    def __len__(self) -> int:
        return len(self._packets)

    def __getitem__(self, i: int) -> Packet:
        return self._packets[i]

    def __reversed__(self) -> Iterator[Packet]:
        return reversed(self._packets)

    def fits(self, sample: InertialSample) -> bool:
        """Is this packet of the gyroscope that is used, and newer than the last? Else it is counted."""
        source = (sample.message, sample.sensor_id)
        if self._source is None:
            self._source = source
        if source != self._source:
            self._journal.counts["second_gyro"] += 1
            return False
        last = self._packets[-1] if self._packets else None
        if last is not None and (sample.stamp.latest_ns < last.stamp.earliest_ns or self._goes_back(sample, last)):
            self._journal.counts["gyro_out_of_order"] += 1
            return False
        return True

    def _goes_back(self, sample: InertialSample, last: Packet) -> bool:
        """Is the packet no newer by the board's clock? Where it surely is by the host's stamps, that clock is wrong."""
        if sample.device_time_us is None or last.device_us is None or sample.epoch != last.epoch:
            return False
        between_us = sample.device_time_us - last.device_us
        if between_us > 0:
            return False
        at_most_ns = max(0, between_us + _resolution_us(sample)) * 1000 / (1.0 - self._drift) + 2
        surely_ns = sample.stamp.earliest_ns - last.stamp.latest_ns
        if surely_ns > at_most_ns:
            self._journal.report("imu_clock", sample.stamp.mid_ns, (surely_ns - at_most_ns) * 1e-9, "s")
        return True

    def append(self, sample: InertialSample, stamp: Stamp, effort: Effort) -> None:
        """The newest packet."""
        began_ns = (self._packets[-1] if self._packets else sample).stamp.earliest_ns
        self._packets.append(
            Packet(
                stamp, sample.epoch, sample.device_time_us, _resolution_us(sample), effort, sample.gyro_rps, began_ns
            )
        )

    def begin_anew(self, effort: Effort) -> None:
        """Forget all but the newest packet; variations count from `effort` on."""
        newest = self._packets[-1]
        self._packets.clear()
        self._packets.append(newest._replace(effort=effort))

    def elapsed(self, sample: InertialSample) -> Elapsed:
        """Time since the last packet. A board's clock that can't be true by the host's stamps is reported."""
        last, stamp = self._packets[-1], sample.stamp
        low = max(0, stamp.earliest_ns - last.stamp.latest_ns)
        high = stamp.latest_ns - last.stamp.earliest_ns
        if sample.device_time_us is None or last.device_us is None or sample.epoch != last.epoch:
            self._intervals_seen = 0
            return Elapsed(down(low * 1e-9), up(high * 1e-9), stamp, True)
        between, resolution = sample.device_time_us - last.device_us, _resolution_us(sample)
        device_low = int(max(0, between - resolution) * 1000 * (1.0 - self._drift)) - 1
        device_high = int((between + resolution) * 1000 / (1.0 - self._drift)) + 2
        self._intervals_seen += 1
        if self._intervals_seen > 1:  # the first one after a start may be anything
            self._period_s = min(self._period_s, between * 1e-6)
        gap = self._intervals_seen <= LEARNING_PACKETS or between * 1e-6 > 1.5 * self._period_s
        if gap and self._intervals_seen > LEARNING_PACKETS:
            self._journal.counts["gyro_gaps"] += 1
        if device_low > high or device_high < low:
            self._journal.report("imu_clock", stamp.mid_ns, max(device_low - high, low - device_high) * 1e-9, "s")
            return Elapsed(down(low * 1e-9), up(high * 1e-9), stamp, True)
        low, high = max(low, device_low, 0), min(high, device_high)
        stamp = Stamp(
            max(stamp.earliest_ns, last.stamp.earliest_ns + low), min(stamp.latest_ns, last.stamp.latest_ns + high)
        )
        return Elapsed(max(0.0, down(low * 1e-9)), up(high * 1e-9), stamp, gap)

    def around(self, sample: InertialSample) -> tuple[Packet | None, Packet] | None:
        """The last gyro packet surely not after the reading (or None), and the newest, surely not before it.

        By the board's own clock where both have it, else by the host's stamps. None while the newest may be before.
        """
        if not self._packets:
            return None
        newest = self._packets[-1]
        if sample.epoch < newest.epoch:
            return None, newest
        own_us = _resolution_us(sample)
        if not _surely_not_after(sample, own_us, newest, backward=True):
            return None
        for packet in reversed(self._packets):
            if _surely_not_after(sample, own_us, packet, backward=False):
                return packet, newest
        return None, newest


def _resolution_us(sample: InertialSample) -> int:
    return CLOCK_STEP_US.get(sample.message, MILLISECOND_US)


def _surely_not_after(sample: InertialSample, own_us: int, packet: Packet, backward: bool) -> bool:
    """Was the gyro packet surely not after the reading (backward: the reading surely not after the packet)?

    own_us: resolution of the reading's device time.
    """
    if sample.epoch == packet.epoch and sample.device_time_us is not None and packet.device_us is not None:
        resolution = packet.resolution_us + own_us
        between = sample.device_time_us - packet.device_us
        return -between >= resolution if backward else between >= resolution
    if backward:
        return sample.stamp.latest_ns <= packet.stamp.earliest_ns
    return packet.stamp.latest_ns <= sample.stamp.earliest_ns
