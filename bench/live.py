"""The service as it runs on a robot: a process of its own, in real time, without lockstep. Start, load and latency."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.client import RemoteMap
from service.commands.demo import demo_configuration
from service.commands.emulated import EmulatedRobot

PATIENCE_S = 120.0
"""The first start compiles."""
TEXT = """## The service, live

`terrabound run` in a process of its own against the emulated robot of `terrabound demo`, in real time, without the
lockstep clock: laser 180 degrees / 1 degree at 75 Hz and 500 kBd, 350 inertial packets, 100 encoder readings and 10
fixes a second. CPU is that process's, all threads, as a share of one core. Latency runs from the read of the last byte
that a scan waited for (beyond the reordering window) to its tile at a subscriber in another process. A start is timed
from the process's start to the first tile at a subscriber, machine code cached.
"""


@dataclass(frozen=True, slots=True)
class Live:
    """What a drive of some seconds showed."""

    setting_up_s: float
    """From the start of the process to the first tile, where the scanner must be set up first."""
    resumed_s: float
    """The same after kill -9, while the scanner streams."""
    seconds: float
    cpu_share: float
    scans_per_s: float
    """Mapped."""
    latency_ms: dict[str, float | None]
    counts: Counter[str]
    """The pipeline's, at the end."""


def measure_live(seconds: float) -> Live:
    """Start, kill, start again, drive."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        loaded = demo_configuration(folder)
        locator = loaded.config.publish.listen[0]
        with EmulatedRobot(folder / "demo.toml", folder, duration_s=seconds + 60.0, speed=1.0, lockstep=False):
            _started(folder, locator).kill_at_first_tile()  # whatever was not compiled yet is now
        for old in (folder / "ports").iterdir():
            old.unlink()
        with EmulatedRobot(folder / "demo.toml", folder, duration_s=seconds + 60.0, speed=1.0, lockstep=False):
            setting_up_s = _started(folder, locator).kill_at_first_tile()
            service = _started(folder, locator)
            with RemoteMap(locator) as remote:
                resumed_s = service.wait_for_tile(remote)
                before, cpu_before, began = _counts(remote), service.cpu_s(), time.monotonic()
                time.sleep(seconds)  # the drive is what is measured
                passed_s, cpu_s = time.monotonic() - began, service.cpu_s() - cpu_before
                after = _counts(remote)
            service.end()
    return Live(
        setting_up_s,
        resumed_s,
        passed_s,
        cpu_s / passed_s,
        (after["scans"] - before["scans"]) / passed_s,
        remote.latencies_ms(),
        after,
    )


@dataclass(frozen=True, slots=True)
class _Service:
    """A `terrabound run`, and when it was started."""

    process: subprocess.Popen[bytes]
    locator: str
    began: float

    def wait_for_tile(self, remote: RemoteMap) -> float:
        """Seconds from its start to the first tile."""
        while not remote.tiles:
            if time.monotonic() - self.began > PATIENCE_S or self.process.poll() is not None:
                raise SystemExit(f"no tile came within {PATIENCE_S:g} s (exit code {self.process.poll()})")
            time.sleep(0.005)  # the passing of time is what is measured
        return time.monotonic() - self.began

    def kill_at_first_tile(self) -> float:
        """Kill it as soon as a subscriber has a tile; the seconds that took."""
        with RemoteMap(self.locator) as remote:
            took_s = self.wait_for_tile(remote)
        self.process.kill()
        self.process.wait()
        return took_s

    def cpu_s(self) -> float:
        """CPU time of all its threads so far."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def end(self) -> None:
        """As systemd ends it."""
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(30)


def _started(folder: Path, locator: str) -> _Service:
    command = [sys.executable, "-m", "service.cli", "run", "--config", str(folder / "demo.toml")]
    began = time.monotonic()
    return _Service(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL), locator, began)


def _counts(remote: RemoteMap) -> Counter[str]:
    counts: dict[str, Any] = remote.health.get("pipeline", {})
    return Counter(counts)


def section() -> str:
    """The page's section."""
    live = measure_live(20.0)
    p50, p99 = live.latency_ms["p50"] or float("nan"), live.latency_ms["p99"] or float("nan")
    return f"""{TEXT}
| what | measured | mark |
|---|---|---|
| CPU of the service | {100 * live.cpu_share:.0f} % of a core | 20 % |
| scans mapped a second | {live.scans_per_s:.1f} | 75 |
| latency p50, p99 | {p50:.1f} ms, {p99:.1f} ms | p99 10 ms |
| start, scanner to be set up | {live.setting_up_s:.1f} s | |
| start after kill -9, scanner streams | {live.resumed_s:.1f} s | 2 s to the first scan, 3 s to resume |
"""
