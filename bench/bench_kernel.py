"""How long one scan takes into the map, at five pose errors: the compiled kernel against numpy with the same maths.

    python -m bench.bench_kernel [--repeats 500]

721 beams, 5 cm cells, the scanner 0.468 m high and pitched 10 degrees down over rough ground. CPU time of the calling
thread, so that a shared machine's scheduler stays out. Before it times anything, it checks that both give one map.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.config import LaserConfig
from drivers.samples import Scan, Stamp
from mapper.config import MapConfig
from mapper.elevation_map import ElevationMap
from mapper.laser_geometry import G_RANGE_MAX, G_RANGE_MIN, Floats, laser_geometry
from mapper.pose_terms import (
    D_BOTH,
    D_MOUNT_PITCH,
    D_MOUNT_ROLL,
    D_MOUNT_YAW,
    D_PITCH,
    D_ROLL,
    D_SCAN,
    D_SIZE,
    P_ASIDE,
    P_BACK,
    P_BULGE,
    P_CENTRE,
    P_CONSTANT,
    P_DIRECTIONS,
    P_FORWARD,
    P_HIGH,
    P_LEVER_UP,
    P_LOW,
    P_PER_METRE,
    P_RANGE_BOUND,
    P_SIZE,
    P_TURN_RANGE,
    P_TURN_TURN,
    P_U_COS,
    P_U_SIN,
    W_ROWS,
    prepare_pose,
)
from mapper.projection import project

BEAMS = 721
RESOLUTION_M = 0.05
TURNS = 20
LEVELS = ((0.01, 0.2), (0.043, 0.42), (0.05, 0.5), (0.2, 1.0), (0.5, 3.0))
"""The second makes 22 cells a beam, the fourth 150: where the marks are."""
LASER = LaserConfig(
    port="none",
    latency_ms=(0.0, 1.0),
    range_bound_m=0.02,
    angle_bound_deg=0.1,
    mount_x_m=0.2,
    mount_y_m=0.0,
    mount_z_m=0.468,
    mount_pitch_deg=-10.0,
    mount_position_bound_m=0.0,
    mount_angle_bound_deg=0.1,
)


def rough_scan() -> Scan:
    """Ground with steps ahead, nothing nearer than 0.5 m or farther than 8 m."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, BEAMS)
    ground = 0.468 / np.sin(np.radians(10.0)) / np.maximum(np.cos(angles), 0.05)
    rough = 0.05 * np.random.default_rng(1).standard_normal(BEAMS) - 0.3 * (np.sin(9 * angles) > 0.5)
    return Scan(
        Stamp(0, 0), np.zeros(BEAMS, np.int64), -np.pi / 2, np.pi / (BEAMS - 1), np.clip(ground + rough, 0.5, 8.0), 0
    )


class NumpyMap:
    """The same map in numpy: boxes for all beams at once, then all touched cells of two dense layers at once."""

    def __init__(self, half_side: int = 1024, resolution_m: float = RESOLUTION_M, laser: LaserConfig = LASER) -> None:
        self.neg_low = np.full((2 * half_side, 2 * half_side), -np.inf, np.float32)
        self.high = self.neg_low.copy()
        self.origin = half_side
        self.inverse = 1.0 / resolution_m
        self.geometry, self.work, self.pose = laser_geometry(laser), np.empty((W_ROWS, 4)), np.empty(P_SIZE)
        self.narrow = np.empty(P_SIZE, np.float32)

    def insert(self, scan: Scan, low: Floats, high: Floats) -> None:
        """Take a scan with one pose for all beams."""
        prepare_pose(low[0], high[0], self.geometry, self.work, self.pose, self.narrow)
        r = scan.ranges_m
        used = (r >= self.geometry[G_RANGE_MIN]) & (r <= self.geometry[G_RANGE_MAX])
        angle = scan.angle_min_rad + np.arange(r.size) * scan.angle_increment_rad
        rows = np.stack((np.cos(angle), np.sin(angle)))[:, used]
        r = r[used]

        def part(at: int, count: int) -> NDArray[np.float64]:
            return self.pose[at : at + 3 * count].reshape(count, 3)

        along = self.pose[P_DIRECTIONS : P_DIRECTIONS + 5 * D_SIZE].reshape(5, D_SIZE)
        flat, flat_longest = rows * r, rows * (r + self.pose[P_RANGE_BOUND])
        u = part(P_U_COS, 1).T * rows[0] + part(P_U_SIN, 1).T * rows[1]
        forward, left = part(P_FORWARD, 2)[:, :2] @ flat + part(P_FORWARD, 2)[:, 2, None]
        up, u = r * u[2] + self.pose[P_LEVER_UP], np.abs(u)
        x, y, z = part(P_CENTRE, 3)[:, :2] @ flat + part(P_CENTRE, 3)[:, 2, None]
        back, aside = self.pose[P_BACK] + 1.0, self.pose[P_ASIDE]
        centre = np.stack((back * x - aside * y, back * x + aside * y, back * y - aside * x, back * y + aside * x, z))
        roll = along[:, D_ROLL : D_ROLL + 2] @ flat + along[:, D_ROLL + 2, None]
        pitch = along[:, D_PITCH, None] * np.stack((up, up, up, up, forward))
        both = along[:, D_BOTH, None] * left
        half = np.abs(flat_longest[1]) * along[:, D_MOUNT_ROLL, None]
        for at in (D_MOUNT_YAW, D_MOUNT_PITCH, D_SCAN):
            half += np.abs(along[:, at : at + 2] @ flat_longest)
        turn_range = part(P_TURN_RANGE, 3) * [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 1.0]]
        second = part(P_TURN_TURN, 3) @ (r * u) + turn_range @ u
        rest = part(P_CONSTANT, 1).T + r * part(P_PER_METRE, 1).T + second
        half += rest[[0, 0, 1, 1, 2]]
        one_sign, two_signs = np.abs(pitch + roll), np.abs(pitch - roll)
        above = half + np.maximum(one_sign + centre + both, two_signs + centre - both)
        below = half + np.maximum(one_sign - centre - both, two_signs - centre + both)
        high = part(P_HIGH, 1) + self.between(above)
        low = part(P_LOW, 1) - self.between(below)
        z = np.stack((-low[:, 2], high[:, 2]))
        neg_low, top = (z + np.abs(z) * 2.0**-23 + 2.0**-100).astype(np.float32)
        first = np.floor(low[:, :2] * self.inverse).astype(np.int64) + self.origin
        last = np.floor(high[:, :2] * self.inverse).astype(np.int64) + self.origin + 1
        columns, count = (last - first)[:, 0], np.prod(last - first, axis=1)
        beam_of = np.repeat(np.arange(r.size), count)
        nth = np.arange(beam_of.size) - np.repeat(np.cumsum(count) - count, count)
        row, column = np.divmod(nth, columns[beam_of])
        cells = (first[beam_of, 1] + row) * self.neg_low.shape[1] + first[beam_of, 0] + column
        np.maximum.at(self.neg_low.reshape(-1), cells, neg_low[beam_of])
        np.maximum.at(self.high.reshape(-1), cells, top[beam_of])

    def between(self, ends: Floats) -> Floats:
        """[n, 3] how far along x, y, z, from [5, n] along x and y at both ends of yaw, and z."""
        left, right = ends[[0, 2]], ends[[1, 3]]
        most = np.maximum(left, right)
        most += np.maximum(0.0, self.pose[P_BULGE] * most - 0.25 * np.abs(left - right))
        return np.stack((most[0], most[1], ends[4]), axis=-1)


