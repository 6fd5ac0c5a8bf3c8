"""What all beams of one pose share: the coefficients of the bounds on where a beam of that pose can hit.

The point, with rotations from the outermost to the innermost (frames: t in map, l in base_link, the beam in laser):

    p = t + R [ l + Rm r (cos th, sin th, 0) ],   R = Rz(yaw) Ry(pitch) Rx(roll),   Rm = Rz Ry(-) Rx of the mounting

Every error is unknown but bounded: the pose axes, the lever arm l, the three mounting angles, the beam's direction
along the scan (a rotation about the scan axis n = R Rm ez) and across it, as a beam is a cone, and the range r. Write
each angle's error as one more rotation about its own axis a_k, fixed at the nominal values. Then, exactly,

    p = t + dt + E1 q,   q = E2 E3 R (l + dl) + E2 ... E8 (r + dr) u,   u = R Rm (cos th, sin th, 0)

with Ek = exp(e_k [a_k x]) and k = yaw | pitch, roll | mount yaw, mount pitch, mount roll, along the scan, across.

**Without yaw** q is centred form with a rigorous remainder. d_k is the half-range of e_k, v = R l + r u,
S = d_2 + d_3, Z = d_2 + ... + d_8, A_k = [a_k x], v_k = v for k <= 3 and (r + d_r) u for k > 3:

    q in v - s + sum_k e_k a_k x v_k + e_2 e_3 a_2 x (a_3 x v) + [-h, h]
    h = |R| dl + d_r |u|
      + C |R l| + C' r |u|                                          second order of two rotations
      + sum_{k<=3} d_k (|A_k R| dl + d_r |A_k| |u|)                 of a rotation and a length
      + d_8 ((r + d_r) |n| + r sum_{k<8} d_k |a_k x n|)             across the scan
      + ( S^3 |l| + 3 S^2 |dl| + Z^3 (r + d_r) + 3 Z^2 d_r ) / 6    third order

The second order of two rotations is the sum over k <= m < 8 of c e_k e_m A_k A_m, c = 1/2 for k = m and 1 otherwise
(C', acts on r u), or over k <= m <= 3 (C, acts on R l). Its signs are known in three places:

* Pitch and roll, whose axes are perpendicular, make a_2 x (a_3 x v) = a_3 (a_2 . v) together. That is not in h but
  stays as it is: linear in either angle, so along any direction the farthest point is at a corner of the two.
* A square's entry beside the diagonal, e_k^2 a_ki a_kj / 2, has one sign: s takes the middle, C' holds half of it.
* All pairs but that of pitch and roll have on the diagonal, with o = sum_{k>3} e_k a_k, together
  -1/2 sum_{j/=i} ((e_2 a_2j + o_j)^2 + (e_3 a_3j + o_j)^2 - o_j^2): it takes the point back towards the origin, and
  never farther away than the pairs of k > 3 alone can. Again s takes the middle of the two ends, C' holds half.

(A_8^2 u = -u likewise.) All else is summed by absolute value. The third order is Lagrange's bound: along any
direction each derivative of a rotation has norm at most 1. It holds everywhere, for half-ranges of any size.

The last rotation's axis turns with the beam, but a_8 x u = n for every beam: what is of first order in it, alone or
with another rotation, is per metre of range the same for all. Along z pitch and roll move a range's error by
d_r (d_2 |forward part of u| + d_3 |left part|) at most: below d_r sqrt(d_2^2 + d_3^2), whatever the beam.

**Yaw** turns q about the vertical and is kept whole. Along x it is n(e).q with n(e) = (cos e, -sin e, 0), and n(e) is
a combination of the two at the ends, n(d) and n(-d), with non-negative weights sin(d +- e) / sin 2d. So the farthest
that a point can be, as far as errors at the ends decide it, is the larger of the two ends' bounds H+ and H-; between
the ends it can be farther by at most max(0, 2 d^2 max(H+, H-) / cos d - |H+ - H-|) / 4. Beyond `YAW_KEPT` the point is
anywhere on a disc.

docs/rounding.md shows this, and that `PAD` and `GROW` cover the floating point.
"""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_into_callers, compiled_without_heap
from mapper.laser_geometry import (
    G_ACROSS_BOUND,
    G_LEVER,
    G_LEVER_BOUND,
    G_LEVER_BOUND_LENGTH,
    G_LEVER_LENGTH,
    G_MOUNT_BOUND,
    G_PITCH_AXIS,
    G_RANGE_BOUND,
    G_RANGE_MAX,
    G_SCAN_BOUND,
    GROW,
    Floats,
)

