"""JSON messages: what is written is read, and nothing else is."""

import json
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.bounded_pose import Anchor, BoundedPose, Guarantee, PlanarEllipsoid
from service.digest import DIGEST_PART_TILES, DigestAssembly, DigestEntry, DigestPart, digest_parts, digest_root
from service.messages import (
    GuaranteeMessage,
    MalformedMessage,
    TileNote,
    guarantee_message,
    read,
    read_anchor,
    read_plain,
    read_pose,
    write,
    write_anchor,
    write_note,
    write_pose,
)

times = st.integers(-(2**62), 2**62)
numbers = st.floats(allow_nan=False, allow_infinity=False)
guarantees = st.one_of(
    st.just(Guarantee()),
    st.builds(Guarantee, times, st.sampled_from(["gps", "tilt"]), restored_ns=times, contradicted_ns=times),
)


def bounds(size: int) -> st.SearchStrategy[tuple[list[float], list[float]]]:
    """[low, high] of `size` axes; either side may be infinite."""
    axis = st.tuples(st.floats(allow_nan=False, max_value=1e308), st.floats(allow_nan=False, min_value=-1e308))
    ordered = axis.map(lambda pair: (min(pair), max(pair)))
    return st.lists(ordered, min_size=size, max_size=size).map(
        lambda rows: ([a for a, _ in rows], [b for _, b in rows])
    )


@given(times, times, bounds(6), guarantees)
def test_a_pose_comes_back_bit_for_bit(
    earliest: int, latest: int, box: tuple[list[float], list[float]], guarantee: Guarantee
) -> None:
    """JSON loses no bit of a bound, infinite ones included: outward rounding survives the wire."""
    pose = BoundedPose(earliest, latest, np.array(box[0]), np.array(box[1]), guarantee)
    back = read_pose(write_pose(pose))
    assert (back.earliest_ns, back.latest_ns, back.guarantee) == (earliest, latest, guarantee)
    outward = np.where(np.isfinite(pose.low), pose.low, -np.inf), np.where(np.isfinite(pose.high), pose.high, np.inf)
    assert back.low.tolist() == outward[0].tolist()
    assert back.high.tolist() == outward[1].tolist()


@given(st.lists(numbers, min_size=12, max_size=12))
def test_a_pose_kept_as_an_ellipsoid_brings_it_along(values: list[float]) -> None:
    """Centre, shape and their own time survive bit for bit; who knows nothing of ellipsoids reads the box alone."""
    ellipsoid = PlanarEllipsoid(3, 4, np.array(values[:3]), np.array(values[3:]).reshape(3, 3))
    text = write_pose(BoundedPose(1, 2, np.zeros(6), np.ones(6), ellipsoid=ellipsoid))
    back = read_pose(text).ellipsoid
    assert back is not None
    assert (back.earliest_ns, back.latest_ns) == (3, 4)
    assert back.centre.tolist() == ellipsoid.centre.tolist()
    assert back.shape.tolist() == ellipsoid.shape.tolist()
    earlier = {key: value for key, value in json.loads(text).items() if key != "ellipsoid"}
    assert read_pose(json.dumps(earlier).encode()).ellipsoid is None


@pytest.mark.parametrize("broken", [{"centre": [0.0, 0.0]}, {"shape": [[1.0] * 3] * 2}, {"shape": None}, {}])
def test_half_an_ellipsoid_is_refused(broken: dict[str, Any]) -> None:
    """A pose whose ellipsoid lacks something is malformed, not read without it."""
    whole = json.loads(write_pose(BoundedPose(1, 2, np.zeros(6), np.ones(6))))
    ellipsoid = {"earliest_ns": 3, "latest_ns": 4, "centre": [0.0] * 3, "shape": [[1.0] * 3] * 3}
    whole["ellipsoid"] = ellipsoid | broken if broken else {"centre": [0.0] * 3}
    with pytest.raises(MalformedMessage):
        read_pose(json.dumps(whole).encode())


def test_the_newest_guarantee_judges_what_was_published_before() -> None:
    """What reaches into the doubt is taken back, also if it was called intact; what came before, or after, is not."""
    lasting = Guarantee(void_since_ns=100, sensor="gps", contradicted_ns=140)
    assert lasting.covers(80, 99)
    assert not lasting.covers(80, 100)
    assert not lasting.covers(900, 901)
    over = replace(lasting, restored_ns=300)
    assert over.covers(300, 310)
    assert not over.covers(290, 310)
    assert Guarantee().covers(0, 10**18)


@given(numbers, numbers, numbers, bounds(4), guarantees)
def test_an_anchor_comes_back_bit_for_bit(
    lat: float, lon: float, alt: float, box: tuple[list[float], list[float]], guarantee: Guarantee
) -> None:
    """The same for the map's place on Earth."""
    anchor = Anchor(lat, lon, alt, np.array(box[0]), np.array(box[1]), guarantee)
    back = read_anchor(write_anchor(anchor))
    assert (back.origin_lat_deg, back.origin_lon_deg, back.origin_alt_m, back.guarantee) == (lat, lon, alt, guarantee)
    assert np.all(back.low <= anchor.low)
    assert np.all(back.high >= anchor.high)


