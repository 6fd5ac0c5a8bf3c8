"""`terrabound check`: is everything there, and does it speak as configured?"""

import sys
import threading
import time
from dataclasses import astuple
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, validators
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from drivers.clock import SystemClock
from service.commands.check_bounds import check_bounds
from service.config import load
from service.devices import Device, wiring
from service.health import DeviceState, Health
from service.lifecycle import stop_on_signals
from service.reader import Reader
from service.sample_queue import SampleQueue

EXIT_USAGE = 2


def check(
    *,
    config: Path | None = None,
    bounds: Path | None = None,
    report: Path | None = None,
    seconds: Annotated[float, Parameter(validator=validators.Number(gte=0, lte=600))] = 8.0,
) -> int:
    """Check the configuration, then listen to every device and say what is wrong and how to mend it.

    Ends with 78 if the configuration is wrong, 1 if a device is missing or silent, 0 if all is well. With --bounds a
    recorded drive is held against the declared bounds instead: 1 if it contradicts one.

    Parameters
    ----------
    config
        The robot's TOML file. With --bounds: instead of the one in the capture.
    bounds
        A capture of the standing and the driving robot: how much of each declared bound do its readings use up,
        which bound do they contradict, which look too wide?
    report
        With --bounds: write the same to this file as JSON.
    seconds
        How long to listen; 0 checks the configuration alone.
    """
    if bounds is not None:
        return check_bounds(bounds, config, report)
    if config is None:
        print("terrabound check: name the robot's TOML file with --config, or a capture with --bounds", file=sys.stderr)
        return EXIT_USAGE
    console = Console()
    loaded = load(config)
    devices = wiring(loaded)
    console.print(f"{config}: configuration is valid", markup=False, highlight=False, soft_wrap=True)
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
    table = Table("device", "state", "samples/s", "bytes/s", Column("port", overflow="fold"), box=SIMPLE)
    remarks, problems = [], []
    for device, reader in zip(devices, readers, strict=True):
        row = snapshot[device.name]
        state, port = Text(row["state"].lower()), Text(device.port)
        table.add_row(device.name, state, f"{row['samples_per_s']:.1f}", f"{row['bytes_per_s']:.0f}", port)
        remarks.append(_remark(device, row, reader))
        if row["state"] != DeviceState.STREAMING:
            problems.append(_advice(device, row, reader))
    console.print(table)
    for line in filter(None, remarks):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    for line in problems:
        console.print(line, style="red", markup=False, highlight=False, soft_wrap=True)
    if not problems:
        console.print("all devices stream", style="green")
    return 1 if problems else 0


def _remark(device: Device, row: dict[str, Any], reader: Reader) -> str:
    """Who the device says that it is, and what its protocol has counted."""
    identity = getattr(reader.protocol, "identity", None)
    words = [str(value) for value in astuple(identity) if value] if identity else []
    words += [f"{name}={count}" for name, count in sorted(row["counts"].items()) if count]
    return f"{device.name}: {' '.join(words)}" if words else ""


def _advice(device: Device, row: dict[str, Any], reader: Reader) -> str:
    """What is wrong with a device, and what to do."""
    state = getattr(reader.protocol, "state", "")
    where = f" ({state})" if state else ""
    match row["state"]:
        case DeviceState.CONNECTING | DeviceState.LOST:
            return f"{device.name}: {row['failure'] or f'{device.port}: not opened yet; listen longer (--seconds)'}"
        case DeviceState.STALE:
            return f"{device.name}: {device.port} is silent{where}; check the device's power, its cable, and its rate"
        case _ if state.startswith("halted"):
            return f"{device.name}: {device.port}: {state}"
        case _:
            return (
                f"{device.name}: {device.port} gives bytes that are partly or wholly not understood{where}; "
                "check the rate, the wiring, and that the right device is on this port"
            )
