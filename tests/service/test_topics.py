"""Keys on the wire."""

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from zenoh import Priority

from service.topics import (
    DIGEST,
    POSE,
    REPAIR_PRIORITY,
    TILE,
    TOPICS,
    TileKey,
    parse_tile_key,
    robot_key,
    split_key,
    tile_key,
    topic_key,
)

robots = st.from_regex(r"[A-Za-z0-9_-]+", fullmatch=True)
indices = st.integers(-(2**31), 2**31 - 1)


@given(robots, st.integers(0, 2**31 - 1), indices, indices, st.sampled_from(["full", "delta"]))
def test_a_tile_key_reads_back_as_it_was_written(robot: str, submap: int, ix: int, iy: int, kind: str) -> None:
    """parse_tile_key is the inverse of tile_key, for negative indices as well."""
    expected = TileKey(robot, submap, ix, iy, "full" if kind == "full" else "delta")
    assert parse_tile_key(tile_key(*expected)) == expected


@pytest.mark.parametrize(
    "key",
    [
        "",
        "terrabound/v1/rover/pose",
        "terrabound/v1/rover/map/0/1/2",
        "terrabound/v1/rover/map/0/1/2/partial",
        "terrabound/v1/rover/map/0/1/2/full/more",
        "terrabound/v2/rover/map/0/1/2/full",
        "terrabound/v1/rover/map/-1/1/2/full",
        "terrabound/v1/rover/map/0/01/2/full",
        "terrabound/v1/rover/map/0/-0/2/full",
        "terrabound/v1/rover/map/0/٣/2/full",
        "terrabound/v1/rover/map/0/1/2/full\n",
        "terrabound/v1/ro*ver/map/0/1/2/full",
        "terrabound/v1/rover/map/0/99999999999999999999/2/full",
    ],
)
def test_a_key_that_is_no_tile_is_no_tile(key: str) -> None:
    """Each tile has exactly one spelling; everything else is refused without an exception."""
    assert parse_tile_key(key) is None


@given(st.text())
def test_no_text_breaks_the_key_parsers(key: str) -> None:
    """Keys come from strangers: any text is either understood or refused."""
    parse_tile_key(key)
    split_key(key)


def test_every_key_is_one_that_zenoh_accepts_and_one_pattern_covers_them_all() -> None:
    """Subscribing to terrabound/v1/<robot>/** receives the whole table."""
    everything = zenoh.KeyExpr(f"{robot_key('rover')}/**")
    keys = [topic_key("rover", topic) for topic in TOPICS if topic is not TILE]
    keys += [tile_key("rover", 0, -3, 4, "full"), tile_key("rover", 0, -3, 4, "delta")]
    for key in keys:
        assert everything.includes(zenoh.KeyExpr(key))


def test_a_key_splits_into_robot_and_topic() -> None:
    """split_key undoes topic_key, and tells the liveliness token from the topics."""
    assert split_key(topic_key("rover", DIGEST)) == ("rover", "digest")
    assert split_key(robot_key("rover")) == ("rover", "")
    assert split_key("weather/v1/rover/pose") is None


def test_a_narrow_link_loses_tiles_before_it_loses_the_pose() -> None:
    """The pose comes first in the table of priorities, tiles and their digest last, repair behind everything."""
    order = [Priority.REAL_TIME, Priority.INTERACTIVE_HIGH, Priority.INTERACTIVE_LOW]
    order += [Priority.DATA_HIGH, Priority.DATA, Priority.DATA_LOW, Priority.BACKGROUND]
    rank = {topic.name: order.index(topic.priority) for topic in TOPICS}
    assert min(rank, key=rank.__getitem__) == POSE.name
    assert {name for name in rank if rank[name] == max(rank.values())} == {TILE.name, DIGEST.name}
    assert order.index(REPAIR_PRIORITY) > rank[TILE.name]
