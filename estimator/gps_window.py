"""The sliding window: what fixes of the last stretch of the way say of yaw, place and bias now (SMF section 7).

Between remembered fixes lie blocks of preintegrated odometry (odometry_block.py). Chained backwards from now
(chaining.py) they tell how far the robot has come since each, but for yaw; and the antenna was inside each fix. What
that leaves of yaw, place and bias is paving.py's.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.fan import DIRECTIONS, add_box
from estimator.frames import turned
from estimator.interval import add, is_empty, meet
from estimator.odometry_block import extend_block
from estimator.paving import contract_by_window

MOST_FIXES = 60
"""SMF section 13."""
LEAST_SPACING_M, MOST_SPACING_M = 0.4, 2.0
"""Fixes are remembered as far apart as their own bound, within these."""


class GpsWindow:
    """Remembered fixes and the blocks between them; the last block is open and ends now."""

    def __init__(self, bias_drift: float) -> None:
        self._drift = bias_drift
        self.count = 0
        shape = (MOST_FIXES + 1,)
        self._antenna = np.zeros((*shape, 2, 2))
        self._offset = np.zeros((*shape, 2, 2))
        self._heading = np.zeros((*shape, 3))
        self._seconds = np.zeros(shape)
        self._way, self._by_bias, self._error = (
            np.zeros((*shape, 2)),
            np.zeros((*shape, 2)),
            np.zeros((*shape, DIRECTIONS)),
        )
        self._bias = np.zeros(shape)
        self._path = np.zeros(shape)
        self._last = np.full(4, np.nan)
        """Axis of the last step, and its heading's τ and ρ, in the open block; NaN before its first."""

    def clear(self) -> None:
        """Forget all fixes."""
        self.count = 0

    def extend(
        self,
        step: NDArray[np.float64],
        axis: NDArray[np.float64],
        heading: NDArray[np.float64],
        quantum: float,
        bias: NDArray[np.float64],
        now_s: float,
    ) -> None:
        """The open block goes on by one step: its box [3, 2] and its middle axis [3], along the step's heading."""
        if self.count:
            extend_block(
                self.count - 1, step, axis, heading, quantum, bias, self._drift, now_s, self._heading, self._seconds,
                self._bias, self._last, self._way, self._by_bias, self._error, self._path,
            )  # fmt: skip

    def narrowed(
        self,
        antenna: NDArray[np.float64],
        offset: NDArray[np.float64],
        heading: NDArray[np.float64],
        seconds: tuple[float, float],
        quantum: float,
        bias: NDArray[np.float64],
        yaw: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> bool:
        """Contract bias [2], yaw [2] (of the gyro node with `heading`) and place [2, 2] (of base_link) on Earth, now.

        antenna [2, 2] is the newest fix's box (east, north), offset [2, 2] where that antenna was from base_link, along
        the heading; seconds: of that gyro node, earliest and latest. False if nothing is left: some bound is broken.
        """
        k = self.count
        self._antenna[k], self._offset[k], self._heading[k], self._seconds[k] = antenna, offset, heading, seconds[0]
        return contract_by_window(
            k, self._antenna, self._offset, self._heading, self._seconds, self._way, self._by_bias,
            self._error, self._bias, seconds[1], quantum, self._drift, bias, yaw, place,
        )  # fmt: skip

    def remember(
        self,
        bias: NDArray[np.float64],
        slack: float,
        quantum: float,
        yaw: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> None:
        """Keep the fix last given to `narrowed`, if the way since the last one kept is long enough.

        Of its box only that part where the antenna can have been, by what is known of yaw [2] and place [2, 2] now.
        """
        k = self.count
        box = self._antenna[k]
        spacing = min(max(0.5 * float(np.max(box[:, 1] - box[:, 0])), LEAST_SPACING_M), MOST_SPACING_M)
        if k and self._path[k - 1] < spacing:
            return
        if k == MOST_FIXES:
            self._let_go_of_the_oldest()
        self._begin_block(bias, slack, quantum)
        antenna, offset = self._antenna[self.count - 1], self._offset[self.count - 1]
        moved = turned((yaw[0], yaw[1]), (offset[0, 0], offset[0, 1]), (offset[1, 0], offset[1, 1]))
        for axis in range(2):
            there = add((place[axis, 0], place[axis, 1]), moved[axis])
            seen = meet((antenna[axis, 0], antenna[axis, 1]), there)
            if not is_empty(seen):
                antenna[axis] = seen

    def _let_go_of_the_oldest(self) -> None:
        """Make room for one more fix."""
        for kept in (
            self._antenna, self._offset, self._heading, self._seconds, self._way, self._by_bias, self._error,
            self._bias, self._path,
        ):  # fmt: skip
            kept[:-1] = kept[1:]
        self.count -= 1

    def _begin_block(self, bias: NDArray[np.float64], slack: float, quantum: float) -> None:
        """The open block ends, and one begins at the fix last given to `narrowed`."""
        k = self.count
        if k:
            add_box(self._error[k - 1], quantum, quantum)
        self._way[k] = self._by_bias[k] = self._path[k] = self._error[k] = 0.0
        add_box(self._error[k], slack, slack)
        self._bias[k] = 0.5 * (bias[0] + bias[1])
        self._last[:] = np.nan
        self.count = k + 1
