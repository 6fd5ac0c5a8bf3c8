"""Reads the numeric arrays of a MATLAB 5 file: no more than the recordings here need.

Format: "MAT-File Format", MathWorks, chapter 1: a header of 128 bytes, then tagged elements, some of them deflated.
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import TerraboundError

HEADER_BYTES = 128
MATRIX, COMPRESSED = 14, 15
NUMBERS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}


def read_arrays(path: Path) -> dict[str, NDArray[np.float64]]:
    """Real numeric arrays by name, as float64. Raises TerraboundError for what is no little-endian MATLAB 5 file."""
    data = path.read_bytes()
    if data[126:128] != b"IM":
        raise TerraboundError(f"{path}: not a little-endian MATLAB 5 file")
    arrays = {}
    for kind, body in _elements(data[HEADER_BYTES:]):
        if kind == COMPRESSED:
            ((kind, body),) = _elements(zlib.decompress(body))
        if kind != MATRIX:
            continue
        _flags, (_, dimensions), (_, name), (number, values) = list(_elements(body))[:4]
        if number in NUMBERS:
            shape = np.frombuffer(dimensions, "<i4")
            arrays[name.decode()] = np.frombuffer(values, NUMBERS[number]).astype(float).reshape(shape, order="F")
    return arrays


def _elements(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(type, content) of tagged elements; a tag whose upper half isn't zero is a small one, of 8 bytes in all."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, at)
        if kind >> 16:
            yield kind & 0xFFFF, data[at + 4 : at + 4 + (kind >> 16)]
            at += 8
        else:
            yield kind, data[at + 8 : at + 8 + size]
            at += 8 + size + (0 if kind == COMPRESSED else -size % 8)
