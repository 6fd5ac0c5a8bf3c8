"""Gyro packets in the order of their true times, and how much time lies between them.

The board's own clock says how long it was, to within its resolution and drift; the host's stamps bound it too.
"""

from collections.abc import Iterator
from copy import copy, deepcopy
from math import inf, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_bare
from drivers.samples import InertialSample, Stamp, Vector3
from estimator.inconsistency import Journal
from estimator.interval import down, up

CLOCK_STEP_US = {"HIGHRES_IMU": 1, "RAW_IMU": 1, "DUAL_AXIS_ACCELERATION": 1, "DUAL_AXIS_TILT": 1}
"""Resolution of a message's device time; the others count milliseconds."""
MILLISECOND_US = 1000
LEARNING_PACKETS = 8
"""Gyro packets until the shortest interval seen is taken for the board's period."""
REMEMBERED = 1024
EARLIEST_NS, LATEST_NS, BEGAN_NS, EPOCH, DEVICE_US, RESOLUTION_US = range(6)
"""Columns of a packet's numbers: its stamp; its mean surely covers nothing before `began`; its place on the board's
clock."""
EFFORT = 6
"""And from here on [3] the summed variation of the body rates from the beginning to it, in motion.QUANTUM."""
NO_CLOCK = -(2**62)
FARTHEST_US = 2**51
"""A board's clock that tells more than 71 years (either way) is taken to tell that."""
PERIOD_S, INTERVALS = range(2)
"""What is learnt of the board: its shortest interval, and how many were seen since it started."""
NOT_YET, NO_PACKET = -1, -2
"""What `around` says where it names no packet."""


class Packet(NamedTuple):
    """One that is remembered."""

    stamp: Stamp
    rate: Vector3


class GyroPackets:
    """The newest packets of the one gyroscope that is used: that which spoke first."""

    def __init__(self, clock_drift_ppm: float, journal: Journal) -> None:
        self.drift = clock_drift_ppm * 1e-6
        self._journal = journal
        self._source: tuple[str, int] | None = None
        self.numbers = np.zeros((REMEMBERED, EFFORT + 3), dtype=np.int64)
        """Of packet k in row k modulo REMEMBERED, in the columns above."""
        self.rates = np.zeros((REMEMBERED, 3))
        """[n, 3] rad/s; NaN: not measured."""
        self.begin = self.end = 0
        """Packets [begin, end) are there."""
        self.learnt = np.array([inf, 0.0])

    def __deepcopy__(self, memo: dict[int, object]) -> "GyroPackets":
        new = copy(self)
        new._journal = deepcopy(self._journal, memo)
        new.numbers, new.rates, new.learnt = self.numbers.copy(), self.rates.copy(), self.learnt.copy()
        return new

    def __len__(self) -> int:
        return self.end - self.begin

    def __getitem__(self, i: int) -> Packet:
        """The oldest is 0."""
        if not 0 <= i < len(self):
            raise IndexError(i)
        row = (self.begin + i) % REMEMBERED
        earliest_ns, latest_ns = self.numbers[row, [EARLIEST_NS, LATEST_NS]].tolist()
        roll, pitch, yaw = (rate if rate == rate else nan for rate in self.rates[row].tolist())
        return Packet(Stamp(earliest_ns, latest_ns), (roll, pitch, yaw))

    def __reversed__(self) -> Iterator[Packet]:
        return (self[i] for i in range(len(self) - 1, -1, -1))

    @property
    def newest_epoch(self) -> int:
        """0 before the first."""
        return int(self.numbers[(self.end - 1) % REMEMBERED, EPOCH])

    def heard(self, sample: InertialSample) -> bool:
        """Is this of the gyroscope that is used? Else it is counted."""
        source = (sample.message, sample.sensor_id)
        if self._source is None:
            self._source = source
        if source != self._source:
            self._journal.counts["second_gyro"] += 1
            return False
        return True

    def begin_with(self, sample: InertialSample) -> None:
        """The first packet."""
        earliest_ns, latest_ns = sample.stamp.earliest_ns, sample.stamp.latest_ns
        append(
            self.numbers, self.rates, 0, earliest_ns, latest_ns, earliest_ns, sample.epoch, *board_clock(sample),
            np.ones(3, np.int64), sample.gyro_rps,
        )  # fmt: skip
        self.begin, self.end = 0, 1

    def appended(self) -> None:
        """One more was (`append`)."""
        self.end += 1
        self.begin = max(self.begin, self.end - REMEMBERED)

    def begin_anew(self, effort: NDArray[np.int64], other: "GyroPackets") -> None:
        """Forget all but the newest packet, whose time is what either takes it for; variations count from `effort`."""
        self.begin = self.end - 1
        mine, its = self.numbers[self.begin % REMEMBERED], other.numbers[(other.end - 1) % REMEMBERED]
        for column, outer in ((EARLIEST_NS, min), (LATEST_NS, max), (BEGAN_NS, min)):
            mine[column] = outer(mine[column], its[column])
        if mine[DEVICE_US] != its[DEVICE_US]:
            mine[DEVICE_US] = NO_CLOCK
        mine[EFFORT:] = effort


def board_clock(sample: InertialSample) -> tuple[int, int]:
    """Device time and its resolution."""
    device_us = sample.device_time_us
    if device_us is None:
        return NO_CLOCK, MILLISECOND_US
    if not -FARTHEST_US < device_us < FARTHEST_US:
        device_us = FARTHEST_US if device_us > 0 else -FARTHEST_US
    return device_us, CLOCK_STEP_US.get(sample.message, MILLISECOND_US)


