"""Wait at a port, read it and hand over what it gave: in machine code, and in the interpreter until that code is there.

Loading numba takes a good part of a second, in which the conversation with a device can begin already. What the
interpreter reads may be read late, as it waits for its turn: so much is told (`times`), and nothing is read wrongly.
"""

import contextlib
import os
import select
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.record_pipe import EMPTY_NS, LOST, LOST_BYTES, PORT, READ_NS, RECORD_HEAD_BYTES, SIZE, ring

EMPTY, READ, SEEN_EMPTY, LOST_SO_FAR = 0, 1, 2, 3
"""In `times`, monotonic nanoseconds: none of the bytes read came before EMPTY; they were read at READ; and the port was
last seen empty at SEEN_EMPTY, which may be later. LOST_SO_FAR: bytes that were read, and found the pipe full.

Only a look that finds nothing sees a port empty: Linux brings in what lies in its reserve first. A read that gives
little does not tell: more may lie there (docs/decisions/0052)."""
NOTHING, GONE, INTERRUPTED, WOKEN = 0, -1, -2, -3
"""Instead of a count of bytes: the time is over; the port can't be read (ask it for the error); a signal has come;
`wake_fd` can be read."""

_MS = 1_000_000


def read_interpreted(
    fd: int,
    wake_fd: int,
    timeout_ns: int,
    watched: NDArray[np.int32],
    moment: NDArray[np.int64],
    times: NDArray[np.int64],
    buffer: NDArray[np.uint8],
) -> int:
    """What `unlocked_read.read_when_ready` does, in the interpreter."""
    before_ns = time.monotonic_ns()
    port = select.poll()
    port.register(fd, select.POLLIN)
    if wake_fd >= 0:
        port.register(wake_fd, select.POLLIN)
    if not (ready := port.poll(0)):
        times[SEEN_EMPTY] = before_ns
        if not (ready := port.poll(timeout_ns / _MS)):
            # It gave up no earlier than it was asked to, and found nothing then.
            times[SEEN_EMPTY] = before_ns + timeout_ns
            return NOTHING
    if fd not in dict(ready):
        return WOKEN
    try:
        count = os.readv(fd, [buffer.data])
    except OSError:
        return GONE
    times[READ] = time.monotonic_ns()
    if count == 0:
        return GONE
    times[EMPTY] = times[SEEN_EMPTY]
    return count


def pump_interpreted(
    fd: int,
    wake_fd: int,
    sink_fd: int,
    alarm: NDArray[np.int64],
    timeout_ns: int,
    watched: NDArray[np.int32],
    moment: NDArray[np.int64],
    times: NDArray[np.int64],
    record: NDArray[np.int64],
    buffer: NDArray[np.uint8],
) -> int:
    """What `unlocked_read.pump_port` does, in the interpreter, for one read."""
    count = read_interpreted(fd, wake_fd, timeout_ns, watched, moment, times, buffer)
    if count <= 0:
        return count
    record[READ_NS], record[EMPTY_NS] = times[READ], times[EMPTY]
    with contextlib.suppress(OSError):  # the pipe is full
        if times[LOST_SO_FAR]:
            record[SIZE], record[LOST_BYTES] = LOST, times[LOST_SO_FAR]
            os.write(sink_fd, record.data.cast("B")[:RECORD_HEAD_BYTES])
            times[LOST_SO_FAR], record[LOST_BYTES] = 0, 0
        record[SIZE] = count
        os.write(sink_fd, record.data.cast("B")[: RECORD_HEAD_BYTES + count])
        ring(alarm, int(record[PORT]), int(times[READ]))
        return NOTHING
    times[LOST_SO_FAR] += count
    return NOTHING


read_when_ready: Callable[..., int] = read_interpreted
"""read_when_ready(fd, wake_fd, timeout_ns, watched, moment, times, buffer), as it is done at present (look it up
at each call): wait until port `fd` has bytes, at most `timeout_ns` and until `wake_fd` (-1: none) can be read; how many
were read into `buffer`, or one of the above.

times [4] goes on from call to call. watched [4] and moment [2] are room for this call alone.
"""

pump_port: Callable[..., int] = pump_interpreted
"""pump_port(fd, wake_fd, sink_fd, alarm, timeout_ns, watched, moment, times, record, buffer), likewise: read port
`fd` again and again, write each read to the pipe `sink_fd` and look at its `alarm`, until `timeout_ns` are over or
something else has happened: one of the above.

record: head and bytes of a drivers/record_pipe.py record, its port and opening filled in; `buffer`: its bytes.
"""


def read_in_machine_code() -> None:
    """Have every read from now on done in machine code, which is loaded first (and compiled at the very first)."""
    global read_when_ready, pump_port
    from drivers import unlocked_read

    unlocked_read.compile_read()
    read_when_ready, pump_port = unlocked_read.read_when_ready, unlocked_read.pump_port
