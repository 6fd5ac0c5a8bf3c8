"""The whole emulated robot: four devices behind pseudo-terminals, driving through the simulated world.

Time goes in slices. At the end T of each slice the robot takes what the hosts wrote, and sends what every device has
finished sending by T. With a lockstep clock it then waits until the hosts have dealt with all of it, so that each byte
is stamped T however loaded the machine is; without one, T is the system's monotonic clock and nobody is waited for.
What this process then can't send within the declared latencies, because the machine kept it from running, is lost on
the line: late bytes would break a promise that the robot's owner has made of real devices.

The robot stands still until the hosts listen: the laser streams and the encoders' channel is open. Then its two seconds
of standstill begin, then the drive. In lockstep they begin at a whole multiple of five seconds, so that the readings of
the drive don't depend on how long the handshakes took.
"""

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from drivers.clock import LockstepClock, SystemClock
from drivers.config import DevicesConfig
from drivers.errors import PortLost
from simulator.emulated_devices import PluggedDevices, plug_in_all
from simulator.wire import PluggedWires
from simulator.world import World

SLICE_NS = 10_000_000
REAL_TIME_SLICE_NS = 2_000_000
SETTLE_S = 0.05
"""Hosts may flush a port just after they have opened it: nothing is sent for so long."""
PATIENCE_S = 60.0
"""How long a host may take over the bytes of one slice: it may have to compile first."""
PROGRESS_EVERY_NS = 200_000_000
BEGIN_GRID_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a run stands."""

    state: Literal["waiting", "starting", "driving", "done"]
    """Nobody has opened the ports; hosts talk to their devices; standstill and drive; over."""
    now_ns: int
    driven_s: float
    """Since the standstill began."""
    duration_s: float
    scans: int
    """Sent by the laser."""
    late_bytes: int = 0
    """Lost because this process could not send them in time."""
    overdue_bytes: int = 0
    """Sent too late all the same: this process was interrupted just then. They may break the declared latencies."""


def print_progress(progress: Progress) -> None:
    """One line of JSON on stdout, at once."""
    print(json.dumps(asdict(progress)), file=sys.stdout, flush=True)


def run_emulated_robot(
    world: World,
    devices: DevicesConfig,
    links: Mapping[str, Path] | Path,
    *,
    clock: LockstepClock | None = None,
    speed: float | None = None,
    truth_path: Path | None = None,
    slice_ns: int | None = None,
    on_progress: Callable[[Progress], None] = print_progress,
    stopping: threading.Event | None = None,
    stay: bool = False,
    punctual: bool = True,
    meddle: Callable[[PluggedWires, float], None] | None = None,
) -> None:
    """Open the ports, wait for the hosts, drive to the end of the world's drive, write the truth.

    links: a path for each device of `laser, encoders, imu, gps` that shall be there, or a folder for links of these
    names are made. Without laser or encoders the robot never drives.
    clock: in lockstep, whose `now_ns` is the world's `start_ns`; None: real time on the system's clock.
    slice_ns: by default SLICE_NS in lockstep, else REAL_TIME_SLICE_NS.
    speed: in lockstep, times real time; None: as fast as the hosts can. Before the drive it is never above 1.
    stopping, or Ctrl-C: end early, the truth is still written. stay: after the drive, stand still until stopped.
    punctual: in real time, what can't be sent within the declared latencies is lost; else it is sent late.
    meddle: called before each slice of the drive with the wires and the seconds driven, to pull plugs and the like.
    """
    stopping = stopping or threading.Event()
    slice_ns = slice_ns or (SLICE_NS if clock else REAL_TIME_SLICE_NS)
    start_ns = world.start_ns if clock else SystemClock().now_ns()
    in_time = punctual and clock is None
    plugged = plug_in_all(world, devices, links, slice_ns, start_ns, in_time)
    try:
        with _ahead_of_others() if in_time else contextlib.nullcontext():
            _Run(world, plugged, clock, speed, slice_ns, on_progress, stopping, stay, meddle).run(truth_path)
    finally:
        for wire in plugged.wires:
            wire.port.close()


@contextlib.contextmanager
def _ahead_of_others() -> Iterator[None]:
    """Run this thread before ordinary ones, where the system lets us: devices do not wait for a busy host.

    It also keeps the promise of the declared latencies, which an interruption between the look at the clock and the
    write would break.
    """
    before, least = os.sched_getscheduler(0), os.sched_param(os.sched_get_priority_min(os.SCHED_FIFO))
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, least)
    try:
        yield
    finally:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, before, os.sched_param(0))


class _Run:
    """The state of one run."""

    def __init__(
        self,
        world: World,
        devices: PluggedDevices,
        clock: LockstepClock | None,
        speed: float | None,
        slice_ns: int,
        on_progress: Callable[[Progress], None],
        stopping: threading.Event,
        stay: bool,
        meddle: Callable[[PluggedWires, float], None] | None,
    ) -> None:
        self._world, self._devices, self._clock = world, devices, clock
        self._speed, self._slice_ns, self._stay = speed, slice_ns, stay
        self._on_progress, self._stopping, self._meddle = on_progress, stopping, meddle
        self._now_ns = (clock or SystemClock()).now_ns()
        self._drive_start_ns: int | None = None
        self._reported_ns: int | None = None
        self._wires = devices.wires

    def run(self, truth_path: Path | None) -> None:
        """From the first open port to the end."""
        try:
            self._report("waiting")
            if self._clock is not None:
                self._wait_for_hosts()
            pace = _Pace(self._speed if self._clock is not None else 1.0)
            while not self._stopping.is_set():
                self._slice(pace)
                end_ns = self._world.drive_end_ns
                if end_ns is not None and self._now_ns >= end_ns and not self._stay:
                    break
            if self._clock is not None:
                self._wait_for_acknowledgements(self._clock)
        except KeyboardInterrupt:
            pass
        finally:
            if truth_path is not None:
                self._world.truth(self._now_ns).save(truth_path)
        self._report("done")

    def _wait_for_hosts(self) -> None:
        """In lockstep time stands still until every port is open."""
        while not all(wire.port.host_present for wire in self._wires) and not self._stopping.is_set():
            time.sleep(0.005)
        time.sleep(SETTLE_S)

    def _slice(self, pace: "_Pace") -> None:
        """One slice of time."""
        driving, heard = self._drive_start_ns is not None, self._devices.heard
        pace.wait(self._slice_ns, driving or heard)
        before_ns = self._now_ns
        if self._clock is not None:
            self._now_ns += self._slice_ns
            self._prepare()
        else:
            # However late this is: step by step, so that only what is late is lost.
            now_ns = SystemClock().now_ns()
            while self._now_ns < now_ns:
                self._now_ns = min(self._now_ns + self._slice_ns, now_ns)
                self._prepare()
        if self._clock is not None:
            # Only now, so that the hosts have dealt with the last slice while this one was made.
            self._wait_for_acknowledgements(self._clock)
        if self._meddle is not None and self._drive_start_ns is not None:
            self._meddle({wire.name: wire for wire in self._wires}, (before_ns - self._drive_start_ns) * 1e-9)
        if self._clock is not None:
            self._clock.set(self._now_ns)
        for wire in self._wires:
            wire.send()
        grid_ns = BEGIN_GRID_NS if self._clock is not None else 1
        if not driving and heard and (self._now_ns - self._world.start_ns) % grid_ns < self._slice_ns:
            self._drive_start_ns = self._now_ns
            self._world.begin_drive(self._now_ns)
        self._report_now_and_then("driving" if driving else "starting")

    def _prepare(self) -> None:
        """Every device up to now."""
        for wire in self._wires:
            wire.prepare(self._now_ns)

    def _wait_for_acknowledgements(self, clock: LockstepClock) -> None:
        """Until the hosts have dealt with every byte; a host that closed its port leaves its bytes behind."""
        deadline = time.monotonic() + PATIENCE_S
        while not clock.wait_for({wire.name: wire.due for wire in self._wires}, timeout_s=0.5):
            if self._stopping.is_set():
                return
            for wire in self._wires:
                wire.port.write()
                late = clock.acknowledged(wire.name) < wire.due
                if late and not wire.port.host_present:
                    wire.write_off(clock.acknowledged(wire.name))
                elif late and time.monotonic() > deadline:
                    raise PortLost(f"{wire.port.path}: the host has not dealt with its bytes for {PATIENCE_S:g} s")

    def _report_now_and_then(self, state: Literal["starting", "driving"]) -> None:
        if self._reported_ns is None or self._now_ns - self._reported_ns >= PROGRESS_EVERY_NS:
            self._report(state)
            self._reported_ns = self._now_ns

    def _report(self, state: Literal["waiting", "starting", "driving", "done"]) -> None:
        driven_ns = 0 if self._drive_start_ns is None else self._now_ns - self._drive_start_ns
        duration_s = self._world.drive.duration_ns * 1e-9
        late, overdue = (sum(getattr(wire, kind) for wire in self._wires) for kind in ("late_bytes", "overdue_bytes"))
        self._on_progress(
            Progress(state, self._now_ns, driven_ns * 1e-9, duration_s, self._devices.laser.scans_sent, late, overdue)
        )


class _Pace:
    """Holds slices back to a speed; a slice that is late makes the next ones hurry."""

    def __init__(self, speed: float | None) -> None:
        self._speed = speed
        self._next_s = time.monotonic()
        self._behind_limit_s = 0.5

    def wait(self, slice_ns: int, hurry: bool) -> None:
        """Sleep until the next slice may begin; without `hurry` the speed is at most that of real time."""
        speed = self._speed if hurry else min(self._speed or 1.0, 1.0)
        if speed is None:
            return
        self._next_s = max(self._next_s + slice_ns * 1e-9 / speed, time.monotonic() - self._behind_limit_s)
        left_s = self._next_s - time.monotonic()
        if left_s > 0:
            time.sleep(left_s)
