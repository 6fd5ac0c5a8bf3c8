"""Pure box propagation: the default filter without its window of fixes, as a measure of what the window is worth.

No setting of the filter does this; nobody should want it on a robot.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from estimator.ellipsoidal_position import NewestFixOnly
from estimator.pose_set import POSITION_CHAINS
from estimator.position import PositionChain


class PureBox(PositionChain):
    """Boxes, and each fix for itself."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.window = NewestFixOnly(self._attitude.gyro.bias_drift)


@contextmanager
def without_window() -> Iterator[None]:
    """Filters that are made meanwhile have no window."""
    default = POSITION_CHAINS["box"]
    POSITION_CHAINS["box"] = PureBox
    try:
        yield
    finally:
        POSITION_CHAINS["box"] = default
