"""The publisher, seen from the wire: real sessions on loopback TCP."""

import json
import re
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.errors import LinkError
from estimator.bounded_pose import INTACT, Anchor, BoundedPose, Guarantee
from mapper.tile import Tile, changed, content_crc, join, snap_outward, unseen_tile
from mapper.tile_codec import decode
from service.digest import DigestEntry, DigestPart, digest_root
from service.loopback import free_locator
from service.map_update import MapUpdate
from service.messages import TileNote, guarantee_from, read, read_anchor, read_pose
from service.publish_config import PublishConfig
from service.publisher import Publisher
from service.session import open_session, with_send_buffer
from service.token_bucket import TokenBucket
from service.topics import GRID, parse_tile_key, robot_key, tile_key

WAIT_S = 20.0


def tile(ix: int = 0, iy: int = 0, seed: int = 0, share: float = 0.5, submap: int = 0) -> Tile:
    """Some cells seen, with bounds that aren't multiples of the published step."""
    rng = np.random.default_rng(seed)
    low = rng.normal(0.0, 0.3, (64, 64)).astype(np.float32)
    high = low + rng.uniform(0.0, 0.2, (64, 64)).astype(np.float32)
    unseen = rng.random((64, 64)) >= share
    low[unseen] = high[unseen] = np.nan
    return Tile(submap, ix, iy, 0.05, low, high)


def update(
    *tiles: Tile, guarantee: Guarantee = INTACT, released_ns: int = 1, beams_until_ns: int | None = None
) -> MapUpdate:
    pose = BoundedPose(10, 20, np.arange(6.0), np.arange(6.0) + 0.1, guarantee)
    anchor = Anchor(47.0, 8.0, 400.0, np.zeros(4), np.array([1.0, 1.0, 2.0, np.inf]), guarantee)
    return MapUpdate(tiles, pose, anchor, {"devices": {"gps": "LOST"}}, guarantee, released_ns, (), beams_until_ns)


@contextmanager
def publishing(address: str | None = None, digest_period_s: float = 0.1) -> Iterator[tuple[Publisher, str]]:
    address = free_locator() if address is None else address
    publisher = Publisher(
        PublishConfig(listen=[address], digest_period_s=digest_period_s), "rover", {"resolution_m": 0.05}
    )
    publisher.start()
    try:
        yield publisher, address
    finally:
        publisher.close()


