"""Keeps the map on the disk: one thread that owns the store. The pipeline hands over and never waits for a disk.

Once a second all tiles that changed go into one transaction. Until it is committed they stay here as well, so nothing
is in danger while a disk is full, read-only or away: health tells, and saving resumes by itself. docs/store.md.
"""

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from estimator.bounded_pose import INTACT, Anchor, Guarantee
from mapper.store import Place, StoreError, Submap, TileRow, TileStore
from mapper.store_check import Findings, open_store
from mapper.tile import Tile, join
from service.digest import DigestEntry
from service.health import Health
from service.messages import guarantee_of, guarantee_text, write_anchor
from service.published_map import EarlierSubmap

OPENING_S = 1.0
"""The run's submap is numbered once the store has been asked; a disk that takes longer is not waited for."""
LAST_SAVE_S = 10.0
STORE, STORED_MAP = "store", "stored map"
"""Names of the troubles: saving fails; what was found damaged when the store was opened."""


EarlierSubmaps: TypeAlias = Mapping[int, EarlierSubmap]
"""What earlier runs left, by number: another map frame each."""


class Unkept:
    """In place of a keeper, where no store is configured: the map lives in memory alone."""

    wants_all = False

    def start(self) -> int:
        """Number of the run's submap."""
        return 0

    def due(self, now_ns: int) -> bool:
        """Never hungry."""
        return False

    def offer(self, tiles: Iterable[Tile], anchor: Anchor | None, guarantee: Guarantee, released_ns: int) -> None:
        """Kept nowhere."""

    def is_saved(self, place: Place) -> bool:
        """Nothing is."""
        return False

    def left_memory(self, places: Iterable[Place]) -> None:
        """Nothing leaves for the store."""

    def returned(self) -> list[Tile]:
        """Nothing comes back."""
        return []

    def recall(self, place: Place) -> Tile | None:
        """Nothing is there."""
        return None

    def kept(self) -> Iterator[Tile]:
        """Nothing."""
        return iter(())

    def state(self) -> dict[str, Any]:
        """Nothing to tell."""
        return {}

    def close(self) -> None:
        """Nothing is open."""


