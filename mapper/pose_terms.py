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

from drivers.compiled import compiled_without_heap
from mapper.laser_geometry import (
    G_ACROSS_BOUND,
    G_LEVER,
    G_LEVER_BOUND,
    G_MOUNT_BOUND,
    G_PITCH_AXIS,
    G_RANGE_BOUND,
    G_RANGE_MAX,
    G_SCAN_BOUND,
    GROW,
    Floats,
)

PAD = 2.0**-40
"""Absolute inflation, per metre of the lengths in play, times (1 + Z)^2: a bound of the chain's rounding error."""
YAW_KEPT = 0.5
"""Half-range of yaw, in radians, up to which it is kept whole."""

# One row of float64 for a pose.
P_LOW = 0  # the pose box's x, y, z
P_HIGH = 3
P_U_COS = 6  # u = U_COS cos th + U_SIN sin th
P_U_SIN = 9
P_BULGE = 12  # 3/4 + d^2 / (2 cos d) of yaw
P_RANGE_BOUND = 13
# h of x, y, z; that of x and y as yaw turns it.
P_CONSTANT = 14
P_PER_METRE = 17
P_TURN_TURN = 20  # [3, 3], acts on r |u|
P_TURN_RANGE = 29  # [3, 3], acts on |u|; along z only the last one does
# v along the robot's heading and to its left, by r cos th, r sin th, and what does not depend on the beam; R l upwards.
P_FORWARD = 38
P_LEFT = 41
P_LEVER_UP = 44
# Along the directions x and y as seen from both ends of yaw, and along z: one row of D_SIZE for each.
P_DIRECTIONS = 45
D_CENTRE = 0  # of v - s: by r cos th, r sin th, and what does not depend on the beam
D_ROLL = 3  # of d_3 a_3 x v: the same three
D_MOUNT_YAW = 6  # of d_4 a_4 x u: by (r + d_r) cos th, (r + d_r) sin th; likewise mount pitch and the scan angle
D_MOUNT_PITCH = 9
D_MOUNT_ROLL = 13  # by (r + d_r) |sin th| alone: mount roll turns about the axis from which th is measured
D_SCAN = 15
D_PITCH = 18  # of d_2 a_2 x v: along x and y by v's height, along z by v's forward part
D_BOTH = 19  # of d_2 d_3 a_2 x (a_3 x v): by v's part to the left
D_SIZE = 20
X_LEFT, X_RIGHT, Y_LEFT, Y_RIGHT, Z_UP = (P_DIRECTIONS + n * D_SIZE for n in range(5))
P_USABLE = P_DIRECTIONS + 5 * D_SIZE  # 1 or 0
P_SIZE = P_USABLE + 2

# Scratch of prepare_pose: rows of four.
W_LEVER = 0  # R l
W_AXIS = 0  # a_k and d_k, k = 2..7, in rows 1 to 6
PITCH, ROLL = 1, 2
W_R = 7
W_M = 10
W_CENTRE = 13  # v - s: by r cos th, r sin th, and what does not depend on the beam
W_SHIFT = 16  # -s, as a matrix that acts on v
W_TURN_LEVER = 19  # C
W_ROWS = 22


