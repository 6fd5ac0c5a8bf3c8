"""What leaves the robot: one thread that owns the Zenoh session and sends what changed.

The pipeline hands over through a mailbox with one slot, fills it only when it is empty, and never waits: changes
coalesce by themselves. Every message may be dropped by the network; the digest tells a subscriber what it missed, and
a get on the tile's key brings it. A session that fails is opened again; mapping goes on meanwhile.
"""

import atexit
import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from math import inf
from typing import Any

import zenoh

from drivers.errors import LinkError
from estimator.bounded_pose import INTACT, Anchor, BoundedPose, Guarantee
from mapper.tile import Tile
from mapper.tile_codec import compile_codec, encode
from service.messages import (
    DigestPart,
    TileId,
    TileNote,
    digest_parts,
    digest_root,
    guarantee_message,
    write,
    write_anchor,
    write_note,
    write_plain,
    write_pose,
)
from service.publish_config import PublishConfig
from service.published_map import EarlierSubmap, PublishedMap, Recall, nothing_kept
from service.session import AddressAway, ended_callback, open_session
from service.session_ahead import SessionAhead
from service.token_bucket import TokenBucket
from service.topics import (
    ANCHOR,
    ANCHOR_OF,
    DIGEST,
    HEALTH,
    INFO,
    POSE,
    TILE,
    Topic,
    anchor_key,
    parse_tile_key,
    robot_key,
    tile_key,
    topic_key,
)

MAP_FRAME = "map"
FIRST_RETRY_S, LAST_RETRY_S = 0.2, 5.0
"""Back-off between attempts to open the session again."""
MAX_QUERIES = 256
"""Questions that may wait for their answers; further ones go unanswered, and are counted."""
TILES_AT_A_TIME = 8
"""So many are sent between two looks at what else is due."""
START_TIMEOUT_S = 15.0


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """What the pipeline hands over."""

    tiles: tuple[Tile, ...]
    """Whole tiles that changed since the last update."""
    pose: BoundedPose | None
    anchor: Anchor | None
    health: Mapping[str, Any]
    guarantee: Guarantee
    released_ns: int
    """Host's monotonic clock when the last sample in it had been read."""
    forgotten: tuple[TileId, ...] = ()
    """Tiles that the map has let go of since the last update: they are listed no more."""
    beams_until_ns: int | None = None
    """No beam in the tiles is newer."""


@dataclass(slots=True)
class _Answer:
    """A question, and the keys still to be sent for it."""

    query: zenoh.Query
    tiles: Iterator[TileId]
    topics: Iterator[Topic]
    anchors: Iterator[int]
    """Submaps whose anchors are asked for."""


