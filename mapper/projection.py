"""From a beam to a box that surely contains the point it hit: centred form with a rigorous remainder.

The point, with rotations from the outermost to the innermost (frames: t in map, l in base_link, the beam in laser):

    p = t + R [ l + Rm r (cos th, sin th, 0) ],   R = Rz(yaw) Ry(pitch) Rx(roll),   Rm = Rz Ry(-) Rx of the mounting

Every error is unknown but bounded: the pose axes, the lever arm l, the three mounting angles, the beam's direction
along the scan (a rotation about the scan axis n = R Rm ez) and across it, as a beam is a cone, and the range r. Write
each angle's error as one more rotation about its own axis a_k, fixed at the nominal values. Then, exactly,

    p = t + dt + E1 E2 E3 R (l + dl) + E1 ... E8 (r + dr) u,   Ek = exp(e_k [a_k x]),   u = R Rm (cos th, sin th, 0)

with k = yaw, pitch, roll | mount yaw, mount pitch, mount roll, along the scan, across. Half-width of p about its
nominal value, d_k being the half-range of e_k, S = d1 + d2 + d3 (without yaw for z), Z = S + d4 + ... + d8:

    first order    dt + |R| dl + dr |u| + sum_k d_k |a_k x v_k|             v_k = R l + r u for k <= 3, else r u
    second order   sum_{k<=m} c_km |A_k A_m| |v_m|                          c_kk = d_k^2 / 2, c_km = d_k d_m
                   + dr sum_k d_k |A_k| |u| + sum_{k<=3} d_k |A_k| |R| dl    A_k = [a_k x]
    third order    ( S^3 |l| + 3 S^2 |dl| + Z^3 (r + dr) + 3 Z^2 dr ) / 6

The last rotation's axis turns with the beam, but a_8 x u = n for every beam: what is of first order in it, alone or
with another rotation, is per metre of range the same for all.

The third order is Lagrange's bound: along any direction each derivative of a rotation has norm at most 1. It holds
everywhere, so the box does for half-ranges of any size. docs/rounding.md shows that `PAD` covers the floating point.
"""

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from drivers.config import LaserConfig
from drivers.samples import Scan
from mapper.fused import fused

Floats = NDArray[np.float64]

PAD = 2.0**-41
"""Absolute inflation, per metre of the lengths in play, times (1 + Z)^2: a bound of the chain's rounding error."""
GROW = 1.0 + 2.0**-40
"""Relative inflation of a half-width: covers the rounding of its own sums and products."""

# A laser's geometry as the compiled code reads it: one row of float64.
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
G_SIZE = 23

# What all beams of one pose share: one row of float64.
P_CENTRE = 0  # t + R l
P_U_COS = 3  # u = U_COS cos th + U_SIN sin th
P_U_SIN = 6
P_LEVER = 9  # d_k a_k x R l, k = 1..3
P_W_COS = 18  # d_k a_k x U_COS, k = 1..7
P_W_SIN = 39  # d_k a_k x U_SIN
P_TURN_TURN = 60  # second order of two rotations, per metre of range; acts on |u|
P_TURN_RANGE = 69  # range, and second order of a rotation and the range; acts on |u|
P_CONSTANT = 78  # all that does not depend on the beam
P_PER_METRE = 81  # third order and all that is across the scan, per metre of range
P_USABLE = 84  # 1 or 0
P_SIZE = 88

# Scratch of prepare_pose: rows of four.
W_AXIS = 0  # a_k and d_k, k = 1..7
W_R = 7
W_M = 10
W_ROWS = 13

# Boxes of up to LANES beams: rows of LANES numbers.
LANES = 64
B_CENTRE = 0  # x, y, z
B_HALF = 3 * LANES  # x, y, z
B_UX = 6 * LANES  # |u|
B_UY = 7 * LANES
B_UZ = 8 * LANES
B_R = 9 * LANES
B_RC = 10 * LANES
B_RS = 11 * LANES
B_SIZE = 12 * LANES


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
    return np.array(
        [
            *rotation(roll, pitch, yaw).ravel(),
            *(-sin(yaw), cos(yaw)),
            *(laser.mount_x_m, laser.mount_y_m, laser.mount_z_m),
            *(bound * GROW for bound in bounds),
            *(laser.range_min_m, laser.range_max_m),
        ]
    )


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


