"""Where bytes come from: serial ports and SocketCAN interfaces. The only file that opens a device.

A transport knows no protocol. It hands over what one read gave, at once, however little that is, and knows when the
port was last seen empty: bytes read now surely came after that, however long this process was kept from reading. A port
that went away is PortLost, once and for all: close it and open a new one.
"""

import contextlib
import errno
import os
import select
import termios
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import can
import numpy as np
import serial
from can.typechecking import CanFilter

from drivers.errors import PortBusy, PortError, PortLost, PortMissing
from drivers.kernel_stamps import KernelStamps
from drivers.port_read import EMPTY, INTERRUPTED, READ, SEEN_EMPTY, read_in_machine_code, read_when_ready
from drivers.track_encoders.codec import CanFrame, pack_can_frame, unpack_can_frame

_READ_BYTES = 65536
_WRITE_PATIENCE_S = 1.0
_FULL_BYTES = 2048
"""A read of so much may have left bytes behind: a terminal's buffer holds 4095, with more bytes in reserve."""


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
        self._watched, self._moment = np.zeros(2, np.int32), np.zeros(2, np.int64)
        self._times = np.full(3, opened_ns)
        self._buffer = np.empty(_READ_BYTES, np.uint8)
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

    def read(self, timeout_s: float) -> bytes:
        """What has arrived; waits for the first byte at most `timeout_s`, then b""."""
        timeout_ns = int(max(0.0, timeout_s) * 1e9)
        count = read_when_ready(
            self._fd, timeout_ns, _FULL_BYTES, self._watched, self._moment, self._times, self._buffer
        )
        if count >= 0:
            return self._buffer[:count].tobytes()
        if count == INTERRUPTED:
            return b""
        try:
            data = os.read(self._fd, _READ_BYTES)
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
                if not self._writable.poll(_WRITE_PATIENCE_S * 1000):
                    raise self._lost(TimeoutError(f"it took no bytes for {_WRITE_PATIENCE_S:g} s"))
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
        raise _refusal(port, baud, error) from error
    except ValueError as error:
        raise PortError(f"{port}: {baud} baud is not possible ({error}); set another rate") from error
    # A USB adapter may hold bytes back for 16 ms unless asked not to; others don't know the question.
    with contextlib.suppress(OSError, ValueError, NotImplementedError):
        line.set_low_latency_mode(True)
    return SerialTransport(port, line, opened_ns)


def _refusal(port: str, baud: int, error: Exception) -> PortError:
    """The error that tells a person why `port` can't be opened, and what to do."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO):
        there = sorted(str(path) for path in Path(port).parent.glob("*")) if "serial" in port else []
        seen = f" (there are: {', '.join(there)})" if there else ""
        return PortMissing(f"{port}: no such port{seen}; plug the device in, or name its port in the configuration")
    if number in (errno.EBUSY, errno.EAGAIN):
        return PortBusy(f"{port}: another process has this port open; end it, or name another port")
    if number in (errno.EACCES, errno.EPERM):
        return PortError(f"{port}: no permission to open it; add this user to the group that owns it (often `dialout`)")
    return PortError(f"{port}: can't be used as a serial port at {baud} baud ({error}); name the device's own port")


class SocketCanTransport:
    """A CAN interface of the kernel; its bytes are Linux `struct can_frame`, 16 a frame, and one frame a read.

    So each frame has its own time of receipt, as the kernel stamped it, however late it is read.
    """

    def __init__(self, interface: str, bus: can.BusABC, stamps: KernelStamps | None = None) -> None:
        """Use `open_socketcan`."""
        self.name = interface
        self.received_ns: int | None = None
        self.stamps = stamps or KernelStamps()
        self._bus = bus
        self.read_ns = self.empty_ns = self.stamps.not_before_ns

    def read(self, timeout_s: float) -> bytes:
        """The next frame; waits for it at most `timeout_s`."""
        try:
            looked_ns = time.monotonic_ns()
            message = self._bus.recv(0)
            if message is None:
                self.stamps.empty_at(looked_ns)
                message = self._bus.recv(max(0.0, timeout_s))
        except (can.CanError, OSError, ValueError) as error:  # ValueError: select on a socket that is closed
            raise self._lost(error) from error
        if message is None:
            return b""
        self.read_ns, self.empty_ns = time.monotonic_ns(), self.stamps.not_before_ns
        self.received_ns = self.stamps.received_ns(round(message.timestamp * 1e9))
        return pack_can_frame(_frame_of(message))

    def write(self, data: bytes) -> None:
        """Send whole frames."""
        for start in range(0, len(data), 16):
            frame = unpack_can_frame(data[start : start + 16])
            if frame is None:
                raise ValueError("write whole struct can_frame records of 16 bytes")
            message = can.Message(
                arbitration_id=frame.can_id,
                is_extended_id=frame.extended,
                is_remote_frame=frame.remote,
                data=None if frame.remote else frame.data,
                dlc=frame.dlc,
            )
            try:
                self._bus.send(message, timeout=_WRITE_PATIENCE_S)
            except (can.CanError, OSError) as error:
                raise self._lost(error) from error

    def set_baud(self, baud: int) -> None:
        """The bit rate of an interface belongs to the system's network configuration, not to us."""

    def close(self) -> None:
        """Let go of the interface."""
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()

    def _lost(self, cause: Exception) -> PortLost:
        return PortLost(
            f"{self.name}: the CAN interface went away ({cause}); check it with `ip -details link show {self.name}`"
        )


def open_socketcan(interface: str, bitrate: int, messages: Sequence[tuple[int, bool]] = ()) -> SocketCanTransport:
    """Open the kernel's CAN interface; it must be up at `bitrate` already, which only the system may set.

    `messages`: identifiers, and whether each is an extended one; the kernel passes on these alone, and error frames.
    """
    filters: list[CanFilter] = [
        {"can_id": can_id, "can_mask": 0x1FFF_FFFF if extended else 0x7FF, "extended": extended}
        for can_id, extended in messages
    ]
    try:
        bus = can.Bus(interface="socketcan", channel=interface, can_filters=filters or None)
    except (can.CanError, OSError) as error:
        raise PortMissing(
            f"{interface}: no CAN interface that is up ({error}); "
            f"bring it up with `ip link set {interface} up type can bitrate {bitrate}`"
        ) from error
    return SocketCanTransport(interface, bus)


def _frame_of(message: can.Message) -> CanFrame:
    return CanFrame(
        can_id=message.arbitration_id,
        data=bytes(message.data or b""),
        dlc=message.dlc,
        extended=message.is_extended_id,
        remote=message.is_remote_frame,
        error=message.is_error_frame,
    )
