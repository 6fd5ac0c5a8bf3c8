"""What rain, fog and people leave in the map, and what of it is in the settled bounds.

    python -m bench.ghosts [--page]

`--page` rewrites bench/GHOSTS.md.

The paper's robot over rough ground; poses known to 2 cm and 0.3 degrees. Every drive is mapped twice, with and without
the disturbance: a cell is a ghost where its upper bound is more than 10 cm above that of the undisturbed map, or where
the undisturbed map has none.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.machine import heading
from drivers.config import LaserConfig
from drivers.samples import Scan, Stamp
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.saved_map import SavedMap, assemble
from simulator.disturbances import Disturbance, Droplets, Walker
from simulator.raycast import cast
from simulator.terrain import Terrain, build_terrain

Array = NDArray[np.float64]

PAGE = Path(__file__).with_name("GHOSTS.md")
BEAMS = 181
SCAN_NS = 40_000_000
"""25 scans a second: every third of the scanner's."""
HALF = np.array([0.02, 0.02, 0.02, *np.radians([0.3, 0.3, 0.3])])
LASER = LaserConfig(
    port="none",
    latency_ms=(0.0, 1.0),
    range_bound_m=0.03,
    angle_bound_deg=0.1,
    mount_x_m=0.2,
    mount_y_m=0.0,
    mount_z_m=0.468,
    mount_pitch_deg=-10.0,
    mount_position_bound_m=0.0,
    mount_angle_bound_deg=0.1,
)
DISTURBANCES: dict[str, tuple[Disturbance, ...]] = {
    "none": (),
    "rain": (Droplets(0.0005, 1),),
    "fog": (Droplets(0.02, 2),),
    "walkers": (Walker(-6.0, 3.0, 1.3, -0.3), Walker(7.0, -2.0, -1.2, 0.25), Walker(2.5, -9.0, 0.05, 1.4)),
}
SETTINGS = ((1000.0, 4, 1), (1000.0, 6, 2), (120.0, 4, 1), (400.0, 8, 3))
"""Slot in milliseconds, slots, set aside."""


@dataclass(frozen=True, slots=True)
class Shots:
    """A drive as the scanner sees it: poses [n, 6], times [n], origins and directions [n, BEAMS, 3]."""

    poses: Array
    times_ns: NDArray[np.int64]
    origins: Array
    directions: Array


def standing(seconds: float) -> Shots:
    """On the spot, a full turn in 18 seconds."""
    times = np.arange(0, round(seconds * 1e9), SCAN_NS)
    poses = np.zeros((times.size, 6))
    poses[:, 5] = times * (2 * np.pi / 18e9)
    return _shots(poses, times)


def driving(seconds: float) -> Shots:
    """Straight ahead at 0.4 m/s."""
    times = np.arange(0, round(seconds * 1e9), SCAN_NS)
    poses = np.zeros((times.size, 6))
    poses[:, 0] = times * 0.4e-9
    return _shots(poses, times)


