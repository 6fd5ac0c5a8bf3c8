"""From a beam to a box that surely contains the point it hit: the bounds of pose_terms.py, beam by beam."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_into_callers, compiled_without_heap
from drivers.config import LaserConfig
from drivers.samples import Scan
from mapper.beam_order import STEP, BeamOrder
from mapper.fused import fused
from mapper.laser_geometry import G_RANGE_MAX, G_RANGE_MIN, Floats, laser_geometry
from mapper.pose_terms import (
    D_BOTH,
    D_MOUNT_PITCH,
    D_MOUNT_ROLL,
    D_MOUNT_YAW,
    D_PITCH,
    D_ROLL,
    D_SCAN,
    P_ASIDE,
    P_BACK,
    P_BULGE,
    P_CENTRE,
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
    Singles,
    prepare_pose,
)

# Boxes of up to LANES beams: rows of LANES numbers.
LANES = 128
B_X0, B_X1, B_Y0, B_Y1, B_Z0, B_Z1 = (row * LANES for row in range(6))
B_SIZE = 6 * LANES
B_RANGE = 6 * LANES
"""Behind the boxes: the beams' ranges, as float32."""
BOXES_SIZE = 7 * LANES
_ZERO: Any = np.float32(0.0)
_QUARTER: Any = np.float32(0.25)


@compiled_without_heap
def box_block(
    narrow: Singles, geometry: Floats, first: int, count: int, beams: Floats, directions: Singles, boxes: Singles
) -> None:
    """Boxes of `count` <= LANES beams from `first` on, all of one pose, as seen from it; NaN for want of a range.

    Lane j of the row B_X0 is boxes[B_X0 + j] [BOXES_SIZE]; a pose box's least x, added to it, is the box's least x.
    narrow: `prepare_pose`'s; beams, directions: BeamOrder's, with the ranges. Each loop runs over lanes of one type, in
    whole steps of STEP, so that the compiler makes it vector instructions without a rest: what stands behind the last
    lane is nobody's.
    """
    least, most = geometry[G_RANGE_MIN], geometry[G_RANGE_MAX]
    steps = (count + STEP - 1) & -STEP
    ranges = beams[2, first : first + steps]
    cosines, sines = directions[0, first : first + steps], directions[1, first : first + steps]
    for j in range(steps):
        r = ranges[j]
        boxes[B_RANGE + j] = np.float32(r if (least <= r) & (r <= most) else np.nan)
    for j in range(steps):
        x0, x1, y0, y1, z0, z1 = box(narrow, boxes[B_RANGE + j], cosines[j], sines[j])
        boxes[B_X0 + j], boxes[B_Y0 + j], boxes[B_Z0 + j] = x0, y0, z0
        boxes[B_X1 + j], boxes[B_Y1 + j], boxes[B_Z1 + j] = x1, y1, z1


@compiled_into_callers
def box(narrow: Singles, r: float, c: float, s: float) -> tuple[float, float, float, float, float, float]:
    """Least and most x, y, z, from the pose's on, of where a beam of range r hits whose angle has cosine c and sine s.

    All in float32.
    """
    ux = fused(narrow[P_U_COS], c, narrow[P_U_SIN] * s)
    uy = fused(narrow[P_U_COS + 1], c, narrow[P_U_SIN + 1] * s)
    uz = fused(narrow[P_U_COS + 2], c, narrow[P_U_SIN + 2] * s)
    longest, bulge, back, aside = r + narrow[P_RANGE_BOUND], narrow[P_BULGE], narrow[P_BACK], narrow[P_ASIDE]
    rc, rs, lc, ls = r * c, r * s, longest * c, longest * s
    left, up = triple(narrow, P_LEFT, rc, rs), fused(r, uz, narrow[P_LEVER_UP])
    x, y = triple(narrow, P_CENTRE, rc, rs), triple(narrow, P_CENTRE + 3, rc, rs)
    aside_x, aside_y = aside * x, aside * y
    ux, uy, uz = abs(ux), abs(uy), abs(uz)

    h = remainder(narrow, 0, r, ux, uy, uz)
    turned = fused(back, x, -aside_y)
    x0_left, x1_left = extent(narrow, X_LEFT, h, turned, up, left, rc, rs, lc, ls)
    turned = fused(back, x, aside_y)
    x0_right, x1_right = extent(narrow, X_RIGHT, h, turned, up, left, rc, rs, lc, ls)
    x0, x1 = x - farthest(x0_left, x0_right, -x, bulge), x + farthest(x1_left, x1_right, x, bulge)

    h = remainder(narrow, 1, r, ux, uy, uz)
    turned = fused(back, y, -aside_x)
    y0_left, y1_left = extent(narrow, Y_LEFT, h, turned, up, left, rc, rs, lc, ls)
    turned = fused(back, y, aside_x)
    y0_right, y1_right = extent(narrow, Y_RIGHT, h, turned, up, left, rc, rs, lc, ls)
    y0, y1 = y - farthest(y0_left, y0_right, -y, bulge), y + farthest(y1_left, y1_right, y, bulge)

    h, forward = remainder(narrow, 2, r, ux, uy, uz), triple(narrow, P_FORWARD, rc, rs)
    z, (z0, z1) = triple(narrow, P_CENTRE + 6, rc, rs), extent(narrow, Z_UP, h, _ZERO, forward, left, rc, rs, lc, ls)
    return x0, x1, y0, y1, z - z0, z + z1


