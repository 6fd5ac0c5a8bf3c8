"""From a beam to a box that surely contains the point it hit: the bounds of pose_terms.py, beam by beam."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_into_callers, compiled_without_heap
from drivers.config import LaserConfig
from drivers.samples import Scan
from mapper.fused import fused
from mapper.laser_geometry import G_RANGE_MAX, G_RANGE_MIN, Floats, beam_table, laser_geometry
from mapper.pose_terms import (
    D_BOTH,
    D_CENTRE,
    D_MOUNT_PITCH,
    D_MOUNT_ROLL,
    D_MOUNT_YAW,
    D_PITCH,
    D_ROLL,
    D_SCAN,
    P_BULGE,
    P_CONSTANT,
    P_FORWARD,
    P_HIGH,
    P_LEFT,
    P_LEVER_UP,
    P_LOW,
    P_PER_METRE,
    P_RANGE_BOUND,
    P_SIZE,
    P_TURN_RANGE,
    P_TURN_TURN,
    P_U_COS,
    P_U_SIN,
    P_USABLE,
    W_ROWS,
    X_LEFT,
    X_RIGHT,
    Y_LEFT,
    Y_RIGHT,
    Z_UP,
    prepare_pose,
)

# Boxes of up to LANES beams: rows of LANES numbers.
LANES = 128
B_X0, B_X1, B_Y0, B_Y1, B_Z0, B_Z1 = (row * LANES for row in range(6))
B_SIZE = 6 * LANES


@compiled_without_heap
def box_block(
    pose: Floats, geometry: Floats, first: int, count: int, ranges: Floats, cosines: Floats, sines: Floats, out: Floats
) -> None:
    """Boxes of `count` <= LANES beams from `first` on, all of one pose, into `out` [B_SIZE]; NaN for want of a range.

    Lane j of the row B_X0 is out[B_X0 + j]. The loop runs over the lanes, so that the compiler makes it vector
    instructions.
    """
    least, most = geometry[G_RANGE_MIN], geometry[G_RANGE_MAX]
    ranges, cosines, sines = ranges[first : first + count], cosines[first : first + count], sines[first : first + count]
    for j in range(count):
        r = ranges[j]
        r = r if (least <= r) & (r <= most) else np.nan
        x0, x1, y0, y1, z0, z1 = box(pose, r, cosines[j], sines[j])
        out[B_X0 + j], out[B_Y0 + j], out[B_Z0 + j] = x0, y0, z0
        out[B_X1 + j], out[B_Y1 + j], out[B_Z1 + j] = x1, y1, z1


@compiled_into_callers
def box(pose: Floats, r: float, c: float, s: float) -> tuple[float, float, float, float, float, float]:
    """Least and most x, y, z of where a beam of range r hits whose angle has cosine c and sine s."""
    ux = fused(pose[P_U_COS], c, pose[P_U_SIN] * s)
    uy = fused(pose[P_U_COS + 1], c, pose[P_U_SIN + 1] * s)
    uz = fused(pose[P_U_COS + 2], c, pose[P_U_SIN + 2] * s)
    longest, bulge = r + pose[P_RANGE_BOUND], pose[P_BULGE]
    rc, rs, lc, ls = r * c, r * s, longest * c, longest * s
    left, up = triple(pose, P_LEFT, rc, rs), fused(r, uz, pose[P_LEVER_UP])
    ux, uy, uz = abs(ux), abs(uy), abs(uz)

    h = remainder(pose, 0, r, ux, uy, uz)
    x0_left, x1_left = extent(pose, X_LEFT, h, up, left, rc, rs, lc, ls)
    x0_right, x1_right = extent(pose, X_RIGHT, h, up, left, rc, rs, lc, ls)
    x0 = pose[P_LOW] - farthest(x0_left, x0_right, bulge)
    x1 = pose[P_HIGH] + farthest(x1_left, x1_right, bulge)

    h = remainder(pose, 1, r, ux, uy, uz)
    y0_left, y1_left = extent(pose, Y_LEFT, h, up, left, rc, rs, lc, ls)
    y0_right, y1_right = extent(pose, Y_RIGHT, h, up, left, rc, rs, lc, ls)
    y0 = pose[P_LOW + 1] - farthest(y0_left, y0_right, bulge)
    y1 = pose[P_HIGH + 1] + farthest(y1_left, y1_right, bulge)

    z0, z1 = extent(
        pose, Z_UP, remainder(pose, 2, r, ux, uy, uz), triple(pose, P_FORWARD, rc, rs), left, rc, rs, lc, ls
    )
    return x0, x1, y0, y1, pose[P_LOW + 2] - z0, pose[P_HIGH + 2] + z1


@compiled_into_callers
def triple(pose: Floats, at: int, rc: float, rs: float) -> float:
    """What is linear in the point."""
    return fused(rc, pose[at], fused(rs, pose[at + 1], pose[at + 2]))


@compiled_into_callers
def extent(
    pose: Floats, at: int, h: float, arm: float, left: float, rc: float, rs: float, lc: float, ls: float
) -> tuple[float, float]:
    """How far the point can be against a direction and along it, whatever the errors but yaw's.

    arm: by what pitch moves it; left: by what pitch and roll together do.
    """
    mount_yaw = abs(fused(lc, pose[at + D_MOUNT_YAW], ls * pose[at + D_MOUNT_YAW + 1]))
    mount_pitch = abs(fused(lc, pose[at + D_MOUNT_PITCH], ls * pose[at + D_MOUNT_PITCH + 1]))
    scan = abs(fused(lc, pose[at + D_SCAN], ls * pose[at + D_SCAN + 1]))
    # Summed in pairs: no sum waits for a long row of others.
    half = (h + mount_yaw) + (mount_pitch + fused(abs(ls), pose[at + D_MOUNT_ROLL], scan))
    # Bilinear in pitch and roll: farthest at one of the four corners, where they have one sign, or two.
    centre, roll = triple(pose, at + D_CENTRE, rc, rs), triple(pose, at + D_ROLL, rc, rs)
    one, two = fused(left, pose[at + D_BOTH], centre), fused(-left, pose[at + D_BOTH], centre)
    one_turn, two_turn = abs(fused(arm, pose[at + D_PITCH], roll)), abs(fused(arm, pose[at + D_PITCH], -roll))
    return half + larger(one_turn - one, two_turn - two), half + larger(one_turn + one, two_turn + two)


@compiled_into_callers
def larger(a: float, b: float) -> float:
    """NaN if b is."""
    return a if a > b else b


@compiled_into_callers
def remainder(pose: Floats, i: int, r: float, ux: float, uy: float, uz: float) -> float:
    """h along x, y or z."""
    rows, shifts = P_TURN_TURN + 3 * i, P_TURN_RANGE + 3 * i
    each = fused(pose[rows], ux, fused(pose[rows + 1], uy, fused(pose[rows + 2], uz, pose[P_PER_METRE + i])))
    once = fused(pose[shifts + 2], uz, pose[P_CONSTANT + i])
    if i < 2:
        once = fused(pose[shifts], ux, fused(pose[shifts + 1], uy, once))
    return fused(r, each, once)


@compiled_into_callers
def farthest(left: float, right: float, bulge: float) -> float:
    """How far a point can be, anywhere between the two ends of yaw."""
    most, least = larger(left, right), left if left < right else right
    return larger(fused(bulge, most, 0.25 * least), most)


@compiled_without_heap
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
                for i in range(3):
                    low[first + j, i] = block[B_X0 + 2 * i * LANES + j]
                    high[first + j, i] = block[B_X1 + 2 * i * LANES + j]
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
