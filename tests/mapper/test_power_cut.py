"""Power cuts: every write and sync of a real process is recorded, and the disk is left as a cut at any moment may."""

import os
import random
import shutil
import struct
import subprocess
import sys
from functools import cache, reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from mapper.store import Place, Submap
from mapper.store_check import open_store
from mapper.tile import Tile, content_crc, join, snap_outward

BATCHES, STATES, SECTOR = 14, 80, 512
RECORDER = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
/* One record: kind, length of the name, offset, length; name; data. */
static void record(char kind, int fd, long long at, long long size, const void *data) {
    static int log = -1;
    static ssize_t (*really)(int, const void *, size_t);
    char link[64], name[4096];
    if (!really) really = dlsym(RTLD_NEXT, "write");
    if (log < 0) log = open(getenv("POWER_CUT_LOG"), O_WRONLY | O_CREAT | O_APPEND, 0600);
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, name, sizeof name - 1);
    if (length < 0 || !memmem(name, length, "map.db", 6)) return;
    struct { long long kind, name, at, size; } head = {kind, length, at, size};
    really(log, &head, sizeof head);
    really(log, name, length);
    if (data) really(log, data, size);
}
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at) {
    ssize_t done = ((ssize_t (*)(int, const void *, size_t, off64_t))dlsym(RTLD_NEXT, "pwrite64"))(fd, data, size, at);
    if (done > 0) record('w', fd, at, done, data);
    return done;
}
ssize_t pwrite(int fd, const void *data, size_t size, off_t at) { return pwrite64(fd, data, size, at); }
int ftruncate64(int fd, off64_t size) {
    record('t', fd, size, 0, 0);
    return ((int (*)(int, off64_t))dlsym(RTLD_NEXT, "ftruncate64"))(fd, size);
}
int ftruncate(int fd, off_t size) { return ftruncate64(fd, size); }
int fsync(int fd) {
    int done = ((int (*)(int))dlsym(RTLD_NEXT, "fsync"))(fd);
    record('s', fd, 0, 0, 0);
    return done;
}
int fdatasync(int fd) {
    int done = ((int (*)(int))dlsym(RTLD_NEXT, "fdatasync"))(fd);
    record('s', fd, 0, 0, 0);
    return done;
}
"""
WRITER = """
import os, sys
from pathlib import Path
import mapper.store as store
store.CHECKPOINT_PAGES = 30
from power_cut_batches import FRAME, BATCHES, batch
from mapper.store_check import open_store
path = Path(sys.argv[1])
opened, _ = open_store(path)
acknowledged = os.open(path.with_name("acknowledged-map.db"), os.O_WRONLY | os.O_CREAT)
for number in range(BATCHES):
    opened.save(FRAME, batch(number), 0)
    os.pwrite(acknowledged, bytes([number + 1]), 0)
os._exit(0)
"""
FRAME = Submap(0, 0.1, "map")


class Operation(NamedTuple):
    """What the process asked of the disk."""

    kind: str
    """w: write, t: truncate, s: sync."""
    name: str
    at: int
    data: bytes


@cache
def batch(number: int) -> list[Tile]:
    """What changed in the number-th second."""
    chance = random.Random(number)
    tiles = []
    for ix in chance.sample(range(16), 6):
        values = np.random.default_rng([number, ix])
        low = values.uniform(-1, 1, (64, 64)).astype(np.float32)
        tiles.append(snap_outward(Tile(0, ix, 0, 0.1, low, low + np.float32(0.25))))
    return tiles


@cache
def joined(batches: int) -> dict[Place, int]:
    """Content of every tile after so many batches."""
    tiles: dict[Place, list[Tile]] = {}
    for tile in (tile for number in range(batches) for tile in batch(number)):
        tiles.setdefault((0, tile.ix, tile.iy), []).append(tile)
    return {place: content_crc(reduce(join, parts)) for place, parts in tiles.items()}


@pytest.fixture(scope="module")
def operations(tmp_path_factory: pytest.TempPathFactory) -> list[Operation]:
    """Everything that a writing process did to its files, in order."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler to record a disk with")
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "recorder.c").write_text(RECORDER)
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-o", folder / "recorder.so", folder / "recorder.c", "-ldl"], check=True
    )
    (folder / "power_cut_batches.py").write_text(Path(__file__).read_text())
    environment = {
        **os.environ,
        "LD_PRELOAD": str(folder / "recorder.so"),
        "POWER_CUT_LOG": str(folder / "log"),
        "PYTHONPATH": str(folder),
    }
    subprocess.run([sys.executable, "-c", WRITER, folder / "map.db"], env=environment, check=True)
    log, at = (folder / "log").read_bytes(), 0
    found: list[Operation] = []
    while at < len(log):
        kind, name_length, offset, size = struct.unpack_from("<4q", log, at)
        at += 32
        name = Path(log[at : at + name_length].decode()).name
        at += name_length
        data = log[at : at + size] if chr(kind) == "w" else b""
        at += len(data)
        found.append(Operation(chr(kind), name, offset, data))
    return found