def test_a_bound_that_is_nan_is_no_bound() -> None:
    """NaN never reaches the wire: the axis becomes unbounded, which is sound."""
    pose = BoundedPose(0, 1, np.full(6, np.nan), np.full(6, np.nan))
    back = read_pose(write_pose(pose))
    assert np.all(back.low == -np.inf)
    assert np.all(back.high == np.inf)


@given(st.binary(max_size=300))
def test_no_bytes_break_a_reader(data: bytes) -> None:
    """Messages come from strangers: any bytes are either understood or refused."""
    for kind in (TileNote, DigestPart):
        with pytest.raises(MalformedMessage):
            read(kind, data)
    for reader in (read_pose, read_anchor):
        with pytest.raises(MalformedMessage):
            reader(data)


@pytest.mark.parametrize("data", [b"[" * 100_000, b"[1]", b'"text"', b"\xff\xfe", b" " * 1_000_000])
def test_deep_odd_and_huge_json_is_refused(data: bytes) -> None:
    """Nesting, other types than an object, bad text and sheer size are refused, not raised as something else."""
    with pytest.raises(MalformedMessage):
        read_plain(data)
    with pytest.raises(MalformedMessage):
        read(DigestPart, data)


@pytest.mark.parametrize(
    ("key", "value"),
    [("epoch", 7), ("epoch", ""), ("version", -1), ("version", "1"), ("released_ns", 1.5), ("guarantee", None)],
)
def test_a_value_of_the_wrong_kind_is_refused(key: str, value: object) -> None:
    """Numbers are numbers and names are names; nothing is converted."""
    good = json.loads(write(TileNote("a", 1, GuaranteeMessage(intact=True), 5)))
    assert read(TileNote, json.dumps(good | {"added_later": 1}).encode()).version == 1
    with pytest.raises(MalformedMessage):
        read(TileNote, json.dumps(good | {key: value}).encode())


def test_a_pose_with_low_above_high_is_refused() -> None:
    """An empty box can't be a pose set."""
    data = json.loads(write_pose(BoundedPose(0, 1, np.zeros(6), np.ones(6))))
    data["low"][3] = 2.0
    with pytest.raises(MalformedMessage):
        read_pose(json.dumps(data).encode())


entries = st.lists(
    st.builds(DigestEntry, st.integers(0, 3), st.integers(-99, 99), st.integers(-99, 99), st.integers(0, 2**32 - 1)),
    unique_by=lambda entry: entry.tile,
)


@given(entries, st.randoms())
def test_the_root_does_not_depend_on_the_order_of_entries_but_on_each_of_them(
    listed: list[DigestEntry], random: Random
) -> None:
    """Same map, same root; one CRC changed, another root."""
    shuffled = list(listed)
    random.shuffle(shuffled)
    assert digest_root(shuffled) == digest_root(listed)
    if listed:
        assert digest_root([listed[0]._replace(crc=listed[0].crc ^ 1), *listed[1:]]) != digest_root(listed)


@pytest.mark.parametrize("count", [0, 1, DIGEST_PART_TILES, DIGEST_PART_TILES + 1, 2500])
def test_a_digest_of_any_size_arrives_whole_in_messages_that_fit_a_slow_link(count: int) -> None:
    """Each part stays below 48 KiB; all parts together, in any order, list every tile."""
    listed = [DigestEntry(2**31, -(2**31) + i, 2**31 - 1, 2**32 - 1) for i in range(count)]
    messages = [write(part) for part in digest_parts("e" * 16, 10**6, False, listed, digest_root(listed))]
    assert max(map(len, messages)) < 48 * 1024
    assembly = DigestAssembly()
    results = [assembly.add(read(DigestPart, message)) for message in reversed(messages)]
    assert results[:-1] == [None] * (len(messages) - 1)
    assert results[-1] == {entry.tile: entry.crc for entry in listed}


def test_a_listing_with_a_missing_part_is_never_taken_for_a_whole_one() -> None:
    """Parts of two listings don't mix; parts whose root doesn't fit are refused."""
    listed = [DigestEntry(0, i, 0, i) for i in range(1500)]
    first = list(digest_parts("e", 1, False, listed, digest_root(listed)))
    second = list(digest_parts("e", 2, False, listed, digest_root(listed)))
    assembly = DigestAssembly()
    assert assembly.add(first[0]) is None
    assert assembly.add(second[1]) is None
    assert assembly.add(second[0]) is not None
    forged = list(digest_parts("e", 3, False, listed, digest_root(listed) ^ 1))
    assert assembly.add(forged[0]) is None
    with pytest.raises(MalformedMessage):
        assembly.add(forged[1])


@given(guarantees, st.none() | times, st.none() | times)
def test_a_note_written_in_haste_is_the_note(
    guarantee: Guarantee, released_ns: int | None, until_ns: int | None
) -> None:
    """Byte for byte what the general writer makes of it."""
    message = guarantee_message(guarantee)
    note = TileNote("0123456789abcdef", 7, message, released_ns, until_ns)
    assert write_note(note.epoch, note.version, write(message), released_ns, until_ns) == write(note)
