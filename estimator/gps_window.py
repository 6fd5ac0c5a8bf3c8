"""The sliding window: what fixes of the last stretch of the way say of yaw, place and bias now (SMF section 7).

Between remembered fixes lie blocks of preintegrated odometry (odometry_block.py). Chained backwards from now
(chaining.py) they tell how far the robot has come since each, but for yaw; and the antenna was inside each fix. What
that leaves of yaw, place and bias is paving.py's.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.fan import less
from estimator.frames import turned
from estimator.interval import add, is_empty, meet
from estimator.odometry_block import BLOCK, Blocks, empty_block, extend_two_blocks, follow_block, put_fix
from estimator.paving import contract_by_window
from estimator.place_by_yaw import PlaceByYaw
from estimator.slip_ledger import Mark, SlipLedger

MOST_FIXES = 60
"""SMF section 13."""
RECENT = MOST_FIXES + 1
"""The row of the block since the last fix that was used, remembered or not; the next row is now's."""
LEAST_SPACING_M, MOST_SPACING_M = 0.4, 2.0
"""Fixes are remembered as far apart as their own bound, within these."""


class GpsWindow:
    """Remembered fixes and the blocks between them; the last block is open and ends now."""

    def __init__(self, bias_drift: float, ledger: SlipLedger | None = None) -> None:
        """`ledger`: of the tracks; None: they are taken to slip alike."""
        self._drift, self._ledger = bias_drift, ledger
        self.count = 0
        self._blocks: Blocks = np.zeros(RECENT + 2, BLOCK)
        """Those between the remembered fixes, then now's; the recent one, and now's again."""
        self._since: list[Mark | None] = [None, None]
        """Where the open block begins, and the recent one."""
        self._places = PlaceByYaw()
        """By all fixes, from one to the next."""

    def clear(self) -> None:
        """Forget all fixes."""
        self.count = 0
        self._places.clear()

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
            extend_two_blocks(
                self.count - 1, RECENT, step, axis, heading, quantum, bias, self._drift, now_s, self._blocks
            )

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
        if k:
            self._settle(k - 1, self._since[0])
        put_fix(self._blocks, k, antenna, offset, heading, seconds[0])
        left = contract_by_window(k, self._blocks, seconds[1], quantum, self._drift, bias, yaw, place)
        return left and self._by_yaw(quantum, seconds[1], bias, yaw, place)

    def _by_yaw(
        self,
        quantum: float,
        now_s: float,
        bias: NDArray[np.float64],
        yaw: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> bool:
        """Contract yaw [2] and place [2, 2], which the newest fix has, by where the last ones leave the robot."""
        self._settle(RECENT, self._since[1])
        self._blocks["heading"][RECENT + 1] = self._blocks["heading"][self.count]
        return self._places.narrowed(self._blocks[RECENT:], now_s, quantum, self._drift, bias, yaw, place)

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
        The polygons go on from every fix.
        """
        k = self.count
        self._go_on_from(bias, slack, quantum, yaw, place)
        box = self._blocks["antenna"][k]
        half_width = 0.5 * max(box[0, 1] - box[0, 0], box[1, 1] - box[1, 0])
        spacing = min(max(half_width, LEAST_SPACING_M), MOST_SPACING_M)
        if k and self._blocks["path"][k - 1] < spacing:
            return
        if k == MOST_FIXES:
            self._let_go_of_the_oldest()
        self._begin_block(bias, slack, quantum)
        antenna, offset = self._blocks["antenna"][self.count - 1], self._blocks["offset"][self.count - 1]
        moved = turned((yaw[0], yaw[1]), (offset[0, 0], offset[0, 1]), (offset[1, 0], offset[1, 1]))
        for axis in range(2):
            there = add((place[axis, 0], place[axis, 1]), moved[axis])
            seen = meet((antenna[axis, 0], antenna[axis, 1]), there)
            if not is_empty(seen):
                antenna[axis] = seen

    def _settle(self, k: int, since: Mark | None) -> None:
        """The error of a block that is open as it is now."""
        of = self._blocks
        less(of["raw"][k], of["least"][k], self._ledger.credit(since) if self._ledger else 0.0, of["error"][k])

    def _go_on_from(
        self,
        bias: NDArray[np.float64],
        slack: float,
        quantum: float,
        yaw: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> None:
        """The way begins anew, at the fix last given to `narrowed`, which left the robot in place [2, 2]."""
        self._places.go_on(quantum, yaw, place)
        for name in ("heading", "seconds"):
            self._blocks[name][RECENT] = self._blocks[name][self.count]
        empty_block(self._blocks, RECENT, bias, slack)
        self._blocks["last"][RECENT] = 1.0, 0.0, *self._blocks["heading"][RECENT][1:]
        self._since[1] = self._mark()

    def _let_go_of_the_oldest(self) -> None:
        """Make room for one more fix."""
        self._blocks[:MOST_FIXES] = self._blocks[1 : MOST_FIXES + 1]
        self.count -= 1

    def _begin_block(self, bias: NDArray[np.float64], slack: float, quantum: float) -> None:
        """The open block ends, and one begins at the fix last given to `narrowed`."""
        k = self.count
        if k:
            self._settle(k - 1, self._since[0])
        follow_block(self._blocks, k, bias, slack, quantum)
        self._since[0] = self._mark()
        self.count = k + 1

    def _mark(self) -> Mark | None:
        """A block begins at the newest count."""
        return self._ledger.mark() if self._ledger else None
