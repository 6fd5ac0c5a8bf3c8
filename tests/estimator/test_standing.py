"""A robot that neither turns nor tilts, and sensors that are as wrong as they may be: zero stays inside."""

from dataclasses import replace
from math import nan, radians

import numpy as np
import pytest
from pydantic import ValidationError

from bench.fault_drive import declared
from drivers.config import ImuConfig
from drivers.samples import InertialSample, Stamp, Vector3, WheelTicks
from estimator.config import FilterConfig, SetName
from estimator.filter import Filter

STEP_NS = 10_000_000
CONFIG = FilterConfig(standstill_s=2.0, standstill_rate_dps=0.0)


def standing(imu: ImuConfig, config: FilterConfig = CONFIG) -> Filter:
    """Nothing known yet; no GPS, and tracks that say nothing of yaw (those of a robot that turned would count)."""
    robot, devices = declared()
    robot = replace(robot, turning_gauge_m=None)
    return Filter(robot, config, replace(devices.encoders, latency_ms=(0.0, 0.0)), imu, None)


def read(
    pose: Filter, k: int, gyro: Vector3 = (0.0, 0.0, 0.0), accel: Vector3 = (0.0, 0.0, nan), tilt_rad: float = 0.0
) -> None:
    """All readings of step k."""
    now_ns = 10**12 + k * STEP_NS
    stamp = Stamp(now_ns, now_ns)
    pose.accept(InertialSample(stamp, "HIGHRES_IMU", 0, now_ns // 1000, accel, gyro, (tilt_rad, tilt_rad)))
    pose.accept(WheelTicks(stamp, 5, 5))


@pytest.mark.parametrize("kept", ["box", "ellipsoid"])
@pytest.mark.parametrize("last_s", [0.1, 0.4])
def test_counts_that_were_read_late_all_at_once_lead_no_farther_than_their_time(kept: SetName, last_s: float) -> None:
    """Twenty counts at a pause's end, each perhaps the first of a restarted unit: the way of one pause, not 20."""
    robot, devices = declared()
    imu = replace(devices.imu, latency_ms=(0.0, 0.0))
    pose, pause_ns = standing(imu, FilterConfig(set=kept)), 250_000_000
    for k in range(100):
        read(pose, k)
    paused_ns = 10**12 + 100 * STEP_NS
    for k in range(100, 100 + round(last_s * 100) + pause_ns // STEP_NS):
        now_ns = 10**12 + k * STEP_NS
        stamp = Stamp(now_ns, now_ns)
        pose.accept(
            InertialSample(stamp, "HIGHRES_IMU", 0, now_ns // 1000, (0.0, 0.0, nan), (0.0, 0.0, 0.0), (0.0, 0.0))
        )
        if now_ns == paused_ns + pause_ns:
            for epoch in range(1, 21):
                pose.accept(WheelTicks(Stamp(paused_ns, now_ns), 5, 5, epoch))
        elif now_ns > paused_ns + pause_ns:
            pose.accept(WheelTicks(stamp, 5, 5, 20))
    box = pose.latest()
    assert box is not None
    assert pose.guarantee.intact
    way = robot.max_speed_mps * pause_ns * 1e-9
    assert box.low[0] <= -way
    assert way <= box.high[0]
    assert max(box.high[:2] - box.low[:2]) < 2.0 * (1.3 * way + 0.02)


WAY_M = 0.003


def test_a_robot_that_stands_stays_where_it_is() -> None:
    """After a minute the place is known as it was after half a one; it may have moved as far as declared."""
    config = FilterConfig(standstill_s=0.5, standstill_rate_dps=0.02, standstill_way_m=WAY_M)
    held, widths = standing(declared()[1].imu, config), []
    for k in range(6001):
        read(held, k)
        if k % 3000 == 0 and k:
            pose = held.latest()
            assert pose is not None
            widths.append(pose.high[:3] - pose.low[:3])
            assert np.all(pose.low[:3] <= -WAY_M)
            assert np.all(pose.high[:3] >= WAY_M)
    assert held.guarantee.intact
    assert np.all(widths[1] <= 1.1 * widths[0])


def test_a_place_is_held_only_where_standing_is_declared() -> None:
    """How far a robot moves while it stands says nothing without when that is."""
    with pytest.raises(ValidationError, match="standstill_way_m"):
        FilterConfig(standstill_way_m=0.001)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_bias_that_drifts_at_its_bound_is_inside(sign: float) -> None:
    """What standing tells of the bias is two seconds old when it may be used: the bias has drifted since."""
    drift_dps2 = 0.3
    imu = replace(
        declared()[1].imu, latency_ms=(0.0, 0.0), gyro_bias_bound_dps=2.0, gyro_bias_drift_dps2=drift_dps2,
        gyro_noise_bound_dps=0.001, gyro_scale_bound=0.0,
    )  # fmt: skip
    pose, checked = standing(imu), 0
    for k in range(900):
        bias = sign * radians(-1.4 + drift_dps2 * (k - 0.5) * STEP_NS * 1e-9)
        read(pose, k, gyro=(0.0, 0.0, bias))
        now = pose.latest() if k % 10 == 0 else None
        if now is not None:
            checked += 1
            assert now.low[5] <= 0.0 <= now.high[5]
    assert checked > 50
    assert pose.guarantee.intact


def test_a_scale_error_is_that_of_all_that_is_read() -> None:
    """The bias is at its bound, noise adds to it, what is read is too large by its scale error: no contradiction."""
    scale, bias, noise = 0.1, radians(1.1), radians(0.4)
    imu = replace(
        declared()[1].imu, latency_ms=(0.0, 0.0), gyro_bias_bound_dps=1.1, gyro_noise_bound_dps=0.4,
        gyro_scale_bound=scale,
    )  # fmt: skip
    pose = standing(imu)
    for k in range(500):
        read(pose, k, gyro=(0.0, 0.0, (bias + noise) / (1.0 - scale) * (1.0 - 1e-12)))
    now = pose.latest()
    assert now is not None
    assert pose.guarantee.intact
    assert now.low[5] <= 0.0 <= now.high[5]


@pytest.mark.parametrize("axis", [0, 1])
def test_an_acceleration_across_gravity_hides_in_its_norm(axis: int) -> None:
    """Felt: exactly g, tilted by what the robot's own acceleration may add. It's no proof that the robot is tilted."""
    robot, devices = declared()
    most = robot.max_acceleration_mps2 + devices.imu.accel_bound_mps2
    pose, checked = standing(replace(devices.imu, latency_ms=(0.0, 0.0))), 0
    for k in range(100):
        felt = most if (k // 10) % 2 else -most
        read(pose, k, accel=(felt, 0.0, nan) if axis == 0 else (0.0, felt, nan), tilt_rad=nan)
        now = pose.latest()
        if now is not None:
            checked += 1
            assert (now.low[3:5] <= 0.0).all()
            assert (now.high[3:5] >= 0.0).all()
    assert checked > 50
    assert pose.guarantee.intact


def test_a_tilt_reading_of_a_gyro_packets_own_time_is_not_widened_by_what_may_happen_around_it() -> None:
    """Roll and pitch are known to within the tilt sensor's bound, at a turn acceleration of 800 deg/s^2 declared."""
    imu = declared()[1].imu
    pose = standing(replace(imu, latency_ms=(0.0, 0.0)))
    for k in range(20):
        read(pose, k)
    now = pose.latest()
    assert now is not None
    assert (now.high[3:5] - now.low[3:5] < 2.0 * radians(imu.tilt_bound_deg) * 1.01).all()


def test_a_robot_that_creeps_keeps_its_pose_where_no_standstill_was_declared() -> None:
    """It turns by 0.5 deg/s and no tick comes: nobody vouched that it stands. Who had, was contradicted."""
    imu = replace(declared()[1].imu, latency_ms=(0.0, 0.0), gyro_bias_bound_dps=0.3)
    for config, intact in ((FilterConfig(), True), (CONFIG, False)):
        pose = standing(imu, config)
        for k in range(800):
            read(pose, k, gyro=(0.0, 0.0, radians(0.5)))
        now = pose.latest()
        assert now is not None
        assert pose.guarantee.intact == intact
        if intact:
            turned = radians(0.5) * (now.earliest_ns - 10**12) * 1e-9
            assert now.low[5] <= turned <= now.high[5]


@pytest.mark.parametrize("half", [{"standstill_s": 0.5}, {"standstill_rate_dps": 0.02}])
def test_a_standstill_is_declared_whole_or_not_at_all(half: dict[str, float]) -> None:
    """How long without a tick, and how fast it may turn then: one without the other says nothing."""
    with pytest.raises(ValidationError, match="declare both, or neither"):
        FilterConfig(**half)  # type: ignore[arg-type]
