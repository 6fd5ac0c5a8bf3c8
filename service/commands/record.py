"""`terrabound record`: the sensors' raw bytes into a capture, nothing else."""

import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

from drivers.clock import SystemClock
from drivers.errors import CaptureError
from drivers.port_read import read_in_machine_code
from service.config import load_for_ports
from service.devices import wiring
from service.lifecycle import stop_on_signals
from service.readers import Readers


def record(*, config: Path, output: Path) -> int:
    """Record the raw bytes of every device until Ctrl-C; `terrabound replay` makes the map from them.

    Parameters
    ----------
    config
        The robot's TOML file; its text goes into the capture.
    output
        MCAP file to write.
    """
    loaded = load_for_ports(config)
    # Samples are made for the devices' states alone: none is kept.
    readers = Readers(loaded, SystemClock(), devices=wiring(loaded), capture=output)
    health = readers.health
    read_in_machine_code()
    ended = threading.Event()
    with ExitStack() as stack:
        stack.enter_context(stop_on_signals(ended))
        readers.open_recording()
        stack.callback(readers.close)
        readers.start()
        stack.callback(readers.stop)
        while not ended.wait(0.5):
            if failure := health.troubles.get("recording"):
                raise CaptureError(failure)
            if readers.failure is not None:
                raise readers.failure
            if sys.stderr.isatty():
                states = health.status_line(time.monotonic_ns())
                size = output.stat().st_size / 1e6
                print(f"\r\x1b[K{output}: {size:.1f} MB | {states}", end="", file=sys.stderr, flush=True)
    if sys.stderr.isatty():
        print(file=sys.stderr)
    return 0
