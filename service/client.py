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
from mapper.tile import Tile, compile_tiles
from mapper.tile_codec import TileFormatError, compile_codec
from service.copied_map import CopiedMap
from service.digest import DigestPart
from service.map_file import save_tiles
from service.map_repair import MapRepair, read_tile
from service.messages import AnchorMessage, MalformedMessage, PoseMessage, TileId, read, read_plain
from service.session import ended_callback, open_session, session_config
from service.topics import ANCHOR, DIGEST, HEALTH, INFO, POSE, ROOT, split_key, submap_of_anchor

RING = 4096
"""Messages that may wait for this side; older ones give way, and the digest brings them back."""
MAX_TILES = 65_536
"""Memory cap: 2 GiB. Tiles beyond it are counted, not kept."""
FIRST_RETRY_S, LAST_RETRY_S = 0.2, 1.0
MAX_LATENCIES = 100_000
MAX_HOSTS = 64


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
        self._copy = CopiedMap(self.counts, max_tiles)
        self.anchors = self._copy.anchors
        """Of each submap, also of those that earlier runs left, as last asked for."""
        self._hosts: dict[str, str] = {}
        """Where each run that was heard runs, by epoch."""
        self._locators = [locators] if isinstance(locators, str) else list(locators)
        self._ring = ring
        self._multicast = multicast
        self._changed = threading.Condition()
        # Between the threads, under the condition's lock:
        self._subscriber: zenoh.Subscriber[zenoh.Handler[zenoh.Sample]] | None = None
        self._stopping = False
        self._latencies_ns: deque[int] = deque(maxlen=MAX_LATENCIES)
        compile_tiles()
        compile_codec()
        self._receiver = threading.Thread(target=self._receive, name="remote-map", daemon=True)
        self._repair = MapRepair(self._copy, self._changed, lambda: self.robot, self._take, self.counts)

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
        self._repair.start()

    def close(self) -> None:
        """End both threads and the session; the copy stays readable."""
        atexit.unregister(self.close)
        with self._changed:
            self._stopping = True
            subscriber = self._subscriber
            self._changed.notify_all()
        if subscriber is not None:
            subscriber.undeclare()  # type: ignore[no-untyped-call]  # the stub lacks a return type
        self._repair.stop()
        if self._receiver.is_alive():
            self._receiver.join()
        self._repair.join()

    @property
    def tiles(self) -> dict[TileId, Tile]:
        """The copy as it is now."""
        with self._changed:
            return dict(self._copy.tiles)

    @property
    def pose(self) -> BoundedPose | None:
        """The newest; None before the first of the run that is followed."""
        with self._changed:
            return self._copy.pose

    @property
    def anchor(self) -> Anchor | None:
        """Of the submap that is being mapped; None where the run that is followed has told none."""
        with self._changed:
            return self._copy.anchor

    @property
    def health(self) -> Mapping[str, Any]:
        """As the robot told it last."""
        with self._changed:
            return self._copy.health

    @property
    def info(self) -> Mapping[str, Any]:
        """What the robot says of itself."""
        with self._changed:
            return self._copy.info

    @property
    def bounds(self) -> Guarantee | None:
        """Do the robot's bounds hold? As its newest tile or pose says; None before the first."""
        with self._changed:
            return self._copy.guarantee

    @property
    def guarantee(self) -> str:
        """`bounds` in words."""
        bounds = self.bounds
        if bounds is None:
            return "unknown"
        return "intact" if bounds.intact else f"contradicted by {bounds.sensor or 'a sensor'}"

    @property
    def rival(self) -> str | None:
        """A sentence where two services lately published under the robot's name; None where one alone does."""
        with self._changed:
            rival = self._copy.run.rival(time.monotonic_ns())
            if rival is None:
                return None
            followed, other = (self._hosts.get(epoch or "", "unknown") for epoch in (self._copy.run.epoch, rival))
        return (
            f"two services publish as {self.robot!r}: the copy is of the one on the host {followed}, not of the one on "
            f"the host {other}; set another robot.name in one, or stop it"
        )

    def promised(self, place: TileId) -> bool:
        """Is all that the copy holds of this tile from before the time since when the bounds are in doubt?"""
        with self._changed:
            return self._copy.promised(place)

    @property
    def in_sync(self) -> bool:
        """Did the copy equal what the newest digest said of the robot's map?"""
        with self._changed:
            return self._copy.in_sync

    def wait_in_sync(self, timeout_s: float, final: bool = False) -> bool:
        """Wait until a digest that comes from now on finds the copy equal to the robot's map (or repair makes it so).

        `final`: until it equals a digest, whenever it came, of which the robot said that this is all.
        """
        with self._changed:
            before = self._copy.digest_count
            return self._changed.wait_for(
                lambda: self._copy.in_sync and (self._copy.final if final else self._copy.digest_count > before),
                timeout_s,
            )

    def wait_complete(self, timeout_s: float) -> bool:
        """Wait until the copy holds every tile as a digest listed it; a robot that maps on is ahead again at once."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._copy.in_sync or (self._copy.compared and not self._copy.stale),
                timeout_s,
            )

    def wait_for_digest(self, timeout_s: float) -> bool:
        """Wait until one more digest has been compared with the copy."""
        with self._changed:
            before = self._copy.digest_count
            return self._changed.wait_for(lambda: self._copy.digest_count > before, timeout_s)

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
            return {"tiles": len(self._copy.tiles), **counts}

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
                self._subscriber = subscriber
                self.failure = None
            self._repair.attend(session)
            try:
                for sample in subscriber:
                    self._take(sample)
            finally:
                with self._changed:
                    self._subscriber = None
                # The session must not be closed under the repair's hands.
                self._repair.leave()

    def _liveliness_changed(self, sample: zenoh.Sample) -> None:
        """A robot came or went (on a thread of Zenoh's); whoever comes is asked what it has."""
        found = split_key(str(sample.key_expr))
        with self._changed:
            if found is None or not self._is_ours(found[0]):
                return
            self.alive = sample.kind == zenoh.SampleKind.PUT
            self._copy.robot_is_there(self.alive)
            self._changed.notify_all()

    def _is_ours(self, robot: str) -> bool:
        """Is it the robot we follow? The first one that is found is followed, if none was named."""
        if self.robot is None and robot:
            self.robot = robot
        if robot == self.robot:
            return True
        self.counts["other_robot"] += 1
        return False

    def _take(self, sample: zenoh.Sample) -> None:
        """Take one message, whatever it is; what doesn't fit is counted, never raised."""
        now_ns = time.monotonic_ns()
        found = split_key(str(sample.key_expr))
        if sample.kind != zenoh.SampleKind.PUT or found is None:
            return
        with self._changed:
            if not self._is_ours(found[0]):
                return
            self.counts["messages"] += 1
        try:
            if found[1].startswith("map/"):
                self._take_tile(sample, now_ns)
            else:
                self._take_topic(found[1], bytes(sample.payload), now_ns)
        except (MalformedMessage, TileFormatError):
            with self._changed:
                self.counts["malformed"] += 1
        with self._changed:
            self._changed.notify_all()

    def _take_topic(self, name: str, payload: bytes, now_ns: int) -> None:
        """Pose, anchor, health, info or digest."""
        copy, told = self._copy, _read_topic(name, payload)
        with self._changed:
            match told:
                case PoseMessage():
                    copy.take_pose(told, now_ns)
                case AnchorMessage():
                    copy.take_anchor(told, now_ns, submap_of_anchor(name))
                case DigestPart():
                    copy.take_digest(told, now_ns)
                case None:
                    self.counts["unknown_topic"] += 1
                case _ if name == HEALTH.name:
                    copy.take_health(told, now_ns)
                case _:
                    self._note_host(told)
                    copy.take_info(told, now_ns)

    def _note_host(self, info: Mapping[str, Any]) -> None:
        """Whose a run is, also of one that is not followed."""
        epoch = str(info.get("epoch"))
        if len(self._hosts) >= MAX_HOSTS and epoch not in self._hosts:
            self._hosts.clear()
        self._hosts[epoch] = str(info.get("host", "unknown"))

    def _take_tile(self, sample: zenoh.Sample, now_ns: int) -> None:
        """Join a tile or a delta."""
        tile, note = read_tile(sample)
        with self._changed:
            if note.released_ns is not None:
                self._latencies_ns.append(now_ns - note.released_ns)
            self._copy.take_tile(tile, note, now_ns)


def _read_topic(name: str, payload: bytes) -> PoseMessage | AnchorMessage | DigestPart | Mapping[str, Any] | None:
    """What a message below the robot's key says; None of a topic that isn't known."""
    if name == POSE.name:
        return read(PoseMessage, payload)
    if name == ANCHOR.name or submap_of_anchor(name) is not None:
        return read(AnchorMessage, payload)
    if name == DIGEST.name:
        return read(DigestPart, payload)
    return read_plain(payload) if name in (HEALTH.name, INFO.name) else None