Singles = NDArray[np.float32]

PAD = 2.0**-40
"""Absolute inflation, per metre of the lengths in play, times (1 + Z)^2: a bound of the chain's rounding error."""
PAD_SINGLE = 2.0**-17
"""The same per metre that errors move a point by: how far is summed in float32 ..."""
PAD_MIDDLE = 2.0**-20
"""... and per metre from base_link to the point: where the middle is, seen from the pose, is a float32 itself."""
YAW_KEPT = 0.5
"""Half-range of yaw, in radians, up to which it is kept whole."""

# One row for a pose; read as float64:
P_LOW = 0  # the pose box's x, y, z, less the padding
P_HIGH = 3  # ... and with it
# The others are read as float32.
P_CENTRE = 6  # [3, 3] v - s along x, y, z: by r cos th, r sin th, and what does not depend on the beam
P_U_COS = 15  # u = U_COS cos th + U_SIN sin th
P_U_SIN = 18
P_RANGE_BOUND = 21
# At an end of yaw x and y are at BACK of themselves from their middle, and -+ ASIDE of each other.
P_BACK = 22
P_ASIDE = 23
P_BULGE = 24  # d^2 / (2 cos d) of yaw
# h of x, y, z; that of x and y as yaw turns it.
P_CONSTANT = 25
P_PER_METRE = 28
P_TURN_TURN = 31  # [3, 3], acts on r |u|
P_TURN_RANGE = 40  # [3, 3], acts on |u|; along z only the last one does
# v along the robot's heading and to its left, by r cos th, r sin th, and what does not depend on the beam; R l upwards.
P_FORWARD = 49
P_LEFT = 52
P_LEVER_UP = 55
# Along the directions x and y as seen from both ends of yaw, and along z: one row of D_SIZE for each.
P_DIRECTIONS = 56
D_ROLL = 0  # of d_3 a_3 x v: by r cos th, r sin th, and what does not depend on the beam
D_MOUNT_YAW = 3  # of d_4 a_4 x u: by (r + d_r) cos th, (r + d_r) sin th; likewise mount pitch and the scan angle
D_MOUNT_PITCH = 5
D_SCAN = 7
D_MOUNT_ROLL = 9  # by (r + d_r) |sin th| alone: mount roll turns about the axis from which th is measured
D_PITCH = 10  # of d_2 a_2 x v: along x and y by v's height, along z by v's forward part
D_BOTH = 11  # of d_2 d_3 a_2 x (a_3 x v): by v's part to the left
D_SIZE = 12
X_LEFT, X_RIGHT, Y_LEFT, Y_RIGHT, Z_UP = (P_DIRECTIONS + n * D_SIZE for n in range(5))
P_USABLE = P_DIRECTIONS + 5 * D_SIZE  # 1 or 0
P_SIZE = P_USABLE + 1

# Scratch of prepare_pose: rows of four.
W_LEVER = 0  # R l
W_AXIS = 0  # a_k and d_k, k = 2..7, in rows 1 to 6
PITCH, ROLL, MOUNT_YAW, MOUNT_PITCH, MOUNT_ROLL, SCAN = 1, 2, 3, 4, 5, 6
W_R = 7
W_M = 10
W_TURN_LEVER = 13  # C |R l|
W_ROWS = 14
_FIRST = (0, 0, D_ROLL, D_MOUNT_YAW, D_MOUNT_PITCH, D_MOUNT_ROLL, D_SCAN)


