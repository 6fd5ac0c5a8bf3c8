"""How well a drive of the emulated robot was bounded: the outputs held against the truth.

Reads what the run left behind (poses.jsonl, the saved maps), not what it kept in memory.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from drivers.config import LaserConfig
from mapper.elevation_map import ElevationMap
from mapper.saved_map import SavedMap, assemble
from mapper.saved_map import load as load_map
from mapper.tile import snap_outward
from service.onboard import Onboard
from service.picture import Labels, Profile, draw
from simulator.truth import Truth

AHEAD_M = 2.5
"""The profile goes on this far beyond the end of the drive: the laser looks ahead."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The results of a demo; the fields of its JSON report."""

    scans: int
    beams: int
    cells: int
    tiles: int
    pose_violations: int
    """True poses outside their published set."""
    cell_violations: int
    """True hits outside their cell's interval, or in no cell at all."""
    surely_hit_cells: int
    """Cells in which a beam certainly ended; the others were possibly touched."""
    mean_width_m: float
    """Mean of upper bound minus lower bound."""
    remote_equal: bool
    """Does the subscriber's map equal the robot's, bit for bit in the published quantisation?"""
    latency_ms: dict[str, float | None]
    """From the read of the last byte that a scan waited for to its tile at the subscriber."""
    realtime_factor: float
    """Seconds driven per second of waiting."""
    guarantee: str
    poses_checked: int
    hits_checked: int

    @property
    def sound(self) -> bool:
        """Did every bound hold, was none called broken, and was there something to hold?"""
        held = self.pose_violations == 0 and self.cell_violations == 0
        return held and self.guarantee == "intact" and self.hits_checked > 0


