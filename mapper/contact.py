"""The terrain under the tracks (the paper, section 4, last equation): where a track touches, it measures the ground.

A track's underside is cut into patches no longer than a cell. Where in base_link a patch is, and how far the ground
that it touches can be from it, is a lever arm with bounds; so the box of the point where it touches, if it does, is
that of a beam of no length. Each patch's interval is joined by hull into all cells that its footprint touches.
docs/contact.md says what that guarantees.
"""

from math import ceil
from typing import Any

import numpy as np

from drivers.compiled import compiled_without_heap
from mapper.config import ContactConfig
from mapper.footprints import Indices, locate_block
from mapper.kernel import WORK_SIZE, Bits, Cells, Counts, Flags, Keys, touch_block
from mapper.laser_geometry import G_LEVER, G_LEVER_BOUND, G_MATRIX, G_SIZE, GROW, Floats, measure_lever
from mapper.pose_terms import P_HIGH, P_LOW, P_USABLE, W_ROWS, Singles, prepare_pose
from mapper.projection import B_X0, B_X1, B_Y0, B_Y1, B_Z0, B_Z1, LANES, box

_ZERO: Any = np.float32(0.0)
_ONE: Any = np.float32(1.0)


def track_patches(contact: ContactConfig, length_m: float, gauge_m: float, resolution_m: float) -> Floats:
    """[n, G_SIZE] a geometry for each patch of both tracks: its middle, and its half sides with the ground's bound."""
    along, across = ceil(length_m / resolution_m), ceil(contact.track_width_m / resolution_m)
    half = length_m / (2 * along), contact.track_width_m / (2 * across), contact.bound_m
    x = (np.arange(along) - (along - 1) / 2) * (2 * half[0])
    y = (np.arange(across) - (across - 1) / 2) * (2 * half[1])
    patches = np.zeros((2, along, across, G_SIZE))
    patches[..., G_MATRIX : G_MATRIX + 9] = np.eye(3).ravel()
    patches[..., G_LEVER] = x[:, None]
    patches[..., G_LEVER + 1] = np.array([-gauge_m / 2, gauge_m / 2])[:, None, None] + y
    patches[..., G_LEVER_BOUND : G_LEVER_BOUND + 3] = np.array(half) * GROW + 1e-12  # the middles' rounding
    measure_lever(patches)
    return patches.reshape(-1, G_SIZE)


@compiled_without_heap
def insert_patches(
    first: int,
    patches: Floats,
    pose_low: Floats,
    pose_high: Floats,
    resolution_m: float,
    max_footprint_m: float,
    plane: int,
    scratch: Floats,
    pose: Floats,
    narrow: Singles,
    spans: Indices,
    heights: Cells,
    numbers: Counts,
    table: Indices,
    keys: Keys,
    dirty: Flags,
    pool: Cells,
    sure: Bits,
) -> int:
    """Take patches from `first` on, of tracks somewhere in the pose box [6]; the first not done, or n when all are.

    pose, narrow [P_SIZE], scratch, spans, heights: scratch; the rest as in kernel.insert_beams. What becomes of a patch
    is not counted among the beams.
    """
    work, block = scratch[:WORK_SIZE].reshape(W_ROWS, 4), scratch[WORK_SIZE:]
    for begin in range(first, patches.shape[0], LANES):
        count = min(patches.shape[0] - begin, LANES)
        for lane in range(count):
            prepare_pose(pose_low, pose_high, patches[begin + lane], work, pose, narrow)
            if pose[P_USABLE] != 1.0:
                return len(patches)
            x0, x1, y0, y1, z0, z1 = box(narrow, _ZERO, _ONE, _ZERO)
            block[B_X0 + lane], block[B_X1 + lane] = pose[P_LOW] + x0, pose[P_HIGH] + x1
            block[B_Y0 + lane], block[B_Y1 + lane] = pose[P_LOW + 1] + y0, pose[P_HIGH + 1] + y1
            block[B_Z0 + lane], block[B_Z1 + lane] = pose[P_LOW + 2] + z0, pose[P_HIGH + 2] + z1
        locate_block(count, 1.0 / resolution_m, max_footprint_m, block, spans, heights)
        done = touch_block(count, plane, False, spans, heights, numbers, table, keys, dirty, pool, sure)
        if done < count:
            return begin + done
    return len(patches)
