"""One emulated device alone on a pseudo-terminal, its line as bad as wanted: for trying hosts against it.

Nobody holds its readings against a truth, so nothing is lost where this process comes late: late bytes are sent late.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.clock import SystemClock
from drivers.config import DevicesConfig
from simulator.emulated_devices import emulate_devices, plug_in
from simulator.emulated_robot import REAL_TIME_SLICE_NS, SLICE_NS
from simulator.emulators.emulator import Emulator
from simulator.emulators.faulty import FaultyEmulator
from simulator.line_faults import LINES, Fault, LineFaults
from simulator.wire import Wire
from simulator.world import World

LINE_OF = {"laser": "lms", "encoders": "encoders", "imu": "imu", "gps": "gps"}
"""The wire of each device."""


@dataclass(frozen=True, slots=True)
class DeviceAlone:
    """What is emulated, and how."""

    name: str
    """`laser`, `encoders`, `imu` or `gps`."""
    link: Path
    speed: float = 1.0
    """Its time runs so many times faster than the host's: rates, timeouts, transfer times."""
    faults: Sequence[Fault] = ()
    seed: int = 1
    """Of the faults."""
    own_messages: bool = False
    """Does the inertial board speak the messages of drivers/imu/terrabound.xml?"""


def run_device(
    world: World,
    devices: DevicesConfig,
    alone: DeviceAlone,
    stopping: threading.Event,
    on_ready: Callable[[], None] = lambda: None,
) -> FaultyEmulator | None:
    """Emulate until `stopping`, on a robot that stands still; what its faults came to, where it has any.

    ValueError where the wire can't have such faults, ConfigurationError where the link's name is taken.
    """
    start_ns = SystemClock().now_ns()
    _, _, emulators = emulate_devices(world, devices, REAL_TIME_SLICE_NS, start_ns, alone.own_messages)
    device: Emulator = emulators[alone.name]
    faulty: FaultyEmulator | None = None
    if alone.faults:
        line = LINES[LINE_OF[alone.name]]
        device = faulty = FaultyEmulator(device, line, LineFaults(line, alone.faults, alone.seed))
    wire = Wire(alone.name, device, plug_in(alone.link))
    try:
        on_ready()
        now_ns = start_ns
        while not stopping.wait(REAL_TIME_SLICE_NS * 1e-9):
            until_ns = start_ns + int((SystemClock().now_ns() - start_ns) * alone.speed)
            while now_ns < until_ns:
                now_ns = min(now_ns + SLICE_NS, until_ns)
                wire.exchange(now_ns)
    finally:
        wire.port.close()
    return faulty
