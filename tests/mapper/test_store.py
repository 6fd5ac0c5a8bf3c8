"""The map on disk: what was acknowledged outlives kill -9 and torn writes; what a disk broke is found and told."""

import os
import random
import shutil
import signal
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from functools import cache, reduce
from pathlib import Path

import numpy as np
import pytest

from mapper.store import PAGE_BYTES, Place, StoreError, Submap, TileStore
from mapper.store_check import open_store
from mapper.tile import Tile, content_crc, join, snap_outward

FRAME = Submap(0, 0.1, "map", anchor='{"origin_lat_deg": 48.0}')
SIDE = 4
Batch = list[Tile]


def a_tile(ix: int, iy: int, seed: int, submap: int = 0) -> Tile:
    """Noise, snapped: what is stored is what was given, bit for bit."""
    chance = np.random.default_rng([seed, ix + 100, iy + 100])
    low = chance.uniform(-1, 1, (64, 64)).astype(np.float32)
    high = low + np.float32(0.25)
    unseen = chance.random((64, 64)) < 0.5
    low[unseen], high[unseen] = np.nan, np.nan
    return snap_outward(Tile(submap, ix, iy, 0.1, low, high))


@cache
def batch(number: int) -> Batch:
    """What changed in the number-th second: some tiles, most of them stored before."""
    chance = random.Random(number)
    places = chance.sample([(ix, iy) for ix in range(-SIDE, SIDE) for iy in range(SIDE)], 12)
    return [a_tile(ix, iy, number) for ix, iy in places]


def joined(batches: list[Batch]) -> dict[Place, int]:
    """Content of every tile once these are all joined."""
    tiles: dict[Place, list[Tile]] = {}
    for tile in (tile for one in batches for tile in one):
        tiles.setdefault((0, tile.ix, tile.iy), []).append(tile)
    return {place: content_crc(reduce(join, parts)) for place, parts in tiles.items()}


