"""One thread a device: open the port, stamp and record what it gives, parse, queue; come back after an unplug.

This is the only place where a protocol meets a port and a clock.
"""

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from drivers.clock import Clock
from drivers.errors import CaptureError, PortError
from drivers.transports import Transport
from service.devices import Device
from service.health import Health
from service.lateness import Lateness, lateness_ns
from service.sample_queue import Arrival, SampleQueue

if TYPE_CHECKING:
    from drivers.capture import CaptureWriter

LONGEST_READ_S = 0.05
"""A read returns at least this often, so that deadlines and the wish to stop are seen."""
FIRST_RETRY_S, LAST_RETRY_S = 0.05, 2.0
"""Back-off between attempts to open a port that is away."""


class Reader:
    """Keeps one device's bytes flowing into the queue until told to stop."""

    def __init__(
        self,
        device: Device,
        clock: Clock,
        queue: SampleQueue,
        health: Health,
        capture: "CaptureWriter | None" = None,
        acknowledge: Callable[[str, int], None] | None = None,
    ) -> None:
        """`acknowledge(device, total bytes)` is called once bytes are parsed and queued; a lockstep waits for it."""
        self.protocol = device.protocol()
        self._device = device
        self._clock = clock
        self._queue = queue
        self._health = health
        self._capture = capture
        health.watch(
            device.name,
            device.stale_after_s,
            self.protocol.counts,
            lambda: getattr(self.protocol, "findings", ()),
        )
        self._acknowledge = acknowledge
        self._lateness = Lateness(self.protocol)
        self._total_bytes = 0
        self.failure: BaseException | None = None
        """What ended the thread, if it wasn't `stop`: a fault of ours or of the disk, never of the line."""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"reader-{device.name}", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End after the present read; returns when the port is closed."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        """The thread: whatever ends it early is kept for whoever watches over the service."""
        try:
            self._read_until_stopped()
        except BaseException as error:
            self.failure = error

    def _read_until_stopped(self) -> None:
        """Open, converse, and after a loss wait a little longer each time before trying again."""
        pause_s = FIRST_RETRY_S
        while not self._stopping.is_set():
            self._health.alive(self._device.name, time.monotonic_ns())
            try:
                transport = self._device.open()
            except PortError as error:
                self._health.port_failed(self._device.name, str(error))
                self._stopping.wait(pause_s)
                pause_s = min(2 * pause_s, LAST_RETRY_S)
                continue
            pause_s = FIRST_RETRY_S
            try:
                self._converse(transport)
            except PortError as error:
                self._health.port_failed(self._device.name, str(error))
            finally:
                transport.close()

    def _converse(self, transport: Transport) -> None:
        """Carry bytes between one open port and the protocol."""
        protocol, name = self.protocol, self._device.name
        opened_ns = self._clock.now_ns()
        protocol.connection_made(opened_ns)
        self._record(b"", opened_ns)  # an empty chunk: the port was opened here
        self._health.port_opened(name)
        while not self._stopping.is_set():
            if request := protocol.data_to_send():
                transport.write(request)
            if protocol.baud is not None:
                transport.set_baud(protocol.baud)
            data = transport.read(self._patience_s())
            received_ns = transport.read_ns
            now_ns = self._clock.read_at(received_ns) if data else self._clock.now_ns()
            self._health.alive(name, time.monotonic_ns())
            if protocol.deadline_ns is not None and protocol.deadline_ns <= now_ns:
                self._record(None, now_ns)
                protocol.advance(now_ns)
            if not data:
                continue
            late_ns = lateness_ns(self._clock.lain_ns(received_ns, transport.empty_ns))
            if transport.received_ns is not None:
                now_ns, late_ns = transport.received_ns, 0
            if late_ns:
                self._lateness.read_late(now_ns, late_ns)
                protocol.counts["late_reads"] += 1
            self._record(data, now_ns, late_ns)
            samples = self._lateness.widened(protocol.receive_data(data, now_ns))
            if samples:
                self._queue.put([Arrival(name, sample, received_ns) for sample in samples])
            self._total_bytes += len(data)
            self._health.received(name, len(data), len(samples), received_ns)
            if self._acknowledge is not None:
                self._acknowledge(name, self._total_bytes)

    def _record(self, data: bytes | None, now_ns: int, late_ns: int = 0) -> None:
        """Into the capture, if there is one (None: a deadline); where the disk refuses, mapping goes on without it."""
        if self._capture is None:
            return
        try:
            if data is None:
                self._capture.write_deadline(self._device.name, now_ns, time.time_ns())
            else:
                self._capture.write(self._device.name, data, now_ns, time.time_ns(), late_ns)
        except CaptureError as error:
            self._capture = None
            self._health.trouble("recording", str(error))

    def _patience_s(self) -> float:
        """How long the next read may wait: until the protocol's deadline, and never too long."""
        deadline_ns = self.protocol.deadline_ns
        if deadline_ns is None:
            return LONGEST_READ_S
        return min(max((deadline_ns - self._clock.now_ns()) * 1e-9, 0.0), LONGEST_READ_S)
