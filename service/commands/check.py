"""`terrabound check`: is everything there, and does it speak as configured?"""

import sys
import threading
import time
from collections import Counter, deque
from dataclasses import astuple
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, validators
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from drivers.clock import SystemClock
from drivers.port_read import read_in_machine_code
from drivers.protocol import DeviceProtocol
from drivers.samples import Sample
from service.commands.check_bounds import check_bounds
from service.commands.check_outputs import output_problems
from service.commands.line_rates import rate_that_is_understood
from service.config import load_for_ports
from service.devices import Device, wiring
from service.health import DeviceState
from service.lifecycle import stop_on_signals
from service.passive import why_nothing
from service.readers import Readers

EXIT_USAGE = 2
LOOK_S, LOOKS = 0.2, 10
"""Devices are looked at so often, and judged by so many looks."""
NO_SAMPLES = {
    "imu": "speaks MAVLink, but sends none of the messages that are read; have it send HIGHRES_IMU and ATTITUDE",
    "gps": "speaks NMEA, but tells no position that can be used; give the antenna a view of the sky, and wait",
    "encoders": "gives CAN frames, but not both counters; check devices.encoders.left and .right against the DBC file",
}
"""Where frames are understood and make no sample."""
SPEAK_BY_THEMSELVES = ("imu", "gps")
"""Devices that need no asking: their rate can be found by listening. The scanner's is found in any case."""


def check(
    *,
    config: Path | None = None,
    bounds: Path | None = None,
    report: Path | None = None,
    seconds: Annotated[float, Parameter(validator=validators.Number(gte=0, lte=600))] = 12.0,
) -> int:
    """Check the configuration, then listen to every device and say what is wrong and how to mend it.

    Tries as well whether recording, store and map can be written and the address be listened at.

    Ends with 78 if the configuration is wrong, 1 if a device is missing or silent or anything else is amiss, 0 if all
    is well. With --bounds a recorded drive is held against the declared bounds instead: 1 if it contradicts one.

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
        How long to listen at most: it is enough when all devices have streamed for two seconds. 0 checks the
        configuration alone.
    """
    if bounds is not None:
        return check_bounds(bounds, config, report)
    if config is None or report is not None:
        what = "--report is of --bounds: leave it out" if config else "name the robot's TOML file with --config"
        print(f"terrabound check: {what}, or a capture with --bounds", file=sys.stderr)
        return EXIT_USAGE
    console = Console()
    loaded = load_for_ports(config)
    devices = wiring(loaded)
    console.print(f"{config}: configuration is valid", markup=False, highlight=False, soft_wrap=True)
    if seconds == 0:
        return 0
    read_in_machine_code()
    readers, ended = Readers(loaded, SystemClock(), devices=devices), threading.Event()
    health = readers.health
    with stop_on_signals(ended):
        readers.start()
        deadline = time.monotonic() + seconds
        looks = {device.name: deque[DeviceState](maxlen=LOOKS) for device in devices}
        with console.status("listening to the devices"):
            while not ended.wait(LOOK_S) and time.monotonic() < deadline:
                for name, seen in looks.items():
                    seen.append(health.state(name, time.monotonic_ns()))
                if all(list(seen) == LOOKS * [DeviceState.STREAMING] for seen in looks.values()):
                    break
        snapshot = health.snapshot(time.monotonic_ns())["devices"]
        readers.stop()
        readers.close()
    table = Table("device", "state", "samples/s", "bytes/s", "damaged", Column("port", overflow="fold"), box=SIMPLE)
    remarks, problems = [], output_problems(loaded)
    for device, conversation in zip(devices, readers, strict=True):
        row = snapshot[device.name]
        if looks[device.name]:  # not what it was in the last instant, but what it mostly was of late
            row["state"] = Counter(looks[device.name]).most_common(1)[0][0].value
        state, port = Text(row["state"].lower()), Text(device.port)
        rates = f"{row['samples_per_s']:.1f}", f"{row['bytes_per_s']:.0f}"
        table.add_row(device.name, state, *rates, f"{100 * _damaged(row):.1f} %", port)
        remarks.append(_remark(device, row, conversation.protocol))
        remarks += [f"{device.name}: {finding}" for finding in row["findings"]]
        problems += _problems(device, row, conversation.protocol)
    console.print(table)
    for line in filter(None, remarks):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    for line in problems:
        console.print(line, style="red", markup=False, highlight=False, soft_wrap=True)
    if not problems:
        console.print("all devices stream, and what the service writes can be written", style="green")
    return 1 if problems else 0


def _damaged(row: dict[str, Any]) -> float:
    """The share of a device's bytes that belong to no frame."""
    skipped, total = int(row["counts"].get("skipped_bytes", 0)), int(row["bytes"])
    return min(1.0, skipped / max(1, total))


def _remark(device: Device, row: dict[str, Any], protocol: DeviceProtocol[Sample]) -> str:
    """Who the device says that it is, and what its protocol has counted."""
    identity = getattr(protocol, "identity", None)
    words = [str(value) for value in astuple(identity) if value] if identity else []
    words += [f"{name}={count}" for name, count in sorted(row["counts"].items()) if count]
    return f"{device.name}: {' '.join(words)}" if words else ""


def _problems(device: Device, row: dict[str, Any], protocol: DeviceProtocol[Sample]) -> list[str]:
    """What is wrong with a device, and what to do."""
    name, port, counts = device.name, device.port, row["counts"]
    state = getattr(protocol, "state", "")
    where = f" ({state})" if state else ""
    problems = []
    match row["state"]:
        case DeviceState.CONNECTING | DeviceState.LOST:
            problems.append(f"{name}: {row['failure'] or f'{port}: not opened yet; listen longer (--seconds)'}")
        case DeviceState.STALE:
            problems.append(f"{name}: {port} is silent{where}; check the device's power, its cable, and its rate")
        case DeviceState.DEGRADED if state.startswith("halted"):
            problems.append(f"{name}: {port}: {state}")
        case DeviceState.DEGRADED if not row["samples"]:
            understood = counts.get("frames", 0) + counts.get("sentences", 0)
            what = NO_SAMPLES.get(name) if understood else why_nothing(counts)
            problems.append(f"{name}: {port} {what or f'gives bytes that are not understood{where}; {_mend(device)}'}")
        case DeviceState.DEGRADED if _damaged(row) > 0:
            problems.append(
                f"{name}: {100 * _damaged(row):.1f} % of the bytes from {port} are damaged{where}; check its plug, its "
                "cable and shield, and the ground between both ends"
            )
        case DeviceState.DEGRADED if not counts.get("stuck"):
            problems.append(f"{name}: {port} is not at its best{where}: see its counts above")
    if counts.get("stuck"):
        sensors = str(getattr(getattr(protocol, "identity", None), "sensors", "")).split(", ")
        stuck = [sensor for sensor in sensors if sensor.endswith("(stuck)")]
        if stuck:
            problems.append(f"{name}: {', '.join(stuck)}: its readings never change; check this sensor and its supply")
    return problems


def _mend(device: Device) -> str:
    """For bytes that nothing can be made of: the rate, if another one is understood."""
    rate = rate_that_is_understood(device) if device.name in SPEAK_BY_THEMSELVES else None
    if rate is not None:
        return f"the device speaks at {rate} baud: set devices.{device.name}.baud = {rate}"
    return "check the rate, the wiring, and that the right device is on this port"
