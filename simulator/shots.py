"""The laser's beams, each shot from the true pose at its own time, with the errors of range and of direction.

A beam is off its nominal direction along the scan (by an angle about the scan axis) and across it (out of its plane).
"""

from math import cos, inf, isinf, sin

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from simulator.errors import chance, draw
from simulator.motion_rows import between
from simulator.raycast import cast_rays

Array = NDArray[np.float64]


@compiled
def shoot(
    poses: Array,
    into_drive_ns: NDArray[np.int64],
    since_start_ns: NDArray[np.int64],
    angles: Array,
    mount: Array,
    mount_rotation: Array,
    heights: Array,
    x0: float,
    y0: float,
    cell: float,
    boxes: Array,
    range_max: float,
    law: int,
    range_key: int,
    range_bound: float,
    angle_key: int,
    angle_bound: float,
    across_key: int,
    across_bound: float,
    lost: float,
    echo_key: int,
    ranges: Array,
    hits: Array,
) -> None:
    """Cast every beam from the true pose at its own time; `ranges` as reported, `hits` as they truly are."""
    count = angles.size
    origins = np.empty((count, 3))
    directions = np.empty((count, 3))
    for i in range(count):
        pose = between(poses, into_drive_ns[i])
        cr, sr = cos(pose[3]), sin(pose[3])
        cp, sp = cos(pose[4]), sin(pose[4])
        cy, sy = cos(pose[5]), sin(pose[5])
        angle = angles[i] + angle_bound * draw(law, angle_key, since_start_ns[i])
        across = across_bound * draw(law, across_key, since_start_ns[i])
        ahead, left, up = cos(across) * cos(angle), cos(across) * sin(angle), sin(across)
        for vector in range(2):
            if vector == 0:
                bx, by, bz = mount[0], mount[1], mount[2]
            else:
                bx = mount_rotation[0, 0] * ahead + mount_rotation[0, 1] * left + mount_rotation[0, 2] * up
                by = mount_rotation[1, 0] * ahead + mount_rotation[1, 1] * left + mount_rotation[1, 2] * up
                bz = mount_rotation[2, 0] * ahead + mount_rotation[2, 1] * left + mount_rotation[2, 2] * up
            wx = cy * cp * bx + (cy * sp * sr - sy * cr) * by + (cy * sp * cr + sy * sr) * bz
            wy = sy * cp * bx + (sy * sp * sr + cy * cr) * by + (sy * sp * cr - cy * sr) * bz
            wz = -sp * bx + cp * sr * by + cp * cr * bz
            if vector == 0:
                origins[i, 0], origins[i, 1], origins[i, 2] = pose[0] + wx, pose[1] + wy, pose[2] + wz
            else:
                directions[i, 0], directions[i, 1], directions[i, 2] = wx, wy, wz
    cast_rays(heights, x0, y0, cell, boxes, origins, directions, range_max, ranges)
    for i in range(count):
        for axis in range(3):
            hits[i, axis] = origins[i, axis] + ranges[i] * directions[i, axis]
        if not isinf(ranges[i]):
            ranges[i] = max(ranges[i] + range_bound * draw(law, range_key, since_start_ns[i]), 0.0)
        if lost > 0.0 and chance(echo_key, since_start_ns[i]) < lost:
            ranges[i] = inf
