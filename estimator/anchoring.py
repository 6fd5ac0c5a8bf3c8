"""GPS: where the map stands on Earth (the anchor), and what that says of the newest position."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from drivers.config import GpsConfig
from drivers.samples import Fix
from estimator.attitude import UNKNOWN_YAW, AttitudeChain
from estimator.bounded_pose import Anchor
from estimator.geodesy import TangentPlane
from estimator.inconsistency import Contradictions
from estimator.interval import down, meet, up
from estimator.observations import anchored, anchored_by_all, lever
from estimator.position import PositionChain

ANYWHERE_M = 1e8
REMEMBERED = 24
"""Early fixes that are applied to the anchor again and again."""
REMEMBER_EVERY_M = 0.4
STANDING_FIXES = 8


class Anchoring:
    """The anchor (t, Ψ) as a set; every fix narrows it, and through it the position."""

    def __init__(
        self,
        gps: GpsConfig | None,
        attitude: AttitudeChain,
        position: PositionChain,
        counts: Counter[str],
        contradictions: Contradictions,
    ) -> None:
        self._arm = np.array([gps.antenna_x_m, gps.antenna_y_m, gps.antenna_z_m] if gps else [0.0, 0.0, 0.0])
        self._attitude, self._position = attitude, position
        self._counts, self._contradictions = counts, contradictions
        self._plane: TangentPlane | None = None
        self._antennas, self._points = np.zeros((REMEMBERED, 3, 2)), np.zeros((REMEMBERED, 3, 2))
        self._remembered = 0
        self._anchor = np.array([[-ANYWHERE_M, ANYWHERE_M]] * 3 + [[-UNKNOWN_YAW, UNKNOWN_YAW]])

    def correct(self, fix: Fix) -> None:
        """antenna = t + Rz(Ψ)(p(τ) + R arm): contract the newest position, and the anchor (t, Ψ).

        p(τ) is the newest position less what was travelled since (SMF equation 26, with the signs kept).
        """
        places, turns, stamp = self._position.tube, self._attitude.tube, fix.stamp
        i, j, n = places.before(stamp.earliest_ns), places.after(stamp.latest_ns), places.newest
        a, b = turns.before(stamp.earliest_ns), turns.after(stamp.latest_ns)
        if i < places.begin or a < turns.begin or b >= turns.end:
            self._counts["fix_too_old"] += 1
            return
        if self._plane is None:
            self._plane = TangentPlane(fix.lat_deg, fix.lon_deg, fix.alt_m)
        arm = np.empty((3, 2))
        lever(turns.hull(a, b), self._arm, arm)
        since = self._position.travelled_since(i, j, n)
        offset = _outward(arm[:, 0] - since[:, 1], arm[:, 1] - since[:, 0])
        here = places.box[n]
        point = _outward(here[:, 0] + offset[:, 0], here[:, 1] + offset[:, 1])
        anchor, points, antenna = self._anchor.copy(), self._points.copy(), self._plane.antenna(fix)
        agree = anchored_by_all(self._antennas, points, self._remembered, anchor)
        if not agree or not anchored(antenna, anchor, point):
            self._contradictions.report("gps", stamp.mid_ns)
            return
        narrowed = np.empty((3, 2))
        for c in range(3):
            seen = (down(point[c, 0] - offset[c, 1]), up(point[c, 1] - offset[c, 0]))
            narrowed[c] = meet((here[c, 0], here[c, 1]), seen)
        if np.any(narrowed[:, 0] > narrowed[:, 1]):
            self._contradictions.report("gps", stamp.mid_ns)
            return
        self._anchor, self._points = anchor, points
        self._remember(antenna, point)
        self._position.contract(narrowed)

    def _remember(self, antenna: NDArray[np.float64], point: NDArray[np.float64]) -> None:
        """Keep the first fixes for later: where the robot stood at first, then one every little way."""
        k = self._remembered
        if k == REMEMBERED:
            return
        if k >= STANDING_FIXES:
            way = np.abs(np.mean(point - self._points[k - 1], axis=1))
            if max(way[0], way[1]) < REMEMBER_EVERY_M:
                return
        self._antennas[k], self._points[k] = antenna, point
        self._remembered += 1

    def anchor(self) -> Anchor | None:
        """Where the map frame stands on Earth; None before the first fix."""
        if self._plane is None or self._anchor[0, 1] >= ANYWHERE_M:
            return None
        plane = self._plane
        low, high = self._anchor[:, 0].copy(), self._anchor[:, 1].copy()
        return Anchor(plane.lat_deg, plane.lon_deg, plane.alt_m, low, high, self._contradictions.guarantee)


def _outward(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n, 2] intervals from their rounded ends."""
    return np.stack([np.nextafter(low, -np.inf), np.nextafter(high, np.inf)], axis=1)
