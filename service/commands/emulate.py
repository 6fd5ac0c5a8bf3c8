"""`terrabound emulate`: the emulated robot, or one device of it, on pseudo-terminals."""

import sys
import threading
import time
import zipfile
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

STANDSTILL_S = 5.0
"""Length of the drive that a single device never begins."""

app = App(
    name="emulate",
    help="Emulate the robot's devices on pseudo-terminals, so that anything can be tried without hardware.",
)


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


Link: TypeAlias = Annotated[Path, Parameter(help="Symbolic link to make; open it as the device's port.")]
Declared: TypeAlias = Annotated[
    Path | None, Parameter(help="Configuration whose bounds the emulated errors keep; by default the demo's.")
]
Ground: TypeAlias = Annotated[Literal["stairs", "rough", "ramp", "flat"], Parameter(help="What the robot stands on.")]
Seed: TypeAlias = Annotated[int, Parameter(help="Of terrain and sensor errors.")]
Errors: TypeAlias = Annotated[Law, Parameter(help="How sensor errors are drawn inside their declared bounds.")]


@app.command
def lms(
    *,
    link: Link = Path("laser"),
    config: Declared = None,
    scene: Ground = "rough",
    seed: Seed = 1,
    errors: Errors = "uniform",
) -> int:
    """A SICK LMS221 on a pseudo-terminal: starts at 9600 baud, strict about its protocol.

    Its robot stands still. Until Ctrl-C. Hear it with `terrabound listen lms laser`.
    """
    return _device("laser", link, config, scene, seed, errors)


@app.command
def encoders(
    *,
    link: Link = Path("encoders"),
    config: Declared = None,
    scene: Ground = "rough",
    seed: Seed = 1,
    errors: Errors = "uniform",
) -> int:
    """Track encoders behind an slcan adapter on a pseudo-terminal: message TRACKS, counters LEFT and RIGHT.

    Their robot stands still. Until Ctrl-C. Hear them with
    `terrabound listen encoders encoders --dbc tracks.dbc --left TRACKS.LEFT --right TRACKS.RIGHT`.
    """
    return _device("encoders", link, config, scene, seed, errors)


@app.command
def imu(
    *,
    link: Link = Path("imu"),
    config: Declared = None,
    scene: Ground = "rough",
    seed: Seed = 1,
    errors: Errors = "uniform",
) -> int:
    """The inertial board on a pseudo-terminal: MAVLink packets of gyroscope, two accelerometers and tilt sensor.

    Its robot stands still. Until Ctrl-C. Hear it with `terrabound listen imu imu`.
    """
    return _device("imu", link, config, scene, seed, errors)


@app.command
def gps(
    *,
    link: Link = Path("gps"),
    config: Declared = None,
    scene: Ground = "rough",
    seed: Seed = 1,
    errors: Errors = "uniform",
) -> int:
    """A GPS receiver on a pseudo-terminal: NMEA sentences, ten fixes a second.

    Its robot stands still. Until Ctrl-C. Hear it with `terrabound listen gps gps`.
    """
    return _device("gps", link, config, scene, seed, errors)


def _device(name: str, link: Path, config: Path | None, scene: Scene, seed: int, errors: Law) -> int:
    """One device alone, on a robot that stands still: its neighbours are not there."""
    loaded = _loaded(config)
    if name == "gps" and loaded.config.devices.gps is None:
        raise ConfigurationError(f"{config}: has no [devices.gps]; a receiver's bounds must be declared to emulate it")
    told = False

    def tell(progress: Progress) -> None:
        nonlocal told
        if not told:
            print(f"{name}: emulated on {link}; Ctrl-C ends it", file=sys.stderr, flush=True)
        told = True

    _emulate(loaded, {name: link}, scene, None, STANDSTILL_S, 1.0, seed, errors, None, None, tell)
    return 0


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

    def __call__(self, progress: Progress) -> None:
        text = f"robot: {progress.state}"
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
    try:
        ground = build_terrain(scene, seed, terrain)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        if terrain is None:
            raise
        raise ConfigurationError(f"--terrain {terrain}: is no elevation model that can be read: {error}") from None
    world = World(
        ground,
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
                punctual=not isinstance(links, Mapping),  # a device alone keeps no promise to anybody
            )
    finally:
        if clock is not None:
            clock.close()
