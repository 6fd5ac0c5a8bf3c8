"""What a crash left in a store's write-ahead log: is something missing that had been acknowledged?

SQLite takes the log up to the first frame that isn't whole and drops the rest without a word. That is right for a
transaction that was being written when the power went, and wrong for a disk that broke an old one: this tells which.
"""

import sqlite3
import struct
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from mapper.store import PAGE_BYTES

_WAL_HEADER, _FRAME_HEADER = 32, 24
"""Bytes (SQLite's file format, section 4)."""


class Frame(NamedTuple):
    """A page in the write-ahead log, whole or not."""

    page: int
    ends: bool
    """Does it end a transaction?"""
    salts: bytes
    """The same in all frames since the log last began anew."""
    folded: bool
    """Is the page in the database file already?"""


def log_frames(path: Path) -> list[Frame]:
    """The frames that belong to the log that a crash left. To be called before the database is opened.

    SQLite syncs a log's header, with salts of its own, before its first frame: frames with other salts are left over
    from the log before. Where the header is broken, those that most frames have are taken.

    (Later would be too late: SQLite's locks go with the first close of the file by anybody in the process.)
    """
    frames: list[Frame] = []
    salts = None
    with suppress(FileNotFoundError), path.with_name(f"{path.name}-wal").open("rb") as log, path.open("rb") as database:
        begins = log.read(_WAL_HEADER)
        salts = begins[16:24] if _is_whole(begins) else None
        size = int.from_bytes(begins[8:12], "big")
        size = size if size in {1 << n for n in range(9, 17)} else PAGE_BYTES
        length = path.stat().st_size
        while len(header := log.read(_FRAME_HEADER)) == _FRAME_HEADER:
            page, ends = (int.from_bytes(header[k : k + 4], "big") for k in (0, 4))
            content = log.read(size)
            folded = False
            if 0 < page * size <= length:
                database.seek((page - 1) * size)
                folded = database.read(size) == content
            frames.append(Frame(page, ends > 0, header[8:16], folded))
    if salts is None and frames:
        ((salts, _),) = Counter(frame.salts for frame in frames).most_common(1)
    return [frame for frame in frames if frame.salts == salts]


def _is_whole(header: bytes) -> bool:
    """Does the header's checksum fit?"""
    if len(header) < _WAL_HEADER:
        return False
    order = ">" if header[3] & 1 else "<"
    a = b = 0
    for x, y in struct.iter_unpack(f"{order}II", header[:24]):
        a = (a + x + b) & 0xFFFFFFFF
        b = (b + y + a) & 0xFFFFFFFF
    return struct.unpack(">II", header[24:]) == (a, b)


def lost_in_log(connection: sqlite3.Connection, frames: list[Frame]) -> tuple[bool, bool]:
    """(acknowledged transactions are lost, the last transaction is not whole), from the log as it was found.

    SQLite takes frames up to the last transaction before the first that isn't whole. What follows was written after
    it: were it the one transaction that was being written, there would be one end of it at most. Where its pages are in
    the file already, nothing is lost.
    """
    if not frames:
        return False, False
    _, taken, _ = connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
    taken = max(taken, 0)
    beyond = frames[taken:]
    newest = {frame.page: frame for frame in beyond}
    if all(frame.folded for frame in newest.values()):
        return False, False
    ends = sum(frame.ends for frame in beyond)
    return ends >= 2, ends <= 1
