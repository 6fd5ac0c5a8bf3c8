"""From a beam to the mean and the covariance of the point it hit: what the mixture and the Kalman map are made of.

The point model is the map's own (mapper/pose_terms.py); errors are independent Gaussians, except those of the pose,
whose covariance [6, 6] is whole. First order, as both papers have it: P = J diag(P_q, ...) J' (BASELINES 3.1).

For one pose, p = t + R l + (r cos th) a + (r sin th) b, and every column of J is linear in r cos th and r sin th. So
each of the six entries of P is a polynomial of nine terms, whose coefficients all beams of a pose share.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from mapper.beam_order import STEP
from mapper.fused import fused
from mapper.laser_geometry import (
    G_ACROSS_BOUND,
    G_LEVER,
    G_LEVER_BOUND,
    G_MOUNT_BOUND,
    G_PITCH_AXIS,
    G_RANGE_BOUND,
    G_RANGE_MAX,
    G_RANGE_MIN,
    G_SCAN_BOUND,
)
from mapper.projection import LANES

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

THREE_SIGMA = 3.0
"""The declared bound is taken for three standard deviations ..."""
UNIFORM = sqrt(3.0)
"""... or for the half-width of a uniform distribution, whose standard deviation is this much smaller."""

ENTRIES = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
"""xx, xy, yy, xz, yz, zz: the order of the six entries of P."""
_ROW, _COLUMN = (np.array(indices) for indices in zip(*ENTRIES, strict=True))

# What all beams of one pose share: one row of float64.
Q_CENTRE = 0  # t + R l
Q_U_COS = 3
Q_U_SIN = 6
Q_TERMS = 9  # nine rows of the six entries: 1, rc, rs, rc^2, rc rs, rs^2, c^2, c s, s^2 (r range, c and s of the angle)
Q_SIZE = Q_TERMS + 9 * len(ENTRIES)
_ONE, _RC, _RS, _RC_RC, _RC_RS, _RS_RS, _CC, _CS, _SS = (Q_TERMS + 6 * term for term in range(9))

# Scratch of prepare_gaussian, rows of six.
_R = 0
_M = 3  # R Rm
_A = 6  # three 3 x 3: a_k x R l, a_k x a, a_k x b; a column an axis (roll, pitch, yaw)
_T = 15  # [18, 3] in [9, 6]: P_q D'
W_GAUSS = 24

# Points of up to LANES beams: rows of LANES numbers.
N_CENTRE = 0  # x, y, z
N_SIZE = 3 * LANES
# In float32, as half-widths are in the map's kernel: the six entries of P, and what they are made of.
N_P = 0
N_RANGE = 6 * LANES
N_SPREADS = 7 * LANES


@compiled
def prepare_gaussian(
    mean: Floats, covariance: Floats, geometry: Floats, bound_sigmas: float, work: Floats, out: Floats, narrow: Singles
) -> None:
    """Fill the row `out` [Q_SIZE] for the pose N(mean [6], covariance [6, 6]); `work` is [W_GAUSS, 6].

    narrow: the same row as float32. Every bound of the laser's geometry is taken for `bound_sigmas` standard
    deviations.
    """
    roll, pitch, yaw = mean[3], mean[4], mean[5]
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    R, M = work[_R : _R + 3], work[_M : _M + 3]
    R[0, 0], R[0, 1], R[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    R[1, 0], R[1, 1], R[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    R[2, 0], R[2, 1], R[2, 2] = -sp, cp * sr, cp * cr
    for i in range(3):
        for j in range(3):
            M[i, j] = R[i, 0] * geometry[j] + R[i, 1] * geometry[3 + j] + R[i, 2] * geometry[6 + j]
        arm = R[i, 0] * geometry[G_LEVER] + R[i, 1] * geometry[G_LEVER + 1] + R[i, 2] * geometry[G_LEVER + 2]
        out[Q_CENTRE + i], R[i, 3] = mean[i] + arm, arm
        out[Q_U_COS + i], out[Q_U_SIN + i] = M[i, 0], M[i, 1]

    # D_m = [I or 0 | A_m]: what the point moves with the pose, for m = 0 (constant), 1 (times rc), 2 (times rs).
    for k in range(3):
        ax, ay, az = (R[0, 0], R[1, 0], R[2, 0]) if k == 0 else (-sy, cy, 0.0) if k == 1 else (0.0, 0.0, 1.0)
        for m in range(3):
            vx, vy, vz = (R[0, 3], R[1, 3], R[2, 3]) if m == 0 else (M[0, m - 1], M[1, m - 1], M[2, m - 1])
            A = work[_A + 3 * m : _A + 3 * m + 3]
            A[0, k], A[1, k], A[2, k] = ay * vz - az * vy, az * vx - ax * vz, ax * vy - ay * vx
    T = work[_T:].reshape(18, 3)
    for m in range(3):
        A = work[_A + 3 * m : _A + 3 * m + 3]
        for q in range(6):
            p3, p4, p5 = covariance[q, 3], covariance[q, 4], covariance[q, 5]
            for i in range(3):
                shift = covariance[q, i] if m == 0 else 0.0
                T[6 * m + q, i] = shift + p3 * A[i, 0] + p4 * A[i, 1] + p5 * A[i, 2]

    share = 1.0 / bound_sigmas**2
    mount, along = share * geometry[G_MOUNT_BOUND] ** 2, share * geometry[G_SCAN_BOUND] ** 2
    across, distance = share * geometry[G_ACROSS_BOUND] ** 2, share * geometry[G_RANGE_BOUND] ** 2
    for e in range(6):
        i, j = _ROW[e], _COLUMN[e]
        one = _product(work, T, 0, 0, i, j)
        for k in range(3):
            one += share * geometry[G_LEVER_BOUND + k] ** 2 * R[i, k] * R[j, k]
        out[_ONE + e] = one
        out[_RC + e] = _product(work, T, 0, 1, i, j) + _product(work, T, 0, 1, j, i)
        out[_RS + e] = _product(work, T, 0, 2, i, j) + _product(work, T, 0, 2, j, i)
        # Rotations of the mounting turn w = rc a + rs b alone; across the scan the beam moves by r n.
        out[_RC_RC + e] = _product(work, T, 1, 1, i, j) + across * M[i, 2] * M[j, 2]
        out[_RC_RS + e] = _product(work, T, 1, 2, i, j) + _product(work, T, 1, 2, j, i)
        out[_RS_RS + e] = _product(work, T, 2, 2, i, j) + across * M[i, 2] * M[j, 2]
        out[_CC + e] = distance * M[i, 0] * M[j, 0]
        out[_CS + e] = distance * (M[i, 0] * M[j, 1] + M[i, 1] * M[j, 0])
        out[_SS + e] = distance * M[i, 1] * M[j, 1]
    for k in range(4):
        variance = along if k == 3 else mount
        for i in range(3):
            pitch_axis = R[i, 0] * geometry[G_PITCH_AXIS] + R[i, 1] * geometry[G_PITCH_AXIS + 1]
            R[i, 3] = R[i, 2] if k == 0 else pitch_axis if k == 1 else M[i, 0] if k == 2 else M[i, 2]
        A = work[_A : _A + 3]
        for m in range(2):
            A[0, m] = R[1, 3] * M[2, m] - R[2, 3] * M[1, m]
            A[1, m] = R[2, 3] * M[0, m] - R[0, 3] * M[2, m]
            A[2, m] = R[0, 3] * M[1, m] - R[1, 3] * M[0, m]
        for e in range(6):
            i, j = _ROW[e], _COLUMN[e]
            out[_RC_RC + e] += variance * A[i, 0] * A[j, 0]
            out[_RC_RS + e] += variance * (A[i, 0] * A[j, 1] + A[i, 1] * A[j, 0])
            out[_RS_RS + e] += variance * A[i, 1] * A[j, 1]
    for k in range(Q_SIZE):
        narrow[k] = np.float32(out[k])


@compiled
def _product(work: Floats, T: Floats, m: int, n: int, i: int, j: int) -> float:
    """Entry i, j of D_m P_q D_n'."""
    A, at = work[_A + 3 * m : _A + 3 * m + 3], 6 * n
    shift = T[at + i, j] if m == 0 else 0.0
    entry: float = shift + A[i, 0] * T[at + 3, j] + A[i, 1] * T[at + 4, j] + A[i, 2] * T[at + 5, j]
    return entry