@compiled
def prepare_pose(low: Floats, high: Floats, geometry: Floats, work: Floats, out: Floats) -> None:
    """Fill the row `out` with what all beams shot from the pose box [low, high] share; `work` is [W_ROWS, 4]."""
    out[P_USABLE] = 0.0
    for i in range(6):
        if not (low[i] <= high[i] and np.isfinite(low[i]) and np.isfinite(high[i])):
            return
    out[P_USABLE] = 1.0

    # Any number near the middle will do, if the half-width is measured from it.
    x, y, z = 0.5 * low[0] + 0.5 * high[0], 0.5 * low[1] + 0.5 * high[1], 0.5 * low[2] + 0.5 * high[2]
    roll, pitch, yaw = 0.5 * low[3] + 0.5 * high[3], 0.5 * low[4] + 0.5 * high[4], 0.5 * low[5] + 0.5 * high[5]
    d_x, d_y, d_z = max(high[0] - x, x - low[0]), max(high[1] - y, y - low[1]), max(high[2] - z, z - low[2])
    d_lever = geometry[G_LEVER_BOUND : G_LEVER_BOUND + 3]
    d_mount, d_across, d_range = geometry[G_MOUNT_BOUND], geometry[G_ACROSS_BOUND], geometry[G_RANGE_BOUND]

    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    R, M, axis = work[W_R : W_R + 3], work[W_M : W_M + 3], work[W_AXIS : W_AXIS + 7]
    R[0, 0], R[0, 1], R[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    R[1, 0], R[1, 1], R[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    R[2, 0], R[2, 1], R[2, 2] = -sp, cp * sr, cp * cr
    for i in range(3):
        for j in range(3):
            M[i, j] = R[i, 0] * geometry[j] + R[i, 1] * geometry[3 + j] + R[i, 2] * geometry[6 + j]  # R Rm

    # Each rotation's axis in the map frame, and its half-range.
    axis[0, 0], axis[0, 1], axis[0, 2], axis[0, 3] = 0.0, 0.0, 1.0, max(high[5] - yaw, yaw - low[5])
    axis[1, 0], axis[1, 1], axis[1, 2], axis[1, 3] = -sy, cy, 0.0, max(high[4] - pitch, pitch - low[4])
    for i in range(3):
        axis[2, i] = R[i, 0]
        axis[3, i] = R[i, 2]
        axis[4, i] = R[i, 0] * geometry[G_PITCH_AXIS] + R[i, 1] * geometry[G_PITCH_AXIS + 1]
        axis[5, i] = M[i, 0]
        axis[6, i] = M[i, 2]
    axis[2, 3] = max(high[3] - roll, roll - low[3])
    axis[3, 3] = axis[4, 3] = axis[5, 3] = d_mount
    axis[6, 3] = geometry[G_SCAN_BOUND]

    lx, ly, lz = geometry[G_LEVER], geometry[G_LEVER + 1], geometry[G_LEVER + 2]
    vx = R[0, 0] * lx + R[0, 1] * ly + R[0, 2] * lz
    vy = R[1, 0] * lx + R[1, 1] * ly + R[1, 2] * lz
    vz = R[2, 0] * lx + R[2, 1] * ly + R[2, 2] * lz
    out[P_CENTRE], out[P_CENTRE + 1], out[P_CENTRE + 2] = x + vx, y + vy, z + vz
    for i in range(3):
        out[P_U_COS + i], out[P_U_SIN + i] = M[i, 0], M[i, 1]

    # First order: d_k a_k x (each vector that rotation k turns).
    for k in range(7):
        ax, ay, az, d = axis[k, 0], axis[k, 1], axis[k, 2], axis[k, 3]
        if k < 3:
            out[P_LEVER + 3 * k] = d * (ay * vz - az * vy)
            out[P_LEVER + 3 * k + 1] = d * (az * vx - ax * vz)
            out[P_LEVER + 3 * k + 2] = d * (ax * vy - ay * vx)
        for j in range(2):
            at = (P_W_COS if j == 0 else P_W_SIN) + 3 * k
            out[at] = d * (ay * M[2, j] - az * M[1, j])
            out[at + 1] = d * (az * M[0, j] - ax * M[2, j])
            out[at + 2] = d * (ax * M[1, j] - ay * M[0, j])

    # Second order. A_k A_m = a_m a_k' - (a_k . a_m) I. What acts on |v| = |R l + r u| is split into |R l| and r |u|.
    for i in range(3):
        lever_shift = abs(R[i, 0]) * d_lever[0] + abs(R[i, 1]) * d_lever[1] + abs(R[i, 2]) * d_lever[2]
        out[P_CONSTANT + i] = (d_x if i == 0 else d_y if i == 1 else d_z) + lever_shift
        for j in range(3):
            turn_turn = turn_turn_outer = turn_range = turn_outer = 0.0
            for m in range(7):
                entry = axis[m, 3] * (0.0 if i == j else abs(axis[m, 3 - i - j]))  # d_m |A_m|, off the diagonal
                turn_range += entry
                if m < 3:
                    turn_outer += entry
                for k in range(m + 1):
                    dot = axis[k, 0] * axis[m, 0] + axis[k, 1] * axis[m, 1] + axis[k, 2] * axis[m, 2]
                    product = axis[m, i] * axis[k, j] - (dot if i == j else 0.0)
                    term = (0.5 if k == m else 1.0) * axis[k, 3] * axis[m, 3] * abs(product)
                    turn_turn += term
                    if m < 3:
                        turn_turn_outer += term
            out[P_TURN_TURN + 3 * i + j] = turn_turn + (0.5 * d_across * d_across if i == j else 0.0)
            out[P_TURN_RANGE + 3 * i + j] = turn_range * d_range + (d_range if i == j else 0.0)
            lever_shift = abs(R[j, 0]) * d_lever[0] + abs(R[j, 1]) * d_lever[1] + abs(R[j, 2]) * d_lever[2]
            out[P_CONSTANT + i] += turn_turn_outer * abs(vx if j == 0 else vy if j == 1 else vz)
            out[P_CONSTANT + i] += turn_outer * lever_shift

    # First and second order across the scan: n, and a_k x n.
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        turned = abs(axis[6, i])
        for k in range(6):
            turned += axis[k, 3] * abs(axis[k, a] * axis[6, b] - axis[k, b] * axis[6, a])
        out[P_PER_METRE + i] = d_across * turned
        out[P_CONSTANT + i] += d_range * d_across * abs(axis[6, i])

    # Third order, and the inflation for rounding.
    lever = np.sqrt(lx * lx + ly * ly + lz * lz)
    lever_bound = np.sqrt(d_lever[0] * d_lever[0] + d_lever[1] * d_lever[1] + d_lever[2] * d_lever[2])
    turn = axis[1, 3] + axis[2, 3]
    inner = axis[3, 3] + axis[4, 3] + axis[5, 3] + axis[6, 3] + d_across
    reach = abs(x) + abs(y) + abs(z) + lever + lever_bound + geometry[G_RANGE_MAX] + d_range
    for i in range(3):
        S = turn if i == 2 else turn + axis[0, 3]
        Z = S + inner
        out[P_CONSTANT + i] += (S**3 * lever + 3.0 * S**2 * lever_bound + Z**3 * d_range + 3.0 * Z**2 * d_range) / 6.0
        out[P_CONSTANT + i] += PAD * reach * (1.0 + axis[0, 3] + turn + inner) ** 2
        out[P_PER_METRE + i] += Z**3 / 6.0


@compiled
def box_block(
    pose: Floats, geometry: Floats, first: int, count: int, ranges: Floats, cosines: Floats, sines: Floats, out: Floats
) -> None:
    """Boxes of `count` <= LANES beams from `first` on, all of one pose: centres and half-widths into `out` [B_SIZE].

    Lane j of the row B_X is out[B_X + j]. Each inner loop runs over the lanes, so that the compiler makes it vector
    instructions. A lane without a usable range holds the box of range zero: nobody reads it.
    """
    least, most = geometry[G_RANGE_MIN], geometry[G_RANGE_MAX]
    x_c, y_c, z_c = pose[P_U_COS], pose[P_U_COS + 1], pose[P_U_COS + 2]
    x_s, y_s, z_s = pose[P_U_SIN], pose[P_U_SIN + 1], pose[P_U_SIN + 2]
    ranges, cosines, sines = ranges[first : first + count], cosines[first : first + count], sines[first : first + count]
    for j in range(count):
        r, c, s = ranges[j], cosines[j], sines[j]
        r = r if (least <= r) & (r <= most) else 0.0
        out[B_R + j], out[B_RC + j], out[B_RS + j] = r, r * c, r * s
        out[B_UX + j] = abs(fused(x_c, c, x_s * s))
        out[B_UY + j] = abs(fused(y_c, c, y_s * s))
        out[B_UZ + j] = abs(fused(z_c, c, z_s * s))
    for i in range(3):
        centre, half = B_CENTRE + i * LANES, B_HALF + i * LANES
        origin, per_metre, constant = pose[P_CENTRE + i], pose[P_PER_METRE + i], pose[P_CONSTANT + i]
        u_c, u_s = pose[P_U_COS + i], pose[P_U_SIN + i]
        turn_x, turn_y, turn_z = pose[P_TURN_TURN + 3 * i], pose[P_TURN_TURN + 3 * i + 1], pose[P_TURN_TURN + 3 * i + 2]
        stretch_x, stretch_y = pose[P_TURN_RANGE + 3 * i], pose[P_TURN_RANGE + 3 * i + 1]
        stretch_z = pose[P_TURN_RANGE + 3 * i + 2]
        c, s = P_W_COS + i, P_W_SIN + i
        l1, l2, l3 = pose[P_LEVER + i], pose[P_LEVER + 3 + i], pose[P_LEVER + 6 + i]
        c1, c2, c3, c4, c5, c6, c7 = (
            pose[c],
            pose[c + 3],
            pose[c + 6],
            pose[c + 9],
            pose[c + 12],
            pose[c + 15],
            pose[c + 18],
        )
        s1, s2, s3, s4, s5, s6, s7 = (
            pose[s],
            pose[s + 3],
            pose[s + 6],
            pose[s + 9],
            pose[s + 12],
            pose[s + 15],
            pose[s + 18],
        )
        for j in range(count):
            r, rc, rs = out[B_R + j], out[B_RC + j], out[B_RS + j]
            out[centre + j] = fused(rc, u_c, fused(rs, u_s, origin))
            h = fused(r, per_metre, constant)
            h += abs(fused(rc, c1, fused(rs, s1, l1)))
            h += abs(fused(rc, c2, fused(rs, s2, l2)))
            h += abs(fused(rc, c3, fused(rs, s3, l3)))
            h += abs(fused(rc, c4, rs * s4))
            h += abs(fused(rc, c5, rs * s5))
            h += abs(fused(rc, c6, rs * s6))
            h += abs(fused(rc, c7, rs * s7))
            h = fused(fused(r, turn_x, stretch_x), out[B_UX + j], h)
            h = fused(fused(r, turn_y, stretch_y), out[B_UY + j], h)
            h = fused(fused(r, turn_z, stretch_z), out[B_UZ + j], h)
            out[half + j] = h * GROW


@compiled
def run_length(first: int, pose_index: NDArray[np.int32]) -> int:
    """How many beams from `first` on, at most LANES, were shot from the same pose."""
    run = pose_index[first : min(first + LANES, pose_index.size)]
    others = np.int32(0)
    for n in range(run.size):
        others |= run[n] ^ run[0]
    if others == 0:
        return run.size
    length = 1
    while run[length] == run[0]:
        length += 1
    return length


@compiled
def usable_range(r: float, geometry: Floats) -> bool:
    """False for NaN and infinities too."""
    return geometry[G_RANGE_MIN] <= r and r <= geometry[G_RANGE_MAX]  # type: ignore[no-any-return]


@compiled
def project_beams(
    ranges: Floats,
    cosines: Floats,
    sines: Floats,
    pose_index: NDArray[np.int32],
    pose_low: Floats,
    pose_high: Floats,
    geometry: Floats,
    work: Floats,
    poses: Floats,
    low: Floats,
    high: Floats,
) -> None:
    """Fill [n, 3] low and high with the box of every usable beam, NaN elsewhere."""
    for m in range(pose_low.shape[0]):
        prepare_pose(pose_low[m], pose_high[m], geometry, work, poses[m])
    block = np.empty(B_SIZE)
    low[:], high[:] = np.nan, np.nan
    first = 0
    while first < ranges.size:
        m, count = pose_index[first], run_length(first, pose_index)
        if 0 <= m < pose_low.shape[0] and poses[m, P_USABLE] == 1.0:
            box_block(poses[m], geometry, first, count, ranges, cosines, sines, block)
            for j in range(count):
                if usable_range(ranges[first + j], geometry):
                    for i in range(3):
                        centre, half = block[B_CENTRE + i * LANES + j], block[B_HALF + i * LANES + j]
                        low[first + j, i], high[first + j, i] = centre - half, centre + half
        first += count


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Outer box of each beam's hit point in the map frame; NaN where the beam has no usable range or pose."""

    low: Floats
    """[n, 3]"""
    high: Floats
    """[n, 3]"""


def project(scan: Scan, laser: LaserConfig, low: Floats, high: Floats, pose_index: NDArray[np.int32]) -> Boxes:
    """Boxes of a scan whose beam i was shot from the pose box [low, high][pose_index[i]] (both [m, 6], as AXES).

    The map does not come this way (its kernel makes the same boxes in passing): this is for tests and comparisons.
    """
    beams = scan.ranges_m.size
    cosines, sines = np.empty(beams), np.empty(beams)
    beam_table(scan.angle_min_rad, scan.angle_increment_rad, cosines, sines)
    boxes = Boxes(np.empty((beams, 3)), np.empty((beams, 3)))
    project_beams(
        np.array(scan.ranges_m, dtype=np.float64),
        *(cosines, sines),
        np.array(pose_index, dtype=np.int32),
        *(np.array(low, dtype=np.float64, order="C"), np.array(high, dtype=np.float64, order="C")),
        *(laser_geometry(laser), np.empty((W_ROWS, 4)), np.empty((len(low), P_SIZE))),
        *(boxes.low, boxes.high),
    )
    return boxes
