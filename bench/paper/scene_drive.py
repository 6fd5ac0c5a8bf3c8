"""A drive through one of the paper's two places: the true world, the real filter, and every scan with its poses.

With a scan setting that the device has, bytes go from emulated devices through drivers and filter into the map, as on
the robot. The paper's 721 beams at 100 Hz no LMS221 can give: there samples come straight from the simulated world.
"""

from dataclasses import dataclass, replace
from math import pi
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bench.paper.gaussian_poses import Array, Times, gaussian_poses
from drivers.config import DevicesConfig, LaserConfig
from drivers.samples import Sample, Scan, Stamp
from service.beam_times import beam_times
from service.commands.evaluation import PoseSets
from service.commands.virtual_drive import START_NS, PoseRecorder, drive_virtually
from service.config import Config, LoadedConfig, load
from service.pipeline import Pipeline
from service.robot_model import robot_model
from service.sample_queue import Arrival
from service.shipped import shipped_config
from simulator.errors import ErrorLaw
from simulator.sample_stream import Rates, sample_stream
from simulator.terrain import build_terrain
from simulator.truth import Truth
from simulator.world import World

Setting = Literal["device", "paper"]
SETTINGS: dict[Setting, str] = {
    "device": "361 beams, 37.5 scans a second (LMS221: 180 deg / 0.5 deg, 500 kBd)",
    "paper": "721 beams, 100 scans a second (the paper's; no setting of an LMS221)",
}
PAPER_BEAMS, PAPER_PERIOD_NS = 721, 10_000_000
STANDSTILL_S = 3.0
"""Before and after the drive proper, together."""


@dataclass(frozen=True, slots=True, eq=False)
class Insertion:
    """One scan as each family of maps takes it; m poses."""

    scan: Scan
    pose_index: NDArray[np.int32]
    low: Array
    """[m, 6]"""
    high: Array
    gaussian: dict[float, tuple[Array, Array]]
    """Means [m, 6] and covariances [m, 6, 6] of the EKF, by how many sigmas a declared bound is."""
    travelled_m: float


@dataclass(frozen=True, slots=True, eq=False)
class SceneDrive:
    """A finished drive. Everything is in the map frame: x ahead at the start, y to the left."""

    laser: LaserConfig
    insertions: list[Insertion]
    truth: Truth
    hits: Array
    """[h, 3] true hits of the beams that were put into the map."""
    way: Array
    """[n, 2] where the robot truly went."""
    pose_violations: int
    poses_checked: int
    intact: bool
    """Did the filter keep its guarantee?"""
    pose_half_widths: Array
    """[6] of the last pose set."""
    ekf_sigmas: dict[float, Array]
    """[6] standard deviations of the last pose."""


def scene_config(resolution_m: float) -> LoadedConfig:
    """The demo's robot and bounds, without GPS; the laser at the finest setting over 180 degrees that comes whole."""
    loaded = load(shipped_config("demo.toml"))
    devices = loaded.config.devices
    devices = replace(devices, gps=None, laser=replace(devices.laser, resolution_deg=0.5))
    config = replace(loaded.config, devices=devices, map=replace(loaded.config.map, resolution_m=resolution_m))
    return replace(loaded, config=config)


def drive_scene(
    scene: str, setting: Setting, law: str, seed: int, duration_s: float, resolution_m: float, sigmas: tuple[float, ...]
) -> SceneDrive:
    """Drive for `duration_s`, standstill included, and give each scan its poses of both kinds."""
    loaded = scene_config(resolution_m)
    samples: list[Sample] = []
    if setting == "device":
        drive = drive_virtually(
            loaded,
            scene=scene,
            law=law,
            seed=seed,
            duration_s=duration_s,
            on_arrival=lambda arrival: samples.append(arrival.sample),
        )
        truth, poses, intact = drive.truth, drive.poses, drive.pipeline.filter.guarantee.intact
    else:
        truth, poses, intact = _drive_samples(loaded.config, scene, law, seed, duration_s, samples)
    truth = truth.in_map_frame()
    laser = loaded.config.devices.laser
    covered = poses.cover(truth.hit_time_ns)
    covered &= (truth.hit_range_m >= laser.range_min_m) & (truth.hit_range_m <= laser.range_max_m)
    gaussians = {s: gaussian_poses(loaded.config, samples, s) for s in sigmas}
    steps = np.hypot(*np.diff(truth.pose[:, :2], axis=0).T)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    insertions = []
    first = 0
    for scan in sorted((s for s in samples if isinstance(s, Scan)), key=lambda scan: scan.stamp.earliest_ns):
        times = beam_times(scan)
        last = first + len(times.earliest_ns)
        if not np.array_equal(poses.earliest_ns[first:last], times.earliest_ns):
            continue  # its poses never came
        middle: Times = (times.earliest_ns + times.latest_ns) // 2
        insertions.append(
            Insertion(
                scan,
                times.pose_index,
                *(poses.low[first:last].copy(), poses.high[first:last].copy()),
                {s: gaussian.at(middle) for s, gaussian in gaussians.items()},
                float(np.interp(middle[0], truth.pose_time_ns, travelled)),
            )
        )
        first = last
    if first != len(poses.earliest_ns) or not insertions:
        raise RuntimeError("scans and pose sets don't belong together")
    return SceneDrive(
        laser,
        insertions,
        truth,
        truth.hit[covered],
        truth.pose[::20, :2].copy(),
        truth.pose_violations(poses.earliest_ns, poses.latest_ns, poses.low, poses.high),
        len(poses.earliest_ns),
        intact,
        0.5 * (poses.high[-1] - poses.low[-1]),
        {s: np.sqrt(np.diagonal(gaussian.covariance[-1])) for s, gaussian in gaussians.items()},
    )


def _drive_samples(
    config: Config, scene: str, law: str, seed: int, duration_s: float, samples: list[Sample]
) -> tuple[Truth, PoseSets, bool]:
    """The same without wires: the paper's scans, and all other samples at 100 Hz."""
    devices: DevicesConfig = config.devices
    terrain, model = build_terrain(scene, seed), robot_model(config.robot)
    world = World(terrain, model, devices, ErrorLaw(law, seed), START_NS, duration_s)
    recorder = PoseRecorder()
    pipeline = Pipeline(config, recorder)
    angles: Array = -0.5 * pi + pi / (PAPER_BEAMS - 1) * np.arange(PAPER_BEAMS, dtype=np.float64)
    # Half a turn of the mirror is in sight.
    offsets = np.arange(PAPER_BEAMS) * (PAPER_PERIOD_NS // 2) // PAPER_BEAMS
    now_ns = START_NS
    for now_ns, readings in sample_stream(world, None, Rates(step_ns=PAPER_PERIOD_NS, steps_per_tilt=1)):
        ranges = world.measure(now_ns + offsets, angles)
        scan = Scan(Stamp(now_ns, now_ns), offsets, float(angles[0]), pi / (PAPER_BEAMS - 1), ranges, 0)
        for name, sample in (("imu", readings[0]), ("encoders", readings[1]), ("laser", scan)):
            samples.append(sample)
            pipeline.step(Arrival(name, sample, now_ns))
    pipeline.finish()
    return world.truth(now_ns + PAPER_PERIOD_NS), recorder.sets(), pipeline.filter.guarantee.intact
