"""What a silent gyroscope, or a line that loses its packets, did not tell: anything may have happened meanwhile."""

from collections.abc import Iterator
from dataclasses import replace
from math import nan, radians

from drivers.config import EncodersConfig, ImuConfig
from drivers.imu.codec import serialise
from drivers.imu.messages import highres_imu
from drivers.imu.protocol import ImuProtocol
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
CALM_IMU = replace(IMU, gyro_bias_bound_dps=0.1)
PERIOD_MS = 10


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


def swaying(loses: bool) -> Iterator[InertialSample | WheelTicks]:
    """Straight on at 0.5 m/s, the yaw to and fro by a hundredth of a degree: each packet's mean is that of one way.

    Its rate rises and falls by 2 degrees a second in 10 ms: 400 a second squared, as declared.
    """
    board = ImuProtocol(CALM_IMU)
    for number in range(1000):
        now_ns = PERIOD_MS * number * MS
        sign = 1.0 if number % 2 else -1.0
        frame = highres_imu(number % 256, PERIOD_MS * number * 1000, 0, gyro_rps=(0.0, 0.0, sign * radians(1.0)))
        if not (loses and number % 2):
            for sample in board.receive_data(serialise(frame), now_ns):
                yield replace(sample, accel_mps2=(nan, nan, nan), tilt_rad=(0.0, 0.0))
        yield WheelTicks(Stamp(now_ns, now_ns), 5 * number, 5 * number)


def last_yaw_deg(loses: bool) -> tuple[float, float]:
    """The yaw's bounds at the end of the drive, in degrees; the true one is as at the beginning."""
    poses = Filter(ROBOT, FilterConfig(history_s=10.0), ENCODERS, CALM_IMU, None)
    for reading in swaying(loses):
        poses.accept(reading)
    assert poses.guarantee.intact
    pose = poses.latest()
    assert pose is not None
    return float(pose.low[5]) / radians(1.0), float(pose.high[5]) / radians(1.0)


def test_of_what_every_other_packet_said_the_rest_tells_nothing() -> None:
    """The means that arrive all say the same way round; the robot went the other way in between, and holds its yaw."""
    low, high = last_yaw_deg(loses=True)
    assert low <= 0.0 <= high


def test_where_nothing_is_lost_the_yaw_stays_narrow() -> None:
    """The same drive, all packets heard: bias and noise alone are left."""
    low, high = last_yaw_deg(loses=False)
    assert low <= 0.0 <= high
    assert high - low < 2 * 0.2 * 10


def test_of_two_packets_in_one_millisecond_the_second_is_not_left_out_silently() -> None:
    """The board speaks every half millisecond, its clock tells whole ones; the robot turns to and fro as fast."""
    imu = replace(CALM_IMU, gyro_bias_bound_dps=1e-4, gyro_noise_bound_dps=1e-4)
    poses = Filter(replace(ROBOT, max_turn_acceleration_dps2=8000.0), FilterConfig(), ENCODERS, imu, None)
    for number in range(400):
        stamp, half_way = Stamp(number * MS // 2, number * MS // 2), number % 2
        gyro = 0.0, 0.0, radians(1.0 if half_way else -1.0)
        poses.accept(InertialSample(stamp, "ATTITUDE", 0, number // 2 * 1000, (nan, nan, nan), gyro, (0.0, 0.0)))
        if not half_way:
            poses.accept(WheelTicks(stamp, number // 4, number // 4))
    pose = poses.latest()
    assert poses.guarantee.intact
    assert pose is not None
    assert pose.low[5] <= 0.0 <= pose.high[5]