class Ear:
    """A bare subscriber to everything: what any Zenoh program would hear."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.samples: list[zenoh.Sample] = []
        self.changed = threading.Condition()
        session.declare_subscriber("terrabound/v1/**", self._hear)

    def _hear(self, sample: zenoh.Sample) -> None:
        with self.changed:
            self.samples.append(sample)
            self.changed.notify_all()

    def of(self, topic: str) -> list[zenoh.Sample]:
        key = f"terrabound/v1/rover/{topic}"
        with self.changed:
            return [sample for sample in self.samples if zenoh.KeyExpr(key).includes(sample.key_expr)]

    def wait(self, topic: str, count: int = 1) -> list[zenoh.Sample]:
        """The first `count` samples of a topic."""
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.of(topic)) >= count, WAIT_S), f"no {count} of {topic}"
        return self.of(topic)[:count]


@contextmanager
def listening(address: str) -> Iterator[Ear]:
    """An Ear that surely hears: a digest has reached it."""
    with open_session("client", connect=[address]) as session:
        ear = Ear(session)
        ear.wait("digest")
        yield ear


def answers(session: zenoh.Session, key: str) -> list[zenoh.Sample]:
    replies = session.get(key, timeout=WAIT_S, consolidation=zenoh.ConsolidationMode.NONE)
    return [reply.ok for reply in replies if reply.ok is not None]


def tile_of(sample: zenoh.Sample) -> Tile:
    key = parse_tile_key(str(sample.key_expr))
    assert key is not None
    return decode(bytes(sample.payload), key.submap).tile


def note_of(sample: zenoh.Sample) -> TileNote:
    assert sample.attachment is not None
    return read(TileNote, bytes(sample.attachment))


def test_a_new_tile_is_sent_whole_and_later_only_what_changed_of_it() -> None:
    """full first; a delta holds exactly the changed cells; both joined are the published tile, bit for bit."""
    first, more = tile(seed=1), tile(seed=2, share=0.03)
    second = join(first, more)
    with publishing() as (publisher, address), listening(address) as ear:
        publisher.offer(update(first))
        full = tile_of(ear.wait("map/0/0/0/full")[0])
        assert full == snap_outward(first)
        assert publisher.wait_until_ready(WAIT_S)
        publisher.offer(update(second))
        delta = tile_of(ear.wait("map/0/0/0/delta")[0])
    assert 0 < delta.cells_seen <= more.cells_seen
    assert delta == changed(snap_outward(first), snap_outward(second))
    assert join(full, delta) == snap_outward(second)


def test_a_tile_of_which_most_changed_is_sent_whole() -> None:
    """A delta of nearly everything would save nothing."""
    first = tile(seed=1, share=0.2)
    second = join(first, tile(seed=2, share=0.9))
    with publishing() as (publisher, address), listening(address) as ear:
        publisher.offer(update(first))
        ear.wait("map/0/0/0/full")
        assert publisher.wait_until_ready(WAIT_S)
        publisher.offer(update(second))
        assert tile_of(ear.wait("map/0/0/0/full", 2)[1]) == snap_outward(second)
        assert ear.of("map/0/0/0/delta") == []


def test_what_did_not_change_in_the_published_quantisation_is_not_sent() -> None:
    """A bound that moved within its step costs nothing on the wire."""
    first = tile(seed=1)
    nudged = Tile(0, 0, 0, 0.05, snap_outward(first).low, first.high)
    with publishing() as (publisher, address), listening(address) as ear:
        for state in (first, first, nudged):
            assert publisher.wait_until_ready(WAIT_S)
            publisher.offer(update(state))
        assert publisher.flush(WAIT_S)
        assert len(ear.wait("map/**")) == 1
        assert publisher.counts["full_tiles"] + publisher.counts["delta_tiles"] == 1


def test_every_message_may_be_dropped_and_tells_how_to_read_it() -> None:
    """Nothing blocks the sender; encodings stand on every message; a tile carries its note."""
    void = Guarantee(void_since_ns=77, sensor="gps")
    with publishing() as (publisher, address), listening(address) as ear:
        publisher.offer(update(tile(), guarantee=void, released_ns=12345, beams_until_ns=76))
        sample = ear.wait("map/0/0/0/full")[0]
        for topic in ("pose", "anchor", "health", "info", "digest"):
            assert str(ear.wait(topic)[0].encoding) == "application/json"
        assert str(sample.encoding) == GRID
        assert all(heard.congestion_control == zenoh.CongestionControl.DROP for heard in ear.of("**"))
    note = note_of(sample)
    assert (note.epoch, note.version, note.released_ns) == (publisher.epoch, 1, 12345)
    assert guarantee_from(note.guarantee) == void
    assert note.beams_until_ns == 76


def test_pose_anchor_health_and_info_arrive_as_they_were_offered() -> None:
    """JSON of each topic reads back as the value that the pipeline handed over."""
    offered = update()
    with publishing() as (publisher, address), listening(address) as ear:
        publisher.offer(offered)
        pose = read_pose(bytes(ear.wait("pose")[0].payload))
        anchor = read_anchor(bytes(ear.wait("anchor")[0].payload))
        health = json.loads(bytes(ear.wait("health")[0].payload))
        info = json.loads(bytes(ear.wait("info")[0].payload))
    assert offered.pose is not None
    assert offered.anchor is not None
    assert (pose.low.tolist(), pose.high.tolist()) == (offered.pose.low.tolist(), offered.pose.high.tolist())
    assert anchor.high.tolist() == offered.anchor.high.tolist()
    assert health["devices"] == {"gps": "LOST"}
    assert health["publisher"]["open"] is True
    assert (info["robot"], info["resolution_m"], info["epoch"]) == ("rover", 0.05, publisher.epoch)


def test_the_pose_is_sent_no_faster_than_asked_and_its_newest_wins() -> None:
    """A hundred offered poses within one period become a few messages, and the last one always goes out."""
    with publishing() as (publisher, address), listening(address) as ear:
        for number in range(100):
            assert publisher.wait_until_ready(WAIT_S)
            pose = BoundedPose(number, number, np.zeros(6), np.ones(6))
            publisher.offer(MapUpdate((), pose, None, {}, INTACT, 0))
        with ear.changed:
            assert ear.changed.wait_for(
                lambda: any(read_pose(bytes(s.payload)).earliest_ns == 99 for s in ear.of("pose")), WAIT_S
            )
        assert len(ear.of("pose")) < 90


def test_a_get_answers_tiles_digest_and_info_to_late_joiners() -> None:
    """map/** brings every tile whole; one key brings one tile; digest lists all; nothing else is invented."""
    tiles = [tile(ix, iy, seed=50 + ix * 7 + iy, submap=ix % 2) for ix in range(-2, 3) for iy in range(3)]
    with publishing() as (publisher, address), open_session("client", connect=[address]) as session:
        publisher.offer(update(*tiles))
        assert publisher.flush(WAIT_S)
        everything = [tile_of(sample) for sample in answers(session, "terrabound/v1/rover/map/**")]
        assert sorted(everything, key=_place) == sorted(map(snap_outward, tiles), key=_place)
        assert len(answers(session, "terrabound/v1/rover/map/1/*/2/full")) == 2
        single = answers(session, tile_key("rover", 1, -1, 2, "full"))
        assert [note_of(sample).released_ns for sample in single] == [None]
        assert tile_of(single[0]) == snap_outward(tiles[5])
        for nothing in (tile_key("rover", 5, 0, 0, "full"), tile_key("rover", 0, 0, 0, "delta")):
            assert answers(session, nothing) == []
        parts = [read(DigestPart, bytes(s.payload)) for s in answers(session, "terrabound/v1/rover/digest")]
        assert [len(part.entries) for part in parts] == [len(tiles)]
        assert json.loads(bytes(answers(session, "terrabound/v1/rover/info")[0].payload))["tiles"] == len(tiles)


