"""`terrabound run` in a process of its own: started, watched from outside, killed or ended."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from service.client import RemoteMap

PATIENCE_S = 900.0
"""The first start compiles: 100 s of CPU, which took seven minutes at a load of ten."""
UNIT = Path(__file__).resolve().parents[1] / "systemd" / "terrabound.service"


def niceness() -> str:
    """As systemd starts it."""
    return next(line.partition("=")[2] for line in UNIT.read_text().splitlines() if line.startswith("Nice="))


@dataclass(frozen=True, slots=True)
class Started:
    """How long a start took."""

    scan_s: float
    """From the process's start until a scan was in the map, as its health tells."""
    tile_s: float
    """... until a subscriber had a tile."""
    cpu_s: float
    """The process's, all threads, until then."""
    waited_s: float
    """Its main thread's, for a processor that others had, until then."""


class ServiceProcess:
    """A running service, and when it was started."""

    def __init__(self, config: Path, locator: str) -> None:
        """Start it; it publishes at `locator`."""
        self.locator = locator
        # An installed program has its bytecode beside it; this one's is written by its first start.
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        self._began = time.monotonic()
        self._process = subprocess.Popen(
            # Where the bench may not, `nice` says so and starts it all the same.
            ["nice", "-n", niceness(), sys.executable, "-m", "service.cli", "run", "--config", config],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def wait_for_tile(self, remote: RemoteMap) -> Started:
        """How long it took until `remote` had its first tile."""
        while not remote.tiles:
            self._wait("no tile came")
        tile_s, cpu_s, waited_s = time.monotonic() - self._began, self.cpu_s(), self.waited_s()
        while remote.health.get("first_scan_s") is None:
            self._wait("health tells of no scan")
        return Started(remote.health["first_scan_s"], tile_s, cpu_s, waited_s)

    def kill_at_first_tile(self) -> Started:
        """Kill it once a subscriber has a tile; how long that took."""
        with RemoteMap(self.locator) as remote:
            started = self.wait_for_tile(remote)
        self._process.kill()
        self._process.wait()
        return started

    def cpu_s(self) -> float:
        """CPU time of all its threads so far."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def waited_s(self) -> float:
        """How long its main thread was ready to run, and something else ran."""
        return int(Path(f"/proc/{self._process.pid}/schedstat").read_text().split()[1]) * 1e-9

    def end(self) -> None:
        """As systemd ends it."""
        self._process.send_signal(signal.SIGTERM)
        self._process.wait(30)

    def _wait(self, failing: str) -> None:
        """The passing of time is what is measured."""
        if time.monotonic() - self._began > PATIENCE_S or self._process.poll() is not None:
            raise SystemExit(f"{failing} within {PATIENCE_S:g} s (exit code {self._process.poll()})")
        time.sleep(0.005)
