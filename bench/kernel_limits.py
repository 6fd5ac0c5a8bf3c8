"""What the kernel does beyond one scan: a large sweep, a large map, page faults, a cold start.

python -m bench.kernel_limits
"""

import resource
import subprocess
import sys
import tracemalloc

import numpy as np
from numpy.typing import NDArray

from bench.bench_kernel import BEAMS, LASER, cells_a_beam, cpu_us, rough_scan
from drivers.samples import Scan, Stamp
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.tile import Tile

Array = NDArray[np.float64]

RINGS, BEAMS_A_RING = 64, 2048
RING_HALF = np.array([[0.024, 0.024, 0.024, *np.radians([0.3, 0.3, 0.3])]])
SWEEP_TURNS = 12
MAP_TILES = (1, 24, 244, 2_441, 24_414)
"""10^3 (in part) to 10^8 cells."""


def large_sweep() -> tuple[Scan, Array, NDArray[np.int32]]:
    """64 rings of 2048 beams over uneven ground 0.468 m below: a pose a ring, turned down by 4 to 40 degrees."""
    down = np.radians(np.linspace(4.0, 40.0, RINGS))
    beams = RINGS * BEAMS_A_RING
    ranges = 0.468 / np.sin(np.repeat(down, BEAMS_A_RING)) * np.random.default_rng(2).uniform(0.95, 1.05, beams)
    poses = np.zeros((RINGS, 6))
    poses[:, 4] = down
    ring = np.repeat(np.arange(RINGS, dtype=np.int32), BEAMS_A_RING)
    return Scan(Stamp(0, 0), np.zeros(beams, np.int64), -np.pi / 4, np.pi / 2 / BEAMS_A_RING, ranges, 0), poses, ring


def sweep_line() -> str:
    """Time of the sweep."""
    scan, poses, ring = large_sweep()
    low, high = poses - RING_HALF, poses + RING_HALF
    terrain = ElevationMap(MapConfig(resolution_m=0.05), LASER)
    each = cells_a_beam(scan, low, high, ring)
    # The quietest of several turns: other programs use the same cores.
    turns = [cpu_us(lambda: terrain.insert(scan, low, high, ring), 50) for _ in range(SWEEP_TURNS)]
    p1, p50, p99 = min(turns, key=lambda turn: turn[1])
    fresh = []
    for _ in range(SWEEP_TURNS):
        empty = ElevationMap(MapConfig(resolution_m=0.05), LASER)
        fresh.append(cpu_us(lambda m=empty: m.insert(scan, low, high, ring), 1, warm=False)[1])  # type: ignore[misc]
    return (
        f"A sweep of {scan.ranges_m.size:,} beams, {each:.1f} cells a beam, over ground seen before: CPU p1 "
        f"{p1 / 1e3:.2f} ms, p50 {p50 / 1e3:.2f} ms, p99 {p99 / 1e3:.2f} ms (quietest of {SWEEP_TURNS} turns of 50; "
        f"median of all turns' p50 {np.median([turn[1] for turn in turns]) / 1e3:.2f} ms); "
        f"{1e3 * p1 / scan.ranges_m.size:.1f} ns a beam at best. Into an empty map {min(fresh) / 1e3:.2f} ms at best.\n"
    )


def growth_rows() -> str:
    """Time of a scan in maps of more and more cells: at one place, and at another place each time."""
    scan, index = rough_scan(), np.zeros(BEAMS, np.int32)
    half = np.array([[0.05] * 3 + [np.radians(0.5)] * 3])
    layer = np.zeros((64, 64), np.float32)
    rows = []
    for tiles in MAP_TILES:
        side = max(round(np.sqrt(tiles)), 1)
        terrain = ElevationMap(MapConfig(resolution_m=0.05, max_tiles=max(tiles + 100, 200)), LASER)
        for n in range(tiles):
            terrain.join(Tile(0, n % side, n // side, 0.05, layer, layer))
        random = np.random.default_rng(5)
        middle = np.zeros((200, 1, 6))
        # The scan reaches 8 m ahead and to both sides.
        if side > 8:
            middle[:, 0, :2] = random.uniform(9.0, side * 3.2 - 9.0, (200, 2))
        here = middle[0]
        terrain.insert(scan, here - half, here + half, index)
        same = cpu_us(lambda p=here, m=terrain: m.insert(scan, p - half, p + half, index), 300)  # type: ignore[misc]
        elsewhere = [
            cpu_us(lambda p=place, m=terrain: m.insert(scan, p - half, p + half, index), 1, warm=False)[1]  # type: ignore[misc]
            for place in middle
        ]
        touched = cells_a_beam(scan, here - half, here + half, index) * BEAMS
        rows.append(
            f"| {terrain.cells_seen:,} | {terrain.tile_count:,} | {same[0]:.1f} us, {1e3 * same[0] / touched:.2f} ns "
            f"| {np.percentile(elsewhere, 25):.0f} us |"
        )
    return (
        "| cells in the map | tiles | at one place: a scan, each cell of a beam | at another place each time |\n"
        "|---|---|---|---|\n" + "\n".join(rows) + "\n"
    )


def warm_loop_line() -> str:
    """Page faults and lasting allocations of 2000 warm scans."""
    scan, index = rough_scan(), np.zeros(BEAMS, np.int32)
    half = np.array([[0.05] * 3 + [np.radians(0.5)] * 3])
    terrain = ElevationMap(MapConfig(resolution_m=0.05), LASER)
    low, high = -half, half
    for _ in range(2000):
        terrain.insert(scan, low, high, index)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(2000):
        terrain.insert(scan, low, high, index)
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    tracemalloc.start()
    terrain.insert(scan, low, high, index)
    start, _ = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    for _ in range(2000):
        terrain.insert(scan, low, high, index)
    end, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return (
        f"2000 warm scans: {faults} page faults; {end - start} bytes more in use after them, at most {peak - start} "
        "between (the result's own numbers).\n"
    )


COLD = """
import resource
import numpy as np
from bench.bench_kernel import BEAMS, LASER, rough_scan
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
terrain = ElevationMap(MapConfig(resolution_m=0.05), LASER)
half = np.array([[0.05] * 3 + [0.01] * 3])
terrain.insert(rough_scan(), -half, half, np.zeros(BEAMS, np.int32))
used = resource.getrusage(resource.RUSAGE_SELF)
from service.lifecycle import process_age_s
print(process_age_s(), used.ru_utime + used.ru_stime)
"""


def cold_start_line() -> str:
    """A new process, the machine code in the cache, to the end of its first scan."""
    times = []
    for _ in range(5):
        done = subprocess.run([sys.executable, "-c", COLD], capture_output=True, text=True, check=True)
        times.append(tuple(map(float, done.stdout.split())))
    elapsed, cpu = min(times[1:])
    return (
        "Cold start, the machine code in the cache: from the start of Python to the end of the first scan "
        f"{elapsed:.2f} s, of which {cpu:.2f} s of CPU (imports of numba, numpy and pydantic for the most part).\n"
    )


def section() -> str:
    """All of it, as Markdown."""
    return "\n".join(part() for part in (sweep_line, warm_loop_line, cold_start_line, growth_rows))


if __name__ == "__main__":
    print(section())
