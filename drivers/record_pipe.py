"""What ports gave, on its way to whoever parses it: a pipe of records, one a read, each with its times.

Every port has a thread that reads it and writes records (drivers/transports.py); one thread takes them all. A pipe, as
the kernel hands over without the interpreter's lock: neither end ever waits for the other's thread, and a reader in
machine code stamps bytes as they come while the interpreter is busy.

A record is written at once or not at all: where the pipe is full, the bytes are dropped and counted, and a record LOST
says how many, before the next that finds room.

Who takes may sleep over records that it needn't see yet: it says what it waits for (`Alarm`), and who writes a record
looks whether that is it.
"""

import contextlib
import fcntl
import os
import select
import struct
import time
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

PORT, OPENING, SIZE, READ_NS, EMPTY_NS, RECEIVED_NS, LOST_BYTES = range(7)
"""Words of a record's head, in its order; see `Record`."""
_HEAD = struct.Struct("=7q")
RECORD_HEAD_BYTES = _HEAD.size
RECORD_BYTES = select.PIPE_BUF
"""No record is longer: so much is written whole."""
READ_BYTES = RECORD_BYTES - RECORD_HEAD_BYTES
"""A read gives at most so much."""
OPENED, LOST = -1, -2
"""Instead of a size: the port was opened; bytes were lost."""
NOT_STAMPED = -1
"""Instead of the kernel's time of receipt."""
WAITED_PORTS, WAITED_SINCE, BELL_FD, ALARM_WORDS = range(4)
"""Words of an alarm: a bit for each port that is waited for (none: nobody waits); only records that were read no
earlier than this count (monotonic ns); and what is written to then, an eventfd."""
_EVERY_PORT = (1 << 62) - 1
_PIPE_BYTES = 1 << 20
"""Fifteen seconds of all sensors; a system may grant less."""
_TAKE_BYTES = 1 << 14


class Record(NamedTuple):
    """What one read of a port gave, or what happened there. Times are the system's monotonic ones, in nanoseconds."""

    port: int
    """Its number."""
    opening: int
    """How often the port had been opened."""
    size: int
    """Of bytes; OPENED, LOST."""
    read_ns: int
    """When the read was over."""
    empty_ns: int
    """None of its bytes came before."""
    received_ns: int
    """When they came, where the kernel tells; else NOT_STAMPED."""
    lost_bytes: int
    """Of LOST."""
    data: bytes


class RecordPipe:
    """Many ports write, one thread takes."""

    def __init__(self) -> None:
        """Make the pipe."""
        self._take_fd, self.sink_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        with contextlib.suppress(OSError):
            fcntl.fcntl(self.sink_fd, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._bell_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.alarm: NDArray[np.int64] = np.zeros(ALARM_WORDS, np.int64)
        """Its words; the takers' to set, the writers' to look at."""
        self.alarm[BELL_FD] = self._bell_fd
        self._poll = select.poll()
        self._poll.register(self._bell_fd, select.POLLIN)
        self._rest = b""

    def put(self, port: int, opening: int, size: int, *, data: bytes = b"", **times: int) -> bool:
        """Write a record; False where there is no room. `times`: read_ns and so on."""
        words = [times.get(name, 0) for name in Record._fields[READ_NS : LOST_BYTES + 1]]
        try:
            os.write(self.sink_fd, _HEAD.pack(port, opening, size, *words) + data)
        except OSError:
            return False
        ring(self.alarm, port, times.get("read_ns", 0))
        return True

    def take(self, timeout_s: float, ports: Iterable[int] | None = None, since_ns: int = 0) -> list[Record]:
        """All that is there, oldest first; waits at most `timeout_s` for the first.

        Of these `ports` (None: of any), and read no earlier than `since_ns`: it sleeps over all others.
        """
        records: list[Record] = []
        until_s, waited = (
            time.monotonic() + timeout_s,
            _EVERY_PORT if ports is None else sum(1 << port for port in ports),
        )
        while True:
            self.alarm[WAITED_SINCE] = since_ns
            self.alarm[WAITED_PORTS] = waited
            # In this order: what is written after this look finds the alarm set.
            more = self._there()
            records += more
            left_s = until_s - time.monotonic()
            if left_s <= 0 or any(waited >> record.port & 1 and record.read_ns >= since_ns for record in more):
                self.alarm[WAITED_PORTS] = 0
                return records
            # It may have rung late for what was taken before: then it is waited for once more.
            if self._poll.poll(left_s * 1000):
                os.eventfd_read(self._bell_fd)

    def _there(self) -> list[Record]:
        """All records that are in the pipe."""
        data = self._rest
        with contextlib.suppress(BlockingIOError):
            while len(more := os.read(self._take_fd, _TAKE_BYTES)) == _TAKE_BYTES:
                data += more
            data += more
        records, start, end = [], 0, len(data)
        while end - start >= RECORD_HEAD_BYTES:
            head = _HEAD.unpack_from(data, start)
            begin = start + RECORD_HEAD_BYTES
            stop = begin + max(head[SIZE], 0)
            if stop > end:
                break
            records.append(Record._make((*head, data[begin:stop])))
            start = stop
        self._rest = data[start:]
        return records

    def close(self) -> None:
        """Let go of it, once no port writes any more."""
        for fd in (self._take_fd, self.sink_fd, self._bell_fd):
            os.close(fd)


def ring(alarm: NDArray[np.int64], port: int, read_ns: int) -> None:
    """Wake who waits for a record of this port, read then; it is in the pipe."""
    if int(alarm[WAITED_PORTS]) >> port & 1 and read_ns >= alarm[WAITED_SINCE]:
        alarm[WAITED_PORTS] = 0
        os.eventfd_write(int(alarm[BELL_FD]), 1)
