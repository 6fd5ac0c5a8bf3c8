"""What passes between one device's port and its protocol: records in, samples and requests out. No thread of its own.

This is the only place where a protocol meets a port and a clock.
"""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from drivers.clock import Clock
from drivers.errors import CaptureError
from drivers.record_pipe import LOST, NOT_STAMPED, OPENED, Record
from service.devices import Device
from service.health import Health
from service.lateness import Lateness, lateness_ns
from service.reader import Request
from service.sample_queue import Arrival, SampleQueue

if TYPE_CHECKING:
    from drivers.capture import CaptureWriter


class Conversation:
    """One device's protocol, and where its samples go."""

    def __init__(
        self,
        device: Device,
        clock: Clock,
        queue: SampleQueue,
        health: Health,
        ask: Callable[[Request], None],
        capture: "CaptureWriter | None" = None,
        acknowledge: Callable[[str, int], None] | None = None,
    ) -> None:
        """`ask` has the port do something; it never waits.

        `acknowledge(device, total bytes)` is called once bytes are parsed and queued, and what the protocol answers has
        been asked for; a lockstep waits for it.
        """
        self.protocol = device.protocol()
        self._name = device.name
        self._clock = clock
        self._queue = queue
        self._health = health
        self._ask = ask
        self._capture = capture
        self._acknowledge = acknowledge
        self._lateness = Lateness(self.protocol)
        self._opening = 0
        self._baud: int | None = None
        """As asked for at this opening."""
        self._total_bytes = 0
        health.watch(
            device.name,
            device.stale_after_s,
            self.protocol.counts,
            lambda: getattr(self.protocol, "findings", ()),
        )

    def take(self, record: Record) -> None:
        """What one read gave, or what happened at the port."""
        read_ns = self._clock.read_at(record.read_ns)
        if record.size == OPENED:
            self._begin(record.opening, read_ns)
        elif record.size == LOST:
            # Bytes beside each other may not belong together: nothing of before is trusted.
            self.protocol.counts["lost_bytes"] += record.lost_bytes
            self._begin(record.opening, read_ns)
        else:
            self._receive(record, read_ns)
        self._request()
        if record.size > 0 and self._acknowledge is not None:
            self._acknowledge(self._name, self._total_bytes)

    def look_up(self, now_ns: int) -> None:
        """Let a deadline pass, where it has."""
        deadline_ns = self.protocol.deadline_ns
        if deadline_ns is not None and deadline_ns <= now_ns and self._opening:
            self._record(None, now_ns)
            self.protocol.advance(now_ns)
            self._request()

    def patience_s(self, now_ns: int) -> float:
        """How long until `look_up` has something to do."""
        deadline_ns = self.protocol.deadline_ns
        return float("inf") if deadline_ns is None or not self._opening else max(deadline_ns - now_ns, 0) * 1e-9

    def _begin(self, opening: int, now_ns: int) -> None:
        """The port was opened."""
        self._opening, self._baud = opening, None
        self.protocol.connection_made(now_ns)
        self._record(b"", now_ns)  # an empty chunk: the port was opened here

    def _receive(self, record: Record, now_ns: int) -> None:
        """Bytes have come."""
        protocol, data = self.protocol, record.data
        deadline_ns = protocol.deadline_ns
        if deadline_ns is not None and deadline_ns <= now_ns:
            self._record(None, now_ns)
            protocol.advance(now_ns)
        if record.received_ns != NOT_STAMPED:
            now_ns, late_ns = record.received_ns, 0
        else:
            late_ns = lateness_ns(self._clock.lain_ns(record.read_ns, record.empty_ns))
        if late_ns:
            self._lateness.read_late(now_ns, late_ns)
            protocol.counts["late_reads"] += 1
        self._record(data, now_ns, late_ns)
        samples = self._lateness.widened(protocol.receive_data(data, now_ns))
        if samples:
            self._queue.put([Arrival(self._name, sample, record.read_ns) for sample in samples])
        self._total_bytes += len(data)
        self._health.received(self._name, len(data), len(samples), record.read_ns)

    def _request(self) -> None:
        """Ask the port for what the protocol wants."""
        data, baud = self.protocol.data_to_send(), self.protocol.baud
        if data or baud != self._baud:
            self._baud = baud
            self._ask(Request(self._opening, data, baud))

    def _record(self, data: bytes | None, now_ns: int, late_ns: int = 0) -> None:
        """Into the capture, if there is one (None: a deadline); where the disk refuses, mapping goes on without it."""
        if self._capture is None:
            return
        try:
            if data is None:
                self._capture.write_deadline(self._name, now_ns, time.time_ns())
            else:
                self._capture.write(self._name, data, now_ns, time.time_ns(), late_ns)
        except CaptureError as error:
            self._capture = None
            self._health.trouble("recording", str(error))
