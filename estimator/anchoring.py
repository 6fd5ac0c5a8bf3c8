"""GPS: where the map stands on Earth (the anchor), and what that says of the newest position."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from drivers.config import GpsConfig
from drivers.samples import Fix
from estimator.antenna_offset import antenna_offsets
from estimator.attitude import AttitudeChain, radians_of
from estimator.bounded_pose import Anchor
from estimator.geodesy import TangentPlane
from estimator.ground_velocity import off_mean, way_along, yaw_by_velocity
from estimator.inconsistency import Journal, least_excess
from estimator.interval import add, down, is_empty, meet, sub, up
from estimator.motion import UNKNOWN_YAW
from estimator.observations import anchored, anchored_by_all, nearest_copy, tied
from estimator.position import ANYWHERE_M, EARTH, MAP, PositionChain

REMEMBERED = 24
"""Early fixes that are applied to the anchor again and again."""
REMEMBER_EVERY_M = 0.4
STANDING_FIXES = 8


class Narrowed(NamedTuple):
    """A copy of what a fix may narrow."""

    box: NDArray[np.float64]
    """[6, 2] the newest place, in the map and on Earth."""
    yaws: NDArray[np.float64]
    """[2, 2] the newest yaw, in the map and on Earth."""
    bias: NDArray[np.float64]
    """[2] the gyroscope's about z."""
    anchor: NDArray[np.float64]
    """[4, 2]"""
    points: NDArray[np.float64]
    """[k, 3, 2] where the antenna was in the map at the remembered fixes."""
    antenna: NDArray[np.float64]
    """[3, 2] the fix."""