@compiled_without_heap
def prepare_pose(low: Floats, high: Floats, geometry: Floats, work: Floats, out: Floats) -> None:
    """Fill the row `out` with what all beams shot from the pose box [low, high] share; `work` is [W_ROWS, 4]."""
    out[P_USABLE] = 0.0
    for i in range(6):
        if not (low[i] <= high[i] and np.isfinite(low[i]) and np.isfinite(high[i])):
            return
    out[P_USABLE] = 1.0
    for i in range(3):
        out[P_LOW + i], out[P_HIGH + i] = low[i], high[i]
    out[P_RANGE_BOUND] = geometry[G_RANGE_BOUND]

    # Any number near the middle will do, if the half-range is measured from it.
    roll, pitch, yaw = 0.5 * low[3] + 0.5 * high[3], 0.5 * low[4] + 0.5 * high[4], 0.5 * low[5] + 0.5 * high[5]
    turn_axes(roll, pitch, yaw, geometry, work)
    work[1, 3] = GROW * max(high[4] - pitch, pitch - low[4])
    work[2, 3] = GROW * max(high[3] - roll, roll - low[3])
    d_yaw = GROW * max(high[5] - yaw, yaw - low[5])

    reach = np.float64(0.0)
    for i in range(3):
        out[P_U_COS + i], out[P_U_SIN + i] = work[W_M + i, 0], work[W_M + i, 1]
        reach += max(abs(low[i]), abs(high[i]))
    second_order(geometry[G_ACROSS_BOUND], work, out)
    bound_remainder(reach, geometry, work, out)
    look_ahead(work, out)
    look_along(0.0, 0.0, 1.0, work, out, Z_UP)
    c, s = np.cos(d_yaw), np.sin(d_yaw)
    if d_yaw <= YAW_KEPT:
        out[P_BULGE] = 0.75 + 0.5 * d_yaw * d_yaw / c
        look_along(c, -s, 0.0, work, out, X_LEFT)
        look_along(c, s, 0.0, work, out, X_RIGHT)
        look_along(-s, c, 0.0, work, out, Y_LEFT)
        look_along(s, c, 0.0, work, out, Y_RIGHT)
        turn_remainder(c, s, out)
    else:
        anywhere_around(geometry, work, out)


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
    axis, shift, turn = work[W_AXIS : W_AXIS + 7], work[W_SHIFT : W_SHIFT + 3], out[P_TURN_TURN : P_TURN_TURN + 9]
    M, lever = work[W_M : W_M + 3], work[W_LEVER]
    turn[:], shift[:] = 0.0, 0.0
    for m in range(1, 7):
        x, y, z, d = axis[m, 0], axis[m, 1], axis[m, 2], axis[m, 3]
        for k in range(1, m + 1):
            kx, ky, kz = axis[k, 0], axis[k, 1], axis[k, 2]
            half = (0.25 if k == m else 0.5) * axis[k, 3] * d
            if half == 0.0 or (k == PITCH and m == ROLL):
                continue
            back_x, back_y, back_z = abs(y * ky + z * kz), abs(z * kz + x * kx), abs(x * kx + y * ky)
            one_way, beside = 2.0 * half, 2.0 * half
            if k <= ROLL:
                one_way = half
                shift[0, 0] -= half * back_x
                shift[1, 1] -= half * back_y
                shift[2, 2] -= half * back_z
            if k == m:
                beside = half
                shift[0, 1] += half * x * y
                shift[0, 2] += half * x * z
                shift[1, 2] += half * y * z
            turn[0] += one_way * back_x
            turn[1] += beside * abs(x * ky)
            turn[2] += beside * abs(x * kz)
            turn[3] += beside * abs(y * kx)
            turn[4] += one_way * back_y
            turn[5] += beside * abs(y * kz)
            turn[6] += beside * abs(z * kx)
            turn[7] += beside * abs(z * ky)
            turn[8] += one_way * back_z
        shift[1, 0], shift[2, 0], shift[2, 1] = shift[0, 1], shift[0, 2], shift[1, 2]
        if m == ROLL:
            for i in range(3):
                moved = shift[i, 0] * lever[0] + shift[i, 1] * lever[1] + shift[i, 2] * lever[2]
                work[W_CENTRE + i, 2] = lever[i] + moved
                for j in range(3):
                    work[W_TURN_LEVER + i, j] = turn[3 * i + j]
    for i in range(3):
        turn[4 * i] += 0.25 * d_across * d_across
        shift[i, i] -= 0.25 * d_across * d_across
        for j in range(2):
            moved = shift[i, 0] * M[0, j] + shift[i, 1] * M[1, j] + shift[i, 2] * M[2, j]
            work[W_CENTRE + i, j] = M[i, j] + moved


