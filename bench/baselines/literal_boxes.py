"""The paper's two ways from a beam to a box, as written: natural interval extension, and first order without remainder.

Neither rounds outward. The natural extension contains the point up to rounding, but every angle is counted wherever it
occurs; the first-order form |J| d is no enclosure: what is of second order in the errors is left out. Errors as in the
map's own projection, but for the beam's divergence across the scan, which the paper does not have.
"""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from mapper.fused import fused
from mapper.laser_geometry import (
    G_LEVER,
    G_LEVER_BOUND,
    G_MOUNT_BOUND,
    G_RANGE_BOUND,
    G_RANGE_MAX,
    G_RANGE_MIN,
)
from mapper.pose_terms import W_LEVER, W_M, W_R, turn_axes
from mapper.projection import B_X0, B_X1, LANES

Floats = NDArray[np.float64]

# What all beams of one pose share in the first order: one row of float64.
F_CENTRE = 0  # t + R l
F_U_COS = 3
F_U_SIN = 6
F_CONSTANT = 9
F_LEVER = 12  # d_k a_k x R l: yaw, pitch, roll
F_W_COS = 21  # d_k a_k x U_COS: those, the mounting's three, and along the scan
F_W_SIN = 42
F_SIZE = 63

# What all beams of one pose share in the natural extension: one row of float64.
I_ORIGIN = 0  # [t] + [R][l]: low x, y, z, then high
I_COS = 6  # [R Rm] first column: low, then high
I_SIN = 12
I_SIZE = 18
W_INTERVALS = 18
"""Rows of four in the scratch of `prepare_intervals`."""


@compiled
def prepare_first_order(low: Floats, high: Floats, geometry: Floats, work: Floats, out: Floats) -> None:
    """Fill the row `out` [F_SIZE] for a pose box; `work` as `mapper.pose_terms.prepare_pose` takes it."""
    turn_axes(0.5 * (low[3] + high[3]), 0.5 * (low[4] + high[4]), 0.5 * (low[5] + high[5]), geometry, work)
    R, M, lever = work[W_R : W_R + 3], work[W_M : W_M + 3], work[W_LEVER]
    work[1, 3], work[2, 3] = 0.5 * (high[4] - low[4]), 0.5 * (high[3] - low[3])
    for i in range(3):
        out[F_CENTRE + i] = 0.5 * (low[i] + high[i]) + lever[i]
        out[F_U_COS + i], out[F_U_SIN + i] = M[i, 0], M[i, 1]
        constant = 0.5 * (high[i] - low[i])
        for j in range(3):
            constant += abs(R[i, j]) * geometry[G_LEVER_BOUND + j]
        out[F_CONSTANT + i] = constant
    for k in range(7):
        ax, ay, az, d = work[k, 0], work[k, 1], work[k, 2], work[k, 3]
        if k == 0:  # yaw, which has no row there
            ax, ay, az, d = 0.0, 0.0, 1.0, 0.5 * (high[5] - low[5])
        for j in range(3):
            vx, vy, vz = (lever[0], lever[1], lever[2]) if j == 2 else (M[0, j], M[1, j], M[2, j])
            at = (F_W_COS if j == 0 else F_W_SIN if j == 1 else F_LEVER) + 3 * k
            if j < 2 or k < 3:
                out[at], out[at + 1], out[at + 2] = (
                    d * (ay * vz - az * vy),
                    d * (az * vx - ax * vz),
                    d * (ax * vy - ay * vx),
                )


@compiled
def first_order_block(
    pose: Floats, geometry: Floats, first: int, count: int, ranges: Floats, cosines: Floats, sines: Floats, out: Floats
) -> None:
    """Centres -+ |J| d of `count` beams, as `mapper.projection.box_block` lays them out."""
    least, most, d_range = geometry[G_RANGE_MIN], geometry[G_RANGE_MAX], geometry[G_RANGE_BOUND]
    ranges, cosines, sines = ranges[first : first + count], cosines[first : first + count], sines[first : first + count]
    for i in range(3):
        low, high = B_X0 + 2 * i * LANES, B_X1 + 2 * i * LANES
        origin, constant, u_c, u_s = pose[F_CENTRE + i], pose[F_CONSTANT + i], pose[F_U_COS + i], pose[F_U_SIN + i]
        c, s = F_W_COS + i, F_W_SIN + i
        l1, l2, l3 = pose[F_LEVER + i], pose[F_LEVER + 3 + i], pose[F_LEVER + 6 + i]
        c1, c2, c3, c4 = pose[c], pose[c + 3], pose[c + 6], pose[c + 9]
        c5, c6, c7 = pose[c + 12], pose[c + 15], pose[c + 18]
        s1, s2, s3, s4 = pose[s], pose[s + 3], pose[s + 6], pose[s + 9]
        s5, s6, s7 = pose[s + 12], pose[s + 15], pose[s + 18]
        for n in range(count):
            r = ranges[n]
            r = r if (least <= r) & (r <= most) else np.nan
            rc, rs = r * cosines[n], r * sines[n]
            centre = fused(rc, u_c, fused(rs, u_s, origin))
            h = fused(d_range, abs(fused(u_c, cosines[n], u_s * sines[n])), constant)
            h += abs(fused(rc, c1, fused(rs, s1, l1)))
            h += abs(fused(rc, c2, fused(rs, s2, l2)))
            h += abs(fused(rc, c3, fused(rs, s3, l3)))
            h += abs(fused(rc, c4, rs * s4))
            h += abs(fused(rc, c5, rs * s5))
            h += abs(fused(rc, c6, rs * s6))
            h += abs(fused(rc, c7, rs * s7))
            out[low + n], out[high + n] = centre - h, centre + h


