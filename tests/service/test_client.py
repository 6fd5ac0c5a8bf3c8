"""The remote copy: real sessions on loopback TCP, lost messages, cut links, restarts, second processes."""

import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zenoh

from drivers.errors import LinkError
from estimator.bounded_pose import INTACT, Anchor, BoundedPose, Guarantee
from mapper.saved_map import assemble, load
from mapper.tile import Tile, join, snap_outward
from mapper.tile_codec import encode
from service.client import RemoteMap
from service.loopback import free_locator
from service.map_update import MapUpdate
from service.messages import GuaranteeMessage, TileId, TileNote, write
from service.publish_config import PublishConfig
from service.publisher import Publisher
from service.session import open_session
from service.topics import robot_key, tile_key

WAIT_S = 30.0


class Drive:
    """A map that grows: each step touches a few cells of some tiles, as a scan does."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.tiles: dict[TileId, Tile] = {}

    def step(self, number: int, share: float = 0.05) -> MapUpdate:
        touched = [self._touch(TileId(0, number // 8 + k, -k), share) for k in range(3)]
        pose = BoundedPose(number, number + 1, np.zeros(6), np.ones(6))
        return MapUpdate(tuple(touched), pose, None, {"step": number}, INTACT, 1)

    def _touch(self, place: TileId, share: float) -> Tile:
        low = self.rng.normal(0.0, 0.3, (64, 64)).astype(np.float32)
        high = low + self.rng.uniform(0.0, 0.2, (64, 64)).astype(np.float32)
        unseen = self.rng.random((64, 64)) >= share
        low[unseen] = high[unseen] = np.nan
        tile = Tile(*place, 0.05, low, high)
        old = self.tiles.get(place)
        self.tiles[place] = tile if old is None else join(old, tile)
        return self.tiles[place]

    def published(self) -> dict[TileId, Tile]:
        """What a copy must equal, bit for bit."""
        return {place: snap_outward(tile) for place, tile in self.tiles.items()}


def drive(publisher: Publisher, course: Drive, steps: range) -> None:
    for number in steps:
        assert publisher.wait_until_ready(WAIT_S)
        assert publisher.offer(course.step(number))


@contextmanager
def publishing(address: str, robot: str = "rover", digest_period_s: float = 0.2) -> Iterator[Publisher]:
    publisher = Publisher(PublishConfig(listen=[address], digest_period_s=digest_period_s), robot)
    publisher.start()
    try:
        yield publisher
    finally:
        publisher.close()


def test_a_copy_equals_the_robots_map_bit_for_bit() -> None:
    """G4 with nothing lost: deltas alone build the copy, and nothing had to be asked for again."""
    course, address = Drive(), free_locator()
    with publishing(address) as publisher, RemoteMap(address, robot="rover") as remote:
        assert remote.wait_in_sync(WAIT_S)
        drive(publisher, course, range(40))
        assert publisher.flush(WAIT_S)
        assert remote.wait_in_sync(WAIT_S, final=True)
        assert remote.tiles == course.published()
        assert remote.pose is not None
        assert remote.health["step"] == 39
        assert remote.stats()["malformed"] == 0


def test_when_it_is_closed_no_thread_is_left_to_abort_the_process() -> None:
    """A thread that is inside Zenoh when the interpreter ends aborts it; neither side leaves one, however often."""
    before, address = set(threading.enumerate()), free_locator()
    for _ in range(20):
        with publishing(address), RemoteMap(address) as remote:
            assert remote.wait_alive(WAIT_S)
        assert set(threading.enumerate()) <= before


def test_a_late_joiner_gets_everything() -> None:
    """Who comes after the drive asks for each tile, and finds the robot's name by itself."""
    course, address = Drive(), free_locator()
    with publishing(address) as publisher:
        drive(publisher, course, range(40))
        assert publisher.flush(WAIT_S)
        with RemoteMap(address) as remote:
            assert remote.wait_in_sync(WAIT_S, final=True)
            assert remote.robot == "rover"
            assert remote.tiles == course.published()
            assert remote.counts["repaired"] >= len(course.tiles)  # a slow machine may ask once more


