"""What every driver's protocol is: bytes in, samples out, no port, no clock.

The shell around it (service/reader.py) does the input and output:

    protocol.connection_made(now)                    # at each opening of the port
    while running:
        transport.write(protocol.data_to_send())     # whatever it wants sent now
        transport.set_baud(protocol.baud)            # if it wants another line rate
        data = transport.read(until protocol.deadline_ns)
        samples = protocol.receive_data(data, now)   # or protocol.advance(now) when the deadline has passed
"""

from collections import Counter
from collections.abc import Sequence
from typing import Protocol, TypeVar, runtime_checkable

from drivers.samples import Sample

S_co = TypeVar("S_co", bound=Sample, covariant=True)


class DeviceProtocol(Protocol[S_co]):
    """One end of a wire. Bad bytes never raise; they are counted and the stream is resynchronised."""

    counts: Counter[str]
    """What happened, by name: `scans`, `bad_crc`, `skipped_bytes`... for health and for people."""

    @property
    def baud(self) -> int | None:
        """Line rate wanted now; None where the wire has none."""

    @property
    def deadline_ns(self) -> int | None:
        """When `advance` wants to be called next; None if nothing is pending."""

    def connection_made(self, now_ns: int) -> None:
        """The port was opened, or opened again after a loss: begin afresh, trust nothing of the old stream.

        Counts are kept; epochs rise, so that nobody subtracts across the gap.
        """

    def receive_data(self, data: bytes, stamp_ns: int) -> Sequence[S_co]:
        """Take bytes that one read gave at host time `stamp_ns`; return the samples they complete."""

    def advance(self, now_ns: int) -> None:
        """Let time pass: timeouts fire, requests are repeated."""

    def data_to_send(self) -> bytes:
        """Bytes to write now; each is handed out once."""


@runtime_checkable
class ComparesTimes(Protocol):
    """A device protocol that judges by the time between two readings, and must know how well it is known."""

    def read_late(self, late_ns: int) -> None:
        """The bytes that come next may have been there for so long before their read (beyond the latency)."""
