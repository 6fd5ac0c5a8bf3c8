"""Checksums that no library has."""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled

_LMS_POLYNOMIAL = 0x18005


def _lms_remainder(value: int) -> int:
    """`value` modulo the polynomial."""
    while value >> 16:
        value ^= _LMS_POLYNOMIAL << value.bit_length() - 17
    return value


_LMS_REMAINDERS = np.array([_lms_remainder(i << 16) for i in range(256)], np.int64)


@compiled
def lms_crc(data: NDArray[np.uint8], start: int, end: int) -> int:
    """SICK LMS2xx checksum of `data[start:end]`, from STX to the last byte before the checksum (LMS2XX section 2).

    Not a catalogued CRC-16: the register shifts once a byte, and each byte enters together with the one before it.
    Eight bytes at a time: the register may grow by eight bits before it is reduced.
    """
    register = previous = np.int64(0)
    at = start
    while at + 8 <= end:
        register <<= 8
        for k in range(8):
            byte = np.int64(data[at + k])
            register ^= (previous << 8 | byte) << 7 - k
            previous = byte
        register = (register & 0xFFFF) ^ _LMS_REMAINDERS[register >> 16]
        at += 8
    while at < end:
        byte = np.int64(data[at])
        register = register << 1 ^ (previous << 8 | byte)
        register = (register & 0xFFFF) ^ _LMS_REMAINDERS[register >> 16]
        previous = byte
        at += 1
    return register  # type: ignore[return-value]  # compiled code hands back a Python int