def content(store: TileStore) -> dict[Place, int]:
    """Content of every stored tile, decoded."""
    return {(tile.submap, tile.ix, tile.iy): content_crc(tile) for tile in store.tiles(0)}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where the store is to be."""
    return tmp_path / "map.db"


def write(path: Path, batches: range) -> None:
    """Save batches in a store, and close it."""
    store, _ = open_store(path)
    for number in batches:
        store.save(FRAME, batch(number), 0)
    store.close()


def copy(path: Path, folder: Path) -> Path:
    """A copy of the database with its log, as a crash would leave both."""
    folder.mkdir()
    for found in path.parent.glob("map.db*"):
        shutil.copy(found, folder)
    return folder / path.name


def test_saved_tiles_come_back_joined(path: Path) -> None:
    """What was saved in any number of transactions is there after a restart as one join, with its frame and anchor."""
    write(path, range(5))
    store, findings = open_store(path)
    assert findings.clean
    assert content(store) == joined([batch(n) for n in range(5)])
    assert store.submaps[0].anchor == FRAME.anchor
    assert store.save(FRAME, batch(3), 0) == 0, "saving again changes nothing"
    assert store.read((0, 99, 99)) is None
    store.close()


def test_submaps_stay_apart(path: Path) -> None:
    """The same place in two frames is two tiles; each submap keeps its own anchor and guarantee."""
    store, _ = open_store(path)
    store.save(FRAME, [a_tile(0, 0, 1)], 0)
    store.save(Submap(1, 0.1, "map", guarantee='{"intact": false}'), [a_tile(0, 0, 2, submap=1)], 0)
    store.close()
    store, findings = open_store(path)
    assert findings.clean
    assert (store.read((0, 0, 0)), store.read((1, 0, 0))) == (a_tile(0, 0, 1), a_tile(0, 0, 2, submap=1))
    assert [submap.guarantee for submap in store.submaps.values()] == ["", '{"intact": false}']
    store.close()


def test_the_file_is_as_the_documentation_says(path: Path) -> None:
    """16 KiB pages, write-ahead log, FULL synchronous; sqlite3 alone reads it."""
    store, _ = open_store(path)
    assert store.connection.execute("PRAGMA journal_mode").fetchone() == (b"wal",)
    assert store.connection.execute("PRAGMA synchronous").fetchone() == (2,)
    store.save(FRAME, batch(0), 0)
    store.close()
    plain = sqlite3.connect(path)
    assert plain.execute("PRAGMA page_size").fetchone() == (PAGE_BYTES,)
    assert plain.execute("SELECT count(*), min(version) FROM tile").fetchone() == (12, 1)
    plain.close()


def writer(path: Path, first: int) -> tuple[int, int]:
    """A real second process that saves batch after batch and tells each that it acknowledges; (pid, pipe)."""
    hearing, speaking = os.pipe()
    pid = os.fork()
    if pid:
        os.close(speaking)
        return pid, hearing
    try:
        store, _ = open_store(path)
        for number in range(first, first + 10_000):
            store.save(FRAME, batch(number), 0)
            os.write(speaking, f"{number}\n".encode())
    finally:
        os._exit(1)


def test_kill_9_at_any_instant_loses_nothing_acknowledged(path: Path) -> None:
    """25 times SIGKILL at a random time: all acknowledged batches are there, whole; of the next, all or nothing."""
    chance, first = random.Random(5), 0
    for _ in range(25):
        pid, pipe = writer(path, first)
        heard = os.read(pipe, 100)
        time.sleep(chance.uniform(0, 0.04))  # no synchronisation: the instant is to be any
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        while more := os.read(pipe, 10_000):
            heard += more
        os.close(pipe)
        acknowledged = int(heard.split()[-1])
        store, findings = open_store(path)
        assert findings.clean
        found = content(store)
        store.close()
        first = acknowledged + 1
        if found != joined([batch(n) for n in range(first)]):
            first += 1
            assert found == joined([batch(n) for n in range(first)])
    assert first > 25


@pytest.fixture
def torn(path: Path, tmp_path: Path) -> Iterator[tuple[Path, int, int]]:
    """A database with its log as they stood when the last of three batches had just been written, and the log's
    lengths before and after it."""
    store, _ = open_store(path)
    log = path.with_name("map.db-wal")
    store.save(FRAME, batch(0), 0)
    store.save(FRAME, batch(1), 0)
    before = log.stat().st_size
    store.save(FRAME, batch(2), 0)
    yield copy(path, tmp_path / "crashed"), before, log.stat().st_size
    store.close()


@pytest.mark.parametrize("kind", ["cut", "zeros", "noise"])
def test_a_torn_last_write_loses_nothing_acknowledged(torn: tuple[Path, int, int], kind: str, tmp_path: Path) -> None:
    """The last transaction cut anywhere, or only partly on the disk: exactly the acknowledged ones are there."""
    crashed, before, after = torn
    two, three, chance = joined([batch(0), batch(1)]), joined([batch(n) for n in range(3)]), random.Random(kind)
    for number in range(20):
        state = copy(crashed, tmp_path / f"{number}")
        log = state.with_name("map.db-wal")
        whole = log.read_bytes()
        written = bytearray(whole)
        at = before if number == 0 else chance.randrange(before, after)
        end = len(written) if number % 2 else min(len(written), at + 4096)
        if kind == "cut":
            del written[at:]
        else:
            written[at:end] = bytes(end - at) if kind == "zeros" else chance.randbytes(end - at)
        log.write_bytes(written)
        store, findings = open_store(state)
        assert content(store) == (three if written == whole else two)
        assert findings.clean
        store.close()


@pytest.mark.parametrize("kind", ["bit", "header", "page"])
def test_whatever_a_disk_breaks_is_found(kind: str, path: Path, tmp_path: Path) -> None:
    """Flipped bits and zeroed pages, 40 times: no tile is wrong, what is lost is told, the rest stays, and goes on."""
    write(path, range(5))
    whole, good = path.read_bytes(), joined([batch(n) for n in range(5)])
    chance, told, kept = random.Random(kind), 0, 0
    for number in range(40):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        broken, at = bytearray(whole), chance.randrange(PAGE_BYTES, len(whole))
        start = at // PAGE_BYTES * PAGE_BYTES
        if kind == "page":
            broken[start : start + PAGE_BYTES] = bytes(PAGE_BYTES)
        else:
            broken[at if kind == "bit" else start + at % 16] ^= 1 << chance.randrange(8)
        (folder / "map.db").write_bytes(broken)
        store, findings = open_store(folder / "map.db")
        found = content(store)
        assert found.items() <= good.items()
        assert found == good or not findings.clean
        if not findings.clean:
            told += 1
            assert findings.set_aside is not None
            assert findings.set_aside.read_bytes() == broken
        kept += len(found)
        store.save(FRAME, [tile for n in range(5) for tile in batch(n)][-12:], 0)
        store.close()
        store, again = open_store(folder / "map.db")
        assert again.clean
        store.close()
    assert told > 15
    assert kept >= 40 * len(good) * (0.6 if kind == "page" else 0.9)


def test_a_broken_log_is_found(path: Path, tmp_path: Path) -> None:
    """Bits flipped in the log that a crash left: an earlier state as a whole, and it is told."""
    store, _ = open_store(path)
    states = [joined([batch(n) for n in range(k)]) for k in range(7)]
    for number in range(6):
        store.save(FRAME, batch(number), 0)
    chance = random.Random(2)
    for number in range(40):
        state = copy(path, tmp_path / f"{number}")
        log = state.with_name("map.db-wal")
        broken = bytearray(log.read_bytes())
        broken[chance.randrange(32 if number < 8 else len(broken))] ^= 1 << chance.randrange(8)
        log.write_bytes(broken)
        opened, findings = open_store(state)
        found = content(opened)
        assert found in states
        assert found == states[6] or findings.log_damaged or findings.log_torn
        if found in states[:5]:
            assert findings.log_damaged
            assert "newest saves are lost" in str(findings)
        opened.close()
    store.close()


def test_a_file_that_is_no_database_any_more_is_set_aside(path: Path) -> None:
    """Its first page overwritten: the file is renamed, a new store begins, and both are told."""
    write(path, range(2))
    broken = b"\0" * PAGE_BYTES + path.read_bytes()[PAGE_BYTES:]
    path.write_bytes(broken)
    store, findings = open_store(path)
    assert findings.set_aside == path.with_name("map.db.damaged-1")
    assert findings.set_aside.read_bytes() == broken
    assert "damaged-1" in str(findings)
    assert not store.rows
    store.save(FRAME, batch(0), 0)
    store.close()


def test_power_gone_between_the_renames_of_a_rebuild(path: Path) -> None:
    """The rebuilt file is there under its temporary name alone: it is taken."""
    write(path, range(2))
    path.rename(path.with_name("map.db.rebuilt"))
    store, findings = open_store(path)
    assert findings.clean
    assert content(store) == joined([batch(0), batch(1)])
    store.close()


def test_other_peoples_files_are_left_alone(path: Path) -> None:
    """Another program's database, a newer format, a store in use: refused, with what to do, and not touched."""
    other = sqlite3.connect(path)
    other.execute("CREATE TABLE diary (entry TEXT)")
    other.commit()
    other.close()
    before = path.read_bytes()
    with pytest.raises(StoreError, match=r"no map's; give another store\.path"):
        open_store(path)
    assert path.read_bytes()[100:] == before[100:]
    path.unlink()
    write(path, range(1))
    newer = sqlite3.connect(path)
    newer.execute("PRAGMA user_version = 2")
    newer.close()
    with pytest.raises(StoreError, match="newer terrabound"):
        open_store(path)
    path.unlink()
    store, _ = open_store(path)
    with pytest.raises(StoreError, match="in use by another process"):
        open_store(path)
    store.close()
    with pytest.raises(StoreError, match="is its folder there"):
        open_store(path.with_name("nowhere") / "map.db")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 2 MiB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(disk)]
    if os.getuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("no disk can be mounted here")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_full_disk_refuses_a_save_whole_and_takes_it_later(small_disk: Path) -> None:
    """The store says that the disk is full; what was acknowledged stays; with room again the same store goes on."""
    path = small_disk / "map.db"
    (small_disk / "other").write_bytes(bytes(1_000_000))
    store, _ = open_store(path)
    number = 0

    def fill() -> None:
        nonlocal number
        while True:
            store.save(FRAME, batch(number), 0)
            number += 1

    with pytest.raises(StoreError, match="the disk is full; make room") as told:
        fill()
    assert number > 0
    assert not told.value.reopen
    assert content(store) == joined([batch(n) for n in range(number)])
    (small_disk / "other").unlink()
    store.save(FRAME, batch(number), 0)
    assert content(store) == joined([batch(n) for n in range(number + 1)])
    store.close()
    store, findings = open_store(path)
    assert findings.clean
    assert content(store) == joined([batch(n) for n in range(number + 1)])
    store.close()
