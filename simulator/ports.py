"""A pseudo-terminal that behaves like a serial port with a device behind it, plugs and unplugs included."""

import contextlib
import os
import select
import termios
import tty
from pathlib import Path

_BACKLOG_BYTES = 1 << 20
_READ_BYTES = 65536
_BAUD_OF_CODE = {
    getattr(termios, f"B{baud}"): baud
    for baud in (4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 500000, 921600, 1000000)
}


class PseudoPort:
    """The device's end of a serial port; the host opens `path` as it would open a real one.

    Bytes written while no host has the port open are gone, as on a real line: a host that opens later must not find
    old bytes and take them for new. We keep no descriptor of the host's end open, so its closing can be seen; the
    pseudo-terminal survives that and can be opened again.
    """

    def __init__(self, link: Path | str | None = None) -> None:
        """Plug in; with `link`, a symbolic link of that name leads to whichever pty stands for the port now."""
        self.keeps_backlog = True
        """May bytes wait for room in the pty's buffer? A real adapter whose host doesn't read loses them."""
        self._link = Path(link) if link is not None else None
        self._master = -1
        self._node = ""
        self._backlog = bytearray()
        self.dropped_bytes = 0
        """Bytes nobody took: no host, unplugged, or backlog full."""
        self.replug()

    @property
    def path(self) -> str:
        """What the host opens: the link, or the pty itself where no link was asked for."""
        return str(self._link) if self._link is not None else self._node

    @property
    def plugged(self) -> bool:
        """Is the device there?"""
        return self._master >= 0

    @property
    def host_present(self) -> bool:
        """Has a host opened the port?"""
        if not self.plugged:
            return False
        poller = select.poll()
        poller.register(self._master, 0)  # POLLHUP is always reported: nobody has the other end open
        return not poller.poll(0)

    @property
    def host_baud(self) -> int | None:
        """The rate the host has set; None while unplugged, or where it is none that devices speak."""
        if not self.plugged:
            return None
        return _BAUD_OF_CODE.get(termios.tcgetattr(self._master)[5])

    def write(self, data: bytes = b"") -> None:
        """Send towards the host; never blocks. What doesn't fit waits for the next call of `write` or `read`."""
        if not self.host_present:
            self.dropped_bytes += len(data) + len(self._backlog)
            self._backlog.clear()
            return
        room = _BACKLOG_BYTES - len(self._backlog)
        self.dropped_bytes += max(0, len(data) - room)
        self._backlog += data[:room]
        with contextlib.suppress(BlockingIOError):
            while self._backlog:
                del self._backlog[: os.write(self._master, self._backlog)]
        if self._backlog and not self.keeps_backlog:
            self.dropped_bytes += len(self._backlog)
            self._backlog.clear()

    def read(self) -> bytes:
        """What the host has sent since the last call; never blocks."""
        self.write()
        if not self.plugged:
            return b""
        try:
            return os.read(self._master, _READ_BYTES)
        except OSError:  # EAGAIN: nothing yet; EIO: no host
            return b""

    def fileno(self) -> int:
        """Descriptor to wait on for the host's bytes; -1 while unplugged."""
        return self._master

    def unplug(self) -> None:
        """Pull the plug: the host's next read fails, and the node is gone."""
        if not self.plugged:
            return
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        self.dropped_bytes += len(self._backlog)
        self._backlog.clear()
        os.close(self._master)
        self._master = -1

    def replug(self) -> None:
        """Plug in again: a new pty, under the same link."""
        if self.plugged:
            return
        master, slave = os.openpty()
        tty.setraw(slave)
        self._node = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(master, False)
        self._master = master
        if self._link is not None:
            draft = self._link.with_name(self._link.name + ".new")
            draft.unlink(missing_ok=True)
            draft.symlink_to(self._node)
            draft.replace(self._link)

    def close(self) -> None:
        """Unplug for good."""
        self.unplug()