class Anchoring:
    """The anchor (t, Ψ) as a set; every fix narrows it, and through it the position."""

    def __init__(
        self,
        gps: GpsConfig | None,
        attitude: AttitudeChain,
        position: PositionChain,
        journal: Journal,
    ) -> None:
        self._arm = np.array([gps.antenna_x_m, gps.antenna_y_m, gps.antenna_z_m] if gps else [0.0, 0.0, 0.0])
        self._velocity_bound = gps.velocity_bound_mps if gps else None
        self._attitude, self._position = attitude, position
        self._journal = journal
        self._plane: TangentPlane | None = None
        self._antennas, self._points = np.zeros((REMEMBERED, 3, 2)), np.zeros((REMEMBERED, 3, 2))
        self._remembered = 0
        self._anchor = np.array([[-ANYWHERE_M, ANYWHERE_M]] * 3 + [[-UNKNOWN_YAW, UNKNOWN_YAW]])

    def begin(self, fix: Fix) -> None:
        """The first fix is the origin on Earth, used or not: so hypotheses that can't use the same ones share it."""
        if self._plane is None:
            self._plane = TangentPlane(fix.lat_deg, fix.lon_deg, fix.alt_m)

    def correct(self, fix: Fix) -> None:
        """Contract the newest pose, in the map and on Earth, and the anchor that ties the two.

        The antenna was where base_link is now, less what was travelled since the fix, plus the lever arm.
        """
        places, turns, stamp = self._position.tube, self._attitude.tube, fix.stamp
        i, j, n = places.before(stamp.earliest_ns), places.after(stamp.latest_ns), places.newest
        a, b = turns.before(stamp.earliest_ns), turns.after(stamp.latest_ns)
        around = turns.before(int(places.times[n, 0]))
        if i < places.begin or min(a, around) < turns.begin or b >= turns.end:
            self._journal.counts["fix_too_old"] += 1
            return
        self.begin(fix)
        assert self._plane is not None
        antenna = self._plane.antenna(fix)
        # from base_link now to the antenna then: along the newest heading, and along the map's axes
        offset, in_map = np.empty((3, 2)), np.empty((3, 2))
        antenna_offsets(
            self._arm, i, j, n, places.net, places.swing, places.heading, places.local, a, b, turns.newest, turns.box,
            turns.swing, turns.heading, self._attitude.bias_since(a), offset, in_map,
        )  # fmt: skip

        def narrowed(wider: float) -> Narrowed | None:
            now = Narrowed(
                places.box[n].copy(), turns.box[turns.newest, 2:].copy(), self._attitude.bias[2].copy(),
                self._anchor.copy(), self._points.copy(), antenna + np.array([-wider, wider]),
            )  # fmt: skip
            agrees = self._along(now, fix, i, j, wider) and self._on_earth(now, offset, around)
            agrees = agrees and self._in_map(now, in_map)
            return now if agrees and tied(now.anchor, now.yaws, now.box) else None

        now = narrowed(0.0)
        if now is None or not self._position.contract(now.box, now.yaws):
            excess = least_excess(lambda wider: narrowed(wider) is not None, 0.01)
            self._journal.report("gps", stamp.mid_ns, excess, "m")
            return
        self._attitude.bias[2] = now.bias
        self._remember(now, in_map)
        self._anchor, self._points = now.anchor, now.points
        self._position.remember()

    def _along(self, now: Narrowed, fix: Fix, i: int, j: int, wider: float) -> bool:
        """Contract yaw on Earth by the fix's velocity, which is between the position nodes i and j."""
        places, turns, attitude = self._position.tube, self._attitude.tube, self._attitude
        if self._velocity_bound is None or fix.ground_velocity_mps is None:
            return True
        i = min(i, j - 1)
        a, b = turns.before(int(places.times[i, 0])), turns.after(int(places.times[j, 1]))
        if i < places.begin or a < turns.begin or b >= turns.end:
            return True
        seconds = up((int(places.times[j, 1]) - int(places.times[i, 0])) * 1e-9)
        varied = float(radians_of(turns.effort[b] - turns.effort[a]).sum())
        varied = up(up(varied) + 1.5001 * attitude.gyro.most_acceleration * seconds * seconds)
        arm = up(float(np.linalg.norm(self._arm)) * (1.0 + 1e-12))
        way = way_along(
            turns.heading[turns.newest], attitude.bias_since(a), places.heading, places.local, i, j,
        )  # fmt: skip
        off = off_mean(seconds, self._position.tracks.most_acceleration, arm, varied)
        seen = yaw_by_velocity(*fix.ground_velocity_mps, self._velocity_bound + wider, way, off)
        if is_empty(seen):
            return True
        yaw = nearest_copy((now.yaws[1, 0], now.yaws[1, 1]), seen)
        now.yaws[1] = yaw
        return not is_empty(yaw)

    def _on_earth(self, now: Narrowed, offset: NDArray[np.float64], around: int) -> bool:
        """SMF section 7: contract yaw and place on Earth by this fix and those of the window."""
        turns, place = self._attitude.tube, now.box[EARTH]
        seen = down(now.antenna[2, 0] - offset[2, 1]), up(now.antenna[2, 1] - offset[2, 0])
        place[2] = meet((place[2, 0], place[2, 1]), seen)
        if place[2, 0] > place[2, 1]:
            return False
        seconds = int(turns.times[around, 0]) * 1e-9, int(turns.times[turns.newest, 1]) * 1e-9
        return self._position.window.narrowed(
            now.antenna[:2], offset[:2], turns.heading[turns.newest], seconds, self._position.quantum,
            now.bias, now.yaws[1], place[:2],
        )  # fmt: skip

    def _in_map(self, now: Narrowed, offset: NDArray[np.float64]) -> bool:
        """antenna = t + Rz(Ψ)(p(τ) + R arm), by this fix and those of the beginning: contract place and anchor."""
        return in_the_map(self._antennas, now.points, self._remembered, now.anchor, now.antenna, offset, now.box[MAP])

    def _remember(self, now: Narrowed, offset: NDArray[np.float64]) -> None:
        """Keep the first fixes for later: where the robot stood at first, then one every little way."""
        k = self._remembered
        if k == REMEMBERED:
            return
        point = np.empty((3, 2))
        plus(now.box[MAP], offset, point)
        if k >= STANDING_FIXES:
            way = np.abs(np.mean(point - now.points[k - 1], axis=1))
            if max(way[0], way[1]) < REMEMBER_EVERY_M:
                return
        self._antennas[k], now.points[k] = now.antenna, point
        self._remembered += 1

    def join(self, other: "Anchoring") -> None:
        """Grow to the hull of both; the fixes of the beginning are forgotten."""
        self._plane = self._plane or other._plane
        low, high = (np.stack([self._anchor[:, k], other._anchor[:, k]]) for k in range(2))
        self._anchor = np.stack([low.min(axis=0), high.max(axis=0)], axis=1)
        self._remembered = 0

    def anchor(self) -> Anchor | None:
        """Where the map frame stands on Earth; None before the first fix."""
        if self._plane is None or self._anchor[0, 1] >= ANYWHERE_M:
            return None
        plane = self._plane
        low, high = self._anchor[:, 0].copy(), self._anchor[:, 1].copy()
        return Anchor(plane.lat_deg, plane.lon_deg, plane.alt_m, low, high)


@compiled
def in_the_map(
    antennas: NDArray[np.float64],
    points: NDArray[np.float64],
    remembered: int,
    anchor: NDArray[np.float64],
    antenna: NDArray[np.float64],
    offset: NDArray[np.float64],
    here: NDArray[np.float64],
) -> bool:
    """Contract the place `here` [3, 2] in the map and the anchor [4, 2] by the remembered fixes and this one."""
    if not anchored_by_all(antennas, points, remembered, anchor):
        return False
    point = np.empty((3, 2))
    plus(here, offset, point)
    if not anchored(antenna, anchor, point):
        return False
    for c in range(3):
        seen = meet((here[c, 0], here[c, 1]), sub((point[c, 0], point[c, 1]), (offset[c, 0], offset[c, 1])))
        if is_empty(seen):
            return False
        here[c, 0], here[c, 1] = seen
    return True


@compiled
def plus(a: NDArray[np.float64], b: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """out = a + b, intervals [3, 2]."""
    for c in range(3):
        out[c, 0], out[c, 1] = add((a[c, 0], a[c, 1]), (b[c, 0], b[c, 1]))
