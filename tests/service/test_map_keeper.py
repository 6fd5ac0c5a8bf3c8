"""Keeping the map while disks fill up, fail, vanish and return: nothing is lost, it is told, and it resumes."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from estimator.bounded_pose import INTACT, Anchor, Guarantee
from mapper.store import Submap
from mapper.store_check import open_store
from mapper.tile import Tile, join, snap_outward
from service import map_keeper
from service.digest import DigestEntry
from service.health import Health
from service.map_keeper import STORE, STORED_MAP, EarlierSubmaps, MapKeeper
from service.messages import guarantee_of, read_anchor

PATIENCE_S = 30.0
QUICK_S = 0.02
ANCHOR = Anchor(48.0, 11.0, 500.0, np.array([0.0, 0.0, 0.0, -1.0]), np.array([1.0, 1.0, 1.0, 1.0]))


def a_tile(ix: int, seed: int = 0, submap: int = 0) -> Tile:
    """Noise, snapped: what is stored is what was given, bit for bit."""
    chance = np.random.default_rng([seed, ix + 100])
    low = chance.uniform(-1, 1, (64, 64)).astype(np.float32)
    return snap_outward(Tile(submap, ix, 0, 0.1, low, low + np.float32(0.25)))


@pytest.fixture(autouse=True)
def a_slow_disk_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine a store may take longer to open than a robot waits for it."""
    monkeypatch.setattr(map_keeper, "OPENING_S", PATIENCE_S)


@contextmanager
def keeping(path: Path, health: Health | None = None, earlier: int = 0) -> Iterator[MapKeeper]:
    """A keeper that has begun."""
    keeper = MapKeeper(path, QUICK_S, 0.1, "map", health or Health(), earlier_submaps=earlier)
    try:
        yield keeper
    finally:
        keeper.close()


def wait_until(happened: Callable[[], bool]) -> None:
    """Look until it is so."""
    deadline = time.monotonic() + PATIENCE_S
    while not happened():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.01)


def offer(keeper: MapKeeper, *tiles: Tile) -> None:
    """Hand over tiles, the bounds being intact."""
    keeper.offer(tiles, ANCHOR, INTACT, 1)


def all_saved(keeper: MapKeeper) -> bool:
    """Is everything on the disk that was handed over?"""
    return bool(keeper.state()["tiles_unsaved"] == 0)


def stored(path: Path, submap: int = 0) -> list[Tile]:
    """What a later process finds."""
    store, findings = open_store(path)
    assert findings.clean, str(findings)
    tiles = sorted(store.tiles(submap), key=lambda tile: tile.ix)
    store.close()
    return tiles


def test_what_was_handed_over_is_saved_by_itself_and_at_the_end(tmp_path: Path) -> None:
    """Tiles reach the disk within an interval; the last ones when the keeper is closed; state says how far it is."""
    with keeping(tmp_path / "map.db") as keeper:
        assert keeper.start() == 0
        offer(keeper, a_tile(0), a_tile(1))
        wait_until(lambda: all_saved(keeper))
        state = keeper.state()
        assert state["tiles"] == state["tiles_written"] == 2
        assert state["saved_up_to_ns"] == 1
        assert keeper.is_saved((0, 0, 0))
        assert not keeper.is_saved((0, 7, 0))
        offer(keeper, a_tile(2))
    assert stored(tmp_path / "map.db") == [a_tile(0), a_tile(1), a_tile(2)]


