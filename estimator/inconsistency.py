"""Measurements that contradict their bounds: said aloud, kept, and never used.

An empty intersection proves that some declared bound was broken, not always the named sensor's own: the others that
made the set count too. That none was empty proves nothing.
"""

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

SENSORS = ("gps", "encoders", "gyro", "tilt", "accelerometer", "imu_clock", "imu_latency")
"""Whose bounds can be broken: `imu_clock`, the board's drift; `imu_latency`, inertial packets that are held up."""
MEASURING = ("gps", "encoders", "gyro", "tilt", "accelerometer")
"""Whoever of these breaks its bound may show in another's contradiction: counts that stand still tell of a standstill,
that of the gyroscope's bias, and the bias of roll and pitch; fixes tell of the bias, too."""
SUSPECTS = {**dict.fromkeys(MEASURING, MEASURING), "imu_clock": ("imu_clock", "imu_latency")}
"""Whose bound may be the broken one where a measurement of this sensor contradicts the set."""


class Contradiction(NamedTuple):
    """One empty intersection."""

    sensor: str
    """Whose measurement left nothing of the set."""
    time_ns: int
    """Host time of that measurement."""
    excess: float
    """By how much its declared bound would have to be wider for something to be left; inf where no width helps."""
    unit: str


class Fault(NamedTuple):
    """A stretch of time with contradictions, and what explains all of them."""

    contradiction: Contradiction
    """The first."""
    sensor: str
    """The likeliest of the suspects."""
    suspects: tuple[str, ...]
    """Each of these alone explains all measurements; none: it takes more than one."""
    void_since_ns: int
    """As far back as it may have begun: poses that reach from here to the contradiction are withdrawn."""
    restored_ns: int | None = None
    """When its sensor was believed again; None while it lasts."""


class Journal:
    """What happened to one pose set: counts, and the first contradiction since it was last read."""

    def __init__(self, counts: Counter[str]) -> None:
        self.counts = counts
        self.contradiction: Contradiction | None = None

    def report(self, sensor: str, time_ns: int, excess: float, unit: str) -> None:
        """`sensor` contradicts the set at host time `time_ns` by `excess`."""
        self.counts[f"contradiction_{sensor}"] += 1
        if self.contradiction is None:
            self.contradiction = Contradiction(sensor, time_ns, excess, unit)


def least_excess(agrees: Callable[[float], bool], first: float) -> float:
    """The least widening, to within a tenth, with which a measurement `agrees`; inf if 2^16 `first` doesn't do."""
    high = first
    while not agrees(high):
        high *= 2.0
        if high > 2.0**16 * first:
            return float("inf")
    low = 0.5 * high if high > first else 0.0
    while high - low > 0.1 * high:
        middle = 0.5 * (low + high)
        if agrees(middle):
            high = middle
        else:
            low = middle
    return high
