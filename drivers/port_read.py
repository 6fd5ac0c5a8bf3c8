"""Wait at a port and read it: in machine code, and in the interpreter until that code is there.

Loading numba takes a good part of a second, in which the conversation with a device can begin already. What the
interpreter reads may be read late, as it waits for its turn: so much is told (`times`), and nothing is read wrongly.
"""

import os
import select
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

EMPTY, READ, SEEN_EMPTY = 0, 1, 2
"""In `times`, monotonic nanoseconds: none of the bytes read came before EMPTY; they were read at READ; and the port was
last seen empty at SEEN_EMPTY, which may be later."""
NOTHING, GONE, INTERRUPTED = 0, -1, -2
"""Instead of a count of bytes: the time is over; the port can't be read (ask it for the error); a signal has come."""

_MS = 1_000_000


def read_interpreted(
    fd: int,
    timeout_ns: int,
    full: int,
    watched: NDArray[np.int32],
    moment: NDArray[np.int64],
    times: NDArray[np.int64],
    buffer: NDArray[np.uint8],
) -> int:
    """What `unlocked_read.read_when_ready` does, in the interpreter."""
    before_ns = time.monotonic_ns()
    port = select.poll()
    port.register(fd, select.POLLIN)
    if not port.poll(timeout_ns / _MS):
        # It gave up no earlier than it was asked to, and found nothing then.
        times[SEEN_EMPTY] = before_ns + timeout_ns
        return NOTHING
    begun_ns = time.monotonic_ns()
    try:
        count = os.readv(fd, [buffer.data])
    except OSError:
        return GONE
    times[READ] = time.monotonic_ns()
    if count == 0:
        return GONE
    times[EMPTY] = times[SEEN_EMPTY]
    if count < full:
        times[SEEN_EMPTY] = begun_ns
    return count


read_when_ready: Callable[..., int] = read_interpreted
"""read_when_ready(fd, timeout_ns, full, watched, moment, times, buffer), as it is done at present (look it up at each
call): wait until port `fd` has bytes, at most `timeout_ns`; how many were read into `buffer`, or one of the above.

times [3] goes on from call to call. A read of `full` bytes or more may have left some behind: then the port has not
been seen empty. watched [2] and moment [2] are room for this call alone.
"""


def read_in_machine_code() -> None:
    """Have every read from now on done in machine code, which is loaded first (and compiled at the very first)."""
    global read_when_ready
    from drivers import unlocked_read

    unlocked_read.compile_read()
    read_when_ready = unlocked_read.read_when_ready