def _place(t: Tile) -> tuple[int, int, int]:
    return t.submap, t.ix, t.iy


def test_the_final_digest_lists_the_crc_of_every_published_tile() -> None:
    """After flush everything offered is out, and the digest says so: final, complete, with the right CRCs."""
    tiles = [tile(ix, 0, seed=ix) for ix in range(5)]
    expected = [DigestEntry(0, t.ix, 0, content_crc(t)) for t in tiles]
    with publishing() as (publisher, address), listening(address) as ear:
        publisher.offer(update(*tiles))
        assert publisher.flush(WAIT_S)
        with ear.changed:
            assert ear.changed.wait_for(lambda: _digests(ear)[-1].final, WAIT_S)
        last = _digests(ear)[-1]
        assert (last.tiles, last.root) == (5, digest_root(expected))
        # A busy line may drop the listing, and then have but its summary: who lacks it asks.
        asked = [read(DigestPart, bytes(one.payload)) for one in answers(ear.session, "terrabound/v1/rover/digest")]
        assert [part.entries for part in asked] == [sorted(expected)]
        publisher.offer(update(tile(9, 9)))
        with ear.changed:
            assert ear.changed.wait_for(lambda: _digests(ear)[-1].tiles == 6, WAIT_S)
        assert not _digests(ear)[-1].final


def _digests(ear: Ear) -> list[DigestPart]:
    return [read(DigestPart, bytes(sample.payload)) for sample in ear.of("digest")]


def test_a_quiet_map_is_not_listed_again_and_again() -> None:
    """Once listed, a digest is a short summary with the same root."""
    with publishing() as (publisher, address), listening(address) as ear:
        publisher.offer(update(tile()))
        ear.wait("map/0/0/0/full")
        heard = len(ear.of("digest"))
        last = [read(DigestPart, bytes(sample.payload)) for sample in ear.wait("digest", heard + 4)][-2:]
        assert [(part.parts, part.tiles) for part in last] == [(0, 1), (0, 1)]


def test_the_liveliness_token_stands_while_the_publisher_lives() -> None:
    """Who asks for living robots finds it, and hears when it goes."""
    came, gone = threading.Event(), threading.Event()

    def notice(sample: zenoh.Sample) -> None:
        assert str(sample.key_expr) == "terrabound/v1/rover"
        (came if sample.kind == zenoh.SampleKind.PUT else gone).set()

    with publishing() as (publisher, address), open_session("client", connect=[address]) as session:
        session.liveliness().declare_subscriber(robot_key("*"), notice, history=True)
        assert came.wait(WAIT_S)
        assert not gone.is_set()
        publisher.close()
        assert gone.wait(WAIT_S)


def test_an_address_in_use_is_named_with_what_to_do_and_taken_once_it_is_free() -> None:
    """The second publisher at one address says which address, what is wrong and how to mend it, and goes on trying."""
    with ExitStack() as first:
        _, address = first.enter_context(publishing())
        second = Publisher(PublishConfig(listen=[address]), "rover")
        second.start()
        try:
            told = str(second.state()["failure"])
            assert re.match(rf"{address}: the address is in use; stop .* or choose another publish\.listen", told), told
            first.close()
            assert second.offer(update(tile(3)))
            assert second.flush(WAIT_S)
            assert second.state()["failure"] is None
        finally:
            second.close()


@pytest.mark.parametrize("address", ["7447", "tcp/127.0.0.1:99999999"])
def test_an_address_that_is_none_is_refused_by_name(address: str) -> None:
    """A garbled address never becomes a session that nobody can reach: neither configured nor opened."""
    with pytest.raises(ValidationError, match="address with a port up to 65535"):
        PublishConfig(listen=[address])
    with pytest.raises(LinkError, match=address), open_session("peer", [address]):
        pass


