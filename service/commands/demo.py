"""`terrabound demo`: the whole line on one machine without hardware, and how well the truth was bounded.

Three processes, as in the field: the emulated robot behind pseudo-terminals, the service (here), a remote subscriber.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter, validators
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from drivers.clock import LockstepClock
from drivers.errors import TerraboundError
from estimator.bounded_pose import BoundedPose
from estimator.config import SetName
from service.commands.emulate import Law, Speed
from service.commands.emulated import EmulatedRobot
from service.commands.evaluation import draw_evaluation, evaluate, results_table
from service.config import LoadedConfig, load
from service.lifecycle import interrupted_later, terminated_like_interrupted
from service.loopback import free_locator
from service.messages import write_pose
from service.onboard import Onboard
from service.output_files import make_folder, refuse_unwritable, write_text
from service.shipped import shipped_config

Scene = Literal["stairs", "rough", "ramp", "flat"]


def demo(
    *,
    scene: Scene = "stairs",
    duration: Annotated[float, Parameter(validator=validators.Number(gte=5, lte=600))] = 30.0,
    speed: Speed = "max",
    seed: int = 1,
    errors: Law = "uniform",
    pose_set: Annotated[SetName, Parameter(name="--set")] = "box",
    output: Path = Path("demo-output"),
    report: Path | None = None,
) -> int:
    """Drive an emulated robot over a scene, map it, copy the map to a second process, and check every bound.

    Nothing real is needed: four emulated devices speak on pseudo-terminals, the real drivers, filter, mapper and
    publisher run against them, and a subscriber joins the tiles over Zenoh. Leaves a picture, the map, the poses, the
    raw capture and the truth in the output folder. Ends with 1 if any true pose or true hit was outside its bounds.

    Parameters
    ----------
    scene
        What to drive over.
    duration
        Seconds of driving, standstill at the start included.
    speed
        Times real time, or max: as fast as this machine can.
    seed
        Of terrain, slip and sensor errors: the same seed gives the same drive.
    errors
        How sensor errors are drawn inside their declared bounds.
    pose_set
        What the pose is kept as: the tighter default, or the ellipsoid of the paper's filter.
    output
        Folder for the results; made if it is not there.
    report
        Write the results as JSON here, too.
    """
    console = Console(stderr=True)
    make_folder(output)
    refuse_unwritable((report,))
    (output / "drive.mcap").unlink(missing_ok=True)
    with ExitStack() as stack:
        stack.enter_context(terminated_like_interrupted())
        ports = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="terrabound-")))
        loaded = demo_configuration(ports, pose_set)
        robot = stack.enter_context(
            EmulatedRobot(
                ports / "demo.toml", ports, scene=scene, duration_s=duration, speed=speed, seed=seed, errors=errors
            )
        )
        clock = LockstepClock.attach(robot.clock_path)
        stack.callback(clock.close)
        poses: list[BoundedPose] = []
        onboard = Onboard(
            loaded,
            clock,
            capture=output / "drive.mcap",
            on_pose=poses.append,
            lockstep=True,
        )
        onboard.start()
        stack.callback(onboard.stop)
        with interrupted_later():
            watcher = stack.enter_context(_Watcher(loaded.config.publish.listen[0], output))
        began = _drive(robot, onboard, console, duration)
        onboard.finish()
        elapsed_s = time.monotonic() - began
        if onboard.failure is not None:
            raise onboard.failure
        onboard.save_map(output / "map.npz")
        onboard.publisher.flush(5.0)
        copy = watcher.finish()
        poses_path = output / "poses.jsonl"
        write_text(poses_path, "".join(f"{write_pose(pose).decode()}\n" for pose in poses))
        truth = robot.truth()
        shutil.copy(robot.truth_path, output / "truth.npz")
        evaluation = evaluate(onboard, truth, poses_path, output, copy, duration / elapsed_s)
    picture = output / "map.png"
    draw_evaluation(picture, evaluation, truth, output, scene)
    Console().print(results_table(evaluation, picture))
    if report is not None:
        write_text(report, json.dumps(asdict(evaluation), indent=2) + "\n")
    return 0 if evaluation.sound and evaluation.remote_equal else 1


def demo_configuration(folder: Path, pose_set: SetName = "box") -> LoadedConfig:
    """The demo's configuration: ports in `folder`, and a free TCP port for the subscriber."""
    source = shipped_config("demo.toml")
    shutil.copy(shipped_config("tracks.dbc"), folder)
    (folder / "ports").mkdir()
    text = source.read_text(encoding="utf-8").replace("tcp/127.0.0.1:7447", free_locator())
    text = text.replace('set = "box"', f'set = "{pose_set}"')
    (folder / "demo.toml").write_text(text, encoding="utf-8")
    return load(folder / "demo.toml")


def _drive(robot: EmulatedRobot, onboard: Onboard, console: Console, duration_s: float) -> float:
    """Follow the drive to its end with a live line; returns the wall time at which it began."""
    began = time.monotonic()
    columns = (
        TextColumn("[bold]{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f} s"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[state]}"),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("starting the scanner", total=duration_s, state="")
        for driven_s in robot.follow():
            if onboard.failure is not None:
                raise onboard.failure
            if driven_s is None:
                began = time.monotonic()
                continue
            progress.update(task, description="driving", completed=driven_s, state=_state(onboard))
    return began


def _state(onboard: Onboard) -> str:
    """What the service has so far, in a few words."""
    pipeline = onboard.pipeline
    pose = pipeline.filter.latest()
    if pose is None:
        return "no pose yet"
    widest_cm = 50 * float((pose.high[:3] - pose.low[:3]).max())
    promise = "bounds hold" if pipeline.filter.guarantee.intact else "BOUNDS VOID"
    return f"{pipeline.counts['scans']} scans, {pipeline.map.cells_seen} cells, pose +-{widest_cm:.0f} cm, {promise}"


class _Watcher:
    """The remote subscriber: `terrabound watch` in a process of its own."""

    def __init__(self, locator: str, output: Path) -> None:
        self._map, self._report = output / "remote.npz", output / "remote.json"
        for old in (self._map, self._report):
            old.unlink(missing_ok=True)
        arguments = ["watch", "--connect", locator, "--map", str(self._map), "--report", str(self._report)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "service.cli", *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=os.environ | {"TERM": "dumb"},
        )

    def __enter__(self) -> "_Watcher":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()

    def finish(self) -> dict[str, Any]:
        """Ask it to end; what it received."""
        self._process.send_signal(signal.SIGTERM)
        try:
            _, errors = self._process.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            raise TerraboundError("the remote subscriber did not end within 30 s") from None
        if not self._report.exists():
            raise TerraboundError(f"the remote subscriber failed: {errors.decode(errors='replace').strip()}")
        received: dict[str, Any] = json.loads(self._report.read_text())
        return received
