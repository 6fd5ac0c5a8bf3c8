"""A remote copy of a robot's map: joined from tiles as they come, repaired by what the digest tells.

Whatever is lost, late or doubled on the way, the copy is a past state of the robot's map or a join of some, and equals
the present one, bit for bit in the published quantisation, once the link has been quiet for a digest.
"""

import atexit
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from zenoh.handlers import RingChannel

from drivers.errors import LinkError
from estimator.bounded_pose import Anchor, BoundedPose, Guarantee
from mapper.tile import Tile, compile_tiles, content_crc, join
from mapper.tile_codec import TileFormatError, decode
from service.map_file import save_tiles
from service.messages import (
    DigestAssembly,
    DigestPart,
    MalformedMessage,
    TileId,
    TileNote,
    digest_root,
    guarantee_from,
    read,
    read_anchor,
    read_plain,
    read_pose,
)
from service.messages import DigestEntry as Entry
from service.session import ended_callback, open_session, session_config
from service.topics import (
    ANCHOR,
    ANCHOR_OF,
    DIGEST,
    HEALTH,
    INFO,
    POSE,
    REPAIR_PRIORITY,
    ROOT,
    parse_tile_key,
    split_key,
    submap_of_anchor,
    tile_key,
    topic_key,
)

RING = 4096
"""Messages that may wait for this side; older ones give way, and the digest brings them back."""
MAX_TILES = 65_536
"""Memory cap: 2 GiB. Tiles beyond it are counted, not kept."""
WINDOW = 16
"""Tiles asked for at a time: repair never floods the link."""
GET_TIMEOUT_S = 5.0
FIRST_RETRY_S, LAST_RETRY_S = 0.2, 1.0
MAX_LATENCIES = 100_000
LISTING = (INFO, ANCHOR, ANCHOR_OF, HEALTH, DIGEST)
"""What a late joiner asks for, in this order."""


