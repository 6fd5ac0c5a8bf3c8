"""The window of fixes against a truth of its own: a robot on a plane whose every error is at its bound."""

from dataclasses import replace
from math import cos, floor, nan, pi, sin

import numpy as np
import pytest
from numpy.typing import NDArray
from pymap3d import enu2geodetic

from bench.fault_drive import declared
from drivers.samples import Fix, InertialSample, Stamp, WheelTicks
from estimator.config import FilterConfig
from estimator.filter import Filter
from estimator.gps_window import MOST_FIXES, GpsWindow

STEP_S = 0.1
NOISE, MOST_BIAS, DRIFT = 0.002, 0.005, 2e-6
ALONG, ACROSS = 0.05, 0.02
"""Of the way in a step."""
FIX_M = 0.3


class Drive:
    """Errors at the corners of their bounds: each of one sign for good, or of another at every reading."""

    def __init__(self, seed: int, constant: bool, trust: float = 1.0) -> None:
        """`trust`: the step's errors are declared so many times as large as they are."""
        self._random, self._constant, self._trust = np.random.default_rng(seed), constant, trust
        self._signs = self._random.choice([-1.0, 1.0], 6)
        self.yaw, self.place = float(self._random.uniform(-pi, pi)), self._random.uniform(-50, 50, 2)
        self.bias = MOST_BIAS * self._signs[0]
        self.window = GpsWindow(DRIFT)
        self.known_bias = np.array([-MOST_BIAS, MOST_BIAS])
        self._heading, self._seconds = np.zeros(3), 0.0
        self._rate, self._speed = 0.0, 0.8

    def _sign(self, channel: int) -> float:
        return float(self._signs[channel] if self._constant else self._random.choice([-1.0, 1.0]))

    def step(self) -> None:
        """One step of tracks and gyroscope."""
        if self._random.random() < 0.05:
            self._rate, self._speed = float(self._random.uniform(-0.6, 0.6)), float(self._random.choice([0.8, 0, -0.5]))
        way = self._speed * STEP_S
        along, across = ALONG * abs(way), ACROSS * abs(way)
        local = np.array([way + along * self._sign(1), across * self._sign(2)])
        c, s = cos(self.yaw), sin(self.yaw)
        self.place = self.place + np.array([c * local[0] - s * local[1], s * local[0] + c * local[1]])
        box = np.array([[way, way], [0, 0], [0, 0]]) + self._trust * np.array(
            [[-along, along], [-across, across], [0, 0]]
        )
        self._seconds += STEP_S
        self.window.extend(box, np.array([1.0, 0.0, 0.0]), self._heading.copy(), 0.0, self.known_bias, self._seconds)
        self.yaw += (self._rate - self.bias + NOISE * self._sign(3)) * STEP_S
        self._heading += (self._rate * STEP_S, -STEP_S, NOISE * STEP_S * (1.0 + 1e-9))
        self.bias = float(np.clip(self.bias + DRIFT * STEP_S * self._sign(4), -MOST_BIAS, MOST_BIAS))
        self.known_bias = np.clip(self.known_bias + DRIFT * STEP_S * np.array([-1, 1]), -MOST_BIAS, MOST_BIAS)

    def fix(self, ahead_m: float = 0.4) -> tuple[bool, NDArray[np.float64], NDArray[np.float64]]:
        """One fix, of an antenna ahead of base_link: does all agree; yaw and place."""
        c, s = cos(self.yaw), sin(self.yaw)
        antenna = self.place + ahead_m * np.array([c, s]) + FIX_M * np.array([self._sign(4), self._sign(5)])
        box = np.stack([antenna - FIX_M, antenna + FIX_M], axis=1) + np.array([-1e-9, 1e-9])
        offset = np.array([[ahead_m - 0.01, ahead_m + 0.01], [-0.01, 0.01]])
        yaw = self.yaw + np.array([-2.0, 1.0])
        place = np.stack([self.place - 4.0, self.place + 3.0], axis=1)
        now = self._seconds, self._seconds
        agrees = self.window.narrowed(box, offset, self._heading, now, 0.0, self.known_bias, yaw, place)
        if agrees:
            self.window.remember(self.known_bias, 0.0, 0.0, yaw, place)
        return agrees, yaw, place

    def holds(self, yaw: NDArray[np.float64], place: NDArray[np.float64]) -> bool:
        """Are the true yaw, place and bias inside?"""
        inside = np.all((place[:, 0] <= self.place) & (self.place <= place[:, 1]))
        return bool(inside and yaw[0] <= self.yaw <= yaw[1] and self.known_bias[0] <= self.bias <= self.known_bias[1])