@compiled_without_heap
def prepare_pose(low: Floats, high: Floats, geometry: Floats, work: Floats, out: Floats, narrow: Singles) -> None:
    """Fill the row `out` with what all beams shot from the pose box [low, high] share; `work` is [W_ROWS, 4].

    narrow: the same row as float32.
    """
    out[P_USABLE] = 0.0
    for i in range(6):
        if not (low[i] <= high[i] and np.isfinite(low[i]) and np.isfinite(high[i])):
            return
    out[P_USABLE] = 1.0
    out[P_RANGE_BOUND] = geometry[G_RANGE_BOUND]

    # Any number near the middle will do, if the half-range is measured from it.
    roll, pitch, yaw = 0.5 * low[3] + 0.5 * high[3], 0.5 * low[4] + 0.5 * high[4], 0.5 * low[5] + 0.5 * high[5]
    turn_axes(roll, pitch, yaw, geometry, work)
    work[PITCH, 3] = GROW * max(high[4] - pitch, pitch - low[4])
    work[ROLL, 3] = GROW * max(high[3] - roll, roll - low[3])
    d_yaw = GROW * max(high[5] - yaw, yaw - low[5])

    for i in range(3):
        out[P_U_COS + i], out[P_U_SIN + i] = work[W_M + i, 0], work[W_M + i, 1]
    second_order(geometry[G_ACROSS_BOUND], work, out)
    bound_remainder(min(d_yaw, YAW_KEPT), geometry, work, out)
    pad_box(low, high, geometry, work, out)
    look_ahead(work, out)
    if d_yaw <= YAW_KEPT:
        c, s = np.cos(d_yaw), np.sin(d_yaw)
        out[P_BULGE] = 0.5 * d_yaw * d_yaw / c
        out[P_BACK], out[P_ASIDE] = c - 1.0, s
        look_along(c, s, work, out)
        turn_remainder(c, s, out)
    else:
        look_along(1.0, 0.0, work, out)
        anywhere_around(geometry, out)
    for k in range(P_SIZE):
        narrow[k] = np.float32(out[k])