@dataclass(frozen=True, slots=True, eq=False)
class PoseSets:
    """The published pose sets of a drive, one a row."""

    earliest_ns: NDArray[np.int64]
    latest_ns: NDArray[np.int64]
    low: NDArray[np.float64]
    """[n, 6]"""
    high: NDArray[np.float64]
    """[n, 6]"""

    @classmethod
    def read(cls, path: Path) -> "PoseSets":
        """From a poses.jsonl."""
        with path.open(encoding="utf-8") as lines:
            rows = [json.loads(line) for line in lines]
        return cls(
            np.array([row["earliest_ns"] for row in rows], np.int64),
            np.array([row["latest_ns"] for row in rows], np.int64),
            np.array([row["low"] for row in rows], float).reshape(-1, 6),
            np.array([row["high"] for row in rows], float).reshape(-1, 6),
        )

    def cover(self, times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which times lie inside any of the stretches: whose beams were put into the map."""
        if len(self.earliest_ns) == 0:
            return np.zeros(len(times_ns), bool)
        order = np.argsort(self.earliest_ns)
        begins, reach = self.earliest_ns[order], np.maximum.accumulate(self.latest_ns[order])
        before = np.searchsorted(begins, times_ns, side="right") - 1
        covered: NDArray[np.bool_] = (before >= 0) & (times_ns <= reach[before])
        return covered


def check_bounds(truth: Truth, poses: PoseSets, saved: SavedMap, laser: LaserConfig) -> tuple[int, int, int]:
    """(poses outside, hits outside, hits checked). Truth in the world frame; sets and map in the map frame."""
    local = truth.in_map_frame()
    pose_violations = local.pose_violations(poses.earliest_ns, poses.latest_ns, poses.low, poses.high)
    inserted = (
        poses.cover(local.hit_time_ns)
        & (local.hit_range_m >= laser.range_min_m)
        & (local.hit_range_m <= laser.range_max_m)
    )
    cell_violations = local.cell_violations(saved.low, saved.high, saved.resolution_m, saved.origin_m, inserted)
    return pose_violations, cell_violations, int(inserted.sum())


def evaluate(
    onboard: Onboard, truth: Truth, poses_path: Path, output: Path, copy: dict[str, Any], realtime_factor: float
) -> Evaluation:
    """Hold the outputs of a finished run against the truth and against the subscriber's copy."""
    pipeline = onboard.pipeline
    saved = load_map(output / "map.npz")
    poses = PoseSets.read(poses_path)
    laser = onboard.laser
    pose_violations, cell_violations, hits = check_bounds(truth, poses, saved, laser)
    guarantee = pipeline.filter.guarantee
    return Evaluation(
        scans=pipeline.counts["scans"],
        beams=pipeline.counts["beams"],
        cells=int(np.isfinite(saved.low).sum()),
        tiles=pipeline.map.tile_count,
        pose_violations=pose_violations,
        cell_violations=cell_violations,
        surely_hit_cells=0 if saved.surely_hit is None else int(saved.surely_hit.sum()),
        mean_width_m=float(np.nanmean(saved.high.astype(float) - saved.low)),
        remote_equal=bool(copy["in_sync"]) and published_equal(pipeline.map, load_map(output / "remote.npz")),
        latency_ms=copy["latency_ms"],
        realtime_factor=realtime_factor,
        guarantee="intact" if guarantee.intact else f"void ({guarantee.sensor})",
        poses_checked=len(poses.earliest_ns),
        hits_checked=hits,
    )


def published_equal(robot: ElevationMap, remote: SavedMap) -> bool:
    """Is the remote map the robot's map, snapped outward to the published step, bit for bit?"""
    published = assemble(map(snap_outward, robot.tiles()), robot.config.resolution_m, remote.frame)
    layers = ("low", "high", "surely_hit", "settled_low", "settled_high")
    pairs = [(getattr(published, name), getattr(remote, name)) for name in layers]
    return (published.resolution_m, published.origin_m) == (remote.resolution_m, remote.origin_m) and all(
        a is b if a is None or b is None else a.tobytes() == b.tobytes() for a, b in pairs
    )


def results_table(result: Evaluation, picture: Path) -> Table:
    """The results for people."""
    table = Table("what", "result", title="terrabound demo", title_justify="left")
    latency = result.latency_ms
    rows = [
        ("scans / beams in the map", f"{result.scans} / {result.beams}"),
        ("cells / tiles", f"{result.cells} / {result.tiles}"),
        ("surely hit cells", str(result.surely_hit_cells)),
        ("mean interval width", f"{100 * result.mean_width_m:.1f} cm"),
        ("true poses outside their set", f"{result.pose_violations} of {result.poses_checked} sets"),
        ("true hits outside their cell", f"{result.cell_violations} of {result.hits_checked} hits"),
        ("guarantee", result.guarantee),
        ("remote copy equal", "yes" if result.remote_equal else "NO"),
        ("latency, last byte to remote tile", _milliseconds(latency)),
        ("speed", f"{result.realtime_factor:.1f} x real time"),
        ("picture", str(picture)),
    ]
    for name, value in rows:
        table.add_row(name, value)
    return table


def _milliseconds(latency: dict[str, float | None]) -> str:
    p50, p99 = latency.get("p50"), latency.get("p99")
    return "not measured" if p50 is None or p99 is None else f"p50 {p50:.1f} ms, p99 {p99:.1f} ms"


def draw_evaluation(path: Path, result: Evaluation, truth: Truth, output: Path, scene: str) -> None:
    """The picture of the drive, with the true ground in the profile."""
    local = truth.in_map_frame()
    drive_xy = local.pose[:, :2]
    x, y = _way_ahead(drive_xy)
    profile = Profile(x, y, local.surface(x, y))
    labels = Labels(
        f"terrabound demo: an emulated tracked robot over {scene}",
        f"{result.scans} scans, {result.cells} cells of bounded elevation; "
        f"true poses outside: {result.pose_violations}, "
        f"true hits outside: {result.cell_violations} of {result.hits_checked}",
    )
    draw(path, load_map(output / "map.npz"), drive_xy, profile, labels)


def _way_ahead(drive_xy: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The driven line at steps of 2 cm, continued straight ahead."""
    steps = np.hypot(*np.diff(drive_xy, axis=0).T)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    along = np.arange(0.0, travelled[-1], 0.02)
    x, y = np.interp(along, travelled, drive_xy[:, 0]), np.interp(along, travelled, drive_xy[:, 1])
    back = drive_xy[np.searchsorted(travelled, max(travelled[-1] - 0.3, 0.0))]
    heading = np.arctan2(drive_xy[-1, 1] - back[1], drive_xy[-1, 0] - back[0])
    ahead = np.arange(0.0, AHEAD_M, 0.02)
    return (
        np.concatenate([x, drive_xy[-1, 0] + ahead * np.cos(heading)]),
        np.concatenate([y, drive_xy[-1, 1] + ahead * np.sin(heading)]),
    )
