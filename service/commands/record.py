"""`terrabound record`: the sensors' raw bytes into a capture, nothing else."""

import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

from drivers.capture import CaptureWriter
from drivers.clock import SystemClock
from drivers.errors import CaptureError
from drivers.port_read import read_in_machine_code
from service.config import load
from service.devices import can_frames, wiring
from service.health import Health
from service.lifecycle import stop_on_signals
from service.reader import Reader
from service.sample_queue import SampleQueue


def record(*, config: Path, output: Path) -> int:
    """Record the raw bytes of every device until Ctrl-C; `terrabound replay` makes the map from them.

    Parameters
    ----------
    config
        The robot's TOML file; its text goes into the capture.
    output
        MCAP file to write.
    """
    loaded = load(config)
    devices = wiring(loaded)
    read_in_machine_code()
    health = Health()
    queue = SampleQueue(capacity=1024)
    ended = threading.Event()
    with ExitStack() as stack:
        stack.enter_context(stop_on_signals(ended))
        capture = CaptureWriter(output, loaded.text, loaded.dbc_text(), can_frames(devices))
        stack.callback(capture.close)
        readers = [Reader(device, SystemClock(), queue, health, capture) for device in devices]
        for reader in readers:
            reader.start()
            stack.callback(reader.stop)
        while not ended.wait(0.5):
            if failure := health.troubles.get("recording"):
                raise CaptureError(failure)
            for reader in readers:
                if reader.failure is not None:
                    raise reader.failure
            queue.take(0)  # samples are parsed for the states below only
            if sys.stderr.isatty():
                states = health.status_line(time.monotonic_ns())
                size = output.stat().st_size / 1e6
                print(f"\r\x1b[K{output}: {size:.1f} MB | {states}", end="", file=sys.stderr, flush=True)
    if sys.stderr.isatty():
        print(file=sys.stderr)
    return 0
