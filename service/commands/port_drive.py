"""A drive through real pseudo-terminals in one process: the emulated robot in a thread, the whole service beside it.

What `terrabound demo` does with processes, for tests that want to reach into both ends: pull plugs, disturb lines, look
at the service's health. Nothing is published.
"""

import shutil
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from drivers.clock import LockstepClock
from drivers.errors import TerraboundError
from service.commands.emulate import LOCKSTEP_START_NS
from service.commands.evaluation import PoseSets
from service.config import LoadedConfig, load
from service.messages import write_pose
from service.onboard import Onboard
from service.robot_model import robot_model
from service.shipped import shipped_config
from simulator.emulated_devices import DEVICES
from simulator.emulated_robot import Progress, run_emulated_robot
from simulator.errors import ErrorLaw
from simulator.terrain import build_terrain
from simulator.truth import Truth
from simulator.wire import PluggedWires
from simulator.world import World

LONGEST_S = 240.0
"""A drive that takes longer hangs."""


@dataclass(frozen=True, slots=True, eq=False)
class PortDrive:
    """A finished drive and what it left behind."""

    loaded: LoadedConfig
    onboard: Onboard
    capture: Path
    map: Path
    poses: Path
    truth: Truth
    """In the world frame."""

    def pose_sets(self) -> PoseSets:
        """The published pose sets."""
        return PoseSets.read(self.poses)


def drive_on_ports(
    folder: Path,
    *,
    scene: str = "stairs",
    law: str = "uniform",
    seed: int = 1,
    duration_s: float = 8.0,
    speed: float | None = None,
    meddle: Callable[[Onboard, PluggedWires, float], None] | None = None,
) -> PortDrive:
    """Drive with everything in `folder`, an empty one.

    `speed`: at most so many times real time; None: as fast as the machine can. `meddle` is called before each slice of
    the drive with the service, the wires and the seconds driven.
    """
    for name in ("demo.toml", "tracks.dbc"):
        shutil.copy(shipped_config(name), folder)
    loaded = load(folder / "demo.toml")
    devices = loaded.config.devices
    world = World(
        build_terrain(scene, seed),
        robot_model(loaded.config.robot),
        devices,
        ErrorLaw(law, seed),
        LOCKSTEP_START_NS,
        duration_s,
    )
    with ExitStack() as stack:
        clock = LockstepClock.create(folder / "clock", DEVICES, LOCKSTEP_START_NS)
        stack.callback(clock.close)
        readers_clock = LockstepClock.attach(folder / "clock")
        stack.callback(readers_clock.close)
        poses = stack.enter_context((folder / "poses.jsonl").open("w", encoding="utf-8"))
        onboard = Onboard(
            loaded,
            readers_clock,
            capture=folder / "drive.mcap",
            on_pose=lambda pose: print(write_pose(pose).decode(), file=poses),
            lockstep=True,
            publish=False,
        )
        robot = _Robot(
            lambda stopping, on_progress: run_emulated_robot(
                world,
                devices,
                folder / "ports",
                clock=clock,
                speed=speed,
                truth_path=folder / "truth.npz",
                on_progress=on_progress,
                stopping=stopping,
                meddle=None if meddle is None else lambda wires, driven_s: meddle(onboard, wires, driven_s),
            )
        )
        stack.callback(robot.stop)
        robot.start()
        onboard.start()
        stack.callback(onboard.stop)
        robot.wait(onboard)
        onboard.finish()
        if onboard.failure is not None:
            raise onboard.failure
        onboard.save_map(folder / "map.npz")
    truth = Truth.load(folder / "truth.npz")
    return PortDrive(loaded, onboard, folder / "drive.mcap", folder / "map.npz", folder / "poses.jsonl", truth)


class _Robot:
    """The emulated robot's thread."""

    def __init__(self, run: Callable[[threading.Event, Callable[[Progress], None]], None]) -> None:
        self._run_robot = run
        self._stopping, self._waiting = threading.Event(), threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="emulated robot", daemon=True)

    def start(self) -> None:
        """Begin; comes back once the ports are there."""
        self._thread.start()
        self._waiting.wait(LONGEST_S)

    def wait(self, onboard: Onboard) -> None:
        """Until the drive is over. Raises what ended it early, on either side."""
        for _ in range(round(LONGEST_S / 0.2)):
            self._thread.join(0.2)
            if not self._thread.is_alive():
                break
            if onboard.failure is not None:
                raise onboard.failure
        else:
            raise TerraboundError(f"the drive did not end within {LONGEST_S:g} s")
        if self._failure is not None:
            raise self._failure

    def stop(self) -> None:
        """End early, if it still drives."""
        self._stopping.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        try:
            self._run_robot(self._stopping, lambda progress: self._waiting.set())
        except BaseException as error:
            self._failure = error
        finally:
            self._waiting.set()
