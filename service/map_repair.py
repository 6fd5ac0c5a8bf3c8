"""The repair of a copy: after each digest, what it says is missing is asked for, a few tiles at a time."""

import threading
from collections import Counter
from collections.abc import Callable, Sequence

import zenoh
from zenoh.handlers import RingChannel

from mapper.tile import Tile
from mapper.tile_codec import TileFormatError, decode
from service.copied_map import CopiedMap
from service.messages import MalformedMessage, TileId, TileNote, read
from service.topics import ANCHOR, ANCHOR_OF, DIGEST, HEALTH, INFO, REPAIR_PRIORITY, parse_tile_key, tile_key, topic_key

WINDOW = 16
"""Tiles asked for at a time: repair never floods the link."""
GET_TIMEOUT_S = 5.0
LISTING = (INFO, ANCHOR, ANCHOR_OF, HEALTH, DIGEST)
"""What a late joiner asks for, in this order."""


class MapRepair:
    """A thread that asks the robot for what the copy lacks."""

    def __init__(
        self,
        copy: CopiedMap,
        changed: threading.Condition,
        robot: Callable[[], str | None],
        take: Callable[[zenoh.Sample], None],
        counts: Counter[str],
    ) -> None:
        """`changed` guards the copy, and tells of its changes; `take` is for answers that are no tiles."""
        self._copy = copy
        self._changed = changed
        self._robot = robot
        self._take = take
        self._counts = counts
        # Between the threads, under the condition's lock:
        self._session: zenoh.Session | None = None
        self._cancellation = zenoh.CancellationToken()
        self._repairing = False
        self._stopping = False
        self._tried_digest = 0
        self._thread = threading.Thread(target=self._repair, name="remote-map-repair", daemon=True)

    def start(self) -> None:
        """Begin; nothing is asked before there is a session."""
        self._thread.start()

    def stop(self) -> None:
        """Ask no more."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()

    def join(self) -> None:
        """Return when the thread has ended."""
        if self._thread.is_alive():
            self._thread.join()

    def attend(self, session: zenoh.Session) -> None:
        """Ask in this session from now on."""
        with self._changed:
            self._session = session
            self._cancellation = zenoh.CancellationToken()
            self._changed.notify_all()

    def leave(self) -> None:
        """Cancel what is asked, and return once the session is in nobody's hands."""
        self._cancellation.cancel()  # type: ignore[no-untyped-call]  # the stub lacks a return type
        with self._changed:
            self._session = None
            self._changed.wait_for(lambda: not self._repairing)

    def _repair(self) -> None:
        """After each digest, bring what it said is stale."""
        while (work := self._next()) is not None:
            session, robot, listing, stale = work
            try:
                if listing:
                    self._bring_listing(session, robot)
                for start in range(0, len(stale), WINDOW):
                    self._bring_tiles(session, robot, stale[start : start + WINDOW])
            except zenoh.ZError:
                # The link is gone: the next digest after it is back starts over.
                with self._changed:
                    self._counts["repairs_failed"] += 1

    def _next(self) -> tuple[zenoh.Session, str, bool, list[TileId]] | None:
        """Wait until something is stale that was not tried since the last digest; None at the end."""
        copy = self._copy
        with self._changed:
            self._repairing = False
            self._changed.notify_all()
            while not self._stopping:
                session, robot = self._session, self._robot()
                untried = copy.digest_count != self._tried_digest
                if session is not None and robot is not None and (copy.listing_wanted or (copy.stale and untried)):
                    listing, copy.listing_wanted = copy.listing_wanted, False
                    self._tried_digest = copy.digest_count
                    self._repairing = True
                    return session, robot, listing, list(copy.stale)
                self._changed.wait()
        return None

    def _bring_listing(self, session: zenoh.Session, robot: str) -> None:
        """Ask for what a late joiner missed: info, anchor, health, and last a digest with all entries."""
        asked = [(topic, self._ask(session, topic_key(robot, topic))) for topic in LISTING]
        for topic, answers in asked:
            for sample in _good(answers):
                # A robot that knows no place yet has no anchor to tell; whoever answers at all has been asked for it.
                self._copy.introduced = self._copy.introduced or topic is DIGEST
                self._take(sample)

    def _bring_tiles(self, session: zenoh.Session, robot: str, places: Sequence[TileId]) -> None:
        """Ask for some whole tiles, all at once, then take the answers."""
        asked = [(place, self._ask(session, tile_key(robot, *place, "full"))) for place in places]
        for place, answers in asked:
            for sample in _good(answers):
                self._take_tile(place, sample)

    def _take_tile(self, place: TileId, sample: zenoh.Sample) -> None:
        try:
            tile, note = read_tile(sample)
            if TileId(tile.submap, tile.ix, tile.iy) != place:
                raise MalformedMessage("an answer to another question")
            with self._changed:
                self._copy.take_answer(tile, note)
                self._changed.notify_all()
        except (MalformedMessage, TileFormatError):
            with self._changed:
                self._counts["malformed"] += 1

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


def read_tile(sample: zenoh.Sample) -> tuple[Tile, TileNote]:
    """A tile and its note. Raises MalformedMessage or TileFormatError where key, payload and note don't fit."""
    place = parse_tile_key(str(sample.key_expr))
    if place is None or sample.attachment is None:
        raise MalformedMessage("no tile's key, or no note on it")
    note = read(TileNote, bytes(sample.attachment))
    tile = decode(bytes(sample.payload), place.submap).tile
    if (tile.ix, tile.iy) != (place.ix, place.iy):
        raise MalformedMessage("the payload is another tile than the key says")
    return tile, note


def _good(replies: "zenoh.Handler[zenoh.Reply]") -> list[zenoh.Sample]:
    """All good answers to a question; returns when the answer is complete or time is up."""
    return [reply.ok for reply in replies if reply.ok is not None]
