"""One thread a device: open the port, let it fill the pipe, write to it what is asked for; come back after an unplug.

It parses nothing (service/conversation.py does): nearly all its time passes in machine code, where the bytes are
stamped as they come. Whatever a port may keep waiting (opening it, a line that takes no bytes) keeps this thread alone.
"""

import os
import threading
import time
from collections import deque
from contextlib import suppress
from typing import NamedTuple

from drivers.errors import PortError
from drivers.record_pipe import OPENED, RecordPipe
from drivers.transports import Transport
from service.devices import Device
from service.health import Health

LONGEST_PUMP_S = 0.5
"""A reader says that it is at work at least this often."""
FIRST_RETRY_S, LAST_RETRY_S = 0.05, 2.0
"""Back-off between attempts to open a port that is away."""


class Request(NamedTuple):
    """What a protocol wants of its port: first these bytes sent, then another rate."""

    opening: int
    """... of this opening; a later one is not asked."""
    data: bytes
    baud: int | None


class Reader:
    """Keeps one device's bytes flowing into the pipe until told to stop."""

    def __init__(self, device: Device, number: int, pipe: RecordPipe, health: Health) -> None:
        """`number`: the port's, in the pipe."""
        self._device = device
        self._number = number
        self._pipe = pipe
        self._health = health
        self._opening = 0
        self._requests: deque[Request] = deque()
        self._wake_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.failure: BaseException | None = None
        """What ended the thread, if it wasn't `stop`: a fault of ours, never of the line."""
        self._stopping = threading.Event()
        self._settled = threading.Event()
        """Nothing that was asked is left to do."""
        self._thread = threading.Thread(target=self._run, name=f"reader-{device.name}", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End after the present read; returns when the port is closed."""
        self._stopping.set()
        self.wake()
        self._thread.join()

    def close(self) -> None:
        """After `stop`, once nobody asks it any more."""
        os.close(self._wake_fd)

    def ask(self, request: Request) -> None:
        """Have this done at the port, soon. Never waits."""
        self._requests.append(request)
        self._settled.clear()
        self.wake()  # in this order: the thread looks once more after this

    def settle(self, timeout_s: float) -> bool:
        """Wait until all that was asked is done; a port that is away, or takes nothing, is not waited for long."""
        return self._settled.wait(timeout_s)

    def wake(self) -> None:
        """Have the thread look up."""
        os.eventfd_write(self._wake_fd, 1)

    def _run(self) -> None:
        """The thread: whatever ends it early is kept for whoever watches over the service."""
        try:
            self._read_until_stopped()
        except BaseException as error:
            self.failure = error

    def _read_until_stopped(self) -> None:
        """Open, pump, and after a loss wait a little longer each time before trying again."""
        pause_s = FIRST_RETRY_S
        while not self._stopping.is_set():
            began_s = time.monotonic()
            self._health.alive(self._device.name, time.monotonic_ns())
            try:
                self._read_until_lost()
            except PortError as error:
                self._health.port_failed(self._device.name, str(error))
                if time.monotonic() - began_s > LAST_RETRY_S:  # it had been there; one that opens and fails had not
                    pause_s = FIRST_RETRY_S
                self._stopping.wait(pause_s)
                pause_s = min(2 * pause_s, LAST_RETRY_S)

    def _read_until_lost(self) -> None:
        """One opening of the port, until it is lost or nobody reads any more."""
        transport = self._device.open()
        try:
            self._pump(transport)
        finally:
            transport.close()

    def _pump(self, transport: Transport) -> None:
        """Keep one open port's bytes flowing, and do what is asked for."""
        self._opening += 1
        while not self._pipe.put(self._number, self._opening, OPENED, read_ns=time.monotonic_ns()):
            if self._stopping.wait(FIRST_RETRY_S):
                return
        self._health.port_opened(self._device.name)
        while not self._stopping.is_set():
            with suppress(BlockingIOError):
                os.eventfd_read(self._wake_fd)
            while self._requests:
                request = self._requests.popleft()
                if request.opening != self._opening:
                    continue
                transport.write(request.data)
                if request.baud is not None:
                    transport.set_baud(request.baud)
            self._settled.set()
            self._health.alive(self._device.name, time.monotonic_ns())
            transport.pump(self._pipe, self._number, self._opening, self._wake_fd, LONGEST_PUMP_S)