@pytest.mark.parametrize("constant", [True, False])
def test_yaw_place_and_bias_hold_the_truth_and_become_narrow(constant: bool) -> None:
    """Over drives long enough that old fixes fall out of the window; yaw and bias end up well below what was known."""
    narrow = []
    for seed in range(6):
        drive = Drive(seed, constant)
        for _ in range(MOST_FIXES + 30):
            for _ in range(20):
                drive.step()
            agrees, yaw, place = drive.fix()
            assert agrees
            assert drive.holds(yaw, place)
        narrow.append((yaw[1] - yaw[0], drive.known_bias[1] - drive.known_bias[0]))
    widths = np.mean(narrow, axis=0)
    assert widths[0] < 0.6
    assert widths[1] < 1.9 * MOST_BIAS


def test_errors_along_the_way_that_are_not_declared_are_noticed() -> None:
    """With half of the declared errors of the steps the window contradicts itself, or loses the truth."""

    def right(drive: Drive) -> bool:
        for _ in range(MOST_FIXES):
            for _ in range(20):
                drive.step()
            agrees, yaw, place = drive.fix()
            if not (agrees and drive.holds(yaw, place)):
                return False
        return True

    assert not all(right(Drive(seed, constant=True, trust=0.3)) for seed in range(12))


def test_a_counter_that_restarts_between_fixes_is_paid_for_twice() -> None:
    """Coarse ticks that lag by all of one before the restart and after it, under fixes of 5 mm: nobody is blamed."""
    robot, devices = declared((0.005, 0.005, 0.04))
    tick_m, latency = 0.1, (0.0, 0.0)
    encoders = replace(devices.encoders, left_metres_per_tick=tick_m, right_metres_per_tick=tick_m, latency_ms=latency)
    assert devices.gps is not None
    imu, gps = replace(devices.imu, latency_ms=latency), replace(devices.gps, latency_ms=latency, antenna_z_m=0.0)
    pose = Filter(replace(robot, slip_ratio=1e-4), FilterConfig(), encoders, imu, gps)
    way = counted = 0.0
    for k in range(600):
        now_ns, moves = 10**12 + k * 20_000_000, 51 <= k % 200 < 149
        way += 0.01 if moves else 0.0
        stamp = Stamp(now_ns, now_ns)
        pose.accept(
            InertialSample(stamp, "HIGHRES_IMU", 0, now_ns // 1000, (0.0, 0.0, nan), (0.0, 0.0, 0.0), (0.0, 0.0))
        )
        epoch = (k + 100) // 200  # it restarts in the middle of each way, where the counts begin from zero
        counted = way if (k + 100) % 200 == 0 else counted
        ticks = floor((way - counted) / tick_m + 1e-9)
        pose.accept(WheelTicks(stamp, ticks, ticks, epoch))
        if k % 200 == 40:
            lat, lon, alt = enu2geodetic(way, 0.0, 0.0, 50.0, 8.0, 100.0)
            pose.accept(Fix(stamp, None, float(lat), float(lon), float(alt), 4, 0.8, (0.005, 0.005, 0.04), None))
    assert pose.guarantee.intact
    assert pose.counts["faults"] == 0
    assert pose.anchor is not None
