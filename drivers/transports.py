"""Where bytes come from: serial ports (socketcan.py has CAN interfaces). No other files open a device.

A transport knows no protocol. It hands over what one read gave, at once, however little that is (`read`, or into a
pipe with `pump`), and knows when the port was last seen empty: bytes read now surely came after that, however long this
process was kept from reading. A port that went away is PortLost, once and for all: close it and open a new one.
"""

import contextlib
import errno
import os
import select
import termios
import time
from pathlib import Path
from typing import Protocol

import numpy as np
import serial

from drivers import port_read
from drivers.errors import PortBusy, PortError, PortLost, PortMissing
from drivers.port_read import EMPTY, GONE, INTERRUPTED, LOST_SO_FAR, READ, SEEN_EMPTY, read_in_machine_code
from drivers.record_pipe import (
    NOT_STAMPED,
    OPENING,
    PORT,
    READ_BYTES,
    RECEIVED_NS,
    RECORD_BYTES,
    RECORD_HEAD_BYTES,
    RecordPipe,
)

WRITE_PATIENCE_S = 1.0


class Transport(Protocol):
    """A duplex wire to one device."""

    name: str
    """The port as the owner wrote it, for messages."""
    received_ns: int | None
    """Monotonic time when what was last read had come, where the kernel stamped it; None: only the reader knows."""

    @property
    def read_ns(self) -> int:
        """Monotonic time when the last read that gave bytes was over."""

    @property
    def empty_ns(self) -> int:
        """Monotonic time before which none of the bytes came that it gave: then the port was seen empty."""

    def read(self, timeout_s: float) -> bytes:
        """What has arrived; waits for the first byte at most `timeout_s`, then b"". Raises PortLost."""

    def pump(self, pipe: RecordPipe, port: int, opening: int, wake_fd: int, lasting_s: float) -> None:
        """Write every read into `pipe`, as of this port and opening, until `wake_fd` can be read.

        It comes back at least every `lasting_s`. Raises PortLost.
        """

    def write(self, data: bytes) -> None:
        """Send all of `data`. Raises PortLost."""

    def set_baud(self, baud: int) -> None:
        """Speak at `baud` from now on; what was written before still leaves at the old rate."""

    def close(self) -> None:
        """Let go of the port; any number of times."""


