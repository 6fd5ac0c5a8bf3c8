"""A scan's beams in the order of their poses: the kernel takes beams that share a pose in blocks.

An interlaced scan (0.5 or 0.25 degree) comes sorted by angle, so that neighbours were shot in different turns of the
mirror, from different poses. In which order beams go into the map makes no difference to it: the hull is a join.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from drivers.samples import Scan
from mapper.laser_geometry import Floats, beam_table

_FLOAT64, _INT32 = np.dtype(np.float64), np.dtype(np.int32)


class BeamOrder:
    """Keeps what scans of one pattern have in common: order, pose numbers, cosines and sines. A scanner has few."""

    def __init__(self) -> None:
        self._angles = (0, 0.0, 0.0)
        self._given: NDArray[np.int32] = np.empty(0, np.int32)
        self._order: NDArray[np.int64] | None = None
        self.directions: Floats = np.empty((2, 0))
        """[2, n] cosines and sines of the beams, in order."""
        self.pose_index: NDArray[np.int32] = np.empty(0, np.int32)
        """[n] which pose each was shot from, in order."""

    def ranges(self, scan: Scan, pose_index: NDArray[np.int32]) -> Floats:
        """The scan's distances [n], and from then on `directions` and `pose_index`, in the order of `pose_index`."""
        angles = (scan.ranges_m.size, scan.angle_min_rad, scan.angle_increment_rad)
        # What nobody can write to still holds what it held.
        known = angles == self._angles and pose_index is self._given and not pose_index.flags.writeable
        if not known:
            self._arrange(angles, pose_index)
        if self._order is None:
            return plain(scan.ranges_m, _FLOAT64)
        return np.asarray(scan.ranges_m[self._order], np.float64)

    def _arrange(self, angles: tuple[int, float, float], pose_index: NDArray[np.int32]) -> None:
        if pose_index.shape != (angles[0],):
            raise ValueError(f"need pose_index [{angles[0]}]; got {list(pose_index.shape)}")
        plainly = plain(pose_index, _INT32)
        order = None if rising(plainly) else np.argsort(plainly, kind="stable")
        if angles != self._angles or order is not None or self._order is not None:
            self.directions = np.empty((2, angles[0]))
            beam_table(angles[1], angles[2], *self.directions)
        if order is not None:
            self.directions, plainly = np.ascontiguousarray(self.directions[:, order]), plainly[order]
        self.pose_index = plainly
        self._angles, self._given, self._order = angles, pose_index, order


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
