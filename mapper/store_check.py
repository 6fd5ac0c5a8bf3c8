"""What a disk did to a store: every row checked when it is opened, the good ones kept, the rest told.

Damage is never mended in place: a damaged B-tree that is written to loses more. The good rows go into a new file,
and the damaged one is set aside under another name. A power cut at any moment leaves one of the two in place.
"""

import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mapper.store import (
    SUBMAP_COLUMNS,
    TILE_COLUMNS,
    DamagedBeyondOpening,
    StoreError,
    Submap,
    TileRow,
    TileStore,
    connect,
    explained,
    fsync_folder,
    intact,
    row_crc,
)
from mapper.store_log import Frame, log_frames, lost_in_log
from mapper.tile_codec import decode

_LEAST_ROW_BYTES = 128


@dataclass(slots=True)
class Findings:
    """What opening a store came to."""

    tiles: int = 0
    """Rows that are what was written."""
    damaged: int = 0
    """Rows that are not."""
    missing: int = 0
    """Tiles that were acknowledged, of which no row is left, or only one of an earlier state."""
    log_damaged: bool = False
    """Transactions stood behind a damaged place of the write-ahead log: the newest saves are lost."""
    log_torn: bool = False
    """The last transaction in the log is not whole: it was being written, or its last bytes are damaged."""
    structure: str = ""
    """What SQLite finds wrong with its own structure."""
    set_aside: Path | None = None
    """Where the damaged file is now."""

    @property
    def clean(self) -> bool:
        """Is everything there that was acknowledged?"""
        return not (self.damaged or self.missing or self.log_damaged or self.structure or self.set_aside)

    def __str__(self) -> str:
        told = [f"{self.tiles} tiles kept"]
        told += [f"{self.damaged} damaged"] if self.damaged else []
        told += [f"{self.missing} missing or older than saved"] if self.missing else []
        told += ["the newest saves are lost (write-ahead log damaged)"] if self.log_damaged else []
        told += ["the last save is not whole (it was being written, or its end is damaged)"] if self.log_torn else []
        told += [f"structure: {self.structure}"] if self.structure else []
        told += [f"the damaged file is {self.set_aside}"] if self.set_aside else []
        return ", ".join(told)


def open_store(path: Path, propose: Callable[[int], None] = lambda number: None) -> tuple[TileStore, Findings]:
    """Open, check and where needed rebuild a store. Raises StoreError where the disk doesn't allow it now.

    `propose` hears, before the rows are checked, a number above all submaps in the store's list of them.
    """
    try:
        rebuilt = _rebuilt(path)
        if not path.exists() and rebuilt.exists():
            # The power went between the two renames of a rebuild.
            rebuilt.rename(path)
            fsync_folder(path.parent)
        frames = log_frames(path)
        try:
            store = TileStore(path)
        except DamagedBeyondOpening as error:
            aside = _set_aside(path)
            propose(0)
            return TileStore(path), Findings(structure=str(error), set_aside=aside)
        propose(max(_submaps(store.connection)[0], default=-1) + 1)
        findings = check(store, frames)
        if findings.damaged or findings.missing or findings.structure:
            findings.set_aside = _rebuild(store)
            store = TileStore(path)
            check(store, [])
        return store, findings
    except sqlite3.Error as error:
        raise explained(error, path) from error
    except OSError as error:
        raise StoreError(f"{path}: can't be used: {error.strerror or error}") from error