def test_each_run_is_a_submap_of_its_own_and_earlier_ones_stay(tmp_path: Path) -> None:
    """Frames differ between runs: tiles of the same place are never joined; the newest earlier runs are handed on."""
    void = Guarantee(5, "gps")
    for run in range(4):
        with keeping(tmp_path / "map.db") as keeper:
            assert keeper.start() == run
            keeper.offer([a_tile(0, run, run)], ANCHOR, void if run == 2 else INTACT, 1)
    heard: list[EarlierSubmaps] = []
    keeper = MapKeeper(tmp_path / "map.db", QUICK_S, 0.1, "map", Health(), heard.append, 2)
    assert keeper.start() == 4
    wait_until(lambda: bool(heard))
    assert list(heard[0]) == [2, 3]
    assert [guarantee.guarantee.sensor for guarantee in heard[0].values()] == ["gps", None]
    for number, earlier in heard[0].items():
        assert earlier.anchor is not None
        assert np.array_equal(read_anchor(earlier.anchor).high, ANCHOR.high)
        assert [entry[:3] for entry in earlier.tiles] == [(number, 0, 0)]
        assert isinstance(earlier.tiles[0], DigestEntry)
        assert keeper.recall(earlier.tiles[0].tile) == a_tile(0, number, number)
    assert guarantee_of("").intact
    keeper.close()
    assert stored(tmp_path / "map.db", 1) == [a_tile(0, 1, 1)]


def test_a_run_that_maps_nothing_leaves_no_submap(tmp_path: Path) -> None:
    """A service that is restarted many times while it stands does not fill the store with empty frames."""
    for _ in range(3):
        with keeping(tmp_path / "map.db") as keeper:
            assert keeper.start() == 0
            keeper.offer([], ANCHOR, INTACT, 1)


def test_recall_gives_all_that_was_ever_handed_over(tmp_path: Path) -> None:
    """Before, while and after saving; also of a tile that left memory, whose new cells are joined to the stored."""
    with keeping(tmp_path / "map.db") as keeper:
        keeper.start()
        offer(keeper, a_tile(0, 1))
        assert keeper.recall((0, 0, 0)) == a_tile(0, 1)
        wait_until(lambda: all_saved(keeper))
        keeper.left_memory([(0, 0, 0)])
        assert list(keeper.kept()) == [a_tile(0, 1)]
        offer(keeper, a_tile(0, 2))
        both = join(a_tile(0, 1), a_tile(0, 2))
        assert keeper.recall((0, 0, 0)) == both
        back: list[Tile] = []

        def something_came_back() -> bool:
            # Whoever saves the map at any moment of this finds the tile here, until it has been taken back.
            assert list(keeper.kept()) == [both]
            assert not keeper.is_saved((0, 0, 0))
            back.extend(keeper.returned())
            return bool(back)

        wait_until(something_came_back)
        assert back == [both]
        assert list(keeper.kept()) == []
        wait_until(lambda: keeper.is_saved((0, 0, 0)))
        assert keeper.recall((0, 9, 9)) is None


def test_a_map_that_is_written_while_tiles_come_back_is_whole(tmp_path: Path) -> None:
    """What memory lacked when it was copied is read from the store, though meanwhile it came back into memory."""
    with keeping(tmp_path / "map.db") as keeper:
        keeper.start()
        offer(keeper, a_tile(0, 1))
        wait_until(lambda: all_saved(keeper))
        keeper.left_memory([(0, 0, 0)])
        offer(keeper, a_tile(0, 2))
        wait_until(lambda: all_saved(keeper))
        missing = keeper.kept()
        wait_until(lambda: bool(keeper.returned()))
        assert list(missing) == [join(a_tile(0, 1), a_tile(0, 2))]


def test_a_store_that_is_away_at_the_start_is_used_once_it_is_there(tmp_path: Path) -> None:
    """Mapping begins at once, as submap 0; what is stored under that number by an earlier run stays another map."""
    disk, aside = tmp_path / "disk", tmp_path / "aside"
    disk.mkdir()
    with keeping(disk / "map.db") as keeper:
        keeper.start()
        offer(keeper, a_tile(0, 1))
    disk.rename(aside)
    health = Health()
    with keeping(disk / "map.db", health) as keeper:
        assert keeper.start() == 0
        assert "is its folder there" in health.troubles[STORE]
        offer(keeper, a_tile(0, 2))
        aside.rename(disk)
        wait_until(lambda: all_saved(keeper))
        assert STORE not in health.troubles
        assert keeper.recall((0, 0, 0)) == a_tile(0, 2)
    assert stored(disk / "map.db", 0) == [a_tile(0, 1)]
    assert [tile.low.tobytes() for tile in stored(disk / "map.db", 1)] == [a_tile(0, 2).low.tobytes()]


