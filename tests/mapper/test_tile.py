"""Laws of tiles: joining, deltas, snapping, and the digest's number, bit for bit."""

import zlib
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from mapper.tile import (
    NO_CELL,
    SNAP_M,
    Tile,
    changed,
    compile_tiles,
    content_crc,
    join,
    snap_outward,
    unseen_tile,
)
from mapper.tile_growth import grown

CELLS = arrays.arrays(
    np.float32,
    (2, 8),
    elements=st.one_of(
        st.floats(width=32, allow_infinity=False, allow_nan=True),
        st.floats(-3, 3, width=32),
        st.sampled_from([0.0, -0.0, SNAP_M, -SNAP_M, 2.0**14, -(2.0**14), 2.0**14 - SNAP_M]),
    ),
)


@st.composite
def some_tiles(draw: Callable[..., np.ndarray]) -> Tile:
    """Eight cells of any content, repeated over the tile; some surely hit, some settled, wherever they are seen."""
    a, b = draw(CELLS)
    unseen = np.isnan(a) | np.isnan(b)
    low, high = np.where(unseen, np.nan, np.minimum(a, b)), np.where(unseen, np.nan, np.maximum(a, b))
    flags, inside = draw(arrays.arrays(np.bool_, (2, 8)))
    c, d = (np.clip(row, low, high) for row in draw(CELLS))
    c, d = np.where(inside, np.minimum(c, d), np.nan), np.where(inside, np.maximum(c, d), np.nan)
    settled = (np.tile(layer, (64, 8)) for layer in (c, d)) if inside.any() else ()
    return a_tile(np.tile(low, (64, 8)), np.tile(high, (64, 8)), np.tile(flags & ~unseen, (64, 8)), *settled)


def a_tile(low: np.ndarray, high: np.ndarray, flags: np.ndarray = NO_CELL, *settled: np.ndarray) -> Tile:
    low, high, *settled_layers = (layer.astype(np.float32) for layer in (low, high, *settled))
    return Tile(0, -3, 5, 0.05, low, high, flags, *settled_layers)


