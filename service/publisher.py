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
from collections.abc import Mapping
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import zenoh

from drivers.errors import LinkError
from mapper.tile import Tile
from mapper.tile_codec import compile_codec
from service.answers import Answers
from service.map_update import MAP_FRAME, MapUpdate
from service.messages import TileId
from service.periodic import Periodic
from service.publish_config import PublishConfig
from service.published_map import EarlierSubmap, PublishedMap, Recall, nothing_kept
from service.published_state import PublishedState
from service.rivals import OwnName, this_host
from service.session import NotAnAddress, ended_callback, open_session
from service.session_ahead import SessionAhead
from service.token_bucket import TokenBucket
from service.topics import TILE, Topic, robot_key, tile_key, topic_key

FIRST_RETRY_S, LAST_RETRY_S = 0.2, 5.0
"""Back-off between attempts to open the session again."""
MAX_QUERIES = 256
"""Questions that may wait for their answers; further ones go unanswered, and are counted."""
TILES_AT_A_TIME = 8
"""So many are sent between two looks at what else is due."""
START_TIMEOUT_S = 15.0


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
        self.rival: str | None = None
        """What is to be said of another publisher of this name, while one is heard."""
        self._config = config
        self._ahead = ahead
        self._robot = robot
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
        about = {"robot": robot, "epoch": self.epoch, "frame": MAP_FRAME, "format": "docs/tile-format.md"}
        about |= {"host": this_host()}
        about |= {} if info is None else dict(info)
        published = PublishedMap(recall, tiles_in_memory)
        self._state = PublishedState(self.epoch, about, published, self.counts, self.state)
        self._bucket = TokenBucket(config.max_bytes_per_s)
        self._own_name = OwnName(robot, self.epoch)
        self._answers = Answers(robot, self._state, self._bucket, self.counts)
        self._update: MapUpdate | None = None
        """The one whose tiles are being sent."""
        self._tiles: deque[Tile | TileId] = deque()
        """Those that are still to be sent; the store gives what is there by its place alone."""
        self._periodic = Periodic(config, robot, self._state)
        compile_codec()
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)

    # Called by the pipeline and by whoever owns the publisher

    @property
    def submap(self) -> int:
        """The one that is being mapped; set it before `start`."""
        return self._state.submap

    @submap.setter
    def submap(self, number: int) -> None:
        self._state.submap = number

    def start(self) -> None:
        """Open the session. Raises NotAnAddress where its address is none.

        One that can't be used now (another program listens there, the radio is still coming up) is waited for in
        background: `failure` says so.
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
            "rival": self.rival,
            "tiles_not_recalled": self._state.map.not_recalled,
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
            except NotAnAddress as error:
                self._refused = error
                self._started.set()
                return
            except (LinkError, zenoh.ZError) as error:
                self._session_failed(str(error))
            except Exception as error:
                # Whatever it is: mapping goes on, and a session is opened anew.
                self._session_failed(f"could not publish: {error!r}")
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
        self._periodic.list_anew()
        with (
            ended_callback(self._ask) as ask,
            session.declare_queryable(f"{robot_key(self._robot)}/**", ask),
            session.liveliness().declare_token(robot_key(self._robot)),
            self._own_name.listening(session),
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
                    self._answers.send_next()

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
                    update, self._slot = self._slot, None
                    self._take_update(update)
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
        delay_s = self._periodic.due_s() - now_s
        if self._update is not None or self._answers:
            delay_s = min(delay_s, self._bucket.delay_s(now_s))
        return delay_s

    def _take_earlier(self) -> None:
        """Earlier submaps have come."""
        if self._earlier_offered:
            self._state.adopt(self._earlier_offered)
            self._earlier_offered = {}

    def _take_questions(self) -> None:
        """Questions have come."""
        if self._questions:
            self._state.write_anchor()
        while self._questions:
            self._answers.take(self._questions.popleft())

    def _take_update(self, update: MapUpdate) -> None:
        """An update has come: its tiles are next, the rest goes when it is due."""
        self._update = update
        self._state.take(update)
        self._tiles.extend(update.tiles)
        self._tiles.extend(update.stored)
        if update.pose is not None:
            self._periodic.pose = update.pose

    def _send_periodic(self, session: zenoh.Session, now_s: float) -> None:
        """Pose, anchor, health, info and digest, each when it is due, and all at the end."""
        ending = self._flush_wanted and self._update is None and self.ready
        if self._periodic.send(partial(self._put, session), now_s, ending):
            self.rival = self._own_name.rival(time.monotonic_ns())
            with self._wake:
                if self._flush_wanted and self._state.final and self._slot is None:
                    self._flush_wanted, self._flushed = False, True
                    self._wake.notify_all()

    def _send_tile(self, session: zenoh.Session, changed: Tile | TileId) -> None:
        """Send what changed of one tile since it was last sent."""
        tile = self._state.map.recall(changed) if isinstance(changed, TileId) else changed
        message = None if tile is None or self._update is None else self._state.news(tile, self._update)
        if tile is None or message is None:
            return
        key = tile_key(self._robot, tile.submap, tile.ix, tile.iy, message.kind)
        self.counts[f"{message.kind}_tiles"] += 1
        self._bucket.spend(len(message.payload))
        self._put(session, TILE, message.payload, key, message.note, at_once=not self._tiles)

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