def _shots(poses: Array, times: NDArray[np.int64]) -> Shots:
    """Level poses: yaw alone turns."""
    angles, down = np.radians(np.arange(BEAMS) - 90.0), np.radians(10.0)
    beams = np.stack((np.cos(angles) * np.cos(down), np.sin(angles), -np.cos(angles) * np.sin(down)), axis=-1)
    c, s = np.cos(poses[:, 5]), np.sin(poses[:, 5])
    turn = np.zeros((times.size, 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, -s, s, c, 1.0
    origins = poses[:, :3] + turn @ np.array([0.2, 0.0, 0.468])
    directions = np.einsum("tij,nj->tni", turn, beams)
    return Shots(poses, times, np.repeat(origins[:, None], BEAMS, axis=1), directions)


def mapped(terrain: Terrain, shots: Shots, disturbances: Sequence[Disturbance], config: MapConfig) -> SavedMap:
    """The map of a drive with range errors at both ends of their bound."""
    random = np.random.default_rng(4)
    robot = ElevationMap(config, LASER)
    for n, time_ns in enumerate(shots.times_ns.tolist()):
        origins, directions = shots.origins[n], shots.directions[n]
        distances = cast(terrain, origins, directions, 30.0)
        for disturbance in disturbances:
            distances = disturbance.seen(origins, directions, distances, time_ns)
        ranges = distances + random.choice([-1.0, 1.0], BEAMS) * LASER.range_bound_m
        scan = Scan(Stamp(time_ns, time_ns), np.zeros(BEAMS, np.int64), -np.pi / 2, np.radians(1.0), ranges, 0)
        pose = shots.poses[n : n + 1]
        robot.insert(scan, pose - HALF, pose + HALF, np.zeros(BEAMS, np.int32))
    return assemble(robot.tiles(), config.resolution_m, "map")


def on_common_cells(a: SavedMap, b: SavedMap, name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """`high` of a and the layer `name` of b over the cells of both."""
    cell = a.resolution_m
    corners = [np.round(np.array(saved.origin_m) / cell).astype(int) for saved in (a, b)]
    low = np.minimum(*corners)
    ends = [corner + saved.low.shape[::-1] for corner, saved in zip(corners, (a, b), strict=True)]
    shape = np.maximum(*ends) - low
    out = []
    for corner, saved, layer in zip(corners, (a, b), ("high", name), strict=True):
        whole = np.full(shape[::-1], np.nan, np.float32)
        x, y = corner - low
        whole[y : y + saved.low.shape[0], x : x + saved.low.shape[1]] = getattr(saved, layer)
        out.append(whole)
    return out[0], out[1]


def ghosts(clean: SavedMap, haunted: SavedMap, name: str) -> tuple[int, int]:
    """(ghost cells in a layer, cells of the undisturbed map that the layer has)."""
    ground, layer = on_common_cells(clean, haunted, name)
    seen = ~np.isnan(layer)
    raised = seen & ~(layer <= ground + 0.1)
    return int(np.count_nonzero(raised)), int(np.count_nonzero(seen & ~np.isnan(ground)))


def section() -> str:
    """The table, as Markdown."""
    terrain = build_terrain("rough", 3)
    rows = []
    for drive, shots in (("turning on the spot, 36 s", standing(36.0)), ("driving, 20 s", driving(20.0))):
        clean = mapped(terrain, shots, (), MapConfig(resolution_m=0.1))
        cells = int(np.count_nonzero(~np.isnan(clean.low)))
        for weather, disturbances in DISTURBANCES.items():
            for slot_ms, slots, set_aside in SETTINGS:
                config = MapConfig(
                    resolution_m=0.1,
                    evidence_slots=slots,
                    evidence_slot_ms=slot_ms,
                    evidence_set_aside=set_aside,
                )
                haunted = mapped(terrain, shots, disturbances, config)
                in_hull, _ = ghosts(clean, haunted, "high")
                in_settled, kept = ghosts(clean, haunted, "settled_high")
                rows.append(
                    f"| {drive} | {weather} | {slot_ms:g} ms x {slots}, {set_aside} aside "
                    f"| {in_hull} | {in_settled} | {100 * kept / cells:.0f} % |"
                )
    return TEXT + "\n".join(rows) + "\n"


TEXT = """Cells of 10 cm on rough ground; a ghost's upper bound is more than 10 cm above that of the undisturbed map, or
it is where that map has no cell. `kept`: cells of the undisturbed map that have settled bounds. Rain: an echo per 2 km
of beam; fog: one per 50 m; three walkers. What it means: [ghosts.md](../docs/ghosts.md).

| drive | weather | evidence | ghosts in the bounds | ghosts in the settled bounds | kept |
|---|---|---|---|---|---|
"""


def main() -> None:
    """Print the table, and write the page if asked to."""
    parser = argparse.ArgumentParser(prog="python -m bench.ghosts", description="what weather and people leave")
    parser.add_argument("--page", action="store_true", help="rewrite bench/GHOSTS.md")
    page = parser.parse_args().page
    text = section()
    print(text)
    if page:
        PAGE.write_text(heading("Ghosts", "python -m bench.ghosts --page") + text, encoding="utf-8")


if __name__ == "__main__":
    main()
