"""Our kernel beside numpy, the mixture, the Kalman and the paper's own map: one run, in turns, on the same readings.

The paper's two places, driven by the real filter (bench/paper/), and a sweep of 131,072 beams.

    python -m bench.comparison
"""

from collections.abc import Callable
from math import radians

import numpy as np
from numpy.typing import NDArray

from bench.bench_kernel import LASER, NumpyMap
from bench.kernel_limits import BEAMS_A_RING, RING_HALF, RINGS
from bench.paper.scene_drive import SETTINGS, Insertion, SceneDrive, drive_scene
from bench.paper.scene_maps import (
    METHODS,
    OURS,
    SIGMAS,
    Layers,
    MapSet,
    Window,
    contenders,
    fill,
    layers_of,
    quietest,
    score,
    true_cells,
)
from bench.paper.snow import SNOW
from bench.paper.stairs import STAIRS
from drivers.samples import Scan, Stamp
from mapper.laser_geometry import rotation
from simulator.raycast import cast
from simulator.terrain import build_terrain
from simulator.truth import Truth

Array = NDArray[np.float64]
NUMPY = "set-valued, numpy"
SECONDS = 20.0
PASSES = 3
SWEEPS = 3
"""The same sweep so often: the first finds an empty map."""

TEXT = """CPU time of one call from Python, warm, in turns in one process, each turn in the quietest of {passes} passes;
`ours takes` is our share of that time. What a call is given has just been read, as on a robot, where parser and filter
have just written it. The Gaussian maps get their poses from a Kalman filter on the same samples (bound = three sigma,
or root three sigma), but for `pose as wide as ours`, whose three sigma are our pose set's half-widths; in the sweep the
two are one. Containment: truly hit cells whose bounds (three sigma of the Gaussian maps) hold every true hit in them.
Errors are white here; under others the Gaussian maps' containment falls (`terrabound reproduce stairs`).
"""


def section() -> str:
    """A table for each place, as Markdown."""
    parts = ["## Beside other maps\n\n" + TEXT.format(passes=PASSES)]
    for place in (STAIRS, SNOW):
        cell_m = place.window.cell_m
        drive = drive_scene(place.scene, "device", "uniform", 1, SECONDS, cell_m, SIGMAS)
        parts.append(f"{place.title.capitalize()}; {SETTINGS['device']}; cells of {100 * cell_m:.0f} cm.\n")
        parts.append(_table(drive, place.window))
    sweep = large_sweep_drive()
    beams = RINGS * BEAMS_A_RING
    parts.append(f"A sweep of {beams:,} beams over level ground, {RINGS} poses; cells of 5 cm.\n")
    parts.append(_table(sweep, Window((-5.0, 5.0), (-5.0, 5.0), 0.05)))
    return "\n".join(parts)


