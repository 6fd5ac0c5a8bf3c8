"""What was true during a run, and whether published sets contain it."""

from dataclasses import dataclass, replace
from math import cos, sin
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from simulator.terrain import Terrain, build_terrain

Array = NDArray[np.float64]
Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """True poses and hits. World frame as saved; `in_map_frame` turns them into the frame the robot maps in."""

    pose_time_ns: Times
    """[N] host time, 1 kHz, rising."""
    pose: Array
    """[N, 6] x, y, z, roll, pitch, yaw (unwrapped); between two rows the truth is taken as linear."""
    hit_time_ns: Times
    """[H] when each beam that was reported as a distance was shot."""
    hit: Array
    """[H, 3] where it truly hit."""
    hit_range_m: Array
    """[H] the distance that was reported for it."""
    scene: str
    seed: int
    source: str
    """File of the elevation model, for the scene `dem`."""
    origin: tuple[float, float, float]
    """WGS-84 latitude, longitude (degrees) and height (m) of the world's origin; x east, y north."""
    map_origin: tuple[float, float, float, float] | None = None
    """World x, y, z and yaw of the map frame, where this truth stands in the map frame; None: world frame."""

    def save(self, path: Path | str) -> None:
        """Write an .npz; who finds the file finds it whole. A link, a device or a pipe stays what it is."""
        path = Path(path).resolve()
        is_file = path.is_file() or not path.exists()
        draft = path.with_name(path.name + ".new") if is_file else path
        with draft.open("wb") as file:
            np.savez(
                file,
                pose_time_ns=self.pose_time_ns,
                pose=self.pose,
                hit_time_ns=self.hit_time_ns,
                hit=self.hit,
                hit_range_m=self.hit_range_m,
                scene=self.scene,
                seed=self.seed,
                source=self.source,
                origin=self.origin,
                **({} if self.map_origin is None else {"map_origin": self.map_origin}),  # type: ignore[arg-type]
            )
        if is_file:
            draft.replace(path)

    @classmethod
    def load(cls, path: Path | str) -> "Truth":
        """Read what `save` wrote."""
        with np.load(path) as stored:
            numbers: dict[str, Any] = {
                name: stored[name] for name in ("pose_time_ns", "pose", "hit_time_ns", "hit", "hit_range_m")
            }
            for name in ("origin", "map_origin"):
                if name in stored:
                    numbers[name] = tuple(float(value) for value in stored[name])
            return cls(**numbers, scene=str(stored["scene"]), seed=int(stored["seed"]), source=str(stored["source"]))

    def terrain(self) -> Terrain:
        """The scene again, in the world frame."""
        return build_terrain(self.scene, self.seed, self.source or None)

    def surface(self, x: Array, y: Array) -> Array:
        """True top surface at x, y of this truth's own frame, in that frame; NaN outside the scene."""
        terrain = self.terrain()
        if self.map_origin is None:
            return terrain.height(x, y)
        x0, y0, z0, yaw = self.map_origin
        return terrain.height(x0 + cos(yaw) * x - sin(yaw) * y, y0 + sin(yaw) * x + cos(yaw) * y) - z0

    def in_map_frame(self, start_ns: int | None = None) -> "Truth":
        """Relative to the true pose at `start_ns` (default: the first): its x, y, z, yaw become exactly zero."""
        if self.map_origin is not None:
            raise ValueError("this truth stands in a map frame already")
        start = self.pose[0] if start_ns is None else _pose_at(self.pose_time_ns, self.pose, start_ns)
        x0, y0, z0, yaw = (float(start[i]) for i in (0, 1, 2, 5))
        pose = self.pose.copy()
        pose[:, :3] = _moved(self.pose[:, :3], x0, y0, z0, yaw)
        pose[:, 5] -= yaw
        return replace(self, pose=pose, hit=_moved(self.hit, x0, y0, z0, yaw), map_origin=(x0, y0, z0, yaw))

    def pose_violations(self, earliest_ns: Times, latest_ns: Times, low: Array, high: Array) -> int:
        """How many of m pose boxes the truth leaves during their time.

        Box i, low[i] to high[i] ([m, 6], yaw unwrapped), must hold every true row in [earliest_ns[i], latest_ns[i]]
        and the truth at both ends. Before the first and after the last row the robot stands where it stood then.
        """
        outside = np.empty(len(earliest_ns), np.bool_)
        _poses_outside(
            self.pose_time_ns,
            self.pose,
            np.ascontiguousarray(earliest_ns, np.int64),
            np.ascontiguousarray(latest_ns, np.int64),
            np.ascontiguousarray(low, np.float64),
            np.ascontiguousarray(high, np.float64),
            outside,
        )
        return int(outside.sum())

    def cell_violations(
        self,
        low: NDArray[np.floating[Any]],
        high: NDArray[np.floating[Any]],
        resolution_m: float,
        origin_m: tuple[float, float],
        inserted: NDArray[np.bool_] | None = None,
    ) -> int:
        """How many true hits lie outside the interval of their cell.

        low, high: [ny, nx], NaN where nothing was seen; origin_m: low corner of cell [0, 0]. A hit off the map or in
        an unseen cell counts. `inserted` [H] leaves out the hits whose beams were not inserted.
        """
        hit = self.hit if inserted is None else self.hit[inserted]
        ix = np.floor((hit[:, 0] - origin_m[0]) / resolution_m).astype(np.int64)
        iy = np.floor((hit[:, 1] - origin_m[1]) / resolution_m).astype(np.int64)
        on_map = (ix >= 0) & (iy >= 0) & (ix < low.shape[1]) & (iy < low.shape[0])
        ix, iy, z = ix[on_map], iy[on_map], hit[on_map, 2]
        inside = (low[iy, ix] <= z) & (z <= high[iy, ix])  # False for NaN
        return int(len(hit) - inside.sum())


def _moved(points: Array, x0: float, y0: float, z0: float, yaw: float) -> Array:
    """Points [n, 3] of the world seen from a frame at (x0, y0, z0) turned by yaw about z."""
    x, y = points[:, 0] - x0, points[:, 1] - y0
    c, s = cos(yaw), sin(yaw)
    return np.column_stack([c * x + s * y, c * y - s * x, points[:, 2] - z0])


@compiled
def _pose_at(times: Times, poses: Array, t_ns: int) -> Array:
    """[6] linear between rows, constant beyond the ends."""
    i = min(max(int(np.searchsorted(times, t_ns, side="right")) - 1, 0), times.size - 2)
    part = min(max((t_ns - times[i]) / (times[i + 1] - times[i]), 0.0), 1.0)
    pose: Array = poses[i] + part * (poses[i + 1] - poses[i])
    return pose


@compiled
def _poses_outside(
    times: Times,
    poses: Array,
    earliest: Times,
    latest: Times,
    low: Array,
    high: Array,
    outside: NDArray[np.bool_],
) -> None:
    for k in range(earliest.size):
        first = _pose_at(times, poses, earliest[k])
        last = _pose_at(times, poses, latest[k])
        inside = True
        for axis in range(6):
            # Written so that NaN counts as outside.
            inside = inside and low[k, axis] <= first[axis] <= high[k, axis]
            inside = inside and low[k, axis] <= last[axis] <= high[k, axis]
        i = np.searchsorted(times, earliest[k])
        while inside and i < times.size and times[i] <= latest[k]:
            for axis in range(6):
                inside = inside and low[k, axis] <= poses[i, axis] <= high[k, axis]
            i += 1
        outside[k] = not inside
