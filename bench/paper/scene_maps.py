"""All maps of one drive: built scan by scan in turns, each call's CPU time taken, and held against the truth."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from math import radians, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.baselines.gaussian_points import THREE_SIGMA, UNIFORM
from bench.baselines.kalman_map import KalmanMap
from bench.baselines.literal_map import LiteralMap
from bench.baselines.mixture_map import MixtureMap
from bench.paper.gaussian_poses import Array
from bench.paper.scene_drive import Insertion, SceneDrive
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.saved_map import assemble
from simulator.truth import Truth

OURS = "set-valued, ours"
MIXTURE = "mixture, b/3"
SIGMAS = (THREE_SIGMA, UNIFORM)
FIRST_ORDER = "set-valued, the paper's first order"
METHODS = (
    OURS,
    "set-valued, natural extension",
    FIRST_ORDER,
    MIXTURE,
    "mixture, b/√3",
    "mixture, pose as wide as ours",
    "Kalman, b/3",
    "Kalman, b/√3",
    "Kalman, b/3, growing",
    "set-valued, ours, pose of the Kalman filter",
    "Kalman, pose as wide as ours",
)
POSES = {
    "the Kalman filter's": (METHODS[9], MIXTURE, METHODS[6]),
    "our set": (OURS, METHODS[5], METHODS[10]),
}
"""Who says where the robot is: set-valued, mixture and Kalman map that believe it. A box of a Kalman filter's pose is
its three sigma, a Gaussian of our set has its half-widths for three sigma (bound = three sigma)."""
SCANS_A_TURN = 20
Turns = NDArray[np.int64]
"""[turns] nanoseconds"""


@dataclass(frozen=True, slots=True)
class Window:
    """The part of the map that is looked at; whole cells. Map frame."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    cell_m: float
    flat_m: float = 0.02
    """A cell is flat if the truth within two cells of it differs by no more than this."""

    @property
    def first(self) -> tuple[int, int]:
        """Number (i, j) of the first cell."""
        return round(self.x_m[0] / self.cell_m), round(self.y_m[0] / self.cell_m)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (y) and columns (x)."""
        return round((self.y_m[1] - self.y_m[0]) / self.cell_m), round((self.x_m[1] - self.x_m[0]) / self.cell_m)

    def centres(self) -> tuple[Array, Array]:
        """x [columns] and y [rows] of the cells' centres."""
        (i, j), (rows, columns) = self.first, self.shape
        x: Array = (i + 0.5 + np.arange(columns, dtype=np.float64)) * self.cell_m
        y: Array = (j + 0.5 + np.arange(rows, dtype=np.float64)) * self.cell_m
        return x, y

    def cut(self, layer: NDArray[Any], first: tuple[int, int], outside: Any = np.nan) -> NDArray[Any]:
        """This window of a layer whose first cell is number `first`."""
        (rows, columns), result = self.shape, np.full(self.shape, outside, layer.dtype)
        x, y = self.first[0] - first[0], self.first[1] - first[1]
        low_y, high_y = max(y, 0), min(y + rows, layer.shape[0])
        low_x, high_x = max(x, 0), min(x + columns, layer.shape[1])
        if low_y < high_y and low_x < high_x:
            result[low_y - y : high_y - y, low_x - x : high_x - x] = layer[low_y:high_y, low_x:high_x]
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """What one map says in the window: NaN where it says nothing."""

    estimate: Array
    low: Array
    high: Array
    """Bounds; of a Gaussian map three sigma."""


@dataclass(frozen=True, slots=True, eq=False)
class TrueCells:
    """What is true in the window."""

    centre: Array
    """Elevation at each cell's centre."""
    hits: NDArray[np.int64]
    """How many beams truly hit the cell."""
    lowest: Array
    """True hits, NaN without."""
    highest: Array
    flat: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class MapSet:
    """All maps of a drive."""

    layers: dict[str, Layers]
    step_us: dict[str, float]
    """Mean CPU time of a scan."""
    beams_a_scan: float
    surely: NDArray[np.bool_]
    """Ours: cells in which a beam certainly ended."""
    bytes_a_cell: dict[str, int]