def check(store: TileStore, frames: list[Frame]) -> Findings:
    """Read every row; fill in what the store has. frames: the log's before the store was opened."""
    connection, findings = store.connection, Findings()
    try:
        findings.log_damaged, findings.log_torn = lost_in_log(connection, frames)
        (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
        findings.structure = "" if verdict == b"ok" else bytes(verdict).decode("utf-8", "replace").splitlines()[-1]
    except sqlite3.DatabaseError as error:
        if not isinstance(explained(error, store.path), DamagedBeyondOpening):
            raise
        findings.structure = str(error)
    submaps, submaps_whole = _submaps(connection)
    if not submaps_whole:
        findings.structure = findings.structure or "a submap's row is damaged"
    counted, xor = Counter[int](), Counter[int]()
    store.rows.clear()
    store.submaps = submaps
    for row in _rows(store, submaps_whole):
        if not intact(row):
            findings.damaged += 1
            continue
        number, submap, ix, iy, version, content, _, crc = row
        store.rows[submap, ix, iy] = TileRow(number, version, content, crc)
        counted[submap] += 1
        xor[submap] ^= crc
    findings.tiles = len(store.rows)
    for number, submap in submaps.items():
        findings.missing += max(submap.tiles - counted[number], int(xor[number] != submap.crc_of_tiles))
    findings.missing = max(0, findings.missing - findings.damaged)
    if counted.keys() - submaps.keys():
        findings.structure = findings.structure or "tiles of a submap that has no row"
    return findings


def _submaps(connection: sqlite3.Connection) -> tuple[dict[int, Submap], bool]:
    """Submaps whose rows are good; are all?"""
    found: dict[int, Submap] = {}
    whole = True
    try:
        for row in connection.execute(f"SELECT {SUBMAP_COLUMNS} FROM submap ORDER BY number"):
            try:
                number, tiles, xor, resolution_m, frame, anchor, guarantee, _ = row
                texts = bytes(frame).decode(), bytes(anchor).decode(), bytes(guarantee).decode()
                submap = Submap(number, float(resolution_m), *texts, tiles, xor)
                good = submap.row()[-1] == row[-1] and number >= 0
            except (TypeError, ValueError, struct.error):
                good = False
            whole = whole and good
            if good:
                found[number] = submap
    except sqlite3.DatabaseError:
        whole = False
    return found, whole


def _rows(store: TileStore, submaps_whole: bool) -> Iterator[Any]:
    """Every row of the table; None in place of one that can't be read. Past a damaged page it goes row by row."""
    last = 0
    select = f"SELECT {TILE_COLUMNS} FROM tile WHERE id"
    try:
        for row in store.connection.execute(f"{select} > 0 ORDER BY id"):
            last = row[0]
            yield row
        return
    except sqlite3.DatabaseError:
        pass
    promised = sum(submap.tiles for submap in store.submaps.values())
    highest = promised if submaps_whole else store.path.stat().st_size // _LEAST_ROW_BYTES
    for number in range(last + 1, highest + 1):
        try:
            row = store.connection.execute(f"{select} = ?", (number,)).fetchone()
        except sqlite3.DatabaseError:
            yield None
        else:
            if row is not None:
                yield row


def _rebuild(store: TileStore) -> Path:
    """Bring the good rows into a new file; set the old one aside, and return its new name."""
    path, rebuilt = store.path, _rebuilt(store.path)
    for leftover in _files(rebuilt):
        leftover.unlink(missing_ok=True)
    connection = connect(rebuilt)
    try:
        connection.execute("BEGIN")
        submaps: dict[int, Submap] = {}
        kept = (row for row in _rows(store, False) if intact(row))
        for number, (_, *place, version, content, body, _) in enumerate(kept, 1):
            crc = row_crc(number, (place[0], place[1], place[2]), version, content, body)
            values = (number, *place, version, content, body, crc)
            connection.execute(f"INSERT INTO tile ({TILE_COLUMNS}) VALUES (?,?,?,?,?,?,?,?)", values)
            submap = submaps.get(place[0]) or _described(store.submaps.get(place[0]), body, place[0])
            xor = submap.crc_of_tiles ^ crc
            submaps[place[0]] = replace(submap, tiles=submap.tiles + 1, crc_of_tiles=xor)
        for submap in submaps.values():
            connection.execute(f"INSERT INTO submap ({SUBMAP_COLUMNS}) VALUES (?,?,?,?,?,?,?,?)", submap.row())
        connection.execute("COMMIT")
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    finally:
        connection.close()
    store.close()
    aside = _set_aside(path)
    rebuilt.rename(path)
    fsync_folder(path.parent)
    return aside


def _described(known: Submap | None, body: bytes, number: int) -> Submap:
    """Frame and place of a submap, no tiles counted; where its row is lost, what its tiles say."""
    if known is not None:
        return replace(known, tiles=0, crc_of_tiles=0)
    received = decode(body, number)
    return Submap(number, received.tile.resolution_m, received.frame_id)


def _rebuilt(path: Path) -> Path:
    return path.with_name(f"{path.name}.rebuilt")


def _files(path: Path) -> list[Path]:
    """A database's own file, and those that SQLite puts beside it."""
    return [path.with_name(path.name + suffix) for suffix in ("", "-wal", "-shm", "-journal")]


def _set_aside(path: Path) -> Path:
    """Rename a damaged database to a name that is free, its log first: nobody finds the one without the other."""
    number = 1
    while (aside := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    for old, new in reversed(list(zip(_files(path), _files(aside), strict=True))):
        with suppress(FileNotFoundError):
            old.rename(new)
    fsync_folder(path.parent)
    return aside
