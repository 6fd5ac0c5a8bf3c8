"""The emulated robot's limits, from the configuration of the real one."""

from estimator.config import RobotConfig
from simulator.robot import RobotModel


def robot_model(robot: RobotConfig) -> RobotModel:
    """The emulated robot keeps what the configuration declares of the real one."""
    return RobotModel(
        track_length_m=robot.track_length_m,
        track_gauge_m=robot.track_gauge_m,
        max_speed_mps=robot.max_speed_mps,
        max_acceleration_mps2=robot.max_acceleration_mps2,
        max_turn_rate_dps=robot.max_turn_rate_dps,
        max_turn_acceleration_dps2=robot.max_turn_acceleration_dps2,
        slip_ratio=robot.slip_ratio,
        lateral_slip_ratio=robot.lateral_slip_ratio,
        turning_centre_m=robot.turning_centre_m,
        normal_slip_ratio=robot.normal_slip_ratio,
    )