@compiled_without_heap
def turn_axes(roll: float, pitch: float, yaw: float, geometry: Floats, work: Floats) -> None:
    """R, M = R Rm, R l and each rotation's axis in the map frame; the half-ranges of the mounting's."""
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    R, M = work[W_R : W_R + 3], work[W_M : W_M + 3]
    R[0, 0], R[0, 1], R[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    R[1, 0], R[1, 1], R[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    R[2, 0], R[2, 1], R[2, 2] = -sp, cp * sr, cp * cr
    lx, ly, lz = geometry[G_LEVER], geometry[G_LEVER + 1], geometry[G_LEVER + 2]
    work[1, 0], work[1, 1], work[1, 2] = -sy, cy, 0.0
    for i in range(3):
        for j in range(3):
            M[i, j] = R[i, 0] * geometry[j] + R[i, 1] * geometry[3 + j] + R[i, 2] * geometry[6 + j]
        work[W_LEVER, i] = R[i, 0] * lx + R[i, 1] * ly + R[i, 2] * lz
        work[2, i] = R[i, 0]
        work[3, i] = R[i, 2]
        work[4, i] = R[i, 0] * geometry[G_PITCH_AXIS] + R[i, 1] * geometry[G_PITCH_AXIS + 1]
        work[5, i] = M[i, 0]
        work[6, i] = M[i, 2]
    work[3, 3] = work[4, 3] = work[5, 3] = geometry[G_MOUNT_BOUND]
    work[6, 3] = geometry[G_SCAN_BOUND]


@compiled_without_heap
def second_order(d_across: float, work: Floats, out: Floats) -> None:
    """Of two rotations, A_k A_m = a_m a_k' - (a_k . a_m) I: C', C, and v - s."""
    # On the diagonal: half of what pairs with pitch or roll can be, and what all others can. Beside it all that a pair
    # needs is |a_mi a_kj|: sums of |d a| over the axes so far, and of the squares', which have a sign.
    near_x, near_y, near_z = 0.0, 0.0, 0.0
    far_x, far_y, far_z = 0.0, 0.0, 0.0
    xy, xz, yx, yz, zx, zy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    square_xy, square_xz, square_yz = 0.0, 0.0, 0.0
    sum_x, sum_y, sum_z = 0.0, 0.0, 0.0
    for m in range(PITCH, SCAN + 1):
        d = work[m, 3]
        x, y, z = d * work[m, 0], d * work[m, 1], d * work[m, 2]
        for k in range(PITCH, m + 1):
            if k == PITCH and m == ROLL:
                continue
            d_k = (0.5 if k == m else 1.0) * work[k, 3]
            xx, yy, zz = x * (d_k * work[k, 0]), y * (d_k * work[k, 1]), z * (d_k * work[k, 2])
            if k <= ROLL:
                near_x += 0.5 * abs(yy + zz)
                near_y += 0.5 * abs(zz + xx)
                near_z += 0.5 * abs(xx + yy)
            else:
                far_x += abs(yy + zz)
                far_y += abs(zz + xx)
                far_z += abs(xx + yy)
        square_xy += 0.25 * x * y
        square_xz += 0.25 * x * z
        square_yz += 0.25 * y * z
        x, y, z = abs(x), abs(y), abs(z)
        before_x, before_y, before_z = sum_x, sum_y, sum_z
        if m == ROLL:  # not with pitch
            before_x, before_y, before_z = 0.0, 0.0, 0.0
        xy += x * (before_y + 0.25 * y)
        xz += x * (before_z + 0.25 * z)
        yx += y * (before_x + 0.25 * x)
        yz += y * (before_z + 0.25 * z)
        zx += z * (before_x + 0.25 * x)
        zy += z * (before_y + 0.25 * y)
        sum_x, sum_y, sum_z = sum_x + x, sum_y + y, sum_z + z
        if m == ROLL:
            lx, ly, lz = work[W_LEVER, 0], work[W_LEVER, 1], work[W_LEVER, 2]
            out[P_CENTRE + 2] = lx + (square_xy * ly + square_xz * lz - near_x * lx)
            out[P_CENTRE + 5] = ly + (square_xy * lx + square_yz * lz - near_y * ly)
            out[P_CENTRE + 8] = lz + (square_xz * lx + square_yz * ly - near_z * lz)
            turned = work[W_TURN_LEVER]
            turned[0] = near_x * abs(lx) + xy * abs(ly) + xz * abs(lz)
            turned[1] = yx * abs(lx) + near_y * abs(ly) + yz * abs(lz)
            turned[2] = zx * abs(lx) + zy * abs(ly) + near_z * abs(lz)
    across = 0.25 * d_across * d_across
    back_x, back_y, back_z = near_x + across, near_y + across, near_z + across
    for j in range(2):
        mx, my, mz = work[W_M, j], work[W_M + 1, j], work[W_M + 2, j]
        out[P_CENTRE + j] = mx + (square_xy * my + square_xz * mz - back_x * mx)
        out[P_CENTRE + 3 + j] = my + (square_xy * mx + square_yz * mz - back_y * my)
        out[P_CENTRE + 6 + j] = mz + (square_xz * mx + square_yz * my - back_z * mz)
    turn = out[P_TURN_TURN : P_TURN_TURN + 9]
    turn[0], turn[1], turn[2] = back_x + far_x, xy, xz
    turn[3], turn[4], turn[5] = yx, back_y + far_y, yz
    turn[6], turn[7], turn[8] = zx, zy, back_z + far_z


@compiled_without_heap
def bound_remainder(d_yaw: float, geometry: Floats, work: Floats, out: Floats) -> None:
    """The rest of h, and what float32 may lose."""
    axis, R = work[W_AXIS : W_AXIS + 7], work[W_R : W_R + 3]
    d_lever = geometry[G_LEVER_BOUND : G_LEVER_BOUND + 3]
    d_across, d_range = geometry[G_ACROSS_BOUND], geometry[G_RANGE_BOUND]
    length, length_bound = geometry[G_LEVER_LENGTH], geometry[G_LEVER_BOUND_LENGTH]
    d_pitch, d_roll = axis[PITCH, 3], axis[ROLL, 3]
    S = d_pitch + d_roll
    Z = S + axis[3, 3] + axis[4, 3] + axis[5, 3] + axis[6, 3] + d_across
    more = (1.0 + Z) ** 2
    third_per_metre = Z**3 * (1.0 / 6.0)
    third = S**2 * (S * length + 3.0 * length_bound) * (1.0 / 6.0) + third_per_metre * d_range + 0.5 * Z**2 * d_range

    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        constant = third + d_range * d_across * abs(axis[SCAN, i]) + work[W_TURN_LEVER, i]
        pitch_a, pitch_b = d_pitch * axis[PITCH, a], d_pitch * axis[PITCH, b]
        roll_a, roll_b = d_roll * axis[ROLL, a], d_roll * axis[ROLL, b]
        for j in range(3):
            pitched, rolled = pitch_a * R[b, j] - pitch_b * R[a, j], roll_a * R[b, j] - roll_b * R[a, j]
            constant += (abs(R[i, j]) + abs(pitched) + abs(rolled)) * d_lever[j]
        # Across the scan: n, and a_k x n.
        turned, n_a, n_b = abs(axis[SCAN, i]), axis[SCAN, a], axis[SCAN, b]
        for k in range(PITCH, SCAN):
            turned += axis[k, 3] * abs(axis[k, a] * n_b - axis[k, b] * n_a)
        moved = more * (Z if i == 2 else Z + 2.0 * d_yaw)
        lost = moved * (length + length_bound + d_range) + more * (d_range + 2.0 * length_bound)
        out[P_CONSTANT + i] = constant + PAD_MIDDLE * length + PAD_SINGLE * lost
        out[P_PER_METRE + i] = d_across * turned + third_per_metre + PAD_MIDDLE + PAD_SINGLE * moved
        out[P_TURN_RANGE + 3 * i + i] = d_range
        out[P_TURN_RANGE + 3 * a + b] = out[P_TURN_RANGE + 3 * b + a] = d_range * (
            d_pitch * abs(axis[PITCH, i]) + d_roll * abs(axis[ROLL, i])
        )
    out[P_CONSTANT + 2] += d_range * np.sqrt(d_pitch**2 + d_roll**2)


@compiled_without_heap
def pad_box(low: Floats, high: Floats, geometry: Floats, work: Floats, out: Floats) -> None:
    """The pose box's x, y, z, made larger by what float64 may lose."""
    Z, reach = geometry[G_ACROSS_BOUND], geometry[G_LEVER_LENGTH] + geometry[G_LEVER_BOUND_LENGTH]
    reach += geometry[G_RANGE_MAX] + geometry[G_RANGE_BOUND]
    for k in range(PITCH, SCAN + 1):
        Z += work[k, 3]
    for i in range(3):
        reach += max(abs(low[i]), abs(high[i]))
    pad = PAD * reach * (1.0 + Z) ** 2
    for i in range(3):
        out[P_LOW + i], out[P_HIGH + i] = low[i] - pad, high[i] + pad


@compiled_without_heap
def look_ahead(work: Floats, out: Floats) -> None:
    """v in the frame that yaw turns: pitch's axis is horizontal, to the left."""
    M, lever, left_x, left_y = work[W_M : W_M + 3], work[W_LEVER], work[PITCH, 0], work[PITCH, 1]
    for j in range(2):
        out[P_FORWARD + j] = left_y * M[0, j] - left_x * M[1, j]
        out[P_LEFT + j] = left_x * M[0, j] + left_y * M[1, j]
    out[P_FORWARD + 2] = left_y * lever[0] - left_x * lever[1]
    out[P_LEFT + 2] = left_x * lever[0] + left_y * lever[1]
    out[P_LEVER_UP] = lever[2]


@compiled_without_heap
def look_along(c: float, s: float, work: Floats, out: Floats) -> None:
    """The first order of each rotation along x and y, as seen from both ends of yaw, whose cosine is c, and along z."""
    M, lever = work[W_M : W_M + 3], work[W_LEVER]
    for k in range(ROLL, SCAN + 1):
        ax, ay, az, d = work[k, 0], work[k, 1], work[k, 2], work[k, 3]
        for j in range(3 if k == ROLL else 2):
            if k == MOUNT_ROLL and j == 0:
                continue
            vx, vy, vz = (lever[0], lever[1], lever[2]) if j == 2 else (M[0, j], M[1, j], M[2, j])
            x, y, z = d * (ay * vz - az * vy), d * (az * vx - ax * vz), d * (ax * vy - ay * vx)
            at = D_MOUNT_ROLL if k == MOUNT_ROLL else _FIRST[k] + j
            along(x, y, z, c, s, out, at)
    for row in range(X_LEFT, P_USABLE, D_SIZE):
        out[row + D_MOUNT_ROLL] = abs(out[row + D_MOUNT_ROLL])
    d_pitch, d_both = work[PITCH, 3], work[PITCH, 3] * work[ROLL, 3]
    along(d_pitch * work[PITCH, 1], -d_pitch * work[PITCH, 0], -d_pitch, c, s, out, D_PITCH)
    along(d_both * work[ROLL, 0], d_both * work[ROLL, 1], d_both * work[ROLL, 2], c, s, out, D_BOTH)


@compiled_into_callers
def along(x: float, y: float, z: float, c: float, s: float, out: Floats, at: int) -> None:
    """The vector (x, y, z) along each of the five directions."""
    cx, cy, sx, sy = c * x, c * y, s * x, s * y
    out[X_LEFT + at], out[X_RIGHT + at] = cx - sy, cx + sy
    out[Y_LEFT + at], out[Y_RIGHT + at] = cy - sx, cy + sx
    out[Z_UP + at] = z


@compiled_without_heap
def turn_remainder(c: float, s: float, out: Floats) -> None:
    """h of x and y, as seen from an end of yaw."""
    for k in range(P_CONSTANT, P_TURN_TURN, 3):
        out[k], out[k + 1] = c * out[k] + s * out[k + 1], c * out[k + 1] + s * out[k]
    for rows in range(P_TURN_TURN, P_FORWARD, 9):
        for k in range(rows, rows + 3):
            out[k], out[k + 3] = c * out[k] + s * out[k + 3], c * out[k + 3] + s * out[k]


@compiled_without_heap
def anywhere_around(geometry: Floats, out: Floats) -> None:
    """x and y where nobody knows which way the robot looks: as far away as the lever and the range together reach."""
    out[P_BULGE], out[P_BACK], out[P_ASIDE] = 0.0, 0.0, 0.0
    for k in range(P_CENTRE, P_CENTRE + 6):
        out[k] = 0.0
    for k in range(X_LEFT, Z_UP):
        out[k] = 0.0
    for rows in range(P_TURN_TURN, P_FORWARD, 9):
        for k in range(rows, rows + 6):
            out[k] = 0.0
    for i in range(2):
        lever = abs(geometry[G_LEVER]) + abs(geometry[G_LEVER + 1]) + abs(geometry[G_LEVER + 2])
        bound = geometry[G_LEVER_BOUND] + geometry[G_LEVER_BOUND + 1] + geometry[G_LEVER_BOUND + 2]
        out[P_CONSTANT + i] += lever + bound + geometry[G_RANGE_BOUND]
        out[P_PER_METRE + i] = 1.0 + PAD_MIDDLE
