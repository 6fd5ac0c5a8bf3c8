"""A slice of the long proof over lasers mounted in any way."""

import pytest

from bench.prove_mounts import loaded_with, prove_drive, prove_points


@pytest.mark.parametrize("seed", [69, 70])
def test_no_hit_is_outside_wherever_the_laser_is_mounted(seed: int) -> None:
    """Through drivers, filter and mapper: each true hit is in its cell, each true pose in its set."""
    score = prove_drive(seed)
    assert score.sound, score.notes
    assert score.hits > 50_000


def test_the_emulated_robot_has_a_fast_scanner_where_90_degrees_are_configured() -> None:
    """The first of the drives above is one of it."""
    assert loaded_with(69).config.devices.laser.scan_angle_deg == 90


@pytest.mark.parametrize("seed", [1, 2])
def test_no_point_is_outside_far_from_the_map_s_origin(seed: int) -> None:
    """Errors at corners of their bounds, poses up to 100 km away."""
    score = prove_points(seed)
    assert score.sound
    assert score.hits > 100_000
