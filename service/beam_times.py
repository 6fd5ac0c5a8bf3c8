"""Which pose belongs to which beam: beams shot close together share one pose box that covers all their times."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from drivers.samples import Scan

STRETCH_NS = 3_400_000
"""Beams within this time share a pose: a quarter of a mirror turn; 0.5 m/s moves 2 mm in it."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamTimes:
    """Stretches of time that cover every shot of a scan."""

    pose_index: NDArray[np.int32]
    """[n] the stretch of each beam."""
    earliest_ns: NDArray[np.int64]
    """[m] no beam of the stretch was shot before."""
    latest_ns: NDArray[np.int64]
    """[m] ... nor after."""


def beam_times(scan: Scan) -> BeamTimes:
    """Cut a scan's shots into stretches of at most STRETCH_NS, each widened by the scan's stamp."""
    pose_index, first, last = _stretches(scan.beam_offset_ns.tobytes())
    return BeamTimes(pose_index, first + scan.stamp.earliest_ns, last + scan.stamp.latest_ns)


@lru_cache(maxsize=16)
def _stretches(offsets: bytes) -> tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.int64]]:
    """The stretch [n] of each shot, first and last shot [m] of each stretch. A scanner has few patterns of shots."""
    offset = np.frombuffer(offsets, np.int64)
    times, starts, n = np.unique(offset), list[int](), 0
    while n < times.size:
        # Each stretch begins with a shot: so there are as few as can be, whatever pauses a mirror makes.
        starts.append(n)
        n = int(np.searchsorted(times, times[n] + STRETCH_NS))
    first, last = times[starts], times[[*(start - 1 for start in starts[1:]), -1]]
    stretches = (np.searchsorted(first, offset, side="right") - 1).astype(np.int32)
    stretches.flags.writeable = False
    return stretches, first, last
