"""`terrabound emulate`: the emulated robot, or one device of it, on pseudo-terminals."""

import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from cyclopts import App, Parameter, validators

from drivers.clock import LockstepClock
from drivers.errors import ConfigurationError
from estimator.config import RobotConfig
from service.config import LoadedConfig, load
from service.lifecycle import stop_on_signals
from service.shipped import shipped_config
from simulator.emulated_robot import DEVICES, Progress, print_progress, run_emulated_robot
from simulator.errors import ErrorLaw
from simulator.robot import RobotModel
from simulator.terrain import build_terrain
from simulator.world import World

Scene: TypeAlias = Literal["stairs", "rough", "ramp", "flat", "dem"]
Law: TypeAlias = Literal["uniform", "corners", "constant", "drift", "switching"]
Speed: TypeAlias = Annotated[float, Parameter(validator=validators.Number(gt=0))] | Literal["max"]
Duration: TypeAlias = Annotated[float, Parameter(validator=validators.Number(gte=5, lte=3600))]

LOCKSTEP_START_NS = 1_000_000_000_000
"""Where a virtual clock begins; any number would do."""

app = App(name="emulate", help="Emulate the robot's devices on pseudo-terminals, so that anything can be tried without hardware.")


@app.command
def robot(
    *,
    config: Path | None = None,
    links: Path = Path("ports"),
    scene: Scene = "stairs",
    terrain: Path | None = None,
    duration: Duration = 60.0,
    speed: Speed = 1.0,
    seed: int = 1,
    errors: Law = "uniform",
    clock: Path | None = None,
    truth: Path | None = None,
    json_progress: bool = False,
) -> int:
    """The whole robot: laser, encoders, inertial board and GPS, driving over a scene.

    It waits until the ports are open and the scanner streams, stands still for two seconds, and drives. Point the ports
    of a configuration at the links, and run `terrabound run` against it.

    Parameters
    ----------
    config
        Declared bounds and limits that the emulated errors keep; by default the demo's.
    links
        Folder for the links laser, encoders, imu and gps.
    scene
        What to drive over.
    terrain
        Elevation model for --scene dem: an ESRI .asc file, or an .npz with `elevation`.
    duration
        Seconds of driving, standstill included.
    speed
        Times real time, or max; other than 1 needs --clock.
    seed
        Of terrain, slip and sensor errors.
    errors
        How sensor errors are drawn inside their declared bounds.
    clock
        Make a lockstep clock at this path and run on it; hosts must read it, as `terrabound demo` does.
    truth
        Write true poses and true hit points to this .npz at the end.
    json_progress
        Tell the progress as JSON lines on standard output.
    """
    if clock is None and speed != 1.0:
        raise ConfigurationError("--speed other than 1 needs --clock: hosts must share the emulated time")
    progress = print_progress if json_progress else _Line()
    _emulate(_loaded(config), links, scene, terrain, duration, speed, seed, errors, clock, truth, progress)
    return 0


def _device(name: str, link: Path, config: Path | None, scene: Scene, seed: int, errors: Law) -> int:
    """One device alone, on a robot that stands still: its neighbours are not there."""
    _emulate(
        _loaded(config), {name: link}, scene, None, 3600.0, 1.0, seed, errors, None, None, _Line(f"{name} on {link}")
    )
    return 0


@app.command
def lms(
    *,
    link: Path = Path("laser"),
    config: Path | None = None,
    scene: Scene = "rough",
    seed: int = 1,
    errors: Law = "uniform",
) -> int:
    """A SICK LMS221 on a pseudo-terminal: starts at 9600 baud, strict about its protocol."""
    return _device("laser", link, config, scene, seed, errors)


@app.command
def encoders(
    *,
    link: Path = Path("encoders"),
    config: Path | None = None,
    scene: Scene = "rough",
    seed: int = 1,
    errors: Law = "uniform",
) -> int:
    """Track encoders behind an slcan adapter on a pseudo-terminal."""
    return _device("encoders", link, config, scene, seed, errors)


@app.command
def imu(
    *,
    link: Path = Path("imu"),
    config: Path | None = None,
    scene: Scene = "rough",
    seed: int = 1,
    errors: Law = "uniform",
) -> int:
    """The inertial board on a pseudo-terminal: MAVLink packets of gyroscope, two accelerometers and tilt sensor."""
    return _device("imu", link, config, scene, seed, errors)


@app.command
def gps(
    *,
    link: Path = Path("gps"),
    config: Path | None = None,
    scene: Scene = "rough",
    seed: int = 1,
    errors: Law = "uniform",
) -> int:
    """A GPS receiver on a pseudo-terminal: NMEA sentences."""
    return _device("gps", link, config, scene, seed, errors)


def robot_model(robot: RobotConfig) -> RobotModel:
    """The emulated robot keeps what the configuration declares of the real one."""
    return RobotModel(
        track_length_m=robot.track_length_m,
        track_gauge_m=robot.track_gauge_m,
        max_speed_mps=robot.max_speed_mps,
        max_acceleration_mps2=robot.max_acceleration_mps2,
        max_turn_rate_dps=robot.max_turn_rate_dps,
        max_turn_acceleration_dps2=robot.max_turn_acceleration_dps2,
        slip_ratio=robot.slip_ratio,
        lateral_slip_ratio=robot.lateral_slip_ratio,
        turning_centre_m=robot.turning_centre_m,
        normal_slip_ratio=robot.normal_slip_ratio,
    )


class _Line:
    """The progress as a line that is rewritten, on a terminal."""

    def __init__(self, what: str = "robot") -> None:
        self._what = what

    def __call__(self, progress: Progress) -> None:
        text = f"{self._what}: {progress.state}"
        if progress.state == "driving":
            text += f", {progress.driven_s:.0f} of {progress.duration_s:.0f} s, {progress.scans} scans"
        if sys.stderr.isatty():
            print(f"\r\x1b[K{text}", end="" if progress.state != "done" else "\n", file=sys.stderr, flush=True)


def _loaded(config: Path | None) -> LoadedConfig:
    return load(shipped_config("demo.toml") if config is None else config)


def _emulate(
    loaded: LoadedConfig,
    links: Mapping[str, Path] | Path,
    scene: Scene,
    terrain: Path | None,
    duration_s: float,
    speed: float | Literal["max"],
    seed: int,
    errors: Law,
    clock_path: Path | None,
    truth: Path | None,
    on_progress: Callable[[Progress], None],
) -> None:
    """Build the world and run it until the drive is over or somebody stops it."""
    if scene == "dem" and terrain is None:
        raise ConfigurationError("--scene dem needs --terrain FILE, an elevation model (.asc or .npz)")
    start_ns = time.monotonic_ns() if clock_path is None else LOCKSTEP_START_NS
    devices = loaded.config.devices
    world = World(
        build_terrain(scene, seed, terrain),
        robot_model(loaded.config.robot),
        devices,
        ErrorLaw(errors, seed),
        start_ns,
        duration_s,
    )
    stopping = threading.Event()
    clock = None if clock_path is None else LockstepClock.create(clock_path, DEVICES, start_ns)
    try:
        with stop_on_signals(stopping):
            run_emulated_robot(
                world,
                devices,
                links,
                clock=clock,
                speed=None if speed == "max" else speed,
                truth_path=truth,
                on_progress=on_progress,
                stopping=stopping,
                stay=clock is None,
            )
    finally:
        if clock is not None:
            clock.close()