@compiled_into_callers
def triple(pose: Floats | Singles, at: int, rc: float, rs: float) -> float:
    """What is linear in the point."""
    return fused(rc, pose[at], fused(rs, pose[at + 1], pose[at + 2]))


@compiled_into_callers
def extent(
    narrow: Singles,
    at: int,
    h: float,
    turned: float,
    arm: float,
    left: float,
    rc: float,
    rs: float,
    lc: float,
    ls: float,
) -> tuple[float, float]:
    """How far the point can be against a direction and along it, whatever the errors but yaw's.

    turned: by what the end of yaw moves it; arm: by what pitch does; left: by what pitch and roll together do.
    """
    mount_yaw = abs(fused(lc, narrow[at + D_MOUNT_YAW], ls * narrow[at + D_MOUNT_YAW + 1]))
    mount_pitch = abs(fused(lc, narrow[at + D_MOUNT_PITCH], ls * narrow[at + D_MOUNT_PITCH + 1]))
    scan = abs(fused(lc, narrow[at + D_SCAN], ls * narrow[at + D_SCAN + 1]))
    # Summed in pairs: no sum waits for a long row of others.
    half = (h + mount_yaw) + (mount_pitch + fused(abs(ls), narrow[at + D_MOUNT_ROLL], scan))
    # Bilinear in pitch and roll: farthest at one of the four corners, where they have one sign, or two.
    both, roll = left * narrow[at + D_BOTH], triple(narrow, at + D_ROLL, rc, rs)
    one, two = abs(fused(arm, narrow[at + D_PITCH], roll)), abs(fused(arm, narrow[at + D_PITCH], -roll))
    return (half - turned) + larger(one - both, two + both), (half + turned) + larger(one + both, two - both)


@compiled_into_callers
def larger(a: float, b: float) -> float:
    """NaN if b is."""
    return a if a > b else b


@compiled_into_callers
def remainder(narrow: Singles, i: int, r: float, ux: float, uy: float, uz: float) -> float:
    """h along x, y or z."""
    rows, shifts = P_TURN_TURN + 3 * i, P_TURN_RANGE + 3 * i
    each = fused(narrow[rows], ux, fused(narrow[rows + 1], uy, fused(narrow[rows + 2], uz, narrow[P_PER_METRE + i])))
    once = fused(narrow[shifts + 2], uz, narrow[P_CONSTANT + i])
    if i < 2:
        once = fused(narrow[shifts], ux, fused(narrow[shifts + 1], uy, once))
    return fused(r, each, once)


@compiled_into_callers
def farthest(left: float, right: float, middle: float, bulge: float) -> float:
    """How far from the middle a point can be, anywhere between the two ends of yaw."""
    most, least = larger(left, right), left if left < right else right
    return most + larger(fused(bulge, middle + most, (least - most) * _QUARTER), _ZERO)


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
    beams: Floats,
    directions: Singles,
    pose_index: NDArray[np.int32],
    pose_low: Floats,
    pose_high: Floats,
    geometry: Floats,
    work: Floats,
    poses: Floats,
    narrow: Singles,
    low: Floats,
    high: Floats,
) -> None:
    """Fill [n, 3] low and high with the box of every usable beam, NaN elsewhere."""
    for m in range(pose_low.shape[0]):
        prepare_pose(pose_low[m], pose_high[m], geometry, work, poses[m], narrow[m])
    boxes = np.empty(BOXES_SIZE, np.float32)
    low[:], high[:] = np.nan, np.nan
    first = 0
    while first < pose_index.size:
        m, count = pose_index[first], run_length(first, pose_index)
        if 0 <= m < pose_low.shape[0] and poses[m, P_USABLE] == 1.0:
            box_block(narrow[m], geometry, first, count, beams, directions, boxes)
            for j in range(count):
                for i in range(3):
                    low[first + j, i] = poses[m, P_LOW + i] + np.float64(boxes[B_X0 + 2 * i * LANES + j])
                    high[first + j, i] = poses[m, P_HIGH + i] + np.float64(boxes[B_X1 + 2 * i * LANES + j])
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
    count, order = scan.ranges_m.size, BeamOrder()
    order.arrange_unsorted(scan.angle_min_rad, scan.angle_increment_rad, count)
    order.beams[2, :count] = scan.ranges_m
    boxes = Boxes(np.empty((count, 3)), np.empty((count, 3)))
    project_beams(
        *(order.beams, order.directions, np.array(pose_index, dtype=np.int32)),
        *(np.array(low, dtype=np.float64, order="C"), np.array(high, dtype=np.float64, order="C")),
        *(laser_geometry(laser), np.empty((W_ROWS, 4))),
        *(np.empty((len(low), P_SIZE)), np.empty((len(low), P_SIZE), np.float32)),
        *(boxes.low, boxes.high),
    )
    return boxes
