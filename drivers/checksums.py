"""Checksums that no library has."""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled


@compiled
def lms_crc(data: NDArray[np.uint8]) -> int:
    """SICK LMS2xx checksum of `data` [n], from STX to the last byte before the checksum (LMS2XX section 2).

    Not a catalogued CRC-16: the register shifts once a byte, and each byte enters together with the one before it.
    """
    register = np.int64(0)
    previous = np.int64(0)
    for i in range(data.size):
        byte = np.int64(data[i])
        register <<= 1
        if register & 0x10000:
            register = (register & 0xFFFF) ^ 0x8005
        register ^= (previous << 8) | byte
        previous = byte
    return register  # type: ignore[return-value]  # compiled code hands back a Python int
