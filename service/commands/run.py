"""`terrabound run`: the service on the robot."""

import sys
import threading
import time
from pathlib import Path

from drivers.clock import SystemClock
from service.config import load
from service.lifecycle import ServiceNotifier, stop_on_signals
from service.onboard import Onboard
from service.status_line import status_line

TICK_S = 0.5


def run(*, config: Path) -> int:
    """Read the sensors, keep the pose set and the map, and stream tiles, until told to stop (SIGTERM, Ctrl-C).

    Parameters
    ----------
    config
        The robot's TOML file; docs/config/ holds examples.
    """
    loaded = load(config)
    record = loaded.config.record.path
    notifier = ServiceNotifier()
    ended = threading.Event()
    with stop_on_signals(ended):
        onboard = Onboard(loaded, SystemClock(), capture=None if record is None else loaded.path(record))
        onboard.start()
        notifier.ready()
        saved_ns = time.monotonic_ns()
        while not ended.wait(TICK_S) and onboard.failure is None:
            now_ns = time.monotonic_ns()
            line = status_line(onboard)
            notifier.status(line)
            notifier.feed(now_ns, onboard.health.flowing(now_ns))
            if sys.stderr.isatty():
                print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
            if now_ns - saved_ns > loaded.config.store.period_s * 1e9:
                saved_ns = now_ns
                onboard.request_save()
        notifier.stopping()
        onboard.stop()
    if sys.stderr.isatty():
        print(file=sys.stderr)
    if onboard.failure is not None:
        raise onboard.failure
    return 0
