"""A scan's beams in the order of their poses: the kernel takes beams that share a pose in blocks.

An interlaced scan (0.5 or 0.25 degree) comes sorted by angle, so that neighbours were shot in different turns of the
mirror, from different poses. In which order beams go into the map makes no difference to it: the hull is a join.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_into_callers
from drivers.samples import Scan
from mapper.bound_arrays import bind
from mapper.laser_geometry import Floats, beam_table

_INT32 = np.dtype(np.int32)
STEP = 8
"""So many beams are taken at once: a vector of float32."""
# Where each array is among the bound ones.
BY_ORDER, BY_POSE, BY_BEAM, BY_DIRECTION = range(4)


class BeamOrder:
    """Keeps what scans of one pattern have in common: order, pose numbers, cosines and sines. A scanner has few."""

    def __init__(self) -> None:
        self._size, self._first_rad, self._step_rad, self._in_order = 0, 0.0, 0.0, True
        self._known: NDArray[np.int32] | None = None
        """The pattern of poses that all is arranged for, if nobody can write to it."""
        self.order: NDArray[np.uint32] = np.empty(0, np.uint32)
        """[n] numbers of the beams, in order."""
        self.pose_index: NDArray[np.int32] = np.empty(0, np.int32)
        """[n] which pose each was shot from, in order."""
        self.beams, self.directions = _tables(0.0, 0.0, 0)
        """[3, n + STEP] cosines and sines of the beams, in order, and room for their ranges: for `put_in_order`. And
        [2, n + STEP] the former as float32. What stands behind n is anything: whole vectors can be read."""
        self.bound = bind(self.order, self.pose_index, self.beams, self.directions)
        """All four for compiled code, as BY_ORDER and so on say."""

    def arrange(self, scan: Scan, pose_index: NDArray[np.int32]) -> None:
        """Bring `order`, `pose_index` and `beams` into the order of the scan's pose numbers."""
        if (
            pose_index is not self._known
            or scan.ranges_m.size != self._size
            or scan.angle_min_rad != self._first_rad
            or scan.angle_increment_rad != self._step_rad
        ):
            self._arrange(scan, pose_index)

    def _arrange(self, scan: Scan, pose_index: NDArray[np.int32]) -> None:
        beams, first, step = scan.ranges_m.size, scan.angle_min_rad, scan.angle_increment_rad
        if pose_index.shape != (beams,):
            raise ValueError(f"need pose_index [{beams}]; got {list(pose_index.shape)}")
        plainly = plain(pose_index, _INT32)
        sorted_already = rising(plainly)
        same_angles = (beams, first, step) == (self._size, self._first_rad, self._step_rad)
        if not (same_angles and sorted_already and self._in_order):
            self.arrange_unsorted(first, step, beams)
        if not sorted_already:
            order = np.argsort(plainly, kind="stable")
            self.order, plainly = order.astype(np.uint32), plainly[order]
            for table in self.beams, self.directions:
                table[:2, :beams] = table[:2, order]
        self.pose_index, self._in_order = plainly, sorted_already
        self._size, self._first_rad, self._step_rad = beams, first, step
        self.bound = bind(self.order, self.pose_index, self.beams, self.directions)
        # What nobody can write to still holds what it held.
        self._known = None if pose_index.flags.writeable else pose_index

    def arrange_unsorted(self, first_rad: float, step_rad: float, beams: int) -> None:
        """Bring `order`, `beams` and `directions` into the order of the scan."""
        self.order = np.arange(beams, dtype=np.uint32)
        self.beams, self.directions = _tables(first_rad, step_rad, beams)


def _tables(first_rad: float, step_rad: float, beams: int) -> tuple[Floats, NDArray[np.float32]]:
    table = np.zeros((3, beams + STEP))
    beam_table(first_rad, step_rad, table[0], table[1])
    return table, table[:2].astype(np.float32)


@compiled_into_callers
def put_in_order(ranges: Floats, order: NDArray[np.int32], ordered: Floats) -> None:
    """A scan's distances [n] in order."""
    for n in range(order.size):
        ordered[n] = ranges[np.uint32(order[n])]


@compiled
def rising(numbers: NDArray[np.int32]) -> bool:
    """Does no number stand before a smaller one?"""
    falls = False
    for n in range(1, numbers.size):
        falls |= numbers[n] < numbers[n - 1]
    return not falls


def plain(array: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The array as the compiled code knows it: another layout, type or a read-only one would compile again, live."""
    if array.dtype is dtype and array.flags.carray:
        return array
    return np.array(array, dtype=dtype, order="C")
