"""One submap of a store as a saved map, for reading only."""

from pathlib import Path

from mapper.saved_map import MapFileError, SavedMap, assemble
from mapper.store import TileStore
from mapper.store_check import Findings, check
from mapper.store_log import log_frames

_SQLITE = b"SQLite format 3\0"


def is_store(path: Path) -> bool:
    """Does the file look like a store?"""
    try:
        with path.open("rb") as file:
            return file.read(len(_SQLITE)) == _SQLITE
    except OSError:
        return False


def load_stored(path: Path, submap: int | None = None) -> tuple[SavedMap, Findings]:
    """A submap, the newest unless another is named; and what is damaged: that is left out, the file is not mended."""
    frames = log_frames(path)
    store = TileStore(path)
    try:
        findings = check(store, frames)
        if not store.submaps:
            raise MapFileError(f"{path}: the store holds no map")
        number = max(store.submaps) if submap is None else submap
        if number not in store.submaps:
            there = ", ".join(map(str, sorted(store.submaps)))
            raise MapFileError(f"{path}: no submap {number}; there are {there}")
        about = store.submaps[number]
        return assemble(store.tiles(number), about.resolution_m, about.frame, about.anchor), findings
    finally:
        store.close()
