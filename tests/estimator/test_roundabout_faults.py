"""A sensor whose fault shows in another's contradiction: it is suspected all the same, and what is promised holds."""

from dataclasses import replace
from math import cos, floor, nan, radians

import numpy as np

from bench.fault_drive import declared, settings
from drivers.samples import ABSENT3, InertialSample, Stamp, WheelTicks
from estimator.filter import Filter

STEP_NS = 20_000_000
DEAD_S = 6.0, 8.5
"""The encoders' unit says the same again and again; the robot stands where that begins and where it ends."""
PACE = ([0.0, 1.0, 5.5, 6.0, 6.5, 8.0, 8.5, 9.0], [0.0, 0.4, 0.4, 0.0, 0.4, 0.4, 0.0, 0.4])
"""Seconds, metres a second."""


def test_counts_that_stand_still_while_the_robot_drives_are_suspected_when_the_tilt_sensor_contradicts() -> None:
    """They tell of a standstill, that of a bias, and the bias of a pitch that is not there: the wheels are to blame.

    No fix would show that the way is missing: so it is not promised without the encoders' word being doubted.
    """
    robot, devices = declared()
    pose = Filter(robot, settings(), devices.encoders, replace(devices.imu, gyro_bias_bound_dps=3.0), None)
    pitch = x = way = counted = 0.0
    false_ns = []
    for k in range(1000):
        seconds, now_ns = k * 0.02, 10**12 + k * STEP_NS
        dead = DEAD_S[0] <= seconds < DEAD_S[1]
        rate = radians(1.0) if dead else 0.0
        if k:
            way = float(np.interp(seconds, *PACE)) * 0.02
            pitch += rate * 0.02
            x += way * cos(pitch)
            counted += 0.0 if dead else way / 0.0002
        stamp, tilt = Stamp(now_ns, now_ns), (0.0, pitch) if k % 5 == 0 else (nan, nan)
        pose.accept(InertialSample(stamp, "HIGHRES_IMU", 0, now_ns // 1000, ABSENT3, (0.0, rate, 0.0), tilt))
        pose.accept(WheelTicks(stamp, floor(counted), floor(counted)))
        box = pose.latest()
        if box is not None and not box.low[0] <= x <= box.high[0]:
            false_ns.append(box.latest_ns)
    (fault,) = pose.faults
    assert fault.contradiction.sensor == "tilt"
    assert "encoders" in fault.suspects
    assert pose.guarantee.restored_ns is not None
    assert not any(pose.guarantee.covers(time_ns, time_ns) for time_ns in false_ns)
    assert not false_ns or max(false_ns) < fault.contradiction.time_ns