@compiled
def point_block(
    pose: Floats,
    narrow: Singles,
    geometry: Floats,
    first: int,
    count: int,
    beams: Floats,
    directions: Singles,
    out: Floats,
    spreads: Singles,
) -> None:
    """Mean [N_SIZE] and covariance [N_SPREADS] of `count` <= LANES points from beam `first` on, all of one pose.

    beams, directions: BeamOrder's, with the ranges. A lane without a usable range holds the point of range zero: nobody
    reads it. As in the map's kernel each loop is of one type and takes whole vectors.
    """
    least, most = geometry[G_RANGE_MIN], geometry[G_RANGE_MAX]
    steps = (count + STEP - 1) & -STEP
    cosines, sines, ranges = beams[0, first:][:steps], beams[1, first:][:steps], beams[2, first:][:steps]
    for n in range(steps):
        r = ranges[n]
        r = r if (least <= r) & (r <= most) else 0.0
        rc, rs = r * cosines[n], r * sines[n]
        for i in range(3):
            centre = fused(rc, pose[Q_U_COS + i], fused(rs, pose[Q_U_SIN + i], pose[Q_CENTRE + i]))
            out[N_CENTRE + i * LANES + n] = centre
        spreads[N_RANGE + n] = np.float32(r)
    narrow_cosines, narrow_sines = directions[0, first:][:steps], directions[1, first:][:steps]
    for n in range(steps):
        r, c, s = spreads[N_RANGE + n], narrow_cosines[n], narrow_sines[n]
        rc, rs = r * c, r * s
        for e in range(6):
            p = fused(rc, narrow[_RC_RC + e], fused(rs, narrow[_RC_RS + e], narrow[_RC + e]))
            p = fused(rc, p, fused(rs, fused(rs, narrow[_RS_RS + e], narrow[_RS + e]), narrow[_ONE + e]))
            p = fused(c, fused(c, narrow[_CC + e], s * narrow[_CS + e]), fused(s * s, narrow[_SS + e], p))
            spreads[N_P + e * LANES + n] = p
