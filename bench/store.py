"""What the store costs: a transaction, a tile on the disk, opening and reading it all back.

python -m bench.store
"""

import tempfile
import time
from pathlib import Path

import numpy as np

from bench.bench_kernel import BEAMS, LASER, rough_scan
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.store import Submap, TileStore
from mapper.store_check import open_store
from mapper.tile import Tile, snap_outward

RESOLUTION_M = 0.05
SUBMAP = Submap(0, RESOLUTION_M, "map")
PLACES = 40
"""Where the scanner stands in turn, 4 m apart: that makes a hundred tiles and more."""
CHANGED = (8, 64)
"""Tiles in a transaction: those around a robot that drives, and those of one that turns with a wide view."""
TRANSACTIONS = 40


def driven_tiles() -> list[Tile]:
    """The tiles of a drive over rough ground, as they are published and stored."""
    terrain, scan, index = (
        ElevationMap(MapConfig(resolution_m=RESOLUTION_M), LASER),
        rough_scan(),
        np.zeros(BEAMS, np.int32),
    )
    half = np.array([[0.02] * 3 + [np.radians(0.3)] * 3])
    for place in range(PLACES):
        for heading in range(24):
            pose = np.array([[4.0 * (place % 8), 4.0 * (place // 8), 0.0, 0.0, 0.0, 0.26 * heading]])
            terrain.insert(scan, pose - half, pose + half, index)
    return [snap_outward(tile) for tile in terrain.tiles()]


def noise_tiles(count: int) -> list[Tile]:
    """Every cell seen, nothing to compress."""
    random = np.random.default_rng(1)
    tiles = []
    for n in range(count):
        low = random.normal(0.0, 3.0, (64, 64)).astype(np.float32)
        tiles.append(
            snap_outward(Tile(0, n, 100, RESOLUTION_M, low, low + random.uniform(0, 9, (64, 64)).astype(np.float32)))
        )
    return tiles


def wider(tile: Tile, by_m: float) -> Tile:
    """The same tile after another second: every seen cell has grown."""
    return Tile(
        tile.submap, tile.ix, tile.iy, tile.resolution_m, tile.low, tile.high + np.float32(by_m), tile.surely_hit
    )


def save_rows(store: TileStore, tiles: list[Tile]) -> list[str]:
    """Transactions in which every cell of a number of tiles changes."""
    rows = []
    for changed in CHANGED:
        walls, cpus = [], []
        for n in range(TRANSACTIONS):
            some = [wider(tiles[(n * changed + k) % len(tiles)], 0.25 * (n + 1)) for k in range(changed)]
            wall, cpu = time.perf_counter(), time.thread_time()
            store.save(SUBMAP, some, n)
            cpus.append(time.thread_time() - cpu)
            walls.append(time.perf_counter() - wall)
        p50, p99 = 1e3 * np.percentile(walls, [50, 99])
        cpu_ms = 1e3 * float(np.percentile(cpus, 25))
        rows.append(
            f"| {changed} | {p50:.1f} / {p99:.1f} ms | {cpu_ms:.1f} ms "
            f"| {1e3 * changed / p50:.0f} | {1e3 * changed / cpu_ms:.0f} |"
        )
    return rows


def section() -> str:
    """The table, as Markdown."""
    tiles, sizes = driven_tiles(), []
    with tempfile.TemporaryDirectory(dir="/var/tmp") as folder:
        for number, kind in enumerate((tiles, noise_tiles(200))):
            path = Path(folder) / f"{number}.db"
            store, _ = open_store(path)
            store.save(SUBMAP, kind, 0)
            store.close()
            sizes.append(path.stat().st_size / len(kind))
        path = Path(folder) / "0.db"
        begin, cpu = time.perf_counter(), time.thread_time()
        store, findings = open_store(path)
        opened = time.perf_counter() - begin
        count = sum(1 for _ in store.tiles(0))
        read, used = time.perf_counter() - begin - opened, time.thread_time() - cpu
        if not findings.clean or count != len(tiles):
            raise SystemExit(f"the store does not hold what was saved: {findings}, {count} of {len(tiles)} tiles")
        rows = save_rows(store, tiles)
        store.close()
    driven, noise = (size / 1024 for size in sizes)
    return (
        "\n".join((TEXT.rstrip("\n"), *rows))
        + f"\n\nOn the disk a tile of the drive takes {driven:.1f} KiB, one of noise {noise:.1f} KiB (33 in memory). "
        f"Opening a store of {count} tiles, with every checksum looked at: {1e3 * opened:.0f} ms; "
        f"reading and decoding them all: {1e3 * read:.0f} ms ({count / read:.0f} tiles/s); "
        f"{1e3 * used:.0f} ms of CPU in both.\n"
    )


TEXT = """Tiles of 64 x 64 cells of a drive over rough ground (5 cm). Every seen cell of each changes, and all are
joined into the stored ones in one transaction with `synchronous = FULL`: what the service does once a second, beside
the mapping. Wall clock is mostly the disk's; the last columns are tiles a second by the clock and by the CPU's time.

| tiles changed | a transaction, p50 / p99 | CPU | tiles/s | tiles/s of CPU |
|---|---|---|---|---|
"""


if __name__ == "__main__":
    print(section())