@compiled_bare
def append(
    numbers: NDArray[np.int64],
    rates: NDArray[np.float64],
    k: int,
    earliest_ns: int,
    latest_ns: int,
    began_ns: int,
    epoch: int,
    device_us: int,
    resolution_us: int,
    effort: NDArray[np.int64],
    rate: Vector3,
) -> None:
    """Packet k."""
    row = k % REMEMBERED
    new = numbers[row]
    new[EARLIEST_NS], new[LATEST_NS], new[BEGAN_NS] = earliest_ns, latest_ns, began_ns
    new[EPOCH], new[DEVICE_US], new[RESOLUTION_US] = epoch, device_us, resolution_us
    for axis in range(3):
        new[EFFORT + axis] = effort[axis]
        rates[row, axis] = rate[axis]


@compiled_bare
def on_one_clock(packet: NDArray[np.int64], epoch: int, device_us: int) -> bool:
    """May the board's times of a packet and of a reading be subtracted?"""
    return bool(epoch == packet[EPOCH] and device_us != NO_CLOCK and packet[DEVICE_US] != NO_CLOCK)


@compiled_bare
def goes_back(
    last: NDArray[np.int64],
    earliest_ns: int,
    latest_ns: int,
    epoch: int,
    device_us: int,
    resolution_us: int,
    drift: float,
) -> tuple[bool, float]:
    """Is a packet no newer than the last by host's stamps or board's clock?

    Where it surely is by the host's stamps, the board's clock is wrong: by so many seconds at least, else 0.
    """
    if latest_ns < last[EARLIEST_NS]:
        return True, 0.0
    if not on_one_clock(last, epoch, device_us) or device_us > last[DEVICE_US]:
        return False, 0.0
    at_most_ns = max(0, device_us - last[DEVICE_US] + resolution_us) * 1000 / (1.0 - drift) + 2
    surely_ns = earliest_ns - last[LATEST_NS]
    return True, max(0.0, (surely_ns - at_most_ns) * 1e-9)


@compiled_bare
def elapsed(
    last: NDArray[np.int64],
    earliest_ns: int,
    latest_ns: int,
    epoch: int,
    device_us: int,
    resolution_us: int,
    drift: float,
    learnt: NDArray[np.float64],
    after_loss: bool,
) -> tuple[float, float, int, int, bool, float]:
    """Time since the last packet: least and most seconds; the new one's stamp, made tighter by the last.

    Then: does its mean cover only the last part of that time? By how many seconds the board's clock can't be true, by
    the host's stamps; else 0. `after_loss`: packets were lost meanwhile, so the time says nothing of the board's
    period: of a line that loses every other one it would be two.
    """
    low, high = max(0, earliest_ns - last[LATEST_NS]), latest_ns - last[EARLIEST_NS]
    if not on_one_clock(last, epoch, device_us):
        learnt[INTERVALS] = 0.0
        return down(low * 1e-9), up(high * 1e-9), earliest_ns, latest_ns, True, 0.0
    between = device_us - last[DEVICE_US]
    device_low = int(max(0, between - resolution_us) * 1000 * (1.0 - drift)) - 1
    device_high = int((between + resolution_us) * 1000 / (1.0 - drift)) + 2
    learnt[INTERVALS] += 1.0
    if learnt[INTERVALS] > 1.0 and not after_loss:  # the first one after a start may be anything
        learnt[PERIOD_S] = min(learnt[PERIOD_S], between * 1e-6)
    unknown = learnt[INTERVALS] <= LEARNING_PACKETS or learnt[PERIOD_S] == inf
    gap = unknown or between * 1e-6 > 1.5 * learnt[PERIOD_S]
    if device_low > high or device_high < low:
        off_s = max(device_low - high, low - device_high) * 1e-9
        return down(low * 1e-9), up(high * 1e-9), earliest_ns, latest_ns, True, off_s
    low, high = max(low, device_low, 0), min(high, device_high)
    earliest_ns, latest_ns = max(earliest_ns, last[EARLIEST_NS] + low), min(latest_ns, last[LATEST_NS] + high)
    return max(0.0, down(low * 1e-9)), up(high * 1e-9), earliest_ns, latest_ns, gap, 0.0


@compiled_bare
def around(
    numbers: NDArray[np.int64],
    begin: int,
    end: int,
    earliest_ns: int,
    latest_ns: int,
    epoch: int,
    device_us: int,
    resolution_us: int,
) -> int:
    """The last gyro packet surely not after a reading, before which the newest surely isn't; NOT_YET while it may be.

    By the board's own clock where both have it, else by the host's stamps.
    """
    if begin == end:
        return NOT_YET
    newest = numbers[(end - 1) % REMEMBERED]
    if epoch < newest[EPOCH]:
        return NO_PACKET
    if on_one_clock(newest, epoch, device_us):
        if newest[DEVICE_US] - device_us < newest[RESOLUTION_US] + resolution_us:
            return NOT_YET
    elif latest_ns > newest[EARLIEST_NS]:
        return NOT_YET
    for k in range(end - 1, begin - 1, -1):
        packet = numbers[k % REMEMBERED]
        if on_one_clock(packet, epoch, device_us):
            if device_us - packet[DEVICE_US] >= packet[RESOLUTION_US] + resolution_us:
                return k
        elif packet[LATEST_NS] <= earliest_ns:
            return k
    return NO_PACKET
