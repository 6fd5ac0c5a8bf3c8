"""The long random drive over open ground: on the ground, inside all limits, with everything the reference drives."""

import numpy as np

from simulator.errors import ErrorLaw
from simulator.open_ground import HALF_SIDE_M, open_ground
from simulator.robot import RobotModel, exceeded_limits, plan_drive

MODEL = RobotModel(max_speed_mps=1.2, max_acceleration_mps2=0.65, max_turn_acceleration_dps2=60.0)


def test_the_drive_wanders_stops_spins_and_reverses_within_the_robots_limits() -> None:
    """Both directions, spins in place, standstill, tilted ground, and never off the ground."""
    ground = open_ground(6, rms_slope_deg=9.0, duration_s=70.0)
    drive = plan_drive(MODEL, ground, ErrorLaw("mixed", 6), 70.0)
    assert exceeded_limits(MODEL, drive) == []
    assert np.abs(drive.pose[:, :2]).max() < HALF_SIDE_M - 1.0
    spinning = (np.abs(drive.speed) < 1e-3) & (np.abs(drive.rate[:, 2]) > 0.2)
    assert drive.speed.max() > 0.4
    assert drive.speed.min() < -0.2
    assert spinning.any()
    assert np.degrees(np.abs(drive.pose[:, 3:5]).max()) > 6.0


def test_the_same_seed_gives_the_same_drive() -> None:
    """Ground and manoeuvres depend on the arguments alone."""
    one, two = open_ground(3), open_ground(3)
    assert np.array_equal(one.heights, two.heights)
    assert one.course == two.course
    assert open_ground(4).course != one.course
