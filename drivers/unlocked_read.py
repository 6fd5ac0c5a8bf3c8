"""Wait at a port, read it and hand over what it gave, all in machine code: no byte waits for the interpreter.

A reader in Python would wait for its turn between the arrival of bytes and the look at the clock, and again each time
it looks whether the port is empty. Here neither waits for another thread; the kernel's scheduler alone is left.
"""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_unlocked
from drivers.port_read import EMPTY, GONE, INTERRUPTED, LOST_SO_FAR, NOTHING, READ, SEEN_EMPTY, WOKEN
from drivers.record_pipe import (
    ALARM_WORDS,
    BELL_FD,
    EMPTY_NS,
    LOST,
    LOST_BYTES,
    PORT,
    READ_NS,
    RECORD_HEAD_BYTES,
    SIZE,
    WAITED_PORTS,
    WAITED_SINCE,
)

POLLIN = 0x0001
CLOCK_MONOTONIC = 1
_NS = 1_000_000_000

_C: Any = numba.types
# Linux's own calls, found in the C library that Python runs on; struct pollfd is two int32, struct timespec two int64.
_ppoll = _C.ExternalFunction("ppoll", _C.int32(_C.intp, _C.uint64, _C.intp, _C.intp))
_read = _C.ExternalFunction("read", _C.int64(_C.int32, _C.intp, _C.uint64))
_write = _C.ExternalFunction("write", _C.int64(_C.int32, _C.intp, _C.uint64))
_clock_gettime = _C.ExternalFunction("clock_gettime", _C.int32(_C.int32, _C.intp))

LOOK_NS = 4_000_000
"""While waiting, a port is looked at this often, so that it is known to have been empty until a little while ago."""


@compiled_unlocked
def read_when_ready(
    fd: int,
    wake_fd: int,
    timeout_ns: int | np.int64,
    watched: NDArray[np.int32],
    moment: NDArray[np.int64],
    times: NDArray[np.int64],
    buffer: NDArray[np.uint8],
) -> int:
    """See drivers/port_read.py."""
    now_ns = _now_ns(moment)
    until_ns, wait_ns = now_ns + timeout_ns, np.int64(0)
    while True:
        watched[0], watched[1] = fd, POLLIN
        watched[2], watched[3] = wake_fd, POLLIN
        moment[0], moment[1] = wait_ns // _NS, wait_ns % _NS
        ready = _ppoll(watched.ctypes.data, 2, moment.ctypes.data, 0)
        if ready < 0:
            return INTERRUPTED
        if ready > 0 and watched[1] >> 16 == 0:
            return WOKEN
        if ready > 0:
            break
        # It gave up no earlier than it was asked to, and found nothing then.
        times[SEEN_EMPTY] = now_ns + wait_ns
        now_ns = _now_ns(moment)
        if now_ns >= until_ns:
            return NOTHING
        left_ns = until_ns - now_ns
        wait_ns = np.int64(left_ns if left_ns < LOOK_NS else LOOK_NS)
    count: int = _read(fd, buffer.ctypes.data, buffer.size)
    times[READ] = _now_ns(moment)
    if count <= 0:
        return GONE
    times[EMPTY] = times[SEEN_EMPTY]
    return count


@compiled_unlocked
def pump_port(
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
    """See drivers/port_read.py."""
    until_ns = _now_ns(moment) + timeout_ns
    while True:
        left_ns = max(until_ns - _now_ns(moment), np.int64(0))
        count: int = read_when_ready(fd, wake_fd, left_ns, watched, moment, times, buffer)
        if count == INTERRUPTED:
            continue
        if count <= 0:
            return count
        record[READ_NS], record[EMPTY_NS] = times[READ], times[EMPTY]
        if times[LOST_SO_FAR] > 0:
            record[SIZE], record[LOST_BYTES] = LOST, times[LOST_SO_FAR]
            if _write(sink_fd, record.ctypes.data, RECORD_HEAD_BYTES) > 0:
                times[LOST_SO_FAR] = 0
            record[LOST_BYTES] = 0
        record[SIZE] = count
        # In their order: what comes after lost bytes must not overtake the word of them.
        if times[LOST_SO_FAR] > 0 or _write(sink_fd, record.ctypes.data, RECORD_HEAD_BYTES + count) < 0:
            times[LOST_SO_FAR] += count
        if (alarm[WAITED_PORTS] >> record[PORT]) & 1 != 0 and times[READ] >= alarm[WAITED_SINCE]:
            alarm[WAITED_PORTS], moment[0] = 0, 1
            _write(np.int32(alarm[BELL_FD]), moment.ctypes.data, 8)


def compile_read() -> None:
    """Have the machine code made now (half a second at first, then cached), so that no byte waits for it."""
    room, moment, times, buffer = (
        np.zeros(4, np.int32),
        np.zeros(2, np.int64),
        np.zeros(4, np.int64),
        np.zeros(1, np.uint8),
    )
    assert read_when_ready(-1, -1, 0, room, moment, times, buffer) == NOTHING
    alarm = np.zeros(ALARM_WORDS, np.int64)
    assert pump_port(-1, -1, -1, alarm, 0, room, moment, times, times, buffer) == NOTHING


@compiled_unlocked
def _now_ns(moment: NDArray[np.int64]) -> np.int64:
    _clock_gettime(CLOCK_MONOTONIC, moment.ctypes.data)
    return np.int64(moment[0] * _NS + moment[1])