@compiled_without_heap
def bound_remainder(reach: float, geometry: Floats, work: Floats, out: Floats) -> None:
    """The rest of h."""
    axis, R, lever = work[W_AXIS : W_AXIS + 7], work[W_R : W_R + 3], work[W_LEVER]
    d_lever = geometry[G_LEVER_BOUND : G_LEVER_BOUND + 3]
    d_across, d_range = geometry[G_ACROSS_BOUND], geometry[G_RANGE_BOUND]
    length = np.sqrt(geometry[G_LEVER] ** 2 + geometry[G_LEVER + 1] ** 2 + geometry[G_LEVER + 2] ** 2)
    length_bound = np.sqrt(d_lever[0] ** 2 + d_lever[1] ** 2 + d_lever[2] ** 2)
    S = axis[1, 3] + axis[2, 3]
    Z = S + axis[3, 3] + axis[4, 3] + axis[5, 3] + axis[6, 3] + d_across
    third = (S**3 * length + 3.0 * S**2 * length_bound + Z**3 * d_range + 3.0 * Z**2 * d_range) / 6.0
    reach += length + length_bound + geometry[G_RANGE_MAX] + d_range
    third += PAD * reach * (1.0 + Z) ** 2

    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        constant = third + d_range * d_across * abs(axis[6, i])
        for j in range(3):
            shift = abs(R[i, j])
            for k in range(PITCH, ROLL + 1):
                shift += axis[k, 3] * abs(axis[k, a] * R[b, j] - axis[k, b] * R[a, j])
            constant += work[W_TURN_LEVER + i, j] * abs(lever[j]) + shift * d_lever[j]
            turn = 1.0
            if i != j:
                turn = axis[PITCH, 3] * abs(axis[PITCH, 3 - i - j]) + axis[ROLL, 3] * abs(axis[ROLL, 3 - i - j])
            out[P_TURN_RANGE + 3 * i + j] = turn * d_range
        # Across the scan: n, and a_k x n.
        turned = abs(axis[6, i])
        for k in range(1, 6):
            turned += axis[k, 3] * abs(axis[k, a] * axis[6, b] - axis[k, b] * axis[6, a])
        out[P_CONSTANT + i] = constant
        out[P_PER_METRE + i] = d_across * turned + Z**3 / 6.0
    out[P_CONSTANT + 2] += d_range * np.sqrt(axis[PITCH, 3] ** 2 + axis[ROLL, 3] ** 2)


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
def look_along(x: float, y: float, z: float, work: Floats, out: Floats, at: int) -> None:
    """One direction's row: v - s and the first order of each rotation along (x, y, z)."""
    M, lever = work[W_M : W_M + 3], work[W_LEVER]
    for j in range(3):
        out[at + j] = x * work[W_CENTRE, j] + y * work[W_CENTRE + 1, j] + z * work[W_CENTRE + 2, j]
    for k in range(ROLL, 7):
        # d n . (a x v) = d (n x a) . v
        ax, ay, az, d = work[k, 0], work[k, 1], work[k, 2], work[k, 3]
        cx, cy, cz = d * (y * az - z * ay), d * (z * ax - x * az), d * (x * ay - y * ax)
        place = at + 3 * (k - 1)
        out[place] = cx * M[0, 0] + cy * M[1, 0] + cz * M[2, 0]
        out[place + 1] = cx * M[0, 1] + cy * M[1, 1] + cz * M[2, 1]
        out[place + 2] = cx * lever[0] + cy * lever[1] + cz * lever[2]
    out[at + D_MOUNT_ROLL] = abs(out[at + D_MOUNT_ROLL])
    out[at + D_PITCH] = work[PITCH, 3] * (x * work[PITCH, 1] - y * work[PITCH, 0] - z)
    along_roll = x * work[ROLL, 0] + y * work[ROLL, 1] + z * work[ROLL, 2]
    out[at + D_BOTH] = work[PITCH, 3] * work[ROLL, 3] * along_roll


@compiled_without_heap
def turn_remainder(c: float, s: float, out: Floats) -> None:
    """h of x and y, as seen from an end of yaw."""
    for k in range(P_CONSTANT, P_TURN_TURN, 3):
        out[k], out[k + 1] = c * out[k] + s * out[k + 1], c * out[k + 1] + s * out[k]
    for rows in range(P_TURN_TURN, P_FORWARD, 9):
        for k in range(rows, rows + 3):
            out[k], out[k + 3] = c * out[k] + s * out[k + 3], c * out[k + 3] + s * out[k]


@compiled_without_heap
def anywhere_around(geometry: Floats, work: Floats, out: Floats) -> None:
    """x and y where nobody knows which way the robot looks: as far away as the lever and the range together reach."""
    out[P_BULGE] = 0.75
    for k in range(X_LEFT, Z_UP):
        out[k] = 0.0
    for rows in range(P_TURN_TURN, P_FORWARD, 9):
        for k in range(rows, rows + 6):
            out[k] = 0.0
    for i in range(2):
        lever = abs(geometry[G_LEVER]) + abs(geometry[G_LEVER + 1]) + abs(geometry[G_LEVER + 2])
        bound = geometry[G_LEVER_BOUND] + geometry[G_LEVER_BOUND + 1] + geometry[G_LEVER_BOUND + 2]
        out[P_CONSTANT + i] += lever + bound + geometry[G_RANGE_BOUND]
        out[P_PER_METRE + i] = 1.0 + 2.0**-40