class SerialTransport:
    """A tty, raw, 8 data bits, no parity, 1 stop bit, no flow control, and ours alone."""

    def __init__(self, port: str, line: serial.Serial, opened_ns: int) -> None:
        """Use `open_serial`. What the port gives came after `opened_ns`."""
        self.name = port
        self.received_ns: int | None = None
        self._line = line
        self._fd = line.fileno()
        self._watched, self._moment = np.zeros(4, np.int32), np.zeros(2, np.int64)
        self._times = np.array([opened_ns, opened_ns, opened_ns, 0])
        self._record = np.zeros(RECORD_BYTES // 8, np.int64)
        self._buffer = self._record.view(np.uint8)[RECORD_HEAD_BYTES:]
        self._writable = select.poll()
        self._writable.register(self._fd, select.POLLOUT)

    @property
    def read_ns(self) -> int:
        """When the last bytes were read."""
        return int(self._times[READ])

    @property
    def empty_ns(self) -> int:
        """Before then none of them came."""
        return int(self._times[EMPTY])

    @property
    def lost_bytes(self) -> int:
        """Read, but the pipe was full; the pipe does not tell yet."""
        return int(self._times[LOST_SO_FAR])

    def read(self, timeout_s: float) -> bytes:
        """What has arrived; waits for the first byte at most `timeout_s`, then b""."""
        timeout_ns = int(max(0.0, timeout_s) * 1e9)
        count = port_read.read_when_ready(
            self._fd, -1, timeout_ns, self._watched, self._moment, self._times, self._buffer
        )
        if count >= 0:
            return self._buffer[:count].tobytes()
        return b"" if count == INTERRUPTED else self._read_or_why_not()

    def pump(self, pipe: RecordPipe, port: int, opening: int, wake_fd: int, lasting_s: float) -> None:
        """Write every read into `pipe`, in machine code, until `wake_fd` can be read."""
        self._record[PORT], self._record[OPENING], self._record[RECEIVED_NS] = port, opening, NOT_STAMPED
        lasting_ns = int(lasting_s * 1e9)
        room = self._watched, self._moment, self._times, self._record, self._buffer
        happened = port_read.pump_port(self._fd, wake_fd, pipe.sink_fd, pipe.alarm, lasting_ns, *room)
        if happened == GONE and (data := self._read_or_why_not()):
            times = {"read_ns": self.read_ns, "empty_ns": self.empty_ns, "received_ns": NOT_STAMPED}
            if not pipe.put(port, opening, len(data), data=data, **times):
                self._times[LOST_SO_FAR] += len(data)

    def _read_or_why_not(self) -> bytes:
        """Where a read has failed: PortLost with the reason, or what comes all the same."""
        try:
            data = os.read(self._fd, READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return b""
        except OSError as error:
            raise self._lost(error) from error
        if not data:  # ready to read, yet nothing to read: the other end is gone
            raise self._lost(None)
        self._times[EMPTY], self._times[READ] = self._times[SEEN_EMPTY], time.monotonic_ns()
        return data

    def write(self, data: bytes) -> None:
        """Send all of `data`; a line that takes nothing for a second counts as lost."""
        rest = memoryview(data)
        while rest:
            try:
                if not self._writable.poll(WRITE_PATIENCE_S * 1000):
                    raise self._lost(TimeoutError(f"it took no bytes for {WRITE_PATIENCE_S:g} s"))
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                continue
            except OSError as error:
                raise self._lost(error) from error

    def set_baud(self, baud: int) -> None:
        """Speak at `baud` from now on; what was written before still leaves at the old rate."""
        if baud == self._line.baudrate:
            return
        try:
            termios.tcdrain(self._fd)
            self._line.baudrate = baud
        except (OSError, termios.error) as error:
            raise self._lost(error) from error
        except ValueError as error:
            raise PortError(f"{self.name}: this port can't run at {baud} baud ({error}); set another rate") from error

    def close(self) -> None:
        """Let go of the port."""
        with contextlib.suppress(OSError, termios.error):
            self._line.close()

    def _lost(self, cause: Exception | None) -> PortLost:
        why = f" ({cause})" if cause else ""
        return PortLost(
            f"{self.name}: the port went away{why}; check its plug and cable, it is opened again when it returns"
        )


def open_serial(port: str, baud: int, *, at_once: bool = False) -> SerialTransport:
    """Open the tty `port` exclusively; what it had buffered is thrown away, since nobody knows when that came.

    `at_once`: even if the machine code that reads punctually (drivers/port_read.py) is not loaded yet.
    """
    if not at_once:
        read_in_machine_code()
    opened_ns = time.monotonic_ns()
    try:
        line = serial.Serial(port, baud, timeout=0, exclusive=True, xonxoff=False, rtscts=False, dsrdtr=False)
    except (OSError, termios.error) as error:  # SerialException is an OSError
        raise refusal(port, baud, error) from error
    except ValueError as error:
        raise PortError(f"{port}: {baud} baud is not possible ({error}); set another rate") from error
    # A USB adapter may hold bytes back for 16 ms unless asked not to; others don't know the question.
    with contextlib.suppress(OSError, ValueError, NotImplementedError):
        line.set_low_latency_mode(True)
    return SerialTransport(port, line, opened_ns)


def refusal(port: str, baud: int, error: Exception) -> PortError:
    """The error that tells a person why `port` can't be opened, and what to do."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO):
        there = sorted(str(path) for path in Path(port).parent.glob("*")) if "serial" in port else []
        seen = f" (there are: {', '.join(there)})" if there else ""
        return PortMissing(f"{port}: no such port{seen}; plug the device in, or name its port in the configuration")
    if number in (errno.EBUSY, errno.EAGAIN):
        return PortBusy(f"{port}: another process has this port open; end it, or name another port")
    if number == errno.EPERM:
        return PortError(
            f"{port}: the system forbids to open it, whatever its file's permissions; a systemd unit allows its kind "
            "with DeviceAllow=char-... rw, named as in /proc/devices"
        )
    if number == errno.EACCES:
        return PortError(f"{port}: no permission to open it; add this user to the group that owns it (often `dialout`)")
    return PortError(f"{port}: can't be used as a serial port at {baud} baud ({error}); name the device's own port")
