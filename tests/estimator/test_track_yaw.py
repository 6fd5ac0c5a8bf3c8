"""What the tracks' difference says of yaw, while the turning centres move."""

from collections import Counter
from math import floor, nan

import numpy as np
import pytest

from bench.fault_drive import declared
from drivers.samples import InertialSample, Stamp
from estimator.attitude import AttitudeChain
from estimator.config import FilterConfig
from estimator.inconsistency import Journal
from estimator.motion import TrackBounds
from estimator.position import Step
from estimator.track_yaw import TrackYaw

STEP_NS, STEP_S = 20_000_000, 0.02
ROBOT, DEVICES = declared()
TICK_M = DEVICES.encoders.left_metres_per_tick
TRACKS = TrackBounds(
    slip=ROBOT.slip_ratio, lateral=0.0, turning_centre=0.0, normal=0.0, quantum_left=TICK_M, quantum_right=TICK_M,
    most_speed=ROBOT.max_speed_mps, most_acceleration=1.0, most_track_acceleration=5.0,
)  # fmt: skip


def contradictions(centres_m: tuple[float, float], gauge_m: tuple[float, float]) -> int:
    """A robot that sways for four seconds: one distance of its turning centres to the left, the other to the right."""
    counts: Counter[str] = Counter()
    journal = Journal(counts)
    attitude = AttitudeChain(ROBOT, FilterConfig(), DEVICES.imu, journal)
    tracks = TrackYaw(gauge_m, TRACKS, attitude, journal)
    ran, counted = np.zeros(2), np.zeros(2)
    for k in range(200):
        turning = 0.5 * np.sin(0.2 * k)
        stamp = Stamp(k * STEP_NS, k * STEP_NS)
        sample = InertialSample(stamp, "HIGHRES_IMU", 0, k * 20_000, (nan, nan, nan), (0.0, 0.0, turning))
        attitude.predict(sample)
        before = Stamp(stamp.earliest_ns - STEP_NS // 2, stamp.latest_ns - STEP_NS // 2)
        attitude.correct_tilt(InertialSample(before, "ATTITUDE", 0, k * 20_000 - 10_000, tilt_rad=(0.0, 0.0)))
        ran += (0.1 + np.array([-0.5, 0.5]) * centres_m[int(turning > 0.0)] * turning) * STEP_S
        count = np.array([floor(way / TICK_M) for way in ran]) * TICK_M
        left, right = (count - counted).tolist()
        counted = count
        tracks.watch(stamp, Step(0, 0, np.zeros((4, 2)), left, right, k > 0, 0.0, STEP_S, abs(turning) * STEP_S, 0.0))
    assert attitude.level
    return sum(count for name, count in counts.items() if name.startswith("contradiction"))


@pytest.mark.parametrize("centres_m", [(0.30, 0.50), (0.50, 0.30), (0.30, 0.30), (0.50, 0.50)])
def test_turning_centres_anywhere_between_their_bounds_contradict_nobody(centres_m: tuple[float, float]) -> None:
    """Though they change from turn to turn: to and fro it adds up, and the robot has turned by nothing."""
    assert contradictions(centres_m, (0.30, 0.50)) == 0


def test_turning_centres_beyond_their_bounds_are_noticed() -> None:
    """Else nothing was compared above."""
    assert contradictions((0.30, 0.50), (0.40, 0.40)) > 0
