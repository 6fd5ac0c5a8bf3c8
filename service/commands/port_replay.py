"""A capture, replayed through pseudo-terminals into the whole service: as the robot's ports would have given it."""

import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

from drivers.capture import RawChunk
from drivers.clock import LockstepClock
from drivers.errors import CaptureError, PortLost
from drivers.protocol import DeviceProtocol
from drivers.samples import Sample
from estimator.bounded_pose import BoundedPose
from service.config import LoadedConfig
from service.devices import Device, wiring
from service.lateness import Lateness
from service.onboard import Onboard
from service.pipeline import Pipeline
from simulator.ports import PseudoPort

OPEN_PATIENCE_S = 60.0
SETTLE_S = 0.05
"""A host flushes a port just after opening it: nothing is written for so long."""
READ_PATIENCE_S = 30.0


def replay_through_ports(
    loaded: LoadedConfig,
    chunks: Iterable[RawChunk],
    devices: Iterable[Device],
    on_pose: Callable[[BoundedPose], None] | None = None,
) -> Pipeline:
    """Write each chunk to its port at its recorded time, on a lockstep clock; returns the finished pipeline.

    Nothing is published.
    """
    if loaded.config.devices.encoders.interface == "socketcan":
        raise CaptureError(
            "the encoders were recorded from SocketCAN, which has no pseudo-terminal; replay without --ports"
        )
    chunks = iter(chunks)
    first = next(chunks, None)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="terrabound-")))
        start_ns = 0 if first is None else first.stamp_ns
        on_ports, links = _with_ports_in(loaded, folder)
        clock = LockstepClock.create(folder / "clock", tuple(links), start_ns)
        stack.callback(clock.close)
        readers_clock = LockstepClock.attach(folder / "clock")
        stack.callback(readers_clock.close)
        ports = {}
        for name, link in links.items():
            ports[name] = PseudoPort(link)
            stack.callback(ports[name].close)
        rehearsed = {device.name: _Rehearsed(device.protocol()) for device in devices}
        rewired = tuple(
            replace(device, protocol=partial(rehearsed.__getitem__, device.name)) for device in wiring(on_ports)
        )
        onboard = Onboard(
            on_ports, readers_clock, devices=rewired, on_pose=on_pose, lockstep=True, publish=False, keep=False
        )
        onboard.start()
        stack.callback(onboard.stop)
        wires = _Wires(clock, ports, onboard, rehearsed)
        wires.wait_until_open()
        if first is not None:
            for chunk in chain([first], chunks):
                wires.play(chunk)
        onboard.finish()
        if onboard.failure is not None:
            raise onboard.failure
        return onboard.pipeline


class _Rehearsed:
    """A driver whose deadlines pass where the recording says, not when the replay's clock happens to be looked at."""

    def __init__(self, protocol: DeviceProtocol[Sample]) -> None:
        self._protocol = protocol
        self._passed_ns: deque[int] = deque()
        self._late: deque[tuple[int, int]] = deque()
        self._lateness = Lateness(protocol)
        self.counts = protocol.counts

    @property
    def baud(self) -> int | None:
        """As the driver wants it."""
        return self._protocol.baud

    @property
    def deadline_ns(self) -> None:
        """The reader shall not look after deadlines."""
        return

    def deadline_passed(self, time_ns: int) -> None:
        """At this place in the recording; takes effect before the bytes that follow. Any thread."""
        self._passed_ns.append(time_ns)

    def read_late(self, read_ns: int, late_ns: int) -> None:
        """The read of this time, which is still to come, was late in the recording. Any thread."""
        self._late.append((read_ns, late_ns))

    def connection_made(self, now_ns: int) -> None:
        """As in the recording."""
        self.advance(now_ns)
        self._protocol.connection_made(now_ns)

    def advance(self, now_ns: int) -> None:
        """Let the recorded deadlines pass; nothing has asked the driver since."""
        while self._passed_ns:
            self._protocol.advance(self._passed_ns.popleft())

    def receive_data(self, data: bytes, stamp_ns: int) -> Sequence[Sample]:
        """As the service does it directly, see service/replay.py."""
        self.advance(stamp_ns)
        deadline_ns = self._protocol.deadline_ns
        if deadline_ns is not None and deadline_ns <= stamp_ns:
            self._protocol.advance(stamp_ns)
        while self._late:
            self._lateness.read_late(*self._late.popleft())
        return self._lateness.widened(self._protocol.receive_data(data, stamp_ns))

    def data_to_send(self) -> bytes:
        """Questions to a device that isn't there."""
        return self._protocol.data_to_send()


class _Wires:
    """The far ends of the ports."""

    def __init__(
        self,
        clock: LockstepClock,
        ports: dict[str, PseudoPort],
        onboard: Onboard,
        rehearsed: dict[str, "_Rehearsed"],
    ) -> None:
        self._clock = clock
        self._ports = ports
        self._onboard = onboard
        self._rehearsed = rehearsed
        self._totals = dict.fromkeys(ports, 0)
        self._opened: set[str] = set()

    def wait_until_open(self) -> None:
        """Until the service has opened every port."""
        deadline = time.monotonic() + OPEN_PATIENCE_S
        while not all(port.host_present for port in self._ports.values()):
            if self._onboard.failure is not None:
                raise self._onboard.failure
            if time.monotonic() > deadline:
                raise PortLost(f"the service has not opened its ports within {OPEN_PATIENCE_S:g} s")
            time.sleep(0.005)
        time.sleep(SETTLE_S)

    def play(self, chunk: RawChunk) -> None:
        """Give one chunk at its time, and wait until it was read; an empty chunk plugs the device in anew."""
        port = self._ports.get(chunk.device)
        if port is None:
            return
        if chunk.deadline:
            self._rehearsed[chunk.device].deadline_passed(chunk.stamp_ns)
            return
        self._clock.set(max(chunk.stamp_ns, self._clock.now_ns()))
        if chunk.data:
            if chunk.late_ns:
                self._rehearsed[chunk.device].read_late(chunk.stamp_ns, chunk.late_ns)
            self._totals[chunk.device] += len(chunk.data)
            port.write(chunk.data)
            self._wait_until_read()
        elif chunk.device in self._opened:
            port.unplug()
            port.replug()
            self.wait_until_open()
        else:
            self._opened.add(chunk.device)
        port.read()  # questions to a device that isn't there

    def _wait_until_read(self) -> None:
        deadline = time.monotonic() + READ_PATIENCE_S
        while not self._clock.wait_for(self._totals, timeout_s=0.2):
            if self._onboard.failure is not None:
                raise self._onboard.failure
            if time.monotonic() > deadline:
                raise PortLost(f"the service has not read its ports for {READ_PATIENCE_S:g} s")
            for port in self._ports.values():
                port.write()  # what didn't fit into the terminal's buffer


def _with_ports_in(loaded: LoadedConfig, folder: Path) -> tuple[LoadedConfig, dict[str, Path]]:
    """The same configuration with every port in `folder`, and where they are."""
    devices = loaded.config.devices
    names = ["laser", "encoders", "imu"] + ([] if devices.gps is None else ["gps"])
    links = {name: folder / name for name in names}
    moved = {name: replace(getattr(devices, name), port=str(link)) for name, link in links.items()}
    config = replace(loaded.config, devices=replace(devices, **moved))
    return replace(loaded, config=config), links
