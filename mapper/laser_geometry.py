"""A laser's mounting and bounds as the compiled code reads them, and the directions of its beams."""

from math import cos, radians, sin

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_into_callers
from drivers.config import LaserConfig

Floats = NDArray[np.float64]

GROW = 1.0 + 2.0**-40
"""Relative inflation of every half-range: covers the rounding of the sums and products that it enters."""

# One row of float64.
G_MATRIX = 0  # Rm, row by row
G_PITCH_AXIS = 9  # mount pitch turns about (x, y, 0) of base_link
G_LEVER = 11
G_LEVER_BOUND = 14  # along x, y, z of base_link
G_MOUNT_BOUND = 17
G_SCAN_BOUND = 18
G_ACROSS_BOUND = 19
G_RANGE_BOUND = 20
G_RANGE_MIN = 21
G_RANGE_MAX = 22
# How long the lever and its bounds are.
G_LEVER_LENGTH = 23
G_LEVER_BOUND_LENGTH = 24
G_SIZE = 25


def laser_geometry(laser: LaserConfig) -> Floats:
    """The mounting and the bounds of a laser, in metres and radians, bounds rounded up."""
    yaw, pitch, roll = radians(laser.mount_yaw_deg), -radians(laser.mount_pitch_deg), radians(laser.mount_roll_deg)
    bounds = (
        *(3 * (laser.mount_position_bound_m,)),
        radians(laser.mount_angle_bound_deg),
        radians(laser.angle_bound_deg),
        radians(laser.angle_bound_deg if laser.across_bound_deg is None else laser.across_bound_deg),
        laser.range_bound_m,
    )
    geometry = np.array(
        [
            *rotation(roll, pitch, yaw).ravel(),
            *(-sin(yaw), cos(yaw)),
            *(laser.mount_x_m, laser.mount_y_m, laser.mount_z_m),
            *(bound * GROW for bound in bounds),
            *(laser.range_min_m, laser.range_max_m),
            *(0.0, 0.0),
        ]
    )
    measure_lever(geometry)
    return geometry


def measure_lever(geometries: Floats) -> None:
    """Fill in how long the lever and its bounds are, in one row [G_SIZE] or many."""
    for length, at in ((G_LEVER_LENGTH, G_LEVER), (G_LEVER_BOUND_LENGTH, G_LEVER_BOUND)):
        geometries[..., length] = np.sqrt(np.sum(geometries[..., at : at + 3] ** 2, axis=-1))


def rotation(roll: float, pitch: float, yaw: float) -> Floats:
    """[3, 3] Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr, cp, sp, cy, sy = cos(roll), sin(roll), cos(pitch), sin(pitch), cos(yaw), sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


@compiled
def beam_table(angle_min_rad: float, angle_increment_rad: float, cosines: Floats, sines: Floats) -> None:
    """Cosine and sine of each beam's angle, by the C library, whose error is known."""
    for i in range(cosines.size):
        angle = angle_min_rad + i * angle_increment_rad
        cosines[i] = np.cos(angle)
        sines[i] = np.sin(angle)


@compiled_into_callers
def usable_range(r: float, geometry: Floats) -> bool:
    """False for NaN and infinities too."""
    return geometry[G_RANGE_MIN] <= r and r <= geometry[G_RANGE_MAX]  # type: ignore[no-any-return]