def disk_after(operations: list[Operation], cut: int, chance: random.Random) -> dict[str, bytes]:
    """Files as a power cut may leave them: what was synced is there, of the rest any sectors, in any order."""
    synced = {op.name: number for number, op in enumerate(operations[:cut]) if op.kind == "s"}
    files: dict[str, bytearray] = {}
    unsynced: list[Operation] = []
    for number, op in enumerate(operations[:cut]):
        files.setdefault(op.name, bytearray())
        if op.kind != "s" and number < synced.get(op.name, -1):
            apply(files[op.name], op)
        elif op.kind != "s":
            unsynced.append(op)
    keep = chance.random()
    for op in unsynced:
        if op.kind == "t":
            if chance.random() < keep:
                apply(files[op.name], op)
            continue
        for start in range(0, len(op.data), SECTOR):
            if chance.random() < keep:
                apply(files[op.name], op._replace(at=op.at + start, data=op.data[start : start + SECTOR]))
    return {name: bytes(content) for name, content in files.items()}


def apply(content: bytearray, op: Operation) -> None:
    """One write or truncation."""
    end = op.at + len(op.data)
    if op.kind == "t":
        del content[op.at :]
    if len(content) < end:
        content.extend(bytes(end - len(content)))
    if op.data:
        content[op.at : end] = op.data


def test_the_recorded_process_folded_its_log_into_the_file_meanwhile(operations: list[Operation]) -> None:
    """So that cuts also fall into checkpoints, and into logs that begin anew."""
    assert sum(op.kind == "w" and op.name == "map.db" for op in operations) > 20
    assert sum(op.kind == "w" and op.name == "map.db-wal" and op.at == 0 for op in operations) > 2
    assert sum(op.kind == "s" for op in operations) > BATCHES


def test_no_power_cut_loses_what_was_acknowledged(operations: list[Operation], tmp_path: Path) -> None:
    """80 cuts at any operation, unsynced sectors there or not: acknowledged batches whole, the next whole or not."""
    chance = random.Random(3)
    begun = next(n for n, op in enumerate(operations) if op.name.startswith("acknowledged"))
    survived_unacknowledged = 0
    for state in range(STATES):
        cut = chance.randrange(begun + 1, len(operations) + 1)
        files = disk_after(operations, cut, chance)
        acknowledged = max(op.data[0] for op in operations[:cut] if op.name.startswith("acknowledged"))
        folder = tmp_path / f"{state}"
        folder.mkdir()
        for name in ("map.db", "map.db-wal"):
            (folder / name).write_bytes(files.get(name, b""))
        store, findings = open_store(folder / "map.db")
        found = {(tile.submap, tile.ix, tile.iy): content_crc(tile) for tile in store.tiles(0)}
        store.close()
        assert findings.clean, f"cut {cut}: {findings}"
        assert found in (joined(acknowledged), joined(acknowledged + 1)), f"cut {cut}"
        survived_unacknowledged += found != joined(acknowledged)
    assert survived_unacknowledged < STATES / 2