def _table(drive: SceneDrive, window: Window) -> str:
    passes = []
    for _ in range(PASSES):
        maps, inserts = contenders(drive, window.cell_m)
        plain = NumpyMap(1024, window.cell_m, drive.laser)
        inserts[NUMPY] = numpy_insert(plain)
        passes.append(fill(inserts, drive.insertions))
    best = quietest(passes, len(drive.insertions))
    beams = float(np.mean([insertion.scan.ranges_m.size for insertion in drive.insertions]))
    true = true_cells(drive.truth, drive.hits, window)
    layers = {name: layers_of(maps[name], window) for name in METHODS} | {NUMPY: numpy_layers(plain, window)}
    sizes = {name: getattr(maps[name], "bytes_a_cell", 8) for name in METHODS} | {NUMPY: 8}
    built = MapSet(layers, best, beams, np.zeros(window.shape, bool), sizes)
    rows = [
        "| map | a scan | a beam | ours takes | bytes a cell | containment | mean width |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, step_us in best.items():
        time = f"{step_us:,.0f} us | {1e3 * step_us / beams:.0f} ns | {100 * best[OURS] / step_us:.0f} %"
        s = score(name, built, true)
        held = f"{np.floor(1000 * s['containment']) / 10:g} % | {1e3 * s['width_m']:.0f} mm"
        rows.append(f"| {name} | {time} | {sizes[name]} | {held} |")
    return "\n".join(rows) + "\n"


def numpy_insert(plain: NumpyMap) -> Callable[[Insertion], None]:
    """Pose by pose: numpy's map takes scans with one pose."""

    def insert(insertion: Insertion) -> None:
        scan, index = insertion.scan, insertion.pose_index
        for m in range(len(insertion.low)):
            beams = np.flatnonzero(index == m)
            first, stride = beams[0], beams[1] - beams[0] if len(beams) > 1 else 1
            angle, step = scan.angle_min_rad + first * scan.angle_increment_rad, stride * scan.angle_increment_rad
            part = Scan(scan.stamp, scan.beam_offset_ns[beams], angle, step, scan.ranges_m[beams], scan.status)
            plain.insert(part, insertion.low[m : m + 1], insertion.high[m : m + 1])

    return insert


def numpy_layers(plain: NumpyMap, window: Window) -> Layers:
    """What numpy's map says in the window."""
    first = -plain.origin, -plain.origin
    low, high = (window.cut(layer.astype(float), first) for layer in (-plain.neg_low, plain.high))
    unseen = high == -np.inf
    low[unseen] = high[unseen] = np.nan
    return Layers(0.5 * (low + high), low, high)


def large_sweep_drive() -> SceneDrive:
    """64 quarter rings of 2048 beams over level ground, a pose a ring; all errors uniform inside their bounds.

    A scan's angles go on from ring to ring: ahead, left, behind, right. So each pose leans over to where its ring is.
    """
    random = np.random.default_rng(2)
    poses, lean, side = np.zeros((RINGS, 6)), np.radians(np.linspace(4.0, 40.0, RINGS)), 0.5 * np.pi * np.arange(RINGS)
    poses[:, 3], poses[:, 4] = -lean * np.sin(side), lean * np.cos(side) + radians(LASER.mount_pitch_deg)
    true_poses = poses + random.uniform(-1.0, 1.0, poses.shape) * RING_HALF
    step = 0.5 * np.pi / BEAMS_A_RING
    angles = (-0.25 * np.pi + step * np.arange(RINGS * BEAMS_A_RING)).reshape(RINGS, BEAMS_A_RING)
    mount = rotation(0.0, -radians(LASER.mount_pitch_deg), 0.0)
    lever = np.array([LASER.mount_x_m, LASER.mount_y_m, LASER.mount_z_m])
    terrain = build_terrain("flat")
    ranges, hits = [], []
    for (x, y, z, roll, pitch, yaw), ring_angles in zip(true_poses, angles, strict=True):
        turn = rotation(roll, pitch, yaw)
        off = ring_angles + random.uniform(-1.0, 1.0, BEAMS_A_RING) * radians(LASER.angle_bound_deg)
        beams = np.column_stack([np.cos(off), np.sin(off), np.zeros(BEAMS_A_RING)]) @ (turn @ mount).T
        origins = np.tile(np.array([x, y, z]) + turn @ lever, (BEAMS_A_RING, 1))
        true_ranges = cast(terrain, origins, beams, 20.0)
        ranges.append(true_ranges + random.uniform(-1.0, 1.0, BEAMS_A_RING) * LASER.range_bound_m)
        hits.append(origins + true_ranges[:, None] * beams)
    ring = np.repeat(np.arange(RINGS, dtype=np.int32), BEAMS_A_RING)
    ring.flags.writeable = False
    covariance = {s: np.array([np.diag((RING_HALF[0] / s) ** 2)] * RINGS) for s in SIGMAS}
    gaussian = {s: (poses, covariance[s]) for s in SIGMAS}
    readings = np.concatenate(ranges)
    scan = Scan(Stamp(0, 0), np.zeros(len(ring), np.int64), -0.25 * np.pi, step, readings, 0)
    insertion = Insertion(scan, ring, poses - RING_HALF, poses + RING_HALF, gaussian, 0.0)
    no_hits = np.zeros(0)
    truth = Truth(
        np.array([0, 1]),
        np.zeros((2, 6)),
        no_hits.astype(np.int64),
        np.zeros((0, 3)),
        no_hits,
        "flat",
        1,
        "",
        (0, 0, 0),
    )
    way, sigmas = np.zeros((2, 2)), {s: np.sqrt(np.diagonal(covariance[s][0])) for s in SIGMAS}
    return SceneDrive(
        LASER,
        [insertion] * SWEEPS,
        truth.in_map_frame(),
        np.concatenate(hits),
        way,
        0,
        RINGS,
        True,
        RING_HALF[0],
        sigmas,
    )


if __name__ == "__main__":
    print(section())
