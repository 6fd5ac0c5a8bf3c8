"""One emulated device on its pseudo-terminal: both directions, what comes too late, what the host left unread."""

from collections.abc import Mapping
from typing import TypeAlias

from drivers.clock import SystemClock
from simulator.emulators.emulator import Emulator
from simulator.ports import PseudoPort


class Wire:
    """One device and its port, and the account of its bytes."""

    def __init__(self, name: str, emulator: Emulator, port: PseudoPort) -> None:
        self.name, self.emulator, self.port = name, emulator, port
        self.patience_ns: int | None = None
        """Bytes that this process can't send within so much of their time are lost; None: nothing is ever late."""
        self.late_bytes = 0
        """So lost."""
        self.overdue_bytes = 0
        """Not in time when they were written, though they were just before."""
        self._prepared: list[tuple[int, bytes, int | None]] = []
        """(time before which nothing of it was due, the bytes, their rate)."""
        self._prepared_ns: int | None = None
        self._written = 0
        self._lost = 0

    @property
    def due(self) -> int:
        """Bytes that the host will have read in all when it has read everything."""
        return self._written - self.port.dropped_bytes - self._lost

    def exchange(self, now_ns: int) -> None:
        """Both directions, up to now."""
        self.prepare(now_ns)
        self.send()

    def prepare(self, now_ns: int) -> None:
        """Take what the host wrote, and have ready what the device has finished sending by `now_ns`."""
        due_ns = now_ns if self._prepared_ns is None else self._prepared_ns
        self._prepared_ns = now_ns
        if request := self.port.read():
            self.emulator.receive_data(self._on_the_line(request), now_ns)
        # A device that changes its rate hands out what it sent before by itself.
        while True:
            rate = self.emulator.baud
            data = self.emulator.data_to_send(now_ns)
            if data:
                self._prepared.append((due_ns, data, rate))
            if self.emulator.baud == rate:
                return

    def send(self) -> None:
        """Write what is ready."""
        for due_ns, data, rate in self._prepared:
            if self._is_late(due_ns):
                self.late_bytes += len(data)
                continue
            self._written += len(data)
            self.port.write(self._on_the_line(data, rate))
            if self._is_late(due_ns):
                self.overdue_bytes += len(data)
        self._prepared.clear()

    def _is_late(self, due_ns: int) -> bool:
        """Is it too late now to send what was due then?"""
        return self.patience_ns is not None and SystemClock().now_ns() - due_ns > self.patience_ns

    def write_off(self, acknowledged: int) -> None:
        """What the host left unread when it closed the port is lost."""
        self._lost += self.due - acknowledged

    def _on_the_line(self, data: bytes, rate: int | None = None) -> bytes:
        """What the other end makes of bytes: themselves at one rate, garbage where the rates differ."""
        rate = self.emulator.baud if rate is None else rate
        return data if rate is None else as_heard(data, rate, self.port.host_baud)


def as_heard(data: bytes, sent_at: int, read_at: int | None) -> bytes:
    """What a line makes of bytes: themselves where both ends have one rate, garbage where the rates differ."""
    return data if read_at == sent_at else bytes((0x5B * byte + 0x9D) & 0xFF | 0x80 for byte in data)


PluggedWires: TypeAlias = Mapping[str, Wire]
"""The wires of the emulated robot by the names of their devices."""
