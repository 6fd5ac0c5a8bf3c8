"""GPS some of whose fixes may be wrong: only what most of a window agree on says anything (`[filter] wrong_fixes`)."""

import numpy as np
from numpy.typing import NDArray

from drivers.samples import Fix
from estimator.anchoring import Anchoring, Narrowed
from estimator.position import EARTH


class RelaxedAnchoring(Anchoring):
    """As Anchoring, but no single fix touches pose or anchor: the anchor learns from the place on Earth alone."""

    def _along(self, now: Narrowed, fix: Fix, i: int, j: int, wider: float) -> bool:
        """A wrong fix's velocity may be wrong as well."""
        return True

    def _on_earth(self, now: Narrowed, offset: NDArray[np.float64], around: int) -> bool:
        """SMF section 7.5: contract yaw and place on Earth by all but some of the window's fixes."""
        turns = self._attitude.tube
        seconds = int(turns.times[around, 0]) * 1e-9, int(turns.times[turns.newest, 1]) * 1e-9
        return self._position.window.narrowed(
            now.antenna, offset, turns.heading[turns.newest], seconds, self._position.quantum,
            now.bias, now.yaws[1], now.box[EARTH],
        )  # fmt: skip

    def _in_map(self, now: Narrowed, offset: NDArray[np.float64]) -> bool:
        """Nothing beyond what ties the pose in the map to that on Earth."""
        return True

    def _remember(self, now: Narrowed, offset: NDArray[np.float64]) -> None:
        """No fix of the beginning is trusted alone either."""
