"""Measure the whole line: scan rate, latency, CPU share at the sensors' full rate, and speed when it may hurry."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.clock import LockstepClock
from service.commands.demo import demo_configuration
from service.commands.emulated import EmulatedRobot
from service.onboard import Onboard


@dataclass(frozen=True, slots=True)
class LineResult:
    """One drive of the emulated robot: laser 75 Hz, 350 inertial packets/s, ticks 100 Hz, GPS 10 Hz."""

    speed: float | Literal["max"]
    seconds_driven: float
    realtime_factor: float
    scans_per_s: float
    """Per second of the drive."""
    cpu_share: float
    """CPU time of the service's process per second of the drive: readers, filter, map, publisher."""
    latency_p50_ms: float
    """Last byte that a scan waited for to its tile at a subscriber in another process."""
    latency_p99_ms: float
    dropped: int
    """Samples dropped by the queue, or late."""


def measure_line(duration_s: float, speed: float | Literal["max"], scene: str = "stairs") -> LineResult:
    """Drive, map, publish and subscribe, in three processes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        loaded = demo_configuration(folder)
        report = folder / "remote.json"
        with EmulatedRobot(folder / "demo.toml", folder, scene=scene, duration_s=duration_s, speed=speed) as robot:
            clock = LockstepClock.attach(robot.clock_path)
            onboard = Onboard(loaded, clock, lockstep=True)
            onboard.start()
            watcher = subprocess.Popen(
                [
                    *(sys.executable, "-m", "service.cli", "watch"),
                    *("--connect", loaded.config.publish.listen[0], "--report", str(report)),
                ],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=os.environ | {"TERM": "dumb"},
            )
            began = time.monotonic(), time.process_time(), onboard.pipeline.counts["scans"]
            for driven_s in robot.follow():
                if driven_s is None:
                    began = time.monotonic(), time.process_time(), onboard.pipeline.counts["scans"]
            wall_s = time.monotonic() - began[0]
            cpu_s = time.process_time() - began[1]
            scans = onboard.pipeline.counts["scans"] - began[2]
            onboard.finish()
            onboard.publisher.flush(5.0)
            watcher.send_signal(signal.SIGTERM)
            watcher.wait(30)
            onboard.stop()
            clock.close()
        latency = json.loads(report.read_text())["latency_ms"]
        return LineResult(
            speed,
            duration_s,
            duration_s / wall_s,
            scans / duration_s,
            cpu_s / duration_s,
            latency["p50"],
            latency["p99"],
            sum(onboard.queue.dropped.values()) + sum(onboard.pipeline.late.values()),
        )