class MapKeeper:
    """Owns the store from `start` to `close`. Any thread may call; only `recall` and `kept` wait for the disk."""

    def __init__(
        self,
        path: Path,
        interval_s: float,
        resolution_m: float,
        frame: str,
        health: Health,
        on_earlier: Callable[[EarlierSubmaps], None] = lambda earlier: None,
        earlier_submaps: int = 0,
    ) -> None:
        """`on_earlier` hears, once the store is open, of the newest `earlier_submaps` that earlier runs left in it."""
        self.wants_all = False
        """The store lost tiles that were saved: the whole map should be offered once more."""
        self._path = path
        self._interval_s = interval_s
        self._health = health
        self._on_earlier = on_earlier
        self._earlier_submaps = earlier_submaps
        self._wake = threading.Condition()
        # Between the threads, under the condition's lock:
        self._pending: dict[Place, Tile] = {}
        self._writing: dict[Place, Tile] = {}
        self._saved: set[Place] = set()
        self._away: set[Place] = set()
        """Left memory; what is mapped there meanwhile begins anew in memory. Until the pipeline has taken a tile back,
        it is the store that holds the whole of it."""
        self._touched: set[Place] = set()
        """Those of `_away` that were mapped again: to be read back."""
        self._returned: dict[Place, Tile] = {}
        """Those of `_touched` that are read, and wait for the pipeline."""
        self._words = Submap(0, resolution_m, frame)
        """Number in the store, anchor and guarantee of the run's submap."""
        self._words_changed = False
        self._told: tuple[Anchor | None, Guarantee] = None, INTACT
        """As the words have it."""
        self._offered_ns = 0
        self._number: int | None = None
        """Of the run's submap, as the pipeline and the wire have it."""
        self._stopping = False
        self._state: dict[str, Any] = {"path": str(path), "open": False, "saves": 0, "tiles_written": 0}
        self._released_ns: int | None = None
        self._opened = threading.Event()
        self._proposed = 0
        # The disk's, under its own lock:
        self._disk = threading.Lock()
        self._store: TileStore | None = None
        self._known: dict[Place, TileRow] = {}
        """What the store had when it was let go of."""
        self._thread = threading.Thread(target=self._run, name="map-keeper", daemon=True)

    # Called by the pipeline's thread, and by whoever owns the keeper

    def start(self) -> int:
        """Begin; the number of the run's submap, one above those in the store (0 where it doesn't open in time)."""
        self._thread.start()
        self._opened.wait(OPENING_S)
        with self._wake:
            self._number = self._proposed
            self._wake.notify_all()
            return self._number

    def due(self, now_ns: int) -> bool:
        """Has nothing been offered for an interval?"""
        return now_ns - self._offered_ns >= self._interval_s * 1e9

    def offer(self, tiles: Iterable[Tile], anchor: Anchor | None, guarantee: Guarantee, released_ns: int) -> None:
        """Hand over tiles that changed, each with all that memory holds of it. Never waits for the disk."""
        with self._wake:
            self._offered_ns = time.monotonic_ns()
            # Whatever is not saved has not left memory: the newer state of a tile contains the older one.
            self._pending.update(((tile.submap, tile.ix, tile.iy), tile) for tile in tiles)
            self._released_ns = released_ns
            if (anchor, guarantee) != self._told:
                self._told = anchor, guarantee
                place = "" if anchor is None else write_anchor(anchor).decode()
                words = replace(self._words, anchor=place, guarantee=guarantee_text(guarantee))
                self._words_changed = self._words_changed or words != self._words
                self._words = words

    def is_saved(self, place: Place) -> bool:
        """Is all of a tile on the disk, and none of it on its way back into memory?"""
        with self._wake:
            return place in self._saved and not any(
                place in moving for moving in (self._pending, self._writing, self._away)
            )

    def left_memory(self, places: Iterable[Place]) -> None:
        """These tiles, all saved, are in the store alone from now on."""
        with self._wake:
            self._away.update(places)

    def returned(self) -> list[Tile]:
        """What the store holds of tiles that had left memory and were touched again: to be joined into the map, by the
        thread that asks for `kept`: a tile is always in one of the two."""
        with self._wake:
            back, self._returned = self._returned, {}
            self._touched -= back.keys()
            self._away -= back.keys()
            return list(back.values())

    def recall(self, place: Place) -> Tile | None:
        """All that was ever offered or stored of a tile; None where the store can't give it. Reads the disk."""
        with self._wake:
            newest = self._pending.get(place) or self._writing.get(place)
        stored = None
        with self._disk, suppress(StoreError):
            if self._store is not None:
                stored = self._store.read((self._in_store(place[0]), *place[1:]))
        if stored is None:
            return newest
        stored = stored if stored.submap == place[0] else replace(stored, submap=place[0])
        return stored if newest is None else join(stored, newest)

    def kept(self) -> Iterator[Tile]:
        """Tiles of this run that are not, or not wholly, in memory now; any thread may take them from the disk."""
        with self._wake:
            away = sorted(self._away)
        return (tile for tile in map(self.recall, away) if tile is not None)

    def state(self) -> dict[str, Any]:
        """How keeping does, for health."""
        with self._wake:
            return {
                **self._state,
                "tiles": len(self._saved),
                "tiles_unsaved": len(self._pending.keys() | self._writing.keys()),
                "tiles_out_of_memory": len(self._away),
            }

    def close(self) -> None:
        """Save what is there, and let go of the file; a disk that hangs is not waited for long."""
        with self._wake:
            self._stopping = True
            self._wake.notify_all()
        if self._thread.is_alive():
            self._thread.join(LAST_SAVE_S)

    # The keeper's thread

    def _run(self) -> None:
        """Every interval: open the store if it isn't, save; what fails is told, and tried again."""
        stopping = False
        while not stopping:
            with self._wake:
                self._wake.wait_for(lambda: self._stopping, 0 if self._store is None else self._interval_s)
                stopping = self._stopping
            try:
                if self._store is None:
                    self._open()
                self._save()
                self._read_back()
            except Exception as error:
                # Whatever it is: mapping goes on, and the store is opened anew.
                self._failed(error if isinstance(error, StoreError) else StoreError(f"{self._path}: {error!r}"))
                with self._wake:
                    self._wake.wait_for(lambda: self._stopping, self._interval_s)
            else:
                self._health.trouble(STORE, None)
        self._let_go()

    def _open(self) -> None:
        """Open and check the store, and settle under which number this run's submap is kept."""
        with self._disk:
            store, findings = open_store(self._path, self._propose)
            with self._wake:
                # A store that opened late, or was damaged, may hold this run's number already, for another frame.
                self._wake.wait_for(lambda: self._number is not None or self._stopping)
                number, taken = self._number or 0, store.submaps.keys() | {place[0] for place in store.rows}
                first = self._state["saves"] == 0
                if first:
                    kept_as = number if number not in taken else max(taken) + 1
                    self._words = replace(self._words, number=kept_as)
                self._saved = {(number, *place[1:]) for place in store.rows if place[0] == self._words.number}
                lost = sum(store.rows.get(place) != row for place, row in self._known.items())
                self._tell(findings, lost)
            self._store = store
        if first:
            self._on_earlier(self._earlier(store, number))

    def _propose(self, number: int) -> None:
        """The store is there, not yet checked: a number above all that it knows."""
        self._proposed = number
        self._opened.set()

    def _tell(self, findings: Findings, lost: int) -> None:
        """What opening came to, into health; what this run had saved and is no longer there, is saved once more."""
        self._state |= {"open": True, "found": str(findings), "found_clean": findings.clean}
        if not findings.clean:
            self._health.trouble(STORED_MAP, f"{self._path}: was damaged: {findings}")
        self.wants_all = self.wants_all or lost > 0
        self._state["tiles_lost"] = self._state.get("tiles_lost", 0) + lost

    def _earlier(self, store: TileStore, number: int) -> EarlierSubmaps:
        """The newest submaps of earlier runs."""
        others = [n for n in store.submaps if n not in (self._words.number, number)]
        tiles: dict[int, list[DigestEntry]] = {
            n: [] for n in sorted(others)[max(0, len(others) - self._earlier_submaps) :]
        }
        for place, row in store.rows.items():
            if place[0] in tiles:
                tiles[place[0]].append(DigestEntry(*place, row.content_crc))
        return {
            n: EarlierSubmap(
                store.submaps[n].anchor.encode() or None, guarantee_of(store.submaps[n].guarantee), tuple(entries)
            )
            for n, entries in tiles.items()
        }

    def _save(self) -> None:
        """One transaction with all that changed."""
        if self._store is None or not self._path.exists():
            raise StoreError(f"{self._path}: it was removed while in use")
        with self._wake:
            if not self._pending and not self._words_changed:
                return
            self._writing, self._pending = self._pending, {}
            words, self._words_changed = self._words, False
            released_ns = self._released_ns
        number = words.number
        tiles = [t if t.submap == number else replace(t, submap=number) for t in self._writing.values()]
        try:
            with self._disk:
                # A run that maps nothing leaves no submap.
                some = bool(tiles) or number in self._store.submaps
                written = self._store.save(words, tiles, time.time_ns()) if some else 0
        except BaseException:
            with self._wake:
                self._pending = self._writing | self._pending
                self._writing, self._words_changed = {}, True
            raise
        with self._wake:
            self._saved.update(self._writing)
            self._touched |= self._writing.keys() & self._away
            self._writing = {}
            self._state["saves"] += 1
            self._state["tiles_written"] += written
            self._state |= {"saved_ns": time.monotonic_ns(), "saved_up_to_ns": released_ns}

    def _read_back(self) -> None:
        """Tiles that had left memory and were mapped again come back; one that can't be read is tried again."""
        with self._wake:
            wanted = sorted(self._touched - self._returned.keys())
        for place in wanted:
            if (tile := self.recall(place)) is not None:
                with self._wake:
                    self._returned[place] = tile

    def _failed(self, error: StoreError) -> None:
        """Tell; let go of a connection that is suspect."""
        self._health.trouble(STORE, str(error))
        self._opened.set()
        if error.reopen:
            self._let_go()

    def _let_go(self) -> None:
        with self._disk:
            if self._store is not None:
                self._store.close()
                self._known = self._store.rows
            self._store = None
        with self._wake:
            self._state["open"] = False

    def _in_store(self, submap: int) -> int:
        """Number in the store of a submap as the wire has it."""
        return self._words.number if submap == self._number else submap
