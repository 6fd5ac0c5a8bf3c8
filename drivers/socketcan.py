"""A CAN interface of the kernel as a transport (drivers/transports.py)."""

import contextlib
import errno
import os
import time
from collections.abc import Sequence
from pathlib import Path

import can
from can.typechecking import CanFilter

from drivers.errors import PortLost, PortMissing
from drivers.kernel_stamps import KernelStamps
from drivers.record_pipe import LOST, NOT_STAMPED, RecordPipe
from drivers.track_encoders.codec import CanFrame, pack_can_frame, unpack_can_frame
from drivers.transports import WRITE_PATIENCE_S

_NETWORK = Path("/sys/class/net")
_ARPHRD_CAN, _IFF_UP = "280", 1

LONGEST_WAIT_S = 0.05
"""`pump` comes back as often, so that the wish to stop is seen."""


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
        self._lost_bytes = 0
        """Found the pipe full."""
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

    def pump(self, pipe: RecordPipe, port: int, opening: int, wake_fd: int, lasting_s: float) -> None:
        """Write every frame into `pipe`. `wake_fd` is seen when the time is over: nobody asks a CAN bus anything."""
        until_s = time.monotonic() + min(lasting_s, LONGEST_WAIT_S)
        while (left_s := until_s - time.monotonic()) > 0:
            if data := self.read(left_s):
                stamp_ns = NOT_STAMPED if self.received_ns is None else self.received_ns
                times = {"read_ns": self.read_ns, "empty_ns": self.empty_ns, "received_ns": stamp_ns}
                lost = self._lost_bytes
                if lost and pipe.put(port, opening, LOST, read_ns=self.read_ns, lost_bytes=lost):
                    lost = 0
                kept = lost == 0 and pipe.put(port, opening, len(data), data=data, **times)
                self._lost_bytes = 0 if kept else lost + len(data)

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
                self._bus.send(message, timeout=WRITE_PATIENCE_S)
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
        raise refusal(interface, bitrate, error) from error
    if not _is_up(interface):
        bus.shutdown()
        raise refusal(interface, bitrate, OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN)))
    return SocketCanTransport(interface, bus)


def refusal(interface: str, bitrate: int, error: Exception) -> PortMissing:
    """The error that tells a person why `interface` can't be opened, and what to do."""
    number = getattr(error, "errno", None)
    if number in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
        return PortMissing(
            f"{interface}: this system has no CAN ({error}); load it with `modprobe can_raw`, in a systemd unit "
            "allow it with RestrictAddressFamilies=AF_CAN, or use an slcan adapter"
        )
    if number == errno.ENODEV:
        there = ", ".join(sorted(path.parent.name for path in _NETWORK.glob("*/type") if _is_can(path))) or "none"
        return PortMissing(
            f"{interface}: no such CAN interface (there are: {there}); plug the adapter in, or name its interface"
        )
    return PortMissing(
        f"{interface}: the CAN interface can't be used ({error}); "
        f"bring it up with `ip link set {interface} up type can bitrate {bitrate}`"
    )


def _is_can(type_file: Path) -> bool:
    try:
        return type_file.read_text().strip() == _ARPHRD_CAN
    except OSError:  # it has just gone
        return False


def _is_up(interface: str) -> bool:
    """Is it, as far as the kernel tells? One that is down can be opened, and fails with the first read."""
    try:
        return bool(int((_NETWORK / interface / "flags").read_text(), 16) & _IFF_UP)
    except (OSError, ValueError):
        return True


def _frame_of(message: can.Message) -> CanFrame:
    return CanFrame(
        can_id=message.arbitration_id,
        data=bytes(message.data or b""),
        dlc=message.dlc,
        extended=message.is_extended_id,
        remote=message.is_remote_frame,
        error=message.is_error_frame,
    )