def build(drive: SceneDrive, window: Window, repeats: int = 3) -> MapSet:
    """Insert every scan into every map, map by map in turns; each turn's time is that of the quietest pass."""
    passes = []
    for _ in range(repeats):
        maps, inserts = contenders(drive, window.cell_m)
        passes.append(fill(inserts, drive.insertions))
    step_us = quietest(passes, len(drive.insertions))
    layers = {name: layers_of(maps[name], window) for name in METHODS}
    ours: ElevationMap = maps[OURS]
    saved = assemble(ours.tiles(), window.cell_m, "map")
    first = round(saved.origin_m[0] / window.cell_m), round(saved.origin_m[1] / window.cell_m)
    assert saved.surely_hit is not None
    beams = float(np.mean([insertion.scan.ranges_m.size for insertion in drive.insertions]))
    sizes = {name: getattr(maps[name], "bytes_a_cell", 8) for name in METHODS}
    return MapSet(layers, step_us, beams, window.cut(saved.surely_hit, first, False), sizes)


def contenders(drive: SceneDrive, cell_m: float) -> tuple[dict[str, Any], dict[str, Callable[[Insertion], object]]]:
    """Empty maps, and how each takes a scan."""
    laser, tiles = drive.laser, 192
    growth = (radians(0.3) / THREE_SIGMA) ** 2  # the tilt's bound, a metre further on
    maps: dict[str, Any] = {
        OURS: ElevationMap(MapConfig(resolution_m=cell_m), laser),
        METHODS[1]: LiteralMap(cell_m, laser, "natural", tiles=tiles),
        FIRST_ORDER: LiteralMap(cell_m, laser, "first order", tiles=tiles),
        MIXTURE: MixtureMap(cell_m, laser, THREE_SIGMA, tiles=tiles),
        METHODS[4]: MixtureMap(cell_m, laser, UNIFORM, tiles=tiles),
        METHODS[5]: MixtureMap(cell_m, laser, THREE_SIGMA, tiles=tiles),
        METHODS[6]: KalmanMap(cell_m, laser, THREE_SIGMA, tiles=tiles),
        METHODS[7]: KalmanMap(cell_m, laser, UNIFORM, tiles=tiles),
        METHODS[8]: KalmanMap(cell_m, laser, THREE_SIGMA, growth, tiles=tiles),
        METHODS[9]: ElevationMap(MapConfig(resolution_m=cell_m), laser),
        METHODS[10]: KalmanMap(cell_m, laser, THREE_SIGMA, tiles=tiles),
    }

    def bounded(terrain: Any) -> Callable[[Insertion], object]:
        return lambda scan: terrain.insert(scan.scan, scan.low, scan.high, scan.pose_index)

    def gaussian(terrain: Any, sigmas: float) -> Callable[[Insertion], object]:
        return lambda scan: terrain.insert(scan.scan, *scan.gaussian[sigmas], scan.pose_index)

    def growing(terrain: KalmanMap) -> Callable[[Insertion], object]:
        def insert(scan: Insertion) -> None:
            terrain.travelled_m = scan.travelled_m
            terrain.insert(scan.scan, *scan.gaussian[THREE_SIGMA], scan.pose_index)

        return insert

    wide = {id(scan): _as_wide(scan) for scan in drive.insertions}
    boxes = {id(scan): _three_sigma(scan) for scan in drive.insertions}

    def same_width(terrain: MixtureMap | KalmanMap) -> Callable[[Insertion], object]:
        return lambda scan: terrain.insert(scan.scan, *wide[id(scan)], scan.pose_index)

    def believing(terrain: ElevationMap) -> Callable[[Insertion], object]:
        return lambda scan: terrain.insert(scan.scan, *boxes[id(scan)], scan.pose_index)

    return maps, {
        **{name: bounded(maps[name]) for name in METHODS[:3]},
        MIXTURE: gaussian(maps[MIXTURE], THREE_SIGMA),
        METHODS[4]: gaussian(maps[METHODS[4]], UNIFORM),
        METHODS[5]: same_width(maps[METHODS[5]]),
        METHODS[6]: gaussian(maps[METHODS[6]], THREE_SIGMA),
        METHODS[7]: gaussian(maps[METHODS[7]], UNIFORM),
        METHODS[8]: growing(maps[METHODS[8]]),
        METHODS[9]: believing(maps[METHODS[9]]),
        METHODS[10]: same_width(maps[METHODS[10]]),
    }


