"""The map on disk: a SQLite database that loses nothing it has acknowledged. docs/store.md describes the file.

`save` joins tiles into the stored ones in one transaction; once it has returned they survive kill -9 and power cuts.
What a disk does to the file later is found by checksums when it is opened: mapper/store_check.py. Since joining is
hull, saving late, twice or in another order changes nothing. One process at a time; any thread, one at a time.
"""

import os
import sqlite3
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, TypeAlias

from drivers.errors import TerraboundError
from mapper.tile import Tile, content_crc, join
from mapper.tile_codec import TileFormatError, decode, encode

APPLICATION_ID = 0x74657262
"""Marks the file as ours ("terb")."""
FORMAT = 1
"""SQLite's user_version. Layers may join a tile's body without a new format."""
PAGE_BYTES = 16384
"""Most tiles fit one page: a tile is written in one piece."""
CHECKPOINT_PAGES = 512
"""The write-ahead log is folded into the file when it has grown to 8 MiB."""
BUSY_S = 0.2

Place: TypeAlias = tuple[int, int, int]
"""(submap, ix, iy) of a tile."""

SCHEMA = """
CREATE TABLE tile (id INTEGER PRIMARY KEY, submap INTEGER NOT NULL, ix INTEGER NOT NULL, iy INTEGER NOT NULL,
    version INTEGER NOT NULL, content_crc INTEGER NOT NULL, body BLOB NOT NULL, crc INTEGER NOT NULL) STRICT;
CREATE TABLE submap (number INTEGER PRIMARY KEY, tiles INTEGER NOT NULL, crc_of_tiles INTEGER NOT NULL,
    resolution_m REAL NOT NULL, frame TEXT NOT NULL, anchor TEXT NOT NULL, guarantee TEXT NOT NULL,
    crc INTEGER NOT NULL) STRICT;
"""
TILE_COLUMNS = "id, submap, ix, iy, version, content_crc, body, crc"
SUBMAP_COLUMNS = "number, tiles, crc_of_tiles, resolution_m, frame, anchor, guarantee, crc"


class StoreError(TerraboundError):
    """The store can't be opened, read or written now. What was acknowledged is not touched."""

    def __init__(self, text: str, reopen: bool = True) -> None:
        """`reopen`: the connection is suspect, and should be closed; otherwise the same save may be tried again."""
        super().__init__(text)
        self.reopen = reopen


class DamagedBeyondOpening(StoreError):
    """The file is no database any more."""


class TileRow(NamedTuple):
    """What is remembered of a stored tile."""

    id: int
    version: int
    """Counts the transactions that changed it."""
    content_crc: int
    """As in the digest: CRC-32 of the tile as published."""
    crc: int
    """CRC-32 of the whole row."""


@dataclass(frozen=True, slots=True)
class Submap:
    """One map frame: tiles of different submaps have different frames, and are never joined."""

    number: int
    resolution_m: float
    frame: str
    anchor: str = ""
    """JSON text that places the frame on Earth; empty if unknown."""
    guarantee: str = ""
    """JSON text: do the bounds hold?"""
    tiles: int = 0
    """How many are stored."""
    crc_of_tiles: int = 0
    """Exclusive or of their rows' CRCs: a row that vanished, or went back to an earlier state, is missed."""

    def row(self) -> tuple[int, int, int, float, str, str, str, int]:
        """As in the table, with its CRC."""
        texts = (self.frame, self.anchor, self.guarantee)
        numbers = struct.pack("<qqqd", self.number, self.tiles, self.crc_of_tiles, self.resolution_m)
        crc = zlib.crc32("\0".join(texts).encode(), zlib.crc32(numbers))
        return (self.number, self.tiles, self.crc_of_tiles, self.resolution_m, *texts, crc)


def row_crc(row: int, place: Place, version: int, content: int, body: bytes) -> int:
    """CRC-32 over everything that a tile's row says."""
    return zlib.crc32(body, zlib.crc32(struct.pack("<6q", row, *place, version, content)))


