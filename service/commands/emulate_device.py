"""`terrabound emulate lms|encoders|imu|gps`: one device alone on a pseudo-terminal, to try anybody's host on."""

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal, TypeAlias

from cyclopts import Parameter, validators

from drivers.errors import ConfigurationError
from service.config import load
from service.lifecycle import stop_on_signals
from service.robot_model import robot_model
from service.shipped import shipped_config
from simulator.emulated_device import DeviceAlone, run_device
from simulator.errors import ErrorLaw
from simulator.line_faults import DEFAULT_RATE, KINDS, Fault
from simulator.terrain import build_terrain
from simulator.world import World

BAD_USAGE = 2
STANDSTILL_S = 5.0
"""Length of the drive that a single device never begins."""

Link: TypeAlias = Annotated[Path, Parameter(help="Symbolic link to make; open it as the device's port.")]
Speed: TypeAlias = Annotated[
    float,
    Parameter(
        validator=validators.Number(gt=0, lte=100),
        help="The device's time runs so many times faster: its rates, timeouts and transfer times.",
    ),
]


def _written_right(_: object, words: list[str] | None) -> None:
    """For cyclopts: raises ValueError where one of them is no fault."""
    for word in words or ():
        Fault.parse(word)


Faults: TypeAlias = Annotated[
    list[str] | None,
    Parameter(
        negative=(),
        validator=_written_right,
        help=(
            f"KIND or KIND:RATE, a fault of the line and the share of frames that it strikes ({DEFAULT_RATE:g} if not "
            f"given); may be given several times. Kinds: {'; '.join(f'{k} ({text})' for k, text in KINDS.items())}."
        ),
    ),
]
Seed: TypeAlias = Annotated[int, Parameter(help="Of terrain, sensor errors and line faults.")]
Declared: TypeAlias = Annotated[
    Path | None, Parameter(help="Configuration whose bounds the emulated errors keep; by default the demo's.")
]
Ground: TypeAlias = Annotated[
    Literal["stairs", "rough", "ramp", "flat"], Parameter(help="What the robot stands on, and the laser sees.")
]
Errors: TypeAlias = Annotated[
    Literal["uniform", "corners", "constant", "drift", "switching"],
    Parameter(help="How sensor errors are drawn inside their declared bounds."),
]


def lms(
    *,
    link: Link = Path("laser"),
    speed: Speed = 1.0,
    fault: Faults = None,
    seed: Seed = 1,
    scene: Ground = "rough",
    errors: Errors = "uniform",
    config: Declared = None,
) -> int:
    """A SICK LMS221 on a pseudo-terminal, until Ctrl-C.

    As strict as the scanner: it starts at 9600 baud, sends and hears garbage at any other rate than its own, keeps its
    times between telegrams, and wants the password of a mode before it lets anything be set. Its robot stands still.
    Hear it with `terrabound listen lms laser`.
    """
    return _emulate(DeviceAlone("laser", link, speed, _faults(fault), seed), config, scene, errors)


def encoders(
    *,
    link: Link = Path("encoders"),
    speed: Speed = 1.0,
    fault: Faults = None,
    seed: Seed = 1,
    scene: Ground = "rough",
    errors: Errors = "uniform",
    config: Declared = None,
) -> int:
    """Track encoders behind an slcan adapter on a pseudo-terminal, until Ctrl-C.

    Message TRACKS (181h), 100 times a second, with the 16-bit counters LEFT and RIGHT, once the host has set the bit
    rate (S6) and opened the channel (O). Their robot stands still. How to hear them is said when they are there.
    """
    return _emulate(DeviceAlone("encoders", link, speed, _faults(fault), seed), config, scene, errors)


def imu(
    *,
    link: Link = Path("imu"),
    speed: Speed = 1.0,
    fault: Faults = None,
    seed: Seed = 1,
    messages: Literal["standard", "terrabound"] = "standard",
    scene: Ground = "rough",
    errors: Errors = "uniform",
    config: Declared = None,
) -> int:
    """An inertial board on a pseudo-terminal, until Ctrl-C: MAVLink 2 of gyroscope, two accelerometers and tilt sensor.

    HIGHRES_IMU 200 times a second for the gyroscope, 50 times for each accelerometer, ATTITUDE 50 times for the tilt.
    Its robot stands still. Hear it with `terrabound listen imu imu`.

    Parameters
    ----------
    messages
        Accelerometers and tilt in standard messages, or in our own small dialect (drivers/imu/terrabound.xml).
    """
    alone = DeviceAlone("imu", link, speed, _faults(fault), seed, own_messages=messages == "terrabound")
    return _emulate(alone, config, scene, errors)


def gps(
    *,
    link: Link = Path("gps"),
    speed: Speed = 1.0,
    fault: Faults = None,
    seed: Seed = 1,
    scene: Ground = "rough",
    errors: Errors = "uniform",
    config: Declared = None,
) -> int:
    """A GPS receiver on a pseudo-terminal, until Ctrl-C: NMEA sentences GGA, RMC and GST, ten fixes a second.

    Its robot stands still. Hear it with `terrabound listen gps gps`.
    """
    return _emulate(DeviceAlone("gps", link, speed, _faults(fault), seed), config, scene, errors)


def _faults(words: Sequence[str] | None) -> list[Fault]:
    return [Fault.parse(word) for word in words or ()]


def _emulate(alone: DeviceAlone, config: Path | None, scene: Ground, errors: Errors) -> int:
    """Build the world around one device, and run it until somebody stops it."""
    loaded = load(shipped_config("demo.toml") if config is None else config)
    devices = loaded.config.devices
    if alone.name == "gps" and devices.gps is None:
        raise ConfigurationError(f"{config}: has no [devices.gps]; a receiver's bounds must be declared to emulate it")
    world = World(
        build_terrain(scene, alone.seed),
        robot_model(loaded.config.robot),
        devices,
        ErrorLaw(errors, alone.seed),
        time.monotonic_ns(),
        STANDSTILL_S,
    )
    stopping = threading.Event()
    with stop_on_signals(stopping):
        try:
            faulty = run_device(world, devices, alone, stopping, lambda: _tell(alone))
        except ValueError as error:
            print(f"terrabound: --fault: {error}", file=sys.stderr)
            return BAD_USAGE
    if faulty is not None:
        print(f"frames: sent {faulty.frames_sent}, whole at the other end {faulty.frames_intact}", file=sys.stderr)
    return 0


def _tell(alone: DeviceAlone) -> None:
    """Where it is, and how to hear it."""
    kind = "lms" if alone.name == "laser" else alone.name
    more = ""
    if alone.name == "encoders":
        more = f" --dbc {quote(str(shipped_config('tracks.dbc')))} --left TRACKS.LEFT --right TRACKS.RIGHT"
    hear = f"terrabound listen {kind} {quote(str(alone.link))}{more}"
    print(f"{alone.name}: emulated on {alone.link}; hear it: {hear}; Ctrl-C ends it", file=sys.stderr, flush=True)


EXAMPLES = {
    lms: "Try: terrabound emulate lms --fault bit-flip:0.1 --fault false-header:0.1",
    encoders: "Try: terrabound emulate encoders --fault dropped --fault silence:0.05",
    imu: "Try: terrabound emulate imu --messages terrabound --fault garbage:0.2",
    gps: "Try: terrabound emulate gps --speed 5 --fault truncated:0.1 --fault split:0.5",
}
"""For the end of each command's page."""