@compiled
def cosine_bounds(low: float, high: float) -> tuple[float, float]:
    """Of the cosine over [low, high]."""
    a, b = np.cos(low), np.cos(high)
    bottom, top = min(a, b), max(a, b)
    turns = 2.0 * np.pi
    if np.ceil(low / turns) * turns <= high:
        top = 1.0
    if (np.ceil((low - np.pi) / turns)) * turns + np.pi <= high:
        bottom = -1.0
    return bottom, top


@compiled
def times(a: float, b: float, c: float, d: float) -> tuple[float, float]:
    """[a, b] [c, d]."""
    ac, ad, bc, bd = a * c, a * d, b * c, b * d
    return min(min(ac, ad), min(bc, bd)), max(max(ac, ad), max(bc, bd))


@compiled
def multiply(A: Floats, B: Floats, out: Floats) -> None:
    """Interval matrices [3, 3, 2]."""
    for i in range(3):
        for j in range(3):
            low = high = 0.0
            for k in range(3):
                bottom, top = times(A[i, k, 0], A[i, k, 1], B[k, j, 0], B[k, j, 1])
                low, high = low + bottom, high + top
            out[i, j, 0], out[i, j, 1] = low, high


@compiled
def turn(axis: int, low: float, high: float, out: Floats) -> None:
    """Interval matrix [3, 3, 2] of the rotation about x, y or z (0, 1, 2) by an angle in [low, high]."""
    out[:] = 0.0
    i, j = (axis + 1) % 3, (axis + 2) % 3
    cos_low, cos_high = cosine_bounds(low, high)
    sin_low, sin_high = cosine_bounds(low - 0.5 * np.pi, high - 0.5 * np.pi)
    out[axis, axis, :] = 1.0
    for k in (i, j):
        out[k, k, 0], out[k, k, 1] = cos_low, cos_high
    out[j, i, 0], out[j, i, 1] = sin_low, sin_high
    out[i, j, 0], out[i, j, 1] = -sin_high, -sin_low


@compiled
def rotate(low: Floats, high: Floats, part: Floats, partial: Floats, out: Floats) -> None:
    """[Rz][Ry][Rx] of roll, pitch, yaw in [low, high], both [3]."""
    turn(2, low[2], high[2], part)
    turn(1, low[1], high[1], out)
    multiply(part, out, partial)
    turn(0, low[0], high[0], part)
    multiply(partial, part, out)


@compiled
def prepare_intervals(low: Floats, high: Floats, geometry: Floats, mount: Floats, work: Floats, out: Floats) -> None:
    """Fill the row `out` [I_SIZE] for a pose box; mount [3] roll, pitch, yaw; work [5, 3, 3, 2]."""
    d_mount = geometry[G_MOUNT_BOUND]
    rotate(low[3:6], high[3:6], work[0], work[1], work[2])
    rotate(mount - d_mount, mount + d_mount, work[0], work[1], work[3])
    multiply(work[2], work[3], work[4])
    for i in range(3):
        bottom, top = low[i], high[i]
        for k in range(3):
            lever, d_lever = geometry[G_LEVER + k], geometry[G_LEVER_BOUND + k]
            a, b = times(work[2, i, k, 0], work[2, i, k, 1], lever - d_lever, lever + d_lever)
            bottom, top = bottom + a, top + b
        out[I_ORIGIN + i], out[I_ORIGIN + 3 + i] = bottom, top
        out[I_COS + i], out[I_COS + 3 + i] = work[4, i, 0, 0], work[4, i, 0, 1]
        out[I_SIN + i], out[I_SIN + 3 + i] = work[4, i, 1, 0], work[4, i, 1, 1]


@compiled
def natural_block(
    pose: Floats, geometry: Floats, first: int, count: int, ranges: Floats, directions: Floats, out: Floats
) -> None:
    """Boxes by the natural interval extension; directions [4, n] low, high cosine, low, high sine."""
    least, most, d_range = geometry[G_RANGE_MIN], geometry[G_RANGE_MAX], geometry[G_RANGE_BOUND]
    ranges = ranges[first : first + count]
    c_low, c_high = directions[0, first : first + count], directions[1, first : first + count]
    s_low, s_high = directions[2, first : first + count], directions[3, first : first + count]
    for i in range(3):
        origin_low, origin_high = pose[I_ORIGIN + i], pose[I_ORIGIN + 3 + i]
        a_low, a_high, b_low, b_high = pose[I_COS + i], pose[I_COS + 3 + i], pose[I_SIN + i], pose[I_SIN + 3 + i]
        for n in range(count):
            r = ranges[n]
            r = r if (least <= r) & (r <= most) else np.nan
            u_low, u_high = times(a_low, a_high, c_low[n], c_high[n])
            v_low, v_high = times(b_low, b_high, s_low[n], s_high[n])
            low, high = times(r - d_range, r + d_range, u_low + v_low, u_high + v_high)
            out[B_X0 + 2 * i * LANES + n], out[B_X1 + 2 * i * LANES + n] = low + origin_low, high + origin_high
