"""`terrabound replay`: the map of a recorded drive, made again."""

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn

from drivers.capture import Capture, RawChunk, read_capture
from drivers.errors import CaptureError
from estimator.bounded_pose import BoundedPose
from service.commands.port_replay import replay_through_ports
from service.config import LoadedConfig, load, parse
from service.map_file import save_map
from service.messages import write_pose
from service.output_files import named_in_errors, refuse_unwritable
from service.pipeline import Pipeline
from service.replay import recorded_devices
from service.replay import replay as replay_directly


def replay(
    capture: Path,
    /,
    *,
    config: Path | None = None,
    map: Path | None = None,  # noqa: A002  the option's name is the contract
    poses: Path | None = None,
    ports: bool = False,
) -> int:
    """Put a capture's bytes through the same drivers, filter and mapper: the same map each time, bit for bit.

    It is the drive's own map, unless the service was too busy then to take every reading (health: `dropped`).

    Parameters
    ----------
    capture
        A recording made by run, record or demo (.mcap); one that was cut short, or is damaged,
        replays up to there.
    config
        Use these declared bounds instead of those in the capture.
    map
        Save the map to this .npz.
    poses
        Write the pose sets used for the scans to this file, a JSON line each.
    ports
        Through pseudo-terminals and the whole service instead of directly.
    """
    refuse_unwritable((map, poses), inputs=(capture, config))
    recording = read_capture(capture)
    loaded = configuration_of(recording, capture, config)
    with ExitStack() as stack:
        on_pose: Callable[[BoundedPose], None] | None = None
        newest: BoundedPose | None = None
        if poses is not None:
            stack.enter_context(named_in_errors(poses))
            lines = stack.enter_context(poses.open("w", encoding="utf-8"))

            def on_pose(pose: BoundedPose) -> None:
                nonlocal newest
                newest = pose
                print(write_pose(pose).decode(), file=lines)

        devices = recorded_devices(loaded, recording)
        chunks = with_progress(recording, stack)
        if ports:
            pipeline = replay_through_ports(loaded, chunks, devices, on_pose)
        else:
            pipeline = replay_directly(loaded, chunks, on_pose, devices)
        if on_pose is not None and newest is not None and newest.guarantee != pipeline.filter.guarantee:
            on_pose(replace(newest, guarantee=pipeline.filter.guarantee))  # by what came after the last scan
    _report(pipeline, recording)
    if map is not None:
        save_map(pipeline, map)
        print(map)
    return 0


def configuration_of(recording: Capture, path: Path, override: Path | None) -> LoadedConfig:
    """The configuration to replay with."""
    if override is not None:
        return load(override)
    if not recording.config_text:
        raise CaptureError(f"{path}: holds no configuration; name one with --config FILE")
    return parse(
        recording.config_text, folder=path.resolve().parent, source=f"configuration in {path}", dbc=recording.dbc_text
    )


def with_progress(recording: Capture, stack: ExitStack) -> Iterator[RawChunk]:
    """The chunks, with a live line on a terminal."""
    console = Console(stderr=True)
    progress = stack.enter_context(
        Progress(SpinnerColumn(), TextColumn("{task.description}"), console=console, disable=not console.is_terminal)
    )
    task = progress.add_task(f"replaying {recording.path.name}")
    return _counted(recording, lambda text: progress.update(task, description=text))


def _counted(chunks: Iterable[RawChunk], tell: Callable[[str], None]) -> Iterator[RawChunk]:
    first_ns = told_ns = None
    for chunk in chunks:
        first_ns = chunk.stamp_ns if first_ns is None else first_ns
        if told_ns is None or chunk.stamp_ns - told_ns > 500_000_000:
            told_ns = chunk.stamp_ns
            tell(f"{(chunk.stamp_ns - first_ns) * 1e-9:.0f} s of the recording")
        yield chunk


def _report(pipeline: Pipeline, recording: Capture) -> None:
    """What came of it, on standard error."""
    told = {f"late_{name}": count for name, count in pipeline.late.items()} | pipeline.counts
    counts = " ".join(f"{name}={count}" for name, count in sorted(told.items()))
    guarantee = pipeline.filter.guarantee
    promise = "bounds hold" if guarantee.intact else f"bounds void: contradicted by {guarantee.sensor}"
    cut = "; the recording is cut short, or damaged inside: replayed up to there" if recording.truncated else ""
    print(f"{counts} cells={pipeline.map.cells_seen}: {promise}{cut}", file=sys.stderr)