def test_a_store_that_is_deleted_while_in_use_is_made_again(tmp_path: Path) -> None:
    """Somebody removes the files: it is noticed, and the map in memory is asked for once more."""
    path = tmp_path / "map.db"
    with keeping(path) as keeper:
        keeper.start()
        offer(keeper, a_tile(0), a_tile(1))
        wait_until(lambda: all_saved(keeper))
        for file in tmp_path.iterdir():
            file.unlink()
        offer(keeper, a_tile(2))
        wait_until(lambda: keeper.wants_all)
        assert keeper.state()["tiles_lost"] == 2
        keeper.wants_all = False
        offer(keeper, a_tile(0), a_tile(1), a_tile(2))
        wait_until(lambda: all_saved(keeper))
    assert stored(path) == [a_tile(0), a_tile(1), a_tile(2)]


def test_a_damaged_store_is_told_and_the_rest_is_there(tmp_path: Path) -> None:
    """One tile is broken: health names the file, what is lost, and where the damaged file is; the run goes on."""
    path = tmp_path / "map.db"
    store, _ = open_store(path)
    store.save(Submap(0, 0.1, "map"), [a_tile(ix) for ix in range(10)], 0)
    store.close()
    broken = bytearray(path.read_bytes())
    broken[5 * 16384 + 8000] ^= 4
    path.write_bytes(broken)
    health = Health()
    with keeping(path, health) as keeper:
        assert keeper.start() == 1
        wait_until(lambda: STORED_MAP in health.troubles)
        told = health.troubles[STORED_MAP]
        assert "9 tiles kept, 1 damaged" in told
        assert "map.db.damaged-1" in told
        assert keeper.state()["found_clean"] is False
        offer(keeper, a_tile(0, 3, submap=1))
    assert len(stored(path)) == 9
    assert stored(path, 1) == [a_tile(0, 3, submap=1)]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 4 MiB of its own."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)]
    if os.getuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("no disk can be mounted here")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_full_disk_is_told_and_saving_resumes_once_there_is_room(small_disk: Path) -> None:
    """The map stays in RAM, health says why; with room again it is saved, all of it."""
    health, ballast = Health(), small_disk / "ballast"
    with keeping(small_disk / "map.db", health) as keeper:
        keeper.start()
        offer(keeper, a_tile(0))
        wait_until(lambda: all_saved(keeper))
        free = os.statvfs(small_disk)
        ballast.write_bytes(bytes((free.f_bavail - 4) * free.f_bsize))
        for ix in range(1, 30):
            offer(keeper, a_tile(ix))
        wait_until(lambda: "the disk is full; make room" in health.troubles.get(STORE, ""))
        assert not all_saved(keeper)
        assert keeper.recall((0, 29, 0)) == a_tile(29)
        ballast.unlink()
        wait_until(lambda: all_saved(keeper))
        wait_until(lambda: STORE not in health.troubles)
    assert stored(small_disk / "map.db") == [a_tile(ix) for ix in range(30)]


def test_a_disk_that_turns_read_only_is_told_and_used_again_later(small_disk: Path) -> None:
    """As a failing card does, and a person mends it."""
    health = Health()
    with keeping(small_disk / "map.db", health) as keeper:
        keeper.start()
        offer(keeper, a_tile(0))
        wait_until(lambda: all_saved(keeper))
        subprocess.run(["umount", "-l", str(small_disk)], check=True)
        subprocess.run(["mount", "-t", "tmpfs", "-o", "ro,size=4m", "tmpfs", str(small_disk)], check=True)
        offer(keeper, a_tile(1))
        wait_until(lambda: STORE in health.troubles and keeper.state()["open"] is False)
        assert not all_saved(keeper)
        subprocess.run(["mount", "-o", "remount,rw", str(small_disk)], check=True)
        wait_until(lambda: keeper.wants_all)
        offer(keeper, a_tile(0), a_tile(1))
        wait_until(lambda: all_saved(keeper))
    assert stored(small_disk / "map.db") == [a_tile(0), a_tile(1)]