class TileStore:
    """An open store. Raises StoreError where the file can't be used; nothing is written before the first save."""

    def __init__(self, path: Path) -> None:
        """Open or make the file. Call store_check.check before saving: rows are known only from then on."""
        self.path = path
        self.connection = connect(path)
        self.rows: dict[Place, TileRow] = {}
        self.submaps: dict[int, Submap] = {}

    def close(self) -> None:
        """Let go of the file."""
        with suppress(sqlite3.Error):
            self.connection.close()

    def save(self, submap: Submap, tiles: Iterable[Tile], stamp_ns: int) -> int:
        """Join tiles of one submap into those stored, and keep its anchor and guarantee; how many rows changed.

        They are on the disk when this returns; after a StoreError, none is. stamp_ns: wall clock, for people.
        """
        rows: dict[Place, TileRow] = {}
        known = self.submaps.get(submap.number, replace(submap, tiles=0, crc_of_tiles=0))
        count, xor = known.tiles, known.crc_of_tiles
        try:
            self.connection.execute("BEGIN IMMEDIATE")
            for tile in tiles:
                place = (tile.submap, tile.ix, tile.iy)
                if tile.submap != submap.number or place in rows:
                    raise ValueError(f"tile {place} twice, or not of submap {submap.number}")
                old = self.rows.get(place)
                stored = None if old is None else self._read(place, old)
                whole = tile if stored is None else join(stored, tile)
                if whole == stored:
                    continue
                if old is None:
                    # Ids are dense, so that a damaged table can be read row by row.
                    old = TileRow(len(self.rows) + 1 + count - known.tiles, 0, 0, 0)
                    count += 1
                row = rows[place] = self._write(whole, old, stamp_ns)
                xor ^= row.crc ^ old.crc
            now = replace(submap, tiles=count, crc_of_tiles=xor)
            if now != known or submap.number not in self.submaps:
                self.connection.execute(f"REPLACE INTO submap ({SUBMAP_COLUMNS}) VALUES (?,?,?,?,?,?,?,?)", now.row())
            self.connection.execute("COMMIT")
        except BaseException as error:
            with suppress(sqlite3.Error):
                self.connection.execute("ROLLBACK")
            if isinstance(error, sqlite3.Error):
                self._make_room(error)
                raise explained(error, self.path) from error
            raise
        self.rows |= rows
        self.submaps[submap.number] = now
        return len(rows)

    def read(self, place: Place) -> Tile | None:
        """The stored tile; None where there is none, or where it no longer is what was written."""
        row = self.rows.get(place)
        try:
            return None if row is None else self._read(place, row)
        except sqlite3.Error as error:
            raise explained(error, self.path) from error

    def tiles(self, submap: int) -> Iterator[Tile]:
        """All stored tiles of a submap that are what was written."""
        for place in [place for place in self.rows if place[0] == submap]:
            tile = self.read(place)
            if tile is not None:
                yield tile

    def _make_room(self, error: sqlite3.Error) -> None:
        """On a full disk, fold the log into the file: the next save begins it anew."""
        if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL:
            with suppress(sqlite3.Error):
                self.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    def _read(self, place: Place, row: TileRow) -> Tile | None:
        found = self.connection.execute(f"SELECT {TILE_COLUMNS} FROM tile WHERE id = ?", (row.id,)).fetchone()
        return decoded(found) if intact(found) and tuple(found[1:4]) == place else None

    def _write(self, tile: Tile, old: TileRow, stamp_ns: int) -> TileRow:
        place, version, content = (tile.submap, tile.ix, tile.iy), old.version + 1, content_crc(tile)
        body = encode(tile, "map", stamp_ns)
        crc = row_crc(old.id, place, version, content, body)
        values = (old.id, *place, version, content, body, crc)
        self.connection.execute(f"REPLACE INTO tile ({TILE_COLUMNS}) VALUES (?,?,?,?,?,?,?,?)", values)
        return TileRow(old.id, version, content, crc)


def intact(row: tuple[object, ...] | None) -> bool:
    """Is a row (TILE_COLUMNS) what was once written?"""
    if row is None:
        return False
    number, submap, ix, iy, version, content, body, crc = row
    try:
        return crc == row_crc(number, (submap, ix, iy), version, content, body)  # type: ignore[arg-type]  # as found
    except (struct.error, TypeError):
        return False


def decoded(row: tuple[object, ...]) -> Tile | None:
    """The tile of an intact row; None where the body is none (another program wrote it)."""
    submap, body = row[1], row[6]
    assert isinstance(submap, int)
    assert isinstance(body, bytes)
    try:
        return decode(body, submap).tile
    except TileFormatError:
        return None


def connect(path: Path) -> sqlite3.Connection:
    """Open the database, or make it; alone with it until it is closed."""
    existed = path.exists()
    connection = None
    try:
        connection = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        # Whatever is in a damaged row, reading it is no error of Unicode's.
        connection.text_factory = bytes
        # A file that is there keeps its page size. Alone with it, SQLite needs no shared memory.
        for pragma in (
            f"page_size = {PAGE_BYTES}",
            "locking_mode = EXCLUSIVE",
            "journal_mode = WAL",
            "synchronous = FULL",
            f"wal_autocheckpoint = {CHECKPOINT_PAGES}",
            "journal_size_limit = 0",
        ):
            connection.execute(f"PRAGMA {pragma}")
        _expect_ours(connection, path)
        if not existed:
            fsync_folder(path.parent)
    except BaseException as error:
        if connection is not None:
            connection.close()
        if isinstance(error, sqlite3.Error):
            raise explained(error, path) from error
        raise
    return connection


def _expect_ours(connection: sqlite3.Connection, path: Path) -> None:
    """Make the tables in a new file; raise StoreError where it is another program's."""
    names = {bytes(name) for (name,) in connection.execute("SELECT name FROM sqlite_master")}
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    if {b"tile", b"submap"} <= names:
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if application == APPLICATION_ID and version > FORMAT:
            raise StoreError(f"{path}: format {version} of a newer terrabound; give another store.path, or update")
        return
    if application == APPLICATION_ID:
        # Mark and tables came in one transaction.
        raise DamagedBeyondOpening(f"{path}: damaged (its tables are gone)")
    if names:
        raise StoreError(f"{path}: a database, but no map's; give another store.path")
    connection.executescript(
        f"BEGIN; PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {FORMAT}; {SCHEMA} COMMIT;"
    )


def explained(error: sqlite3.Error, path: Path) -> StoreError:
    """What a person can do about it."""
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code in (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT):
        return DamagedBeyondOpening(f"{path}: damaged ({error})")
    advice = {
        sqlite3.SQLITE_FULL: "the disk is full; make room",
        sqlite3.SQLITE_READONLY: "can't be written: mount the disk for writing, and give the file to this user",
        sqlite3.SQLITE_CANTOPEN: "can't be opened: is its folder there, and may this user write in it?",
        sqlite3.SQLITE_BUSY: "in use by another process; stop that one, or give another store.path",
        sqlite3.SQLITE_IOERR: "the disk fails",
    }.get(code, "fails")
    return StoreError(f"{path}: {advice} ({error})", reopen=code != sqlite3.SQLITE_FULL)


def fsync_folder(folder: Path) -> None:
    """Have a folder's entries on the disk: a new file is not there before its name is."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