class RemoteMap:
    """Follows one robot from anywhere its address reaches. A context manager: two threads live inside it."""

    def __init__(
        self,
        locators: str | Sequence[str],
        robot: str | None = None,
        *,
        ring: int = RING,
        max_tiles: int = MAX_TILES,
        multicast: bool = False,
    ) -> None:
        """Follow `robot`, or the first that is found at `locators` (as tcp/192.168.1.5:7447)."""
        self.robot = robot
        """Its name, once known."""
        self.counts: Counter[str] = Counter()
        """messages, repaired, malformed, stale, other_robot, epochs, too_many_tiles..."""
        self.failure: str | None = None
        """Why there is no session at present."""
        self.alive = False
        """Does the robot's liveliness token stand?"""
        self.pose: BoundedPose | None = None
        self.anchor: Anchor | None = None
        """Of the submap that is being mapped."""
        self.anchors: dict[int, Anchor] = {}
        """Of each submap, also of those that earlier runs left, as last asked for."""
        self.health: Mapping[str, Any] = {}
        self.info: Mapping[str, Any] = {}
        self._locators = [locators] if isinstance(locators, str) else list(locators)
        self._ring = ring
        self._max_tiles = max_tiles
        self._multicast = multicast
        self._changed = threading.Condition()
        # Between the threads, under the condition's lock:
        self._session: zenoh.Session | None = None
        self._subscriber: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]] | None = None
        self._cancellation = zenoh.CancellationToken()
        self._repairing = False
        self._stopping = False
        self._epoch: str | None = None
        self._tiles: dict[TileId, Tile] = {}
        self._crcs: dict[TileId, int] = {}
        self._guarantee: Guarantee | None = None
        self._beams_until_ns: dict[TileId, int | None] = {}
        self._stale: dict[TileId, int] = {}
        """Tiles that differed from the digest when it came, with the CRC that it listed."""
        self._listing_wanted = True
        """The robot's root differs from ours, and we have no listing to tell where."""
        self._root: tuple[int, int] | None = None
        """(tiles, root) of the newest digest."""
        self._compared = False
        """Has a listing of this epoch been compared with the copy?"""
        self._introduced = False
        """Were info, anchor and health of this epoch asked for and answered?"""
        self._in_sync = False
        self._final = False
        self._digest_count = self._repaired_digest = 0
        self._assembly = DigestAssembly()
        self._latencies_ns: deque[int] = deque(maxlen=MAX_LATENCIES)
        compile_tiles()
        self._receiver = threading.Thread(target=self._receive, name="remote-map", daemon=True)
        self._repairer = threading.Thread(target=self._repair, name="remote-map-repair", daemon=True)

    # For the one who watches

    def __enter__(self) -> "RemoteMap":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Begin to connect, and keep trying. Raises LinkError where a locator isn't one."""
        session_config("client", connect=self._locators)
        # A thread that is inside Zenoh when the interpreter ends would abort the process.
        atexit.register(self.close)
        self._receiver.start()
        self._repairer.start()

    def close(self) -> None:
        """End both threads and the session; the copy stays readable."""
        atexit.unregister(self.close)
        with self._changed:
            self._stopping = True
            subscriber = self._subscriber
            self._changed.notify_all()
        if subscriber is not None:
            subscriber.undeclare()  # type: ignore[no-untyped-call]  # the stub lacks a return type
        for thread in (self._receiver, self._repairer):
            if thread.is_alive():
                thread.join()

    @property
    def tiles(self) -> dict[TileId, Tile]:
        """The copy as it is now."""
        with self._changed:
            return dict(self._tiles)

    @property
    def bounds(self) -> Guarantee | None:
        """Do the robot's bounds hold? As its newest tile or pose says; None before the first."""
        with self._changed:
            return self._guarantee

    @property
    def guarantee(self) -> str:
        """`bounds` in words."""
        bounds = self.bounds
        if bounds is None:
            return "unknown"
        return "intact" if bounds.intact else f"contradicted by {bounds.sensor or 'a sensor'}"

    def promised(self, place: TileId) -> bool:
        """Is all that the copy holds of this tile from before the time since when the bounds are in doubt?"""
        with self._changed:
            bounds, until_ns = self._guarantee, self._beams_until_ns.get(place)
        if bounds is None or bounds.void_since_ns is None:
            return bounds is not None
        return until_ns is not None and until_ns < bounds.void_since_ns

    @property
    def in_sync(self) -> bool:
        """Did the copy equal what the newest digest said of the robot's map?"""
        with self._changed:
            return self._in_sync

    def wait_in_sync(self, timeout_s: float, final: bool = False) -> bool:
        """Wait until a digest that comes from now on finds the copy equal to the robot's map (or repair makes it so).

        `final`: until it equals a digest, whenever it came, of which the robot said that this is all.
        """
        with self._changed:
            before = self._digest_count
            return self._changed.wait_for(
                lambda: self._in_sync and (self._final if final else self._digest_count > before), timeout_s
            )

    def wait_complete(self, timeout_s: float) -> bool:
        """Wait until the copy holds every tile as a digest listed it; a robot that maps on is ahead again at once."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._in_sync or (self._compared and not self._stale),
                timeout_s,
            )

    def wait_for_digest(self, timeout_s: float) -> bool:
        """Wait until one more digest has been compared with the copy."""
        with self._changed:
            before = self._digest_count
            return self._changed.wait_for(lambda: self._digest_count > before, timeout_s)

    def wait_alive(self, timeout_s: float, alive: bool = True) -> bool:
        """Wait until the robot is there (or gone)."""
        with self._changed:
            return self._changed.wait_for(lambda: self.alive is alive, timeout_s)

    def latencies(self) -> list[int]:
        """Nanoseconds from the update's last sample to each tile's arrival; only meaningful on the robot's own host."""
        with self._changed:
            return list(self._latencies_ns)

    def latencies_ms(self) -> dict[str, float | None]:
        """Median and 99th percentile of `latencies`, in milliseconds."""
        latencies = self.latencies()
        if not latencies:
            return {"p50": None, "p99": None}
        p50, p99 = np.percentile(latencies, (50, 99)) * 1e-6
        return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}

    def stats(self) -> dict[str, Any]:
        """What was received, for a report."""
        with self._changed:
            counts = {"messages": 0, "repaired": 0, "malformed": 0} | dict(self.counts)
            return {"tiles": len(self._tiles), **counts}

    def save(self, path: Path, submap: int | None = None) -> None:
        """Write the copy as `.npz`: one submap, the newest unless another is asked for, with its own anchor."""
        tiles = list(self.tiles.values())
        numbers = {tile.submap for tile in tiles}
        chosen = max(numbers, default=0) if submap is None else submap
        tiles = [tile for tile in tiles if tile.submap == chosen]
        resolution_m = tiles[0].resolution_m if tiles else self._announced_resolution_m()
        mapped_now = self.info.get("submap", max(numbers, default=0))
        anchor = self.anchor if chosen == mapped_now else self.anchors.get(chosen)
        bounds = self.bounds if chosen == mapped_now else None
        save_tiles(tiles, resolution_m, anchor, bounds, path)

    def _announced_resolution_m(self) -> float:
        """Of a map without tiles."""
        value = self.info.get("resolution_m")
        return float(value) if isinstance(value, int | float) and isfinite(value) and value > 0 else 1.0

    # The receiving thread

    def _receive(self) -> None:
        """Connect; take each message from the ring; when the session ends by itself, connect anew."""
        pause_s = FIRST_RETRY_S
        while not self._stopping:
            try:
                with open_session("client", connect=self._locators, multicast=self._multicast) as session:
                    pause_s = FIRST_RETRY_S
                    self._follow(session)
                failure = None
            except (LinkError, zenoh.ZError) as error:
                failure = str(error)
            with self._changed:
                self.failure = failure
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._stopping, pause_s)
            pause_s = min(2 * pause_s, LAST_RETRY_S)

    def _follow(self, session: zenoh.Session) -> None:
        """Take messages until the session is closed."""
        channel: RingChannel[zenoh.Sample] = RingChannel(self._ring)
        subscriber = session.declare_subscriber(f"{ROOT}/{self.robot or '*'}/**", channel)
        robots = f"{ROOT}/{self.robot or '*'}"
        with (
            ended_callback(self._liveliness_changed) as changed,
            session.liveliness().declare_subscriber(robots, changed, history=True),
        ):
            with self._changed:
                if self._stopping:
                    return
                self._session, self._subscriber = session, subscriber
                self._cancellation = zenoh.CancellationToken()
                self.failure = None
                self._changed.notify_all()
            try:
                for sample in subscriber:
                    self._take(sample, time.monotonic_ns())
            finally:
                # The session must not be closed under the repairer's hands.
                self._cancellation.cancel()  # type: ignore[no-untyped-call]  # the stub lacks a return type
                with self._changed:
                    self._session = self._subscriber = None
                    self._changed.wait_for(lambda: not self._repairing)

    def _liveliness_changed(self, sample: zenoh.Sample) -> None:
        """A robot came or went (on a thread of Zenoh's); whoever comes is asked what it has."""
        found = split_key(str(sample.key_expr))
        with self._changed:
            if found is None or not self._is_ours(found[0]):
                return
            self.alive = sample.kind == zenoh.SampleKind.PUT
            self._listing_wanted = self._listing_wanted or self.alive
            self._in_sync = self._in_sync and self.alive
            self._changed.notify_all()

    def _is_ours(self, robot: str) -> bool:
        """Is it the robot we follow? The first one that is found is followed, if none was named."""
        if self.robot is None and robot:
            self.robot = robot
        if robot == self.robot:
            return True
        self.counts["other_robot"] += 1
        return False

    def _take(self, sample: zenoh.Sample, now_ns: int) -> None:
        """Take one message, whatever it is; what doesn't fit is counted, never raised."""
        key = str(sample.key_expr)
        found = split_key(key)
        if sample.kind != zenoh.SampleKind.PUT or found is None:
            return
        with self._changed:
            if not self._is_ours(found[0]):
                return
            self.counts["messages"] += 1
        try:
            if found[1].startswith("map/"):
                self._take_tile(key, sample, now_ns)
            else:
                self._take_topic(found[1], bytes(sample.payload))
        except (MalformedMessage, TileFormatError):
            with self._changed:
                self.counts["malformed"] += 1
        with self._changed:
            self._changed.notify_all()

    def _take_topic(self, name: str, payload: bytes) -> None:
        """Pose, anchor, health, info or digest."""
        if name == POSE.name:
            self.pose = read_pose(payload)
            with self._changed:
                self._guarantee = self.pose.guarantee
        elif name == ANCHOR.name:
            self.anchor = read_anchor(payload)
        elif (submap := submap_of_anchor(name)) is not None:
            self.anchors[submap] = read_anchor(payload)
        elif name == HEALTH.name:
            self.health = read_plain(payload)
        elif name == INFO.name:
            self.info = read_plain(payload)
        elif name == DIGEST.name:
            self._take_digest(read(DigestPart, payload))
        else:
            self.counts["unknown_topic"] += 1

    def _take_tile(self, key: str, sample: zenoh.Sample, now_ns: int) -> None:
        """Join a tile or a delta."""
        tile, note = self._read_tile(key, sample)
        with self._changed:
            self._enter_epoch(note.epoch)
            self._take_guarantee(tile, note)
            if note.released_ns is not None:
                self._latencies_ns.append(now_ns - note.released_ns)
            self._join(tile)

    def _read_tile(self, key: str, sample: zenoh.Sample) -> tuple[Tile, TileNote]:
        """A tile and its note, if key, payload and attachment fit together."""
        place = parse_tile_key(key)
        if place is None or sample.attachment is None:
            raise MalformedMessage("no tile's key, or no note on it")
        note = read(TileNote, bytes(sample.attachment))
        tile = decode(bytes(sample.payload), place.submap).tile
        if (tile.ix, tile.iy) != (place.ix, place.iy):
            raise MalformedMessage("the payload is another tile than the key says")
        return tile, note

    def _join(self, tile: Tile) -> None:
        """Hull of what we have and what came."""
        place = TileId(tile.submap, tile.ix, tile.iy)
        old = self._tiles.get(place)
        if old is None and len(self._tiles) >= self._max_tiles:
            self.counts["too_many_tiles"] += 1
            return
        if old is not None and old.resolution_m != tile.resolution_m:
            raise MalformedMessage("a tile of another resolution")
        self._set(place, tile if old is None else join(old, tile))

    def _take_guarantee(self, tile: Tile, note: TileNote) -> None:
        """What a tile of the newest submap says of the bounds; earlier runs are over, and had their own."""
        place, until_ns = TileId(tile.submap, tile.ix, tile.iy), note.beams_until_ns
        known = self._beams_until_ns.get(place, until_ns)
        self._beams_until_ns[place] = None if known is None or until_ns is None else max(known, until_ns)
        if tile.submap >= max((place.submap for place in self._tiles), default=0):
            self._guarantee = guarantee_from(note.guarantee)

    def _set(self, place: TileId, tile: Tile) -> None:
        self._tiles[place] = tile
        self._crcs.pop(place, None)

    def _enter_epoch(self, epoch: str) -> None:
        """Another run of the publisher is another map, in another frame perhaps: begin anew."""
        if epoch == self._epoch:
            return
        first, self._epoch = self._epoch is None, epoch
        self.counts["epochs"] += 1
        self._tiles.clear()
        self._crcs.clear()
        self._beams_until_ns.clear()
        self.anchors.clear()
        self._stale.clear()
        self._root = None
        self._introduced = self._introduced and first
        self._compared = self._in_sync = self._final = False
        self._listing_wanted = True

    # Digest and repair

    def _take_digest(self, part: DigestPart) -> None:
        """Compare the copy with what the robot says it has."""
        with self._changed:
            self._enter_epoch(part.epoch)
            self._final = part.final
            self._root = (part.tiles, part.root)
            equal = self._equals_digest()
            self._in_sync = equal and self._introduced
            listed = self._assembly.add(part) if part.parts else None
            if equal:
                self._stale.clear()
                self._listing_wanted = False
            elif listed is not None:
                self._compare(listed)
            elif part.parts == 0:
                self._listing_wanted = True
            self._listing_wanted = self._listing_wanted or not self._introduced
            if equal or listed is not None or part.parts == 0:
                self._digest_count += 1
            self._changed.notify_all()

    def _equals_digest(self) -> bool:
        """Is the copy what the newest digest says?"""
        return self._root is not None and self._root == (len(self._tiles), digest_root(self._entries()))

    def _compare(self, listed: Mapping[TileId, int]) -> None:
        """Note what differs from the listing, and let go of what the robot doesn't have."""
        self._listing_wanted, self._compared = False, True
        own = {entry.tile: entry.crc for entry in self._entries()}
        for place in own.keys() - listed.keys():
            del self._tiles[place]
            self._beams_until_ns.pop(place, None)
            self._crcs.pop(place, None)
            self.counts["unlisted"] += 1
        self._stale = {place: crc for place, crc in listed.items() if own.get(place) != crc}
        self.counts["stale"] += len(self._stale)

    def _entries(self) -> list[Entry]:
        """The copy as a digest would list it."""
        for place, tile in self._tiles.items():
            if place not in self._crcs:
                self._crcs[place] = content_crc(tile)
        return [Entry(*place, crc) for place, crc in self._crcs.items()]

    def _repair(self) -> None:
        """The repairing thread: after each digest, bring what it said is stale, a few tiles at a time."""
        while (work := self._next_repair()) is not None:
            session, robot, listing, stale = work
            try:
                if listing:
                    self._bring_listing(session, robot)
                for start in range(0, len(stale), WINDOW):
                    self._bring_tiles(session, robot, stale[start : start + WINDOW])
            except zenoh.ZError:
                # The link is gone: the next digest after it is back starts over.
                with self._changed:
                    self.counts["repairs_failed"] += 1

    def _next_repair(self) -> tuple[zenoh.Session, str, bool, list[TileId]] | None:
        """Wait until something is stale that was not tried since the last digest; None at the end."""
        with self._changed:
            self._repairing = False
            self._changed.notify_all()
            while not self._stopping:
                session, robot = self._session, self.robot
                untried = self._digest_count != self._repaired_digest
                if session is not None and robot is not None and (self._listing_wanted or (self._stale and untried)):
                    listing, self._listing_wanted = self._listing_wanted, False
                    self._repaired_digest = self._digest_count
                    self._repairing = True
                    return session, robot, listing, list(self._stale)
                self._changed.wait()
        return None

    def _bring_listing(self, session: zenoh.Session, robot: str) -> None:
        """Ask for what a late joiner missed: info, anchor, health, and last a digest with all entries."""
        asked = [(topic, self._ask(session, topic_key(robot, topic))) for topic in LISTING]
        for topic, answers in asked:
            for sample in self._answers(answers):
                # A robot that knows no place yet has no anchor to tell; whoever answers at all has been asked for it.
                self._introduced = self._introduced or topic is DIGEST
                self._take(sample, time.monotonic_ns())

    def _bring_tiles(self, session: zenoh.Session, robot: str, places: Sequence[TileId]) -> None:
        """Ask for some whole tiles, all at once, then take the answers."""
        asked = [(place, self._ask(session, tile_key(robot, *place, "full"))) for place in places]
        for place, answers in asked:
            for sample in self._answers(answers):
                self._take_answer(place, sample)

    def _take_answer(self, place: TileId, sample: zenoh.Sample) -> None:
        """Join a whole tile; where ours still differs although the robot's is as listed, ours is wrong: replace it."""
        try:
            tile, note = self._read_tile(str(sample.key_expr), sample)
            if TileId(tile.submap, tile.ix, tile.iy) != place:
                raise MalformedMessage("an answer to another question")
            crc = content_crc(tile)
            with self._changed:
                if note.epoch != self._epoch:
                    return
                self._take_guarantee(tile, note)
                listed = self._stale.pop(place, None)
                self.counts["repaired"] += 1
                old = self._tiles.get(place)
                if (
                    crc == listed
                    and old is not None
                    and (old.resolution_m != tile.resolution_m or content_crc(join(old, tile)) != crc)
                ):
                    self.counts["replaced"] += 1
                    self._set(place, tile)
                else:
                    self._join(tile)
                if not self._stale:
                    self._in_sync = self._introduced and self._equals_digest()
                self._changed.notify_all()
        except (MalformedMessage, TileFormatError):
            with self._changed:
                self.counts["malformed"] += 1

    def _ask(self, session: zenoh.Session, key: str) -> "zenoh.Handler[zenoh.Reply]":
        """A question that never presses on the link."""
        channel: RingChannel[zenoh.Reply] = RingChannel(128)
        return session.get(
            key,
            channel,
            timeout=GET_TIMEOUT_S,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=REPAIR_PRIORITY,
            cancellation_token=self._cancellation,
        )

    @staticmethod
    def _answers(replies: "zenoh.Handler[zenoh.Reply]") -> list[zenoh.Sample]:
        """All good answers to a question; returns when the answer is complete or time is up."""
        return [reply.ok for reply in replies if reply.ok is not None]