def test_a_limit_on_the_size_of_files_is_a_full_disk(tmp_path: Path) -> None:
    """In a process of its own: writes beyond the limit fail, are told, and go through once the limit is lifted."""
    path, words = tmp_path / "map.db", tmp_path / "words"
    pid = os.fork()
    if pid == 0:
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))
            health = Health()
            with keeping(path, health) as keeper:
                keeper.start()
                offer(keeper, *(a_tile(ix) for ix in range(30)))
                wait_until(lambda: STORE in health.troubles)
                words.write_text(health.troubles[STORE])
                wait_until(lambda: all_saved(keeper))
            os._exit(0)
        finally:
            os._exit(1)
    wait_until(words.exists)
    wait_until(lambda: words.read_text() != "")
    assert str(path) in words.read_text()
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert os.waitpid(pid, 0)[1] == 0
    assert stored(path) == [a_tile(ix) for ix in range(30)]


FAILING_FSYNC = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdlib.h>
#include <unistd.h>
static int fails(void) { const char *sign = getenv("FSYNC_FAILS"); return sign && access(sign, F_OK) == 0; }
int fsync(int fd) {
    if (fails()) { errno = EIO; return -1; }
    return ((int (*)(int))dlsym(RTLD_NEXT, "fsync"))(fd);
}
int fdatasync(int fd) {
    if (fails()) { errno = EIO; return -1; }
    return ((int (*)(int))dlsym(RTLD_NEXT, "fdatasync"))(fd);
}
"""
KEEP_ON = """
import sys, time
from pathlib import Path
from tests_of_keeper import a_tile, offer, MapKeeper, Health, STORE
path, sign, words = map(Path, sys.argv[1:])
health = Health()
keeper = MapKeeper(path, 0.02, 0.1, "map", health)
keeper.start()
for ix in range(10_000):
    offer(keeper, a_tile(ix % 40, ix // 40))
    if keeper.wants_all:
        keeper.wants_all = False
    if ix == 40:
        sign.touch()
    if STORE in health.troubles and not words.exists():
        words.write_text(health.troubles[STORE])
        sign.unlink()
        break
    time.sleep(0.01)
while keeper.state()["tiles_unsaved"]:
    time.sleep(0.01)
print(ix, flush=True)
time.sleep(60)
"""


def test_a_failing_fsync_is_told_and_nothing_acknowledged_is_lost(tmp_path: Path) -> None:
    """A process whose disk refuses to sync for a while, and which is then killed: all that it acknowledged is there."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler to make a failing disk with")
    (tmp_path / "shim.c").write_text(FAILING_FSYNC)
    shim = tmp_path / "shim.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", shim, tmp_path / "shim.c", "-ldl"], check=True)
    (tmp_path / "tests_of_keeper.py").write_text(Path(__file__).read_text())
    path, sign, words = tmp_path / "map.db", tmp_path / "sign", tmp_path / "words"
    environment = {**os.environ, "LD_PRELOAD": str(shim), "FSYNC_FAILS": str(sign), "PYTHONPATH": str(tmp_path)}
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(KEEP_ON), path, sign, words],
        env=environment,
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    last = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert "the disk fails" in words.read_text()
    kept = {tile.ix: tile for tile in stored(path)}
    for ix in range(last + 1):
        tile = a_tile(ix % 40, ix // 40)
        assert join(kept[tile.ix], tile) == kept[tile.ix]
