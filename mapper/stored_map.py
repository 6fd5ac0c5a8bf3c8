"""One submap of a store as a saved map, for reading only."""

import fcntl
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from mapper.saved_map import MapFileError, SavedMap, assemble
from mapper.store import StoreError, TileStore, explained
from mapper.store_check import Findings, check
from mapper.store_log import log_frames

_SQLITE = b"SQLite format 3\0"
_LOCK_BYTES = 0x4000_0000, 512
"""Where SQLite's locks lie in the file: first byte, length (the file format's "locking page")."""
_INTACT = '{"intact":true,"void_since_ns":null,"sensor":null}'


def is_store(path: Path) -> bool:
    """Does the file look like a store?"""
    try:
        with path.open("rb") as file:
            return file.read(len(_SQLITE)) == _SQLITE
    except OSError:
        return False


def load_stored(path: Path, submap: int | None = None) -> tuple[SavedMap, Findings]:
    """A submap, the newest unless another is named; and what is damaged: that is left out, the file is not mended.

    Raises StoreError where the file can't be read, or is in use; MapFileError where there is no such submap.
    """
    with _openable(path) as opened:
        try:
            return _load(opened, path, submap)
        except sqlite3.Error as error:
            raise explained(error, path) from error
        except StoreError as error:
            raise StoreError(str(error).replace(str(opened), str(path))) from error


def _load(opened: Path, path: Path, submap: int | None) -> tuple[SavedMap, Findings]:
    frames = log_frames(opened)
    store = TileStore(opened)
    try:
        findings = check(store, frames)
        if not store.submaps:
            raise MapFileError(f"{path}: the store holds no map")
        number = max(store.submaps) if submap is None else submap
        if number not in store.submaps:
            there = ", ".join(map(str, sorted(store.submaps)))
            raise MapFileError(f"{path}: no submap {number}; there are {there}")
        about = store.submaps[number]
        saved = assemble(store.tiles(number), about.resolution_m, about.frame, about.anchor)
        return replace(saved, guarantee=about.guarantee or _INTACT), findings
    finally:
        store.close()


@contextmanager
def _openable(path: Path) -> Iterator[Path]:
    """The store itself, or a copy of it and of its log where it can't be written: a backup, or somebody else's.

    SQLite opens a database with a log only where it may write.
    """
    if os.access(path, os.W_OK) and os.access(path.resolve().parent, os.W_OK):
        yield path
        return
    _refuse_in_use(path)
    with tempfile.TemporaryDirectory(prefix="terrabound-") as folder:
        copy = Path(folder, path.name)
        try:
            shutil.copyfile(path, copy)
            log = path.with_name(f"{path.name}-wal")
            if log.exists():
                shutil.copyfile(log, copy.with_name(f"{copy.name}-wal"))
        except OSError as error:
            raise StoreError(f"{path}: can't be copied to {folder} for reading ({error.strerror})") from error
        yield copy


def _refuse_in_use(path: Path) -> None:
    """Raise StoreError where a service is writing the file."""
    start, length = _LOCK_BYTES
    try:
        file = path.open("rb")
    except OSError as error:
        raise StoreError(f"{path}: can't be read ({error.strerror}); ask its owner for the right to") from error
    with file:
        try:
            fcntl.lockf(file, fcntl.LOCK_SH | fcntl.LOCK_NB, length, start)
        except OSError as error:
            raise StoreError(f"{path}: in use by another process; stop that one") from error
