"""`terrabound check`: is everything there, and does it speak as configured?"""

import threading
import time
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators
from rich.console import Console
from rich.table import Table

from drivers.clock import SystemClock
from service.config import load
from service.devices import Device, wiring
from service.health import DeviceState, Health
from service.lifecycle import stop_on_signals
from service.reader import Reader
from service.sample_queue import SampleQueue


def check(
    *,
    config: Path,
    seconds: Annotated[float, Parameter(validator=validators.Number(gte=0, lte=600))] = 8.0,
) -> int:
    """Check the configuration, then listen to every device and say what is wrong and how to mend it.

    Ends with 78 if the configuration is wrong, 1 if a device is missing or silent, 0 if all is well.

    Parameters
    ----------
    config
        The robot's TOML file.
    seconds
        How long to listen; 0 checks the configuration alone.
    """
    console = Console()
    loaded = load(config)
    devices = wiring(loaded)
    console.print(f"{config}: configuration is valid")
    if seconds == 0:
        return 0
    health, queue, ended = Health(), SampleQueue(capacity=1024), threading.Event()
    readers = [Reader(device, SystemClock(), queue, health) for device in devices]
    with stop_on_signals(ended):
        for reader in readers:
            reader.start()
        deadline = time.monotonic() + seconds
        with console.status("listening to the devices"):
            while not ended.wait(0.2) and time.monotonic() < deadline:
                queue.take(0)
        snapshot = health.snapshot(time.monotonic_ns())["devices"]
        for reader in readers:
            reader.stop()
    table = Table("device", "port", "state", "identity", "samples/s", "bytes/s", "counts")
    problems = []
    for device, reader in zip(devices, readers, strict=True):
        row = snapshot[device.name]
        identity = getattr(reader.protocol, "identity", None)
        counts = " ".join(f"{name}={count}" for name, count in sorted(row["counts"].items()) if count)
        table.add_row(
            device.name,
            device.port,
            row["state"],
            str(identity or ""),
            f"{row['samples_per_s']:.1f}",
            f"{row['bytes_per_s']:.0f}",
            counts,
        )
        if row["state"] != DeviceState.STREAMING:
            problems.append(_advice(device, row))
    console.print(table)
    for problem in problems:
        console.print(problem, style="red", soft_wrap=True)
    return 1 if problems else 0


def _advice(device: Device, row: dict[str, object]) -> str:
    """What is wrong with a device, and what to do."""
    match row["state"]:
        case DeviceState.CONNECTING | DeviceState.LOST:
            return f"{device.name}: {row['failure'] or f'{device.port}: not opened yet; listen longer (--seconds)'}"
        case DeviceState.STALE:
            return f"{device.name}: {device.port} is silent; check the device's power, its cable, and its rate"
        case _:
            return (
                f"{device.name}: {device.port} gives bytes that are partly or wholly not understood; "
                "check the rate, the wiring, and that the right device is on this port"
            )