def test_an_address_that_this_host_does_not_have_yet_does_not_stop_mapping() -> None:
    """The radio may come up later: the failure is counted and said, offers never wait, and the end is orderly."""
    publisher = Publisher(PublishConfig(listen=["tcp/192.0.2.1:7447"]), "rover")
    publisher.start()
    assert publisher.offer(update(tile()))
    assert not publisher.offer(update(tile()))
    assert publisher.counts["offers_refused"] == 1
    assert publisher.state()["open"] is False
    assert "192.0.2.1" in str(publisher.state()["failure"])
    assert not publisher.flush(0.0)
    publisher.close()
    assert publisher.counts["session_failures"] >= 1


def test_what_can_not_be_published_is_told_and_the_next_goes_out() -> None:
    """A fault of ours in one tile ends neither the publisher nor the service: health says what it was."""
    broken = tile(7)
    object.__setattr__(broken, "low", None)
    with publishing() as (publisher, address):
        publisher.offer(update(broken))
        deadline = time.monotonic() + WAIT_S
        while not publisher.counts["session_failures"]:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert "could not publish" in str(publisher.state()["failure"])
        assert publisher.wait_until_ready(WAIT_S)
        publisher.offer(update(tile(3)))
        assert publisher.flush(WAIT_S)
        with open_session("client", connect=[address]) as session:
            assert [tile_of(sample) for sample in answers(session, "terrabound/v1/rover/map/**")] == [
                snap_outward(tile(3))
            ]


def test_a_full_mailbox_refuses_and_never_waits() -> None:
    """One slot: ready until it is filled, refused and counted while it is full."""
    publisher = Publisher(PublishConfig(), "rover")
    assert publisher.ready
    assert publisher.offer(update())
    assert not publisher.ready
    assert not publisher.offer(update())
    assert not publisher.wait_until_ready(0.0)


def test_health_that_is_no_json_is_counted_and_the_publisher_lives_on() -> None:
    """NaN in a health value costs that message, not the thread."""
    with publishing() as (publisher, address), listening(address) as ear:
        publisher.offer(MapUpdate((tile(),), None, None, {"rate": float("nan")}, INTACT, 0))
        assert "failure" in json.loads(bytes(ear.wait("health")[0].payload))
        ear.wait("map/0/0/0/full")
    assert publisher.counts["unsendable_health"] >= 1


@given(st.lists(st.integers(1, 50_000), min_size=1, max_size=60), st.sampled_from([10_000.0, 200_000.0, 1e7]))
def test_the_token_bucket_keeps_the_mean_rate(sizes: list[int], rate: float) -> None:
    """Over any run of messages no more than burst + one message + rate * time has been sent."""
    bucket, now_s, sent = TokenBucket(rate), 0.0, 0
    for size in sizes:
        while (delay_s := bucket.delay_s(now_s)) > 0:
            now_s += delay_s
        assert sent <= rate * now_s + max(65536.0, 0.05 * rate) + 1.0 * len(sizes)
        bucket.spend(size)
        sent += size


def test_links_have_short_send_buffers() -> None:
    """What lies in a long buffer is stale when it arrives."""
    assert with_send_buffer("tcp/0.0.0.0:7447") == "tcp/0.0.0.0:7447#so_sndbuf=65536"
    assert with_send_buffer("tls/robot:7447#a=b") == "tls/robot:7447#a=b;so_sndbuf=65536"
    assert with_send_buffer("tcp/0.0.0.0:7447#so_sndbuf=1") == "tcp/0.0.0.0:7447#so_sndbuf=1"
    assert with_send_buffer("udp/0.0.0.0:7447") == "udp/0.0.0.0:7447"


def test_a_narrow_link_slows_tiles_down_without_losing_what_changed() -> None:
    """With 200 kB/s allowed, tiles wait in the mailbox's coalescing map, and all arrive in the end."""
    address = free_locator()
    publisher = Publisher(PublishConfig(listen=[address], max_bytes_per_s=200_000, digest_period_s=0.1), "rover")
    publisher.start()
    tiles = [tile(ix, 0, seed=ix, share=1.0) for ix in range(20)]
    began = time.monotonic()
    publisher.offer(update(*tiles))
    assert publisher.flush(WAIT_S)
    elapsed_s = time.monotonic() - began
    sent = publisher.counts["bytes"]
    publisher.close()
    assert publisher.counts["full_tiles"] == 20
    assert sent - 40_000 <= 65536 + 20_000 + 200_000 * elapsed_s


def test_an_unseen_tile_is_nothing_to_publish() -> None:
    """A tile without a seen cell is neither sent nor listed."""
    with publishing() as (publisher, address), listening(address) as ear:
        publisher.offer(update(unseen_tile(0, 0, 0, 0.05)))
        assert publisher.flush(WAIT_S)
        with ear.changed:
            assert ear.changed.wait_for(lambda: _digests(ear)[-1].final, WAIT_S)
        assert _digests(ear)[-1].tiles == 0
        assert ear.of("map/**") == []