def _as_wide(scan: Insertion) -> tuple[Array, Array]:
    """Independent Gaussians whose three sigma are the pose set's half-widths."""
    sigma = 0.5 * (scan.high - scan.low) / THREE_SIGMA
    return 0.5 * (scan.low + scan.high), np.einsum("mi,ij->mij", sigma**2, np.eye(6))


def _three_sigma(scan: Insertion) -> tuple[Array, Array]:
    """The box of a Gaussian pose: its mean and three sigma to either side, which is no bound."""
    mean, covariance = scan.gaussian[THREE_SIGMA]
    reach = THREE_SIGMA * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return mean - reach, mean + reach


def fill(inserts: dict[str, Callable[[Insertion], object]], insertions: list[Insertion]) -> dict[str, Turns]:
    """CPU time of each turn of each map, in nanoseconds: some scans into each map in turn, then the next ones."""
    spent: dict[str, list[int]] = {name: [] for name in inserts}
    names = list(inserts)
    for turn, first in enumerate(range(0, len(insertions), SCANS_A_TURN)):
        scans = insertions[first : first + SCANS_A_TURN]
        # Not always in one order: each finds the caches as another left them.
        for k in range(len(names)):
            name = names[(k + turn) % len(names)]
            insert = inserts[name]
            for scan in scans:
                _read(scan)
            start = time.thread_time_ns()
            for scan in scans:
                insert(scan)
            spent[name].append(time.thread_time_ns() - start)
    return {name: np.array(turns) for name, turns in spent.items()}


def quietest(passes: list[dict[str, Turns]], scans: int) -> dict[str, float]:
    """Mean CPU time of a scan for each map, in microseconds, each turn's as it was in the quietest pass."""
    return {name: float(np.min([turns[name] for turns in passes], axis=0).sum()) / scans / 1e3 for name in passes[0]}


def _read(scan: Insertion) -> None:
    """On a robot the parser and the filter have just written what a map is given: it lies in the caches."""
    bounded: tuple[NDArray[Any], ...] = scan.scan.ranges_m, scan.pose_index, scan.low, scan.high
    for array in (*bounded, *chain.from_iterable(scan.gaussian.values())):
        array.sum()


def layers_of(terrain: Any, window: Window) -> Layers:
    if isinstance(terrain, ElevationMap):
        saved = assemble(terrain.tiles(), window.cell_m, "map")
        first = round(saved.origin_m[0] / window.cell_m), round(saved.origin_m[1] / window.cell_m)
        low, high = (window.cut(layer.astype(float), first) for layer in (saved.low, saved.high))
        return Layers(0.5 * (low + high), low, high)
    if isinstance(terrain, LiteralMap):
        lowest, highest, first = terrain.bounds()
        low, high = window.cut(lowest, first), window.cut(highest, first)
        return Layers(0.5 * (low + high), low, high)
    mean, sigma, first = terrain.estimate()
    mean, sigma = window.cut(mean, first), window.cut(sigma, first)
    return Layers(mean, mean - 3.0 * sigma, mean + 3.0 * sigma)


