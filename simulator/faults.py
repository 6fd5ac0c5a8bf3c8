"""Sensors that break their word: what a broken one reads in place of a good one.

A fault changes readings of one sensor from `begin_s` to `end_s` of the drive and leaves all others alone. It is made
afresh for each drive, since some remember what they read before.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import cos, pi, radians

import numpy as np

from drivers.samples import Fix, InertialSample, Vector3, WheelTicks

Reading = InertialSample | WheelTicks | Fix
METRES_PER_DEGREE = 111_320.0


@dataclass(slots=True)
class Fault:
    """One broken sensor."""

    begin_s: float
    end_s: float

    def changed(self, reading: Reading, t_s: float) -> Reading:
        """What is read instead, at a time of the drive."""
        return self.broken(reading, t_s) if self.begin_s <= t_s < self.end_s else reading

    def broken(self, reading: Reading, t_s: float) -> Reading:
        """The same while the fault lasts."""
        raise NotImplementedError


@dataclass(slots=True)
class GpsJump(Fault):
    """Fixes lie that far north of the truth."""

    metres: float = 2.0

    def broken(self, reading: Reading, t_s: float) -> Reading:
        """As Fault's."""
        if isinstance(reading, Fix):
            return replace(reading, lat_deg=reading.lat_deg + self.metres / METRES_PER_DEGREE)
        return reading


@dataclass(slots=True)
class FalseFixes(Fault):
    """Single fixes are off, anywhere between `nearest` and `farthest` times their bound, in any direction.

    A share of all, but never more than `most` of any `of` in succession; `at_once`: as soon as that allows it.
    """

    share: float = 0.08
    most: int = 1
    of: int = 20
    nearest: float = 1.5
    farthest: float = 30.0
    at_once: bool = False
    together: bool = False
    """All to the same side, by `nearest` times the bound: they agree with each other."""
    seed: int = 0
    count: int = 0
    """Fixes that were made false."""
    _random: np.random.Generator | None = None
    _recent: tuple[bool, ...] = ()
    """Which of the last of - 1 were false."""

    def broken(self, reading: Reading, t_s: float) -> Reading:
        """As Fault's."""
        if not isinstance(reading, Fix):
            return reading
        if self._random is None:
            self._random = np.random.default_rng(self.seed)
        false = sum(self._recent) < self.most and (self.at_once or self._random.random() < self.share)
        self._recent = (*self._recent, false)[-(self.of - 1) :]
        if not false:
            return reading
        self.count += 1
        times = self.nearest if self.together else self._random.uniform(self.nearest, self.farthest)
        direction = np.ones(3) if self.together else self._random.normal(size=3)
        direction /= np.abs(direction).max()  # at least one axis is that far off
        # a fix may have been off by its bound, to the other side
        east, north, up = (float(d * b * (times + 1.0)) for d, b in zip(direction, reading.bound_m, strict=True))
        return replace(
            reading,
            lat_deg=reading.lat_deg + north / METRES_PER_DEGREE,
            lon_deg=reading.lon_deg + east / (METRES_PER_DEGREE * cos(reading.lat_deg * pi / 180.0)),
            alt_m=reading.alt_m + up,
        )


@dataclass(slots=True)
class StuckGyro(Fault):
    """The gyroscope repeats its last good packet."""

    _held: Vector3 | None = None

    def broken(self, reading: Reading, t_s: float) -> Reading:
        """As Fault's."""
        if not isinstance(reading, InertialSample):
            return reading
        if self._held is None:
            self._held = reading.gyro_rps
        return replace(reading, gyro_rps=self._held)


@dataclass(slots=True)
class TiltSpike(Fault):
    """Roll and pitch read that much more."""

    degrees: float = 6.0

    def broken(self, reading: Reading, t_s: float) -> Reading:
        """As Fault's."""
        if not isinstance(reading, InertialSample):
            return reading
        roll, pitch = reading.tilt_rad
        return replace(reading, tilt_rad=(roll + radians(self.degrees), pitch + radians(self.degrees)))


@dataclass(slots=True)
class WrongTracks(Fault):
    """Counters that gain what the ground never saw; what was gained stays when the fault is over.

    Each track counts `scale` times too much, and runs `speed_ticks` a second on the spot besides.
    """

    scale: tuple[float, float] = (1.0, 1.0)
    ticks_per_s: tuple[float, float] = (0.0, 0.0)
    _last: tuple[int, int, float] | None = None
    _gained: tuple[float, float] = (0.0, 0.0)

    def changed(self, reading: Reading, t_s: float) -> Reading:
        """As Fault's."""
        if not isinstance(reading, WheelTicks):
            return reading
        if self._last is not None and self.begin_s <= t_s < self.end_s:
            left, right, then_s = self._last
            passed = t_s - then_s
            self._gained = (
                self._gained[0] + (self.scale[0] - 1.0) * (reading.left - left) + self.ticks_per_s[0] * passed,
                self._gained[1] + (self.scale[1] - 1.0) * (reading.right - right) + self.ticks_per_s[1] * passed,
            )
        self._last = reading.left, reading.right, t_s
        return replace(
            reading, left=reading.left + round(self._gained[0]), right=reading.right + round(self._gained[1])
        )


FaultMaker = Callable[[float], Fault]
"""A fault that begins at a time of the drive."""