def bits(layer: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(layer).view(np.uint32 if layer.dtype == np.float32 else np.uint8)


EMPTY = unseen_tile(0, -3, 5, 0.05)
compile_tiles()  # outside of any time that is taken


@given(some_tiles(), some_tiles(), some_tiles())
def test_join_is_commutative_associative_and_idempotent(a: Tile, b: Tile, c: Tile) -> None:
    """Bit for bit, unseen cells, negative zeros and odd NaNs included; the unseen tile is neutral."""
    assert join(a, b) == join(b, a)
    assert join(join(a, b), c) == join(a, join(b, c))
    assert join(a, a) == a
    assert join(join(a, b), b) == join(a, b)
    assert join(a, EMPTY) == a


@given(some_tiles(), some_tiles())
def test_join_contains_both(a: Tile, b: Tile) -> None:
    """A cell that was seen in one is in the join at least as wide."""
    both = join(a, b)
    for part in (a, b):
        seen = ~np.isnan(part.low)
        assert np.all(both.low[seen] <= part.low[seen])
        assert np.all(both.high[seen] >= part.high[seen])
        assert np.all(both.surely_hit >= part.surely_hit)
        settled = ~np.isnan(part.settled_low)
        assert np.all(both.settled_low[settled] <= part.settled_low[settled])
        assert np.all(both.settled_high[settled] >= part.settled_high[settled])
    assert both.cells_seen == np.count_nonzero(~np.isnan(a.low) | ~np.isnan(b.low))


@given(some_tiles(), some_tiles())
def test_a_delta_joined_to_the_old_tile_gives_the_new_one(old: Tile, more: Tile) -> None:
    """For a tile that grew from the old one, the delta holds exactly the cells that differ."""
    new = join(old, more)
    delta = changed(old, new)
    assert join(old, delta) == new
    assert changed(new, new) == EMPTY
    assert changed(None, new) == new
    held = ~np.isnan(delta.low)
    differs = np.any([bits(a) != bits(b) for a, b in zip(old.layers, new.layers, strict=True)], axis=0)
    assert np.array_equal(held, differs)


@given(some_tiles(), some_tiles())
def test_advancing_a_published_tile_is_joining_and_comparing_it(a: Tile, b: Tile) -> None:
    """What is done for each message in one go gives what its parts give, bit for bit."""
    old = snap_outward(a)
    new = join(old, snap_outward(b))
    delta, growth = changed(old, new), grown(old, b)
    assert growth.tile == new
    assert np.array_equal(growth.differs, ~np.isnan(delta.low))
    assert (growth.cells_changed, growth.cells_seen) == (delta.cells_seen, new.cells_seen)


@given(some_tiles(), some_tiles())
def test_snapping_is_outward_exact_and_idempotent_and_commutes_with_join(a: Tile, b: Tile) -> None:
    """Bounds move by at most 2^-9 m, outward, onto multiples of 2^-9 m; large ones stay as they are."""
    snapped = snap_outward(a)
    seen = ~np.isnan(a.low)
    low, high = snapped.low[seen].astype(np.float64), snapped.high[seen].astype(np.float64)
    assert np.all((low <= a.low[seen]) & (a.low[seen] - low <= SNAP_M))
    assert np.all((high >= a.high[seen]) & (high - a.high[seen] <= SNAP_M))
    assert np.all(low / SNAP_M == np.floor(low / SNAP_M))
    assert np.all(high / SNAP_M == np.floor(high / SNAP_M))
    assert snap_outward(snapped) == snapped
    assert snap_outward(join(a, b)) == join(snap_outward(a), snap_outward(b))


@given(some_tiles())
def test_the_digest_number_is_the_crc_of_the_snapped_bytes(tile: Tile) -> None:
    """Low, high, settled bounds if any, flags if any; little-endian, one kind of NaN; the same once snapped."""
    snapped = snap_outward(tile)
    content = snapped.low.tobytes() + snapped.high.tobytes()
    if not np.isnan(snapped.settled_low).all():
        content += snapped.settled_low.tobytes() + snapped.settled_high.tobytes()
    if snapped.surely_hit.any():
        content += snapped.surely_hit.tobytes()
    assert content_crc(tile) == content_crc(snapped) == zlib.crc32(content)


def test_the_digest_number_of_known_tiles() -> None:
    """Written down, so that a decoder elsewhere can check itself: an unseen tile, and one cell at [-0.001, 0.5]."""
    assert content_crc(EMPTY) == zlib.crc32(bytes.fromhex("0000c07f") * 8192)
    low, high = np.full((64, 64), np.nan, np.float32), np.full((64, 64), np.nan, np.float32)
    low[2, 1], high[2, 1] = -0.001, 0.5
    cell = 4 * (2 * 64 + 1)
    expected = bytearray(bytes.fromhex("0000c07f") * 8192)
    expected[cell : cell + 4] = bytes.fromhex("000000bb")  # -2^-9
    expected[16384 + cell : 16384 + cell + 4] = bytes.fromhex("0000003f")
    assert content_crc(a_tile(low, high)) == zlib.crc32(expected)


def test_tiles_are_canonical_read_only_and_their_own() -> None:
    """Signalling NaNs and negative zeros are gone, nobody can write into a tile, and its source may change."""
    low = np.zeros((64, 64), np.float32)
    low[0, 0] = -0.0
    low[1, 1] = np.uint32(0xFFC12345).view(np.float32)
    high = low.copy()
    tile = a_tile(low, high)
    low[5, 5] = 9.0
    assert tile.low[5, 5] == 0.0
    assert set(np.unique(tile.low.view(np.uint32))) == {0, 0x7FC00000}
    with pytest.raises(ValueError, match="read-only"):
        tile.low[0, 0] = 1.0


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (1.0, 0.0, "no interval"),
        (np.nan, 0.0, "one side"),
        (0.0, np.nan, "one side"),
        (-np.inf, 0.0, "no interval"),
        (0.0, np.inf, "no interval"),
    ],
)
def test_a_tile_that_holds_no_intervals_is_refused(low: float, high: float, words: str) -> None:
    """Crossed, one-sided and infinite bounds."""
    layer = np.zeros((64, 64))
    with pytest.raises(ValueError, match=words):
        a_tile(np.where(np.eye(64) > 0, low, layer), np.where(np.eye(64) > 0, high, layer))


def test_flags_and_settled_bounds_without_ground_are_refused() -> None:
    """A flag on an unseen cell, settled bounds outside the cell's own, and layers of another kind."""
    level, nothing = np.zeros((64, 64), np.float32), np.full((64, 64), np.nan, np.float32)
    everywhere = np.ones((64, 64), np.bool_)
    with pytest.raises(ValueError, match="surely hit, but unseen"):
        a_tile(nothing, nothing, everywhere)
    with pytest.raises(ValueError, match="not inside"):
        a_tile(level, level, everywhere, level, level + 1)
    with pytest.raises(ValueError, match="not inside"):
        a_tile(nothing, nothing, NO_CELL, level, level)
    with pytest.raises(ValueError, match=r"bool \[64, 64\]"):
        a_tile(level, level, level)


def test_only_tiles_of_one_place_are_joined_or_compared() -> None:
    """Another submap, index or resolution is refused, and named."""
    layer = np.zeros((64, 64), np.float32)
    for other in (
        Tile(1, -3, 5, 0.05, layer, layer),
        Tile(0, 3, 5, 0.05, layer, layer),
        Tile(0, -3, 5, 0.1, layer, layer),
    ):
        with pytest.raises(ValueError, match="tile"):
            join(EMPTY, other)
        with pytest.raises(ValueError, match="tile"):
            changed(EMPTY, other)
    with pytest.raises(ValueError, match=r"float32 \[64, 64\]"):
        Tile(0, 0, 0, 0.05, layer[1:], layer[1:])
