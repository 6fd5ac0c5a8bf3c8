"""The service as it runs on a robot: a process of its own, in real time, without lockstep. Start, load and latency."""

import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from math import nan
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from bench.service_process import ServiceProcess, Started
from service.client import RemoteMap
from service.commands.demo import demo_configuration
from service.commands.emulated import EmulatedRobot

STARTS = 3
"""Of each kind."""
DRIVE_S = 120.0
"""After it the robot stands and is measured on."""
TEXT = f"""## The service, live

`terrabound run` in a process of its own against the emulated robot of `terrabound demo`, in real time, without the
lockstep clock: laser 180 degrees / 1 degree at 75 Hz and 500 kBd, 350 inertial packets, 100 encoder readings and 10
fixes a second. It runs at the unit's `Nice` (root only), robot and subscriber at 0, all on
the same cores. CPU is that process's, all threads, as a share of one core. Latency runs from the read of the last byte
that a scan waited for (beyond the reordering window) to its tile at a subscriber in another process. Scans that come
while the service starts wait until it can map; their tiles, all that come before the first word of health does, have a
row of their own. A start is timed from the process's start to the first scan in the map, and to the first tile at a
subscriber that was there before it; bytecode (as in any installed program) and machine code are on disk. What it waited
for a processor that other programs had (its main thread, by the scheduler's account) stands beside it. All are medians
of {STARTS}.
"""


@dataclass(frozen=True, slots=True)
class Live:
    """What a drive of some seconds showed."""

    setting_up: Started
    """Where the scanner must be set up first."""
    resumed: Started
    """After kill -9, while the scanner streams."""
    seconds: float
    cpu_share: float
    scans_per_s: float
    """Mapped."""
    latency_ms: tuple[float, float]
    """p50 and p99."""
    starting_ms: tuple[float, float]
    """Of the tiles before."""
    counts: Counter[str]
    """The pipeline's, at the end."""


def measure_live(seconds: float) -> Live:
    """Start, kill, start again, drive."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        loaded = demo_configuration(folder)
        config, locator = folder / "demo.toml", loaded.config.publish.listen[0]
        setting_up = []
        for number in range(1 + STARTS):
            with EmulatedRobot(config, folder, duration_s=DRIVE_S, speed=1.0, lockstep=False):
                started = ServiceProcess(config, locator).kill_at_first_tile()
            if number > 0:  # the first compiles what was not compiled yet
                setting_up.append(started)
            for old in (folder / "ports").iterdir():
                old.unlink()
        with EmulatedRobot(config, folder, duration_s=seconds + 60.0, speed=1.0, lockstep=False):
            ServiceProcess(config, locator).kill_at_first_tile()
            resumed = [ServiceProcess(config, locator).kill_at_first_tile() for _ in range(STARTS)]
            service = ServiceProcess(config, locator)
            with RemoteMap(locator) as remote:
                service.wait_for_tile(remote)
                before, cpu_before, began = remote.health, service.cpu_s(), time.monotonic()
                earlier = len(remote.latencies())
                time.sleep(seconds)  # the drive is what is measured
                passed_s, cpu_s = time.monotonic() - began, service.cpu_s() - cpu_before
                after, latencies = remote.health, remote.latencies()
            service.end()
    return Live(
        _median(setting_up),
        _median(resumed),
        passed_s,
        cpu_s / passed_s,
        _scans_per_s(before, after),
        _percentiles_ms(latencies[earlier:]),
        _percentiles_ms(latencies[:earlier]),
        _counts(after),
    )


def _scans_per_s(before: Mapping[str, Any], after: Mapping[str, Any]) -> float:
    """By health's own times: it is told once a second, and each may be that old."""
    passed_s: float = (after["time_ns"] - before["time_ns"]) * 1e-9
    return (_counts(after)["scans"] - _counts(before)["scans"]) / passed_s


def _median(starts: list[Started]) -> Started:
    """Each time by itself."""
    times = zip(*((start.scan_s, start.tile_s, start.cpu_s, start.waited_s) for start in starts), strict=True)
    return Started(*map(median, times))


def _counts(health: Mapping[str, Any]) -> Counter[str]:
    counts: dict[str, Any] = health.get("pipeline", {})
    return Counter(counts)


def _percentiles_ms(latencies_ns: list[int]) -> tuple[float, float]:
    """p50 and p99."""
    if not latencies_ns:
        return nan, nan
    p50, p99 = np.percentile(latencies_ns, (50, 99)) * 1e-6
    return float(p50), float(p99)


def _row(start: Started) -> str:
    return f"{start.scan_s:.2f} s, {start.tile_s:.2f} s, {start.cpu_s:.2f} s, {start.waited_s:.2f} s"


def section() -> str:
    """The page's section."""
    live = measure_live(20.0)
    (p50, p99), (starting_p50, starting_p99) = live.latency_ms, live.starting_ms
    return f"""{TEXT}
| what | measured | mark |
|---|---|---|
| CPU of the service | {100 * live.cpu_share:.0f} % of a core | 20 % |
| scans mapped a second | {live.scans_per_s:.1f} | 75 |
| latency p50, p99 | {p50:.1f} ms, {p99:.1f} ms | p99 10 ms |
| ... while the service starts | {starting_p50:.1f} ms, {starting_p99:.1f} ms | |
| start, scanner to be set up: first scan in the map, first tile, CPU, waiting until then | {_row(live.setting_up)} | |
| start after kill -9, scanner streams: the same | {_row(live.resumed)} | 2 s to the first scan, 3 s to resume |
"""