def true_cells(truth: Truth, hits: Array, window: Window) -> TrueCells:
    """The truth in the window: surface at the centres, and every true hit."""
    x, y = window.centres()
    centre = truth.surface(*np.meshgrid(x, y))
    (rows, columns), (i0, j0) = window.shape, window.first
    i = np.floor(hits[:, 0] / window.cell_m).astype(int) - i0
    j = np.floor(hits[:, 1] / window.cell_m).astype(int) - j0
    inside = (i >= 0) & (j >= 0) & (i < columns) & (j < rows)
    i, j, z = i[inside], j[inside], hits[inside, 2]
    count = np.zeros(window.shape, np.int64)
    np.add.at(count, (j, i), 1)
    lowest, highest = np.full(window.shape, np.inf), np.full(window.shape, -np.inf)
    np.minimum.at(lowest, (j, i), z)
    np.maximum.at(highest, (j, i), z)
    lowest[count == 0] = highest[count == 0] = np.nan
    # The surface half a cell beyond its centres, so that an edge inside a cell is seen.
    fine_x, fine_y = (np.append(c - 0.5 * window.cell_m, c[-1] + 0.5 * window.cell_m) for c in (x, y))
    corners = truth.surface(*np.meshgrid(fine_x, fine_y))
    top = np.maximum.reduce([corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:], corners[1:, 1:], centre])
    bottom = np.minimum.reduce([corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:], corners[1:, 1:], centre])
    flat = _widest(top, np.maximum) - -_widest(-bottom, np.maximum) <= window.flat_m + 2e-9
    return TrueCells(centre, count, lowest, highest, flat)


def _widest(layer: Array, join: Any) -> Array:
    """Joined over the 5 x 5 cells around each."""
    padded = np.pad(layer, 2, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))
    return np.asarray(join.reduce(join.reduce(windows, axis=-1), axis=-1))


def score(name: str, maps: MapSet, true: TrueCells) -> dict[str, float]:
    """One map's row: shares from 0 to 1, metres, microseconds."""
    layer = maps.layers[name]
    filled, hit = np.isfinite(layer.estimate), true.hits > 0
    answered = hit & filled
    inside = answered & (layer.low <= true.lowest) & (true.highest <= layer.high)
    error = layer.estimate - true.centre
    common = np.logical_and.reduce([np.isfinite(other.estimate) for other in maps.layers.values()])

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")

    steps = [np.diff(error, axis=axis) for axis in (0, 1)]
    level = [true.flat[1:] & true.flat[:-1], true.flat[:, 1:] & true.flat[:, :-1]]
    jumps = np.concatenate([step[flat & np.isfinite(step)] for step, flat in zip(steps, level, strict=True)])
    return {
        "filled": float(filled.mean()),
        "hit_cells": int(hit.sum()),
        "hit_cells_filled": float(answered.sum() / max(hit.sum(), 1)),
        # For ours a hit cell without an answer is one outside.
        "hit_cells_outside": int((hit if name == OURS else answered).sum() - inside.sum()),
        "containment": float(inside.sum() / max((hit if name == OURS else answered).sum(), 1)),
        "centre_containment": float(np.mean((layer.low <= true.centre)[filled] & (true.centre <= layer.high)[filled])),
        "width_m": float(np.mean((layer.high - layer.low)[answered])),
        "rmse_m": rms(error[filled]),
        "rmse_common_m": rms(error[common]),
        "rmse_flat_m": rms(error[filled & true.flat]),
        "rmse_hit_m": rms(error[answered]),
        "roughness_m": rms(jumps),
        "step_us": maps.step_us[name],
    }


def surely_and_touched(maps: MapSet, true: TrueCells) -> dict[str, float]:
    """Ours, the surely hit cells apart from those that were only touched."""
    layer, hit = maps.layers[OURS], true.hits > 0
    filled = np.isfinite(layer.estimate)
    result: dict[str, float] = {}
    for name, cells in (("surely", filled & maps.surely), ("touched", filled & ~maps.surely)):
        count = max(int(cells.sum()), 1)
        error = (layer.estimate - true.centre)[cells]
        held = (layer.low <= true.centre) & (true.centre <= layer.high)
        result |= {
            f"{name}_cells": int(cells.sum()),
            f"{name}_truly_hit": float((cells & hit).sum() / count),
            f"{name}_width_m": float(np.mean((layer.high - layer.low)[cells])) if cells.any() else float("nan"),
            f"{name}_rmse_m": sqrt(float(np.mean(error**2))) if cells.any() else float("nan"),
            f"{name}_centre_inside": float((held & cells).sum() / count),
        }
    return result
