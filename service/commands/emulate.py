"""`terrabound emulate`: the emulated robot, or one device of it, on pseudo-terminals."""

import sys
import threading
import time
import zipfile
from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from cyclopts import App, Parameter, validators

from drivers.clock import LockstepClock
from drivers.errors import ConfigurationError
from service.commands.emulate_device import BAD_USAGE, EXAMPLES
from service.config import LoadedConfig, load
from service.lifecycle import stop_on_signals
from service.output_files import make_folder, refuse_unwritable
from service.robot_model import robot_model
from service.shipped import shipped_config
from simulator.emulated_devices import DEVICES
from simulator.emulated_robot import Progress, print_progress, run_emulated_robot
from simulator.errors import ErrorLaw
from simulator.terrain import build_terrain
from simulator.world import World

Scene: TypeAlias = Literal["stairs", "rough", "ramp", "flat", "dem"]
Law: TypeAlias = Literal["uniform", "corners", "constant", "drift", "switching"]


def _is_speed(_: object, speed: float | str) -> None:
    """For cyclopts: raises ValueError where time would stand still or run back."""
    if not isinstance(speed, str) and not 0.0 < speed < inf:
        raise ValueError("Must be > 0, or max.")


Speed: TypeAlias = Annotated[float | Literal["max"], Parameter(validator=_is_speed)]
Duration: TypeAlias = Annotated[float, Parameter(validator=validators.Number(gte=5, lte=3600))]

LOCKSTEP_START_NS = 1_000_000_000_000
"""Where a virtual clock begins; any number would do."""

app = App(
    name="emulate",
    help="Emulate the robot's devices on pseudo-terminals, so that anything can be tried without hardware.",
    help_epilogue="Start with: terrabound emulate imu --link imu, and elsewhere: terrabound listen imu imu",
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
        return _misused("--speed other than 1 needs --clock: hosts must share the emulated time")
    if scene == "dem" and terrain is None:
        return _misused("--scene dem needs --terrain FILE, an elevation model (.asc or .npz)")
    if scene != "dem" and terrain is not None:
        return _misused(f"--terrain goes with --scene dem, and --scene {scene} would be built without it")
    refuse_unwritable((truth,), inputs=(config, terrain))
    make_folder(links)
    progress = print_progress if json_progress else _Line()
    _emulate(_loaded(config), links, scene, terrain, duration, speed, seed, errors, clock, truth, progress)
    return 0


for _device, _examples in EXAMPLES.items():
    app.command(_device, help_epilogue=_examples)


def _misused(why: str) -> int:
    print(f"terrabound emulate robot: {why}", file=sys.stderr)
    return BAD_USAGE


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
    links: Path,
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
            )
    finally:
        if clock is not None:
            clock.close()
