"""Interlaced scans: neighbouring beams were shot from different poses."""

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.bench_kernel import LASER, rough_scan
from mapper.beam_order import BeamOrder
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.saved_map import SavedMap, assemble

POSES = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.1], [0.3, 0.1, 0.0, 0.0, 0.05, -0.2], [0.6, -0.4, 0.1, 0.1, 0.0, 0.4]])
HALF = np.array([0.02, 0.02, 0.01, 0.003, 0.003, 0.01])


def mapped(*indices: NDArray[np.int32]) -> SavedMap:
    """The map after one scan for each way of dealing its beams to poses; -1 leaves a beam out."""
    terrain, scan = ElevationMap(MapConfig(resolution_m=0.05), LASER), rough_scan()
    for index in indices:
        terrain.insert(scan, POSES - HALF, POSES + HALF, index)
    return assemble(terrain.tiles(), 0.05, "map")


def test_an_interlaced_scan_makes_the_map_that_its_poses_make_one_by_one() -> None:
    """Every third beam from another pose, writable or not, once and again: bit for bit what three part scans make."""
    interlaced = np.arange(721, dtype=np.int32) % 3
    locked = interlaced.copy()
    locked.flags.writeable = False
    parts = mapped(*(np.where(interlaced == pose, pose, -1).astype(np.int32) for pose in range(3)))
    for dealt in ((interlaced,), (locked,), (locked, locked), (interlaced, locked, interlaced)):
        whole = mapped(*dealt)
        assert whole.low.tobytes() == parts.low.tobytes()
        assert whole.high.tobytes() == parts.high.tobytes()


def test_a_pattern_that_changes_in_place_is_noticed() -> None:
    """The same array with other numbers in it is another pattern."""
    order, scan, index = BeamOrder(), rough_scan(), np.arange(721, dtype=np.int32) % 2
    order.arrange(scan, index)
    index[:] = 1 - index
    order.arrange(scan, index)
    assert np.array_equal(order.order, np.concatenate([np.arange(1, 721, 2), np.arange(0, 721, 2)]))
    assert np.array_equal(order.pose_index, np.sort(index))


def test_a_pattern_of_another_length_is_refused() -> None:
    """A pose number for each beam, or an error that says how many."""
    with pytest.raises(ValueError, match=r"need pose_index \[721\]; got \[720\]"):
        BeamOrder().arrange(rough_scan(), np.zeros(720, np.int32))
