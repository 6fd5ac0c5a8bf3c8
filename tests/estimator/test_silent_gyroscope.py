"""While the gyroscope is silent for long, anything may happen between its packets, whatever is known at both ends."""

from collections.abc import Iterator
from math import nan, radians

from drivers.config import EncodersConfig, ImuConfig
from drivers.samples import InertialSample, Stamp, WheelTicks
from estimator.config import FilterConfig, RobotConfig
from estimator.filter import Filter

MS = 1_000_000
SILENT_MS = (2000, 5000)
ROBOT = RobotConfig(
    name="test",
    track_length_m=0.65,
    track_gauge_m=0.35,
    max_speed_mps=1.0,
    max_acceleration_mps2=1.0,
    max_turn_rate_dps=90.0,
    max_turn_acceleration_dps2=400.0,
    slip_ratio=0.03,
    lateral_slip_ratio=0.01,
    turning_centre_m=0.04,
    normal_slip_ratio=0.01,
)
ENCODERS = EncodersConfig(
    port="", dbc="", left="", right="", left_metres_per_tick=0.001, right_metres_per_tick=0.001, latency_ms=(0.0, 0.0)
)
IMU = ImuConfig(
    port="",
    latency_ms=(0.0, 0.0),
    clock_drift_ppm=100.0,
    gyro_bias_bound_dps=0.3,
    gyro_bias_drift_dps2=0.0005,
    gyro_noise_bound_dps=0.05,
    gyro_scale_bound=0.003,
    tilt_bound_deg=0.5,
    accel_bound_mps2=0.1,
)


def readings() -> Iterator[InertialSample | WheelTicks]:
    """Level at all times that something is read; 0.5 m/s on the tracks; the board is silent for three seconds."""
    for ms in range(0, 6001, 10):
        stamp = Stamp(ms * MS, ms * MS)
        if not SILENT_MS[0] < ms < SILENT_MS[1]:
            gyro = (0.0, 0.0, 0.0)
            yield InertialSample(stamp, "HIGHRES_IMU", 0, 1000 * ms, (nan, nan, nan), gyro, (0.0, 0.0))
        yield WheelTicks(stamp, ms // 2, ms // 2)


def test_a_robot_may_have_climbed_and_come_down_again_while_nothing_was_read() -> None:
    """It was level before and is level after: in between it may have pitched, rolled, and turned, at declared rates."""
    poses = Filter(ROBOT, FilterConfig(history_s=10.0), ENCODERS, IMU, None)
    for reading in readings():
        poses.accept(reading)
    assert poses.guarantee.intact
    between, after = poses.pose_over(3500 * MS, 3500 * MS), poses.pose_over(5900 * MS, 5900 * MS)
    assert between is not None
    assert after is not None
    for axis in range(3, 6):
        assert between.low[axis] < -radians(60.0)
        assert between.high[axis] > radians(60.0)
    assert after.high[4] - after.low[4] < radians(2.0)
    # 1.2 s at 80 degrees a second up, level again as fast, at 0.5 m/s meanwhile: more than half a metre up.
    assert after.high[2] > 0.5