def cpu_us(call: Callable[[], object], repeats: int, warm: bool = True) -> tuple[float, float, float]:
    """p1, p50, p99 of the thread's CPU time, in microseconds."""
    if warm:
        call()
    times = []
    for _ in range(repeats):
        start = time.thread_time_ns()
        call()
        times.append(time.thread_time_ns() - start)
    p1, p50, p99 = np.percentile(times, [1, 50, 99]) / 1e3
    return float(p1), float(p50), float(p99)


def cells_a_beam(scan: Scan, low: Floats, high: Floats, pose_index: NDArray[np.int32]) -> float:
    """Cells in a beam's footprint, in the mean."""
    boxes = project(scan, LASER, low, high, pose_index)
    counts = np.floor(boxes.high[:, :2] / RESOLUTION_M) - np.floor(boxes.low[:, :2] / RESOLUTION_M) + 1
    return float(np.mean(np.prod(counts, axis=1)))


def main() -> None:
    """Print the table, and write nothing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=500)
    print(section(parser.parse_args().repeats))


def section(repeats: int = 500) -> str:
    """The table, as Markdown."""
    scan, pose_index = rough_scan(), np.zeros(BEAMS, np.int32)
    rows = []
    for metres, degrees in LEVELS:
        high = np.array([[metres] * 3 + [np.radians(degrees)] * 3])
        terrain = ElevationMap(MapConfig(resolution_m=RESOLUTION_M, max_footprint_m=50.0), LASER)
        plain = NumpyMap()
        terrain.insert(scan, -high, high, pose_index)
        plain.insert(scan, -high, high)
        seen = int(np.count_nonzero(plain.high > -np.inf))
        if abs(terrain.cells_seen - seen) > 1e-3 * seen:
            raise SystemExit(f"the two maps differ: {terrain.cells_seen} and {seen} cells")
        each = cells_a_beam(scan, -high, high, pose_index)
        # In turns, and the quietest turn of each: other programs use the same cores.
        ours, theirs = [], []
        for _ in range(TURNS):
            ours.append(cpu_us(lambda h=high, m=terrain: m.insert(scan, -h, h, pose_index), repeats // 4))  # type: ignore[misc]
            theirs.append(cpu_us(lambda h=high, m=plain: m.insert(scan, -h, h), max(5, repeats // 50)))  # type: ignore[misc]
        best, reference = min(ours, key=lambda turn: turn[1]), min(theirs, key=lambda turn: turn[1])
        rows.append(
            f"| {metres} m, {degrees} deg | {each:.0f} | {seen:,} | {best[0]:.1f} / {best[1]:.1f} / {best[2]:.1f} us "
            f"| {1e3 * best[1] / BEAMS:.0f} ns | {reference[1]:.0f} us | {reference[1] / best[1]:.0f} |"
        )
    return TEXT + "\n".join(rows) + "\n"


TEXT = f"""One scan of {BEAMS} beams, cells of 5 cm, the scanner 0.468 m high and 10 degrees down over rough ground: CPU
time of the whole call from Python, warm, the quietest of {TURNS} turns (the machine is shared). Marks: 30 us at 22
cells a beam, 50 us at 150; 10 and 30 times numpy.

| pose error | cells a beam | cells seen | kernel p1 / p50 / p99 | a beam | numpy, same maths | times |
|---|---|---|---|---|---|---|
"""


if __name__ == "__main__":
    main()
