"""Host time: the system's monotonic clock, or a virtual one that several processes share in lockstep.

In lockstep one process drives: it sets the time, writes what the devices have sent by then, and waits until the others
acknowledge that these bytes were read and dealt with. So every read of a time slice is stamped with exactly the
slice's time, however loaded the machine is, and a run can be repeated bit for bit.

    driver:  clock.set(T);  port.write(...);  clock.wait_for({"imu": total written so far}, timeout_s=1.0)
    reader:  data = read();  protocol.receive_data(data, clock.now_ns());  clock.acknowledge("imu", total read so far)

The time and the acknowledged totals stand in a small mapped file; a FIFO beside it (same name with `.ack`) wakes the
driver. Each word of the file has one writer, so nothing is locked and nobody's death can block the others.
"""

import contextlib
import mmap
import os
import select
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from drivers.errors import PortMissing

_MAGIC = int.from_bytes(b"terraclk", "little") & 0x7FFF_FFFF_FFFF_FFFF
_MAGIC_WORD, _NOW_WORD, _DEVICES_WORD, _HEADER_WORDS = 0, 1, 2, 8
_NAME_BYTES = 56
_SLOT_WORDS = 1 + _NAME_BYTES // 8
"""A device's slot: the total acknowledged, then its name."""


class Clock(Protocol):
    """Where the host's time comes from."""

    def now_ns(self) -> int:
        """Monotonic time in nanoseconds."""

    def read_at(self, read_ns: int) -> int:
        """The time of a read that was over at `read_ns` of the system's clock."""

    def lain_ns(self, read_ns: int, empty_ns: int) -> int:
        """How long bytes read then may have lain in a port that the system's clock saw empty at `empty_ns`."""

    def acknowledge(self, device: str, total_bytes: int) -> None:
        """Say that `total_bytes` of `device` have been read and dealt with since the start."""


class SystemClock:
    """The machine's monotonic clock; nobody waits for acknowledgements."""

    def now_ns(self) -> int:
        """Nanoseconds of the monotonic clock."""
        return time.monotonic_ns()

    def read_at(self, read_ns: int) -> int:
        """The same clock."""
        return read_ns

    def lain_ns(self, read_ns: int, empty_ns: int) -> int:
        """Since then."""
        return read_ns - empty_ns

    def acknowledge(self, device: str, total_bytes: int) -> None:
        """Nobody waits."""


class LockstepClock:
    """A virtual clock in a mapped file; see the module's text."""

    def __init__(self, memory: mmap.mmap, wake_fd: int, devices: Sequence[str], owned: Sequence[Path]) -> None:
        """Use `create` or `attach`."""
        self._memory = memory
        self._words = memoryview(memory).cast("q")
        self._wake_fd = wake_fd
        self._slots = {name: _HEADER_WORDS + i * _SLOT_WORDS for i, name in enumerate(devices)}
        self._owned = owned

    @classmethod
    def create(cls, path: Path | str, devices: Sequence[str], now_ns: int = 0) -> "LockstepClock":
        """Make the clock's file at `path`, for the process that drives; `close` removes it."""
        path, fifo = Path(path), _fifo(path)
        content = bytearray(8 * (_HEADER_WORDS + len(devices) * _SLOT_WORDS))
        words = memoryview(content).cast("q")
        words[_MAGIC_WORD], words[_NOW_WORD], words[_DEVICES_WORD] = _MAGIC, now_ns, len(devices)
        for i, name in enumerate(devices):
            encoded = name.encode()
            if len(encoded) > _NAME_BYTES:
                raise ValueError(f"device name {name!r} is longer than {_NAME_BYTES} bytes")
            start = 8 * (_HEADER_WORDS + i * _SLOT_WORDS + 1)
            content[start : start + len(encoded)] = encoded
        for old in (path, fifo):
            old.unlink(missing_ok=True)
        os.mkfifo(fifo, 0o600)
        # Open for reading and writing: readers may come and go without this end ever seeing the end of the file.
        wake_fd = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
        draft = path.with_name(path.name + ".new")
        draft.write_bytes(content)
        draft.replace(path)  # who finds the file finds it whole
        return cls(_map(path), wake_fd, devices, owned=(path, fifo))

    @classmethod
    def attach(cls, path: Path | str) -> "LockstepClock":
        """Open a clock that another process drives."""
        path = Path(path)
        missing = PortMissing(f"{path}: no lockstep clock there; start the emulated robot or the replay first")
        try:
            memory = _map(path)
            wake_fd = os.open(_fifo(path), os.O_WRONLY | os.O_NONBLOCK)
        except (OSError, ValueError) as error:
            raise missing from error
        with memoryview(memory) as content, content.cast("q") as words:
            if len(words) < _HEADER_WORDS or words[_MAGIC_WORD] != _MAGIC:
                os.close(wake_fd)
                raise missing
            starts = [8 * (_HEADER_WORDS + i * _SLOT_WORDS + 1) for i in range(words[_DEVICES_WORD])]
            names = [bytes(content[s : s + _NAME_BYTES]).rstrip(b"\0").decode() for s in starts]
        return cls(memory, wake_fd, names, owned=())

    def now_ns(self) -> int:
        """The virtual time."""
        return self._words[_NOW_WORD]

    def read_at(self, read_ns: int) -> int:
        """Now: time stands still until all bytes are dealt with."""
        return self.now_ns()

    def lain_ns(self, read_ns: int, empty_ns: int) -> int:
        """No time at all: it stands still until all bytes are dealt with."""
        return 0

    def set(self, now_ns: int) -> None:
        """Move the virtual time to `now_ns`; it never goes back."""
        if now_ns < self._words[_NOW_WORD]:
            raise ValueError(f"virtual time can't go back from {self._words[_NOW_WORD]} to {now_ns} ns")
        self._words[_NOW_WORD] = now_ns

    def acknowledge(self, device: str, total_bytes: int) -> None:
        """Say that `total_bytes` of `device` have been dealt with; a device that the clock doesn't know is ignored."""
        slot = self._slots.get(device)
        if slot is None:
            return
        self._words[slot] = total_bytes
        # A full FIFO has wakes enough; a broken one has nobody left to wake.
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._wake_fd, b"\0")

    def acknowledged(self, device: str) -> int:
        """The total last acknowledged for `device`: where to count on from when bytes went missing on the way."""
        return self._words[self._slots[device]]

    def wait_for(self, totals: Mapping[str, int], timeout_s: float) -> bool:
        """Sleep until every device in `totals` has acknowledged at least its total; False when `timeout_s` passed."""
        deadline = time.monotonic() + timeout_s
        poller = select.poll()
        poller.register(self._wake_fd, select.POLLIN)
        while any(self._words[self._slots[device]] < total for device, total in totals.items()):
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                return False
            if poller.poll(left_s * 1000):
                os.read(self._wake_fd, 4096)
        return True

    def close(self) -> None:
        """Let go of the file; its creator removes it."""
        self._words.release()
        self._memory.close()
        os.close(self._wake_fd)
        for path in self._owned:
            path.unlink(missing_ok=True)


def _fifo(path: Path) -> Path:
    return path.with_name(path.name + ".ack")


def _map(path: Path) -> mmap.mmap:
    with path.open("r+b") as file:
        return mmap.mmap(file.fileno(), 0)