class Publisher:
    """Owns the session from `start` to `close`; only its own thread touches it."""

    takes_updates = True

    def __init__(
        self,
        config: PublishConfig,
        robot: str,
        info: Mapping[str, Any] | None = None,
        recall: Recall = nothing_kept,
        tiles_in_memory: int | None = None,
        ahead: SessionAhead | None = None,
    ) -> None:
        """`info` is added to what `.../info` says; beyond `tiles_in_memory`, published tiles are recalled.

        `ahead`: the first session, where it is being opened already.
        """
        self.counts: Counter[str] = Counter()
        """Messages and bytes sent, deltas and full tiles, questions answered, sessions failed."""
        self.epoch = secrets.token_hex(8)
        """Names this run: subscribers begin anew when it changes."""
        self.failure: str | None = None
        """Why there is no session at present."""
        self.submap = 0
        """The one that is being mapped; set it before `start`."""
        self._config = config
        self._ahead = ahead
        self._robot = robot
        self._info = {"robot": robot, "epoch": self.epoch, "frame": MAP_FRAME, "format": "docs/tile-format.md"}
        self._info |= {} if info is None else dict(info)
        self._wake = threading.Condition()
        # Between the threads, under the condition's lock:
        self._slot: MapUpdate | None = None
        self._questions: deque[zenoh.Query] = deque()
        self._flush_wanted = False
        self._flushed = False
        self._stopping = False
        self._started = threading.Event()
        self._refused: LinkError | None = None
        self._earlier_offered: Mapping[int, EarlierSubmap] = {}
        # The publisher thread's own:
        self._map = PublishedMap(recall, tiles_in_memory)
        self._earlier: Mapping[int, EarlierSubmap] = {}
        self._bucket = TokenBucket(config.max_bytes_per_s)
        self._tiles: deque[Tile] = deque()
        self._answers: deque[_Answer] = deque()
        self._update: MapUpdate | None = None
        self._unsent_pose: BoundedPose | None = None
        self._guarantee, self._guarantee_message = INTACT, guarantee_message(INTACT)
        self._guarantee_json = write(self._guarantee_message)
        self._beams_until_ns: dict[TileId, int] = {}
        """Of the tiles that this run has sent."""
        self._newest_anchor: Anchor | None = None
        """Not written yet: that is done when one could be sent."""
        self._anchor: bytes | None = None
        self._unsent_anchor = False
        self._health: Mapping[str, Any] | None = None
        self._pose_due_s = self._health_due_s = self._digest_due_s = -inf
        self._sequence = 0
        self._final = False
        """Is everything that was offered, all of it, sent? From a flush until the next offer."""
        self._listed_root: int | None = None
        compile_codec()
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)

    # Called by the pipeline and by whoever owns the publisher

    def start(self) -> None:
        """Open the session. Raises LinkError where its address is wrong or in use.

        An address that this host merely doesn't have yet (the radio is still coming up) is waited for in background.
        """
        # A thread that is inside Zenoh when the interpreter ends would abort the process.
        atexit.register(self.close)
        self._thread.start()
        self._started.wait(START_TIMEOUT_S)
        if self._refused is not None:
            self._thread.join()
            raise self._refused

    @property
    def ready(self) -> bool:
        """Is the mailbox empty?"""
        return self._slot is None

    def offer(self, update: MapUpdate) -> bool:
        """Put an update into the mailbox; False (and counted) where the last one is still in it. Never waits."""
        with self._wake:
            if self._slot is not None:
                self.counts["offers_refused"] += 1
                return False
            self._slot = update
            self._flushed = False
            self._wake.notify_all()
        return True

    def offer_earlier(self, earlier: Mapping[int, EarlierSubmap]) -> None:
        """Publish what earlier runs left, too: by number of the submap. Their tiles must be there to be recalled."""
        with self._wake:
            self._earlier_offered = dict(earlier)
            self._wake.notify_all()

    def wait_until_ready(self, timeout_s: float) -> bool:
        """Wait until the mailbox is empty; False after the timeout."""
        with self._wake:
            return self._wake.wait_for(lambda: self._slot is None, timeout_s)

    def flush(self, timeout_s: float) -> bool:
        """An orderly end: send everything that was offered, then a final digest; False after the timeout."""
        with self._wake:
            self._flush_wanted, self._flushed = True, False
            self._wake.notify_all()
            return self._wake.wait_for(lambda: self._flushed, timeout_s)

    def close(self) -> None:
        """End the thread and its session."""
        atexit.unregister(self.close)
        with self._wake:
            self._stopping = True
            self._wake.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    def state(self) -> dict[str, Any]:
        """How publishing does, for health."""
        return {
            "open": self._started.is_set() and self.failure is None,
            "failure": self.failure,
            "tiles_not_recalled": self._map.not_recalled,
            **self.counts,
        }

    # The publisher thread

    def _run(self) -> None:
        """Open a session and serve; when it fails, wait a little longer each time and open it again."""
        pause_s = FIRST_RETRY_S
        while not self._stopping:
            try:
                with self._session() as session:
                    pause_s = FIRST_RETRY_S
                    self._serve(session)
            except LinkError as error:
                if not self._started.is_set() and not isinstance(error, AddressAway):
                    self._refused = error
                    self._started.set()
                    return
                self._session_failed(str(error))
            except zenoh.ZError as error:
                self._session_failed(str(error))
            self._started.set()
            with self._wake:
                self._wake.wait_for(lambda: self._stopping, pause_s)
            pause_s = min(2 * pause_s, LAST_RETRY_S)

    def _session(self) -> AbstractContextManager[zenoh.Session]:
        """A new session, or the one that was opened ahead."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None:
            return ahead.session()
        return open_session("peer", self._config.listen, self._config.connect, self._config.multicast)

    def _session_failed(self, failure: str) -> None:
        self.failure = failure
        self.counts["session_failures"] += 1
        self._answers.clear()
        with self._wake:
            self._questions.clear()

    def _serve(self, session: zenoh.Session) -> None:
        """Send whatever is due, sleep until something is; few messages at a time, so that nothing waits long."""
        self._listed_root = None
        with (
            ended_callback(self._ask) as ask,
            session.declare_queryable(f"{robot_key(self._robot)}/**", ask),
            session.liveliness().declare_token(robot_key(self._robot)),
        ):
            self.failure = None
            self._started.set()
            while self._wait_for_work():
                now_s = time.monotonic()
                self._send_periodic(session, now_s)
                if self._bucket.delay_s(now_s) > 0:
                    continue
                for _ in range(min(len(self._tiles), TILES_AT_A_TIME)):
                    self._send_tile(session, self._tiles.popleft())
                    if self._bucket.delay_s(now_s) > 0:
                        break
                if not self._tiles:
                    self._update = None
                if self._answers:
                    self._answer(self._answers[0])

    def _ask(self, query: zenoh.Query) -> None:
        """A question has come (on a thread of Zenoh's): queue it for the publisher thread."""
        with self._wake:
            if len(self._questions) >= MAX_QUERIES:
                self.counts["questions_dropped"] += 1
                query.drop()  # type: ignore[no-untyped-call]  # the stub lacks a return type
                return
            self._questions.append(query)
            self._wake.notify_all()

    def _wait_for_work(self) -> bool:
        """Sleep until something is due; False when the publisher is to end."""
        with self._wake:
            while not self._stopping:
                now_s = time.monotonic()
                self._take_questions()
                self._take_earlier()
                if self._update is None and self._slot is not None:
                    self._take_update(self._slot)
                    self._slot = None
                    self._wake.notify_all()
                delay_s = self._delay_s(now_s)
                if delay_s <= 0:
                    return True
                self._wake.wait(delay_s)
        return False

    def _delay_s(self, now_s: float) -> float:
        """How long nothing is due."""
        if self._flush_wanted and self._update is None and self._slot is None:
            return 0.0
        due_s = self._digest_due_s
        if self._unsent_pose is not None:
            due_s = min(due_s, self._pose_due_s)
        if self._health is not None:
            due_s = min(due_s, self._health_due_s)
        delay_s = due_s - now_s
        if self._update is not None or self._answers:
            delay_s = min(delay_s, self._bucket.delay_s(now_s))
        return delay_s

    def _take_earlier(self) -> None:
        """Earlier submaps have come: from now on the digest lists them."""
        if self._earlier_offered:
            self._earlier, self._earlier_offered = self._earlier_offered, {}
            for submap in self._earlier.values():
                self._map.adopt(submap.tiles)

    def _take_update(self, update: MapUpdate) -> None:
        """An update has come: its tiles are next, the rest goes when it is due."""
        self._update = update
        self._map.forget(update.forgotten)
        for place in update.forgotten:
            self._beams_until_ns.pop(place, None)
        self._final = False
        self._tiles.extend(update.tiles)
        self._health = update.health
        if update.pose is not None:
            self._unsent_pose = update.pose
        self._newest_anchor = update.anchor or self._newest_anchor
        if update.guarantee != self._guarantee:
            self._guarantee, self._guarantee_message = update.guarantee, guarantee_message(update.guarantee)
            self._guarantee_json = write(self._guarantee_message)

    def _send_periodic(self, session: zenoh.Session, now_s: float) -> None:
        """Pose, anchor, health, info and digest, each when it is due, and all at the end."""
        ending = self._flush_wanted and self._update is None and self.ready
        if self._unsent_pose is not None and (ending or now_s >= self._pose_due_s):
            self._pose_due_s = now_s + 1 / self._config.pose_rate_hz
            pose, self._unsent_pose = self._unsent_pose, None
            self._put(session, POSE, write_pose(pose))
            self._write_anchor()
        if self._health is not None and (ending or now_s >= self._health_due_s):
            self._health_due_s = now_s + self._config.health_period_s
            self._put(session, HEALTH, self._topic(HEALTH))
        if self._unsent_anchor and self._anchor is not None:
            self._unsent_anchor = False
            self._put(session, ANCHOR, self._anchor)
        self._final = self._final or ending
        if ending or now_s >= self._digest_due_s:
            self._digest_due_s = now_s + self._config.digest_period_s
            self._send_digest(session)

    def _send_digest(self, session: zenoh.Session) -> None:
        """Info, anchor and digest; the tiles are listed only when something changed since the last listing."""
        self._put(session, INFO, self._topic(INFO))
        self._write_anchor()
        if self._anchor is not None:
            self._put(session, ANCHOR, self._anchor)
        parts = list(self._digest(summary_if_root=self._listed_root))
        for number, submap in self._earlier.items() if parts[0].parts else ():
            if submap.anchor is not None:
                self._put(session, ANCHOR_OF, submap.anchor, anchor_key(self._robot, number))
        for part in parts:
            self._put(session, DIGEST, write(part))
            self._listed_root = part.root
        with self._wake:
            if self._flush_wanted and self._final and self._slot is None:
                self._flush_wanted, self._flushed = False, True
                self._wake.notify_all()

    def _write_anchor(self) -> None:
        """The newest anchor as it is sent, and whether it is another one than before."""
        if self._newest_anchor is not None:
            anchor, self._newest_anchor = write_anchor(self._newest_anchor), None
            self._unsent_anchor = self._unsent_anchor or anchor != self._anchor
            self._anchor = anchor

    def _digest(self, summary_if_root: int | None = None) -> Iterator[DigestPart]:
        """The present digest; a summary alone where its root is this one."""
        self._sequence += 1
        entries = self._map.entries()
        root = digest_root(entries)
        if root == summary_if_root:
            return iter([DigestPart(self.epoch, self._sequence, self._final, len(entries), root, 0, 0, [])])
        return digest_parts(self.epoch, self._sequence, self._final, entries, root)

    def _send_tile(self, session: zenoh.Session, tile: Tile) -> None:
        """Send what changed of one tile since it was last sent."""
        news = self._map.update(tile)
        if news is None or self._update is None:
            return
        kind, cells, version = news
        payload = encode(cells, MAP_FRAME, time.time_ns())
        place, beams_until_ns = TileId(tile.submap, tile.ix, tile.iy), self._update.beams_until_ns
        if beams_until_ns is not None:
            self._beams_until_ns[place] = beams_until_ns
        note = write_note(self.epoch, version, self._guarantee_json, self._update.released_ns, beams_until_ns)
        key = tile_key(self._robot, tile.submap, tile.ix, tile.iy, kind)
        self.counts[f"{kind}_tiles"] += 1
        self._bucket.spend(len(payload))
        self._put(session, TILE, payload, key, note, at_once=not self._tiles)

    def _put(
        self,
        session: zenoh.Session,
        topic: Topic,
        payload: bytes,
        key: str | None = None,
        note: bytes | None = None,
        at_once: bool = True,
    ) -> None:
        """Send one message; a full queue drops it. Not `at_once`: with the next, or within a millisecond or so.

        A message that is to leave at once costs twice as much, so of an update's tiles the last alone does.
        """
        session.put(
            topic_key(self._robot, topic) if key is None else key,
            payload,
            encoding=topic.encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=topic.priority,
            express=topic.express and at_once,
            attachment=note,
        )
        self.counts["messages"] += 1
        self.counts["bytes"] += len(payload)

    def _topic(self, topic: Topic) -> bytes:
        """`info` and `health` as they are now."""
        if topic is INFO:
            return write_plain(self._info | {"submap": self.submap, "tiles": len(self._map)})
        try:
            return write_plain({**(self._health or {}), "publisher": self.state()})
        except (ValueError, TypeError) as error:
            self.counts["unsendable_health"] += 1
            return write_plain({"failure": f"health can't be written: {error}", "publisher": self.state()})

    # Answers to late joiners and for repair

    def _take_questions(self) -> None:
        """Work out which keys each waiting question asks for."""
        if self._questions:
            self._write_anchor()
        while self._questions:
            query = self._questions.popleft()
            asked = query.key_expr
            single = parse_tile_key(str(asked))
            if single is not None:
                place = TileId(single.submap, single.ix, single.iy)
                tiles = iter([place] if single.kind == "full" and place in self._map else [])
                self._answers.append(_Answer(query, tiles, iter([]), iter([])))
                continue
            topics = [t for t in (INFO, ANCHOR, HEALTH, DIGEST) if asked.intersects(topic_key(self._robot, t))]
            matching = (place for place in self._map if asked.intersects(tile_key(self._robot, *place, "full")))
            anchors = (n for n in [*self._earlier, self.submap] if asked.intersects(anchor_key(self._robot, n)))
            self._answers.append(_Answer(query, matching, iter(topics), anchors))

    def _answer(self, answer: _Answer) -> None:
        """Send one message of an answer; a question whose answer is complete is let go."""
        try:
            if (topic := next(answer.topics, None)) is not None:
                for payload in self._topic_answer(topic):
                    key = topic_key(self._robot, topic)
                    self._bucket.spend(len(payload))
                    answer.query.reply(key, payload, encoding=topic.encoding)
                return
            if (submap := next(answer.anchors, None)) is not None:
                anchor = self._earlier[submap].anchor if submap in self._earlier else self._anchor
                if anchor is not None:
                    self._bucket.spend(len(anchor))
                    answer.query.reply(anchor_key(self._robot, submap), anchor, encoding=ANCHOR_OF.encoding)
                return
            place = next(answer.tiles, None)
            published = None if place is None else self._map.get(place)
            if place is not None and published is not None:
                earlier = self._earlier.get(place.submap)
                guarantee = self._guarantee_message if earlier is None else earlier.guarantee
                beams_until_ns = self._beams_until_ns.get(place)
                note = write(TileNote(self.epoch, published.version, guarantee, beams_until_ns=beams_until_ns))
                payload = encode(published.tile, MAP_FRAME, time.time_ns())
                self._bucket.spend(len(payload))
                key = tile_key(self._robot, *place, "full")
                answer.query.reply(key, payload, encoding=TILE.encoding, attachment=note)
                self.counts["tiles_answered"] += 1
                return
        except zenoh.ZError:
            # Who asked is gone.
            self.counts["answers_failed"] += 1
        self._answers.popleft()
        answer.query.drop()  # type: ignore[no-untyped-call]  # the stub lacks a return type

    def _topic_answer(self, topic: Topic) -> list[bytes]:
        """What a get on a topic brings."""
        if topic is DIGEST:
            return [write(part) for part in self._digest()]
        if topic is ANCHOR:
            return [] if self._anchor is None else [self._anchor]
        if topic is HEALTH and self._health is None:
            return []
        return [self._topic(topic)]