def test_a_ring_that_overflows_loses_messages_and_the_copy_becomes_equal_all_the_same() -> None:
    """Nearly every message is lost on the subscriber's side; the digest tells, and repair brings the tiles."""
    course, address = Drive(), free_locator()
    with publishing(address) as publisher, RemoteMap(address, ring=1) as remote:
        assert remote.wait_alive(WAIT_S)
        # While this thread holds the copy, the receiver stands still and its ring runs over.
        with remote._changed:
            drive(publisher, course, range(40))
            assert publisher.flush(WAIT_S)
        assert remote.wait_in_sync(WAIT_S, final=True)
        assert remote.tiles == course.published()
        assert remote.counts["repaired"] > 0


def test_waiting_for_equality_is_not_content_with_an_old_digest() -> None:
    """What was published before the call is in the copy when the wait ends, though the copy was in sync long before."""
    course, address = Drive(), free_locator()
    with publishing(address) as publisher, RemoteMap(address) as remote:
        for number in range(5):
            drive(publisher, course, range(number, number + 1))
            assert publisher.flush(WAIT_S)
            assert remote.wait_in_sync(WAIT_S)
            assert remote.tiles == course.published()


def test_a_second_process_that_joins_late_saves_the_same_map(tmp_path: Path) -> None:
    """G4 across processes: the file that a remote process writes holds the robot's cells, bit for bit."""
    course, address = Drive(), free_locator()
    saved = tmp_path / "remote.npz"
    program = (
        "import sys\n"
        "from pathlib import Path\n"
        "from service.client import RemoteMap\n"
        "with RemoteMap(sys.argv[1]) as remote:\n"
        "    assert remote.wait_alive(30)\n"
        "    print('alive', flush=True)\n"
        "    assert remote.wait_in_sync(30, final=True)\n"
        "    remote.save(Path(sys.argv[2]))\n"
    )
    with publishing(address) as publisher:
        drive(publisher, course, range(20))
        process = subprocess.Popen(
            [sys.executable, "-c", program, address, str(saved)], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        assert process.stdout.readline() == "alive\n"
        drive(publisher, course, range(20, 40))
        assert publisher.flush(WAIT_S)
        process.communicate(timeout=WAIT_S)
        assert process.returncode == 0
    expected = assemble(course.published().values(), 0.05, "map")
    remote = load(saved)
    assert remote.low.tobytes() == expected.low.tobytes()
    assert remote.high.tobytes() == expected.high.tobytes()
    assert (remote.resolution_m, remote.origin_m) == (expected.resolution_m, expected.origin_m)


def test_a_stopped_subscriber_holds_up_neither_the_robot_nor_the_others() -> None:
    """A frozen process's link fills up; publishing goes on, and a healthy subscriber gets it all."""
    course, address = Drive(), free_locator()
    program = (
        "import sys, threading\n"
        "from service.client import RemoteMap\n"
        "remote = RemoteMap(sys.argv[1])\n"
        "remote.start()\n"
        "assert remote.wait_in_sync(30)\n"
        "print('in sync', flush=True)\n"
        "sys.stdin.read()\n"
    )
    with publishing(address) as publisher, RemoteMap(address) as healthy:
        command = [sys.executable, "-c", program, address]
        frozen = subprocess.Popen(command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert frozen.stdout is not None
        assert frozen.stdout.readline() == "in sync\n"
        frozen.send_signal(signal.SIGSTOP)
        try:
            for number in range(60):
                assert publisher.wait_until_ready(5.0)
                assert publisher.offer(course.step(number, share=0.9))
            assert publisher.flush(5.0)
            assert healthy.wait_in_sync(WAIT_S, final=True)
            assert healthy.tiles == course.published()
        finally:
            frozen.kill()
            frozen.communicate()


class Relay:
    """A TCP relay whose links can be cut, as a radio's are."""

    def __init__(self, target: str) -> None:
        self._target = target.removeprefix("tcp/").split(":")
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        self._links: list[socket.socket] = []
        self._wake, self._woken = os.pipe()
        self.accepting = threading.Event()
        self.accepting.set()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        peers: dict[socket.socket, socket.socket] = {}
        while True:
            ends: list[socket.socket | int] = [self._server, self._wake, *peers]
            ready, _, _ = select.select(ends, [], [])
            if self._wake in ready:
                order = os.read(self._wake, 1)
                for end in peers:
                    end.close()
                peers.clear()
                if order == b"e":
                    self._server.close()
                    return
                continue
            for link in ready:
                if link is self._server:
                    near, _ = self._server.accept()
                    if not self.accepting.is_set():
                        near.close()
                        continue
                    far = socket.create_connection((self._target[0], int(self._target[1])))
                    peers[near], peers[far] = far, near
                elif isinstance(link, socket.socket) and link in peers:
                    other = peers[link]
                    data = b""
                    with suppress(OSError):
                        data = link.recv(65536)
                        other.sendall(data)
                    if not data:
                        for end in (link, other):
                            peers.pop(end, None)
                            end.close()

    def cut(self) -> None:
        """Break every link, and refuse new ones until `mend`."""
        self.accepting.clear()
        os.write(self._woken, b"c")

    def mend(self) -> None:
        self.accepting.set()

    def close(self) -> None:
        os.write(self._woken, b"e")
        self._thread.join()
        os.close(self._wake)
        os.close(self._woken)


def test_a_cut_link_is_survived_and_the_copy_becomes_equal_again() -> None:
    """What was published during the cut is brought afterwards; mapping never noticed."""
    course, address = Drive(), free_locator()
    with publishing(address) as publisher:
        relay = Relay(address)
        with RemoteMap(relay.address) as remote:
            drive(publisher, course, range(15))
            assert remote.wait_in_sync(WAIT_S)
            relay.cut()
            assert remote.wait_alive(WAIT_S, alive=False)
            assert not remote.in_sync
            before = len(remote.tiles)
            drive(publisher, course, range(15, 40))
            assert publisher.flush(WAIT_S)
            assert len(remote.tiles) == before
            relay.mend()
            assert remote.wait_in_sync(WAIT_S, final=True)
            assert remote.tiles == course.published()
            assert remote.counts["epochs"] == 1
        relay.close()


def test_a_restarted_robot_is_followed_by_itself_and_its_maps_are_not_mixed() -> None:
    """After a restart the map frame may be another: the copy begins anew and equals the new map alone."""
    old, new, address = Drive(seed=1), Drive(seed=2), free_locator()
    with RemoteMap(address) as remote:
        with publishing(address) as publisher:
            drive(publisher, old, range(20))
            assert publisher.flush(WAIT_S)
            assert remote.wait_in_sync(WAIT_S, final=True)
            assert remote.tiles == old.published()
        assert remote.wait_alive(WAIT_S, alive=False)
        assert remote.tiles == old.published()
        with publishing(address) as publisher:
            assert remote.wait_alive(WAIT_S)
            drive(publisher, new, range(10))
            assert publisher.flush(WAIT_S)
            assert remote.wait_in_sync(WAIT_S, final=True)
            assert remote.tiles == new.published()
            assert remote.counts["epochs"] == 2


def test_of_a_robot_that_was_restarted_nothing_of_the_old_run_stays(tmp_path: Path) -> None:
    """The new map has another frame: without a fix yet it has no place on Earth, neither told nor saved."""
    old, new, address = Drive(seed=1), Drive(seed=2), free_locator()
    anchor = Anchor(47.0, 8.0, 400.0, np.zeros(4), np.ones(4))
    with RemoteMap(address) as remote:
        with publishing(address) as publisher:
            assert remote.wait_in_sync(WAIT_S)
            assert publisher.offer(replace(old.step(0), anchor=anchor))
            assert publisher.flush(WAIT_S)
            assert remote.wait_in_sync(WAIT_S, final=True)
            assert remote.anchor is not None
            assert remote.health["step"] == 0
        assert remote.wait_alive(WAIT_S, alive=False)
        with publishing(address) as publisher:
            assert remote.wait_alive(WAIT_S)
            assert publisher.offer(MapUpdate(new.step(1).tiles, None, None, {}, INTACT, 1))
            assert publisher.flush(WAIT_S)
            assert remote.wait_in_sync(WAIT_S, final=True)
            assert remote.tiles == new.published()
            told: list[object] = [remote.anchor, remote.pose]
            assert told == [None, None]
            assert "step" not in remote.health
            remote.save(tmp_path / "map.npz")
    assert load(tmp_path / "map.npz").anchor == ""


def test_a_copy_that_claims_more_than_the_robot_is_mended() -> None:
    """G4 the other way: a wrong cell, and a tile the robot never had, are gone after the next digest."""
    course, address = Drive(), free_locator()
    with publishing(address) as publisher, RemoteMap(address) as remote:
        drive(publisher, course, range(10))
        assert publisher.flush(WAIT_S)
        assert remote.wait_in_sync(WAIT_S, final=True)
        strangers = Drive(seed=9)
        replaced, unlisted = remote.counts["replaced"], remote.counts["unlisted"]
        with remote._changed:
            for place in (TileId(0, 0, 0), TileId(0, 77, 77)):
                remote._copy.join(strangers._touch(place, 0.5))
            remote._copy.in_sync = False
        assert remote.wait_in_sync(WAIT_S)
        assert remote.tiles == course.published()
        assert (remote.counts["replaced"], remote.counts["unlisted"]) == (replaced + 1, unlisted + 1)


def test_latencies_are_those_of_tiles_that_were_sent_not_asked_for() -> None:
    """Each tile that came live gives one arrival minus release; answers to questions give none."""
    course, address = Drive(), free_locator()
    with publishing(address) as publisher:
        with RemoteMap(address) as remote:
            assert remote.wait_in_sync(WAIT_S)
            drive(publisher, course, range(5))
            assert publisher.flush(WAIT_S)
            assert remote.wait_in_sync(WAIT_S, final=True)
            sent = publisher.counts["full_tiles"] + publisher.counts["delta_tiles"]
            # On a loaded machine a few may have been dropped, and come by repair.
            assert sent == 15
            assert 0 < len(remote.latencies()) <= sent
            assert min(remote.latencies()) > 0
        with RemoteMap(address) as late:
            assert late.wait_in_sync(WAIT_S, final=True)
            assert late.latencies() == []
            assert late.latencies_ms() == {"p50": None, "p99": None}


def test_a_guarantee_that_broke_is_seen_remotely() -> None:
    """G5: the copy says which sensor contradicted its bounds, and when."""
    void = Guarantee(void_since_ns=123, sensor="gps")
    anchor = Anchor(47.0, 8.0, 400.0, np.zeros(4), np.ones(4), void)
    course, address = Drive(), free_locator()
    with publishing(address) as publisher, RemoteMap(address) as remote:
        touched = course.step(0).tiles
        publisher.offer(MapUpdate(touched, None, anchor, {}, void, 1))
        assert publisher.flush(WAIT_S)
        assert remote.wait_in_sync(WAIT_S, final=True)
        with remote._changed:
            assert remote._changed.wait_for(lambda: remote._copy.guarantee == void, WAIT_S)
        assert remote.bounds == void
        assert remote.guarantee == "contradicted by gps"
        assert remote.anchor is not None
        assert remote.anchor.guarantee == void


def _whole_tile(place: TileId) -> Tile:
    """A tile all of whose cells are seen."""
    low = np.zeros((64, 64), np.float32)
    return Tile(*place, 0.05, low, low + np.float32(0.1), np.zeros((64, 64), np.bool_))


def test_a_copy_tells_which_of_its_tiles_are_older_than_the_doubt(tmp_path: Path) -> None:
    """A fault takes back what was published since it may have begun; tiles whose beams are older stay promised."""
    old, new = TileId(0, 0, 0), TileId(0, 3, 0)
    void = Guarantee(void_since_ns=100, sensor="gps", contradicted_ns=140)
    address = free_locator()
    with publishing(address) as publisher, RemoteMap(address) as remote:
        publisher.offer(MapUpdate((_whole_tile(old),), None, None, {}, Guarantee(), 1, (), 99))
        assert publisher.flush(WAIT_S)
        assert remote.wait_in_sync(WAIT_S, final=True)
        assert remote.promised(old)
        publisher.offer(MapUpdate((_whole_tile(new),), None, None, {}, void, 1, (), 120))
        assert publisher.flush(WAIT_S)
        assert remote.wait_in_sync(WAIT_S, final=True)
        with remote._changed:
            assert remote._changed.wait_for(lambda: remote._copy.guarantee == void, WAIT_S)
        assert remote.promised(old)
        assert not remote.promised(new)
        remote.save(tmp_path / "copy.npz")
    with RemoteMap(address) as nobody:
        assert not nobody.promised(old)
    told = json.loads(load(tmp_path / "copy.npz").guarantee)
    assert (told["intact"], told["void_since_ns"], told["contradicted_ns"]) == (False, 100, 140)


def test_another_robot_at_the_same_address_is_not_mixed_in() -> None:
    """One copy follows one robot; who is named is followed, whoever else speaks."""
    mine, other, address = Drive(seed=1), Drive(seed=2), free_locator()
    with (
        publishing(address, robot="rover") as publisher,
        open_session("client", connect=[address]) as stranger,
        RemoteMap(address, robot="rover") as remote,
    ):
        _token = stranger.liveliness().declare_token(robot_key("tractor"))
        tile = other.step(0).tiles[0]
        stranger.put(tile_key("tractor", 0, tile.ix, tile.iy, "full"), encode(tile, "map", 0), attachment=b"{}")
        drive(publisher, mine, range(10))
        assert publisher.flush(WAIT_S)
        assert remote.wait_in_sync(WAIT_S, final=True)
        assert remote.tiles == mine.published()


def _note(epoch: str = "e") -> bytes:
    return write(TileNote(epoch, 1, GuaranteeMessage(intact=True)))


def test_malformed_messages_are_counted_and_change_nothing() -> None:
    """Garbage, a tile under another's key, another resolution, a missing note: refused; the good one still counts."""
    address = free_locator()
    good = snap_outward(Drive().step(0).tiles[0])
    coarse = Tile(0, good.ix, good.iy, 0.1, good.low, good.high)
    payload = encode(good, "map", 0)
    key = tile_key("rover", 0, good.ix, good.iy, "full")
    bad: list[tuple[str, bytes, bytes | None]] = [
        (key, b"", _note()),
        (key, os.urandom(5000), _note()),
        (key, payload[:-3], _note()),
        (key, payload, None),
        (key, payload, b"no json"),
        (tile_key("rover", 0, good.ix + 1, good.iy, "full"), payload, _note()),
        ("terrabound/v1/rover/map/0/01/0/full", payload, _note()),
        (key, encode(coarse, "map", 0), _note()),
        ("terrabound/v1/rover/pose", b'{"low":[1]}', None),
        ("terrabound/v1/rover/anchor", b"null", None),
        ("terrabound/v1/rover/health", b"[" * 50_000, None),
        ("terrabound/v1/rover/digest", b'{"epoch":"e","sequence":-1}', None),
    ]
    with open_session("peer", listen=[address]) as rogue, RemoteMap(address) as remote:
        _token = rogue.liveliness().declare_token(robot_key("rover"))
        assert remote.wait_alive(WAIT_S)
        _wait_for_subscriber(rogue, key)
        rogue.put(key, payload, attachment=_note())
        for bad_key, data, note in bad:
            rogue.put(bad_key, data, attachment=note, congestion_control=zenoh.CongestionControl.BLOCK)
        with remote._changed:
            assert remote._changed.wait_for(lambda: remote.counts["malformed"] == len(bad), WAIT_S), remote.counts
        assert list(remote.tiles.values()) == [good]


def test_tiles_of_two_runs_are_never_joined_not_even_for_a_moment() -> None:
    """The first tile of another epoch makes the copy begin anew, before any digest has come."""
    address = free_locator()
    first, second = Drive(seed=1).step(0).tiles, Drive(seed=2).step(0).tiles
    with open_session("peer", listen=[address]) as robot, RemoteMap(address) as remote:
        _token = robot.liveliness().declare_token(robot_key("rover"))
        assert remote.wait_alive(WAIT_S)
        _wait_for_subscriber(robot, tile_key("rover", 0, 0, 0, "full"))
        for epoch, tiles in (("one", first), ("two", second[:1])):
            for tile in tiles:
                key = tile_key("rover", tile.submap, tile.ix, tile.iy, "full")
                robot.put(key, encode(tile, "map", 0), attachment=_note(epoch))
        with remote._changed:
            assert remote._changed.wait_for(lambda: remote.counts["messages"] == 4, WAIT_S)
            assert remote._changed.wait_for(lambda: remote.counts["epochs"] == 2, WAIT_S)
        assert list(remote.tiles.values()) == [snap_outward(second[0])]


def _wait_for_subscriber(session: zenoh.Session, key: str) -> None:
    """Until the other side's subscription is known here: what is put before would reach nobody."""
    publisher, matching = session.declare_publisher(key), threading.Event()
    publisher.declare_matching_listener(lambda status: matching.set() if status.matching else None)
    assert publisher.matching_status or matching.wait(WAIT_S)


def test_a_flood_of_tiles_is_bounded() -> None:
    """Beyond its cap a copy keeps no more tiles, counts them, and doesn't claim to be in sync."""
    course, address = Drive(), free_locator()
    with publishing(address) as publisher, RemoteMap(address, max_tiles=4) as remote:
        drive(publisher, course, range(40))
        assert publisher.flush(WAIT_S)
        assert remote.wait_for_digest(WAIT_S)
        assert remote.wait_for_digest(WAIT_S)
        assert len(remote.tiles) == 4
        assert remote.counts["too_many_tiles"] > 0
        assert not remote.in_sync


def test_a_copy_waits_for_a_robot_that_is_not_there_yet() -> None:
    """The subscriber may be started first; closing it without ever having met a robot is quick and clean."""
    course, address = Drive(), free_locator()
    with RemoteMap(address) as never:
        assert not never.in_sync
        assert never.guarantee == "unknown"
    with RemoteMap(address) as remote:
        with remote._changed:
            assert remote._changed.wait_for(lambda: remote.failure is not None, WAIT_S)
        assert "nobody answers" in str(remote.failure)
        with publishing(address) as publisher:
            drive(publisher, course, range(5))
            assert publisher.flush(WAIT_S)
            assert remote.wait_in_sync(WAIT_S, final=True)
            assert remote.tiles == course.published()


def test_a_locator_that_is_none_is_refused_at_once() -> None:
    """A typing mistake is told, not retried for ever."""
    with pytest.raises(LinkError, match="robot:7447: not an address"):
        RemoteMap("robot:7447").start()


def test_a_process_with_an_open_copy_ends_by_itself() -> None:
    """Neither an open subscriber nor an open publisher keeps the interpreter from exiting."""
    program = (
        "import sys\n"
        "from service.client import RemoteMap\n"
        "from service.publisher import Publisher\n"
        "from service.publish_config import PublishConfig\n"
        "publisher = Publisher(PublishConfig(listen=[sys.argv[1]]), 'rover')\n"
        "publisher.start()\n"
        "remote = RemoteMap(sys.argv[1])\n"
        "remote.start()\n"
        "assert remote.wait_in_sync(30)\n"
        "print('in sync', flush=True)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, free_locator()], capture_output=True, text=True, timeout=3 * WAIT_S
    )
    assert (done.returncode, done.stdout) == (0, "in sync\n"), done.stderr
