"""Tiles survive the wire; nothing else passes for a tile."""

import struct
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest
from backports import zstd
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from hypothesis import given
from hypothesis import strategies as st

from mapper.tile import Tile, changed, snap_outward, unseen_tile
from mapper.tile_codec import TileFormatError, decode, encode

STAMP = 1_700_000_000_123_456_789


def a_tile(ix: int = -3, iy: int = 5, resolution: float = 0.05) -> Tile:
    """Smooth ground with centimetre roughness, 46 % seen."""
    random = np.random.default_rng(1)
    y, x = np.mgrid[0:64, 0:64]
    low = (0.1 * np.sin(x / 9) + 0.1 * np.cos(y / 7) + random.normal(0, 0.01, (64, 64))).astype(np.float32)
    high = low + random.uniform(0.05, 0.1, (64, 64)).astype(np.float32)
    unseen = x + y < 66
    low[unseen], high[unseen] = np.nan, np.nan
    return Tile(4, ix, iy, resolution, low, high, ~unseen & (x % 3 == 0))


def settled(tile: Tile) -> Tile:
    """The tile of a map that keeps evidence: half of its cells are settled, somewhat inside their bounds."""
    random = np.random.default_rng(2)
    inset = ((tile.high - tile.low) * random.uniform(0, 0.5, (64, 64))).astype(np.float32)
    inset[random.random((64, 64)) < 0.5] = np.nan
    layers = tile.low + inset, np.maximum(tile.high - inset, tile.low + inset)
    return Tile(tile.submap, tile.ix, tile.iy, tile.resolution_m, tile.low, tile.high, tile.surely_hit, *layers)


def repacked(change: Callable[[Grid], object]) -> bytes:
    message = Grid()
    message.ParseFromString(zstd.decompress(encode(a_tile(), "map", STAMP)))
    change(message)
    return zstd.compress(message.SerializeToString())


@pytest.mark.parametrize("resolution", [0.05, 0.03, 0.005, 10.0])
@pytest.mark.parametrize("index", [0, -1, 1_000_003, -(2**24)])
def test_a_tile_comes_back_as_it_was_snapped(index: int, resolution: float) -> None:
    """Bit for bit, at every place, with the frame and the stamp."""
    tile = a_tile(index, -index, resolution)
    back = decode(encode(tile, "map/4", STAMP), submap=4)
    assert back.tile == snap_outward(tile)
    assert (back.frame_id, back.stamp_ns) == ("map/4", STAMP)


def test_settled_bounds_come_back_too() -> None:
    """Every layer of a tile with settled cells, bit for bit as snapped; its delta where they alone differ as well."""
    plain, tile = a_tile(), settled(a_tile())
    back = decode(encode(tile, "map", STAMP), 4).tile
    assert back == snap_outward(tile)
    assert back.has_settled
    delta = changed(snap_outward(plain), snap_outward(tile))
    assert delta.cells_seen == np.count_nonzero(~np.isnan(tile.settled_low))
    assert decode(encode(delta, "map", STAMP), 4).tile == delta
    assert len(encode(tile, "map", STAMP)) < 24_000


@pytest.mark.parametrize(("old", "new"), [(unseen_tile(4, -3, 5, 0.05), a_tile()), (a_tile(), settled(a_tile()))])
@pytest.mark.parametrize("part", [0.0, 0.01, 0.5, 1.0])
def test_a_delta_is_written_from_the_whole_tile(old: Tile, new: Tile, part: float) -> None:
    """Byte for byte what the delta itself would be, whichever cells it is of, settled or not."""
    random = np.random.default_rng(3)
    old, new = snap_outward(old), snap_outward(new)
    keep = random.random((64, 64)) < part
    layers = [np.where(keep, b, a) for a, b in zip(old.layers, new.layers, strict=True)]
    new = Tile(4, -3, 5, 0.05, *layers)
    delta = changed(old, new)
    assert encode(new, "map", STAMP, ~np.isnan(delta.low)) == encode(delta, "map", STAMP)


def test_a_tile_from_before_cells_had_flags_is_still_read() -> None:
    """Eight bytes a cell, two fields: the same elevations, nothing surely hit."""
    tile = snap_outward(a_tile())
    old = Grid()
    old.ParseFromString(zstd.decompress(encode(tile, "map", STAMP)))
    del old.fields[2:]
    old.cell_stride, old.row_stride = 8, 512
    old.data = np.stack((tile.low, tile.high), axis=-1).astype("<f4").tobytes()
    back = decode(zstd.compress(old.SerializeToString()), 4).tile
    assert back == Tile(4, -3, 5, 0.05, tile.low, tile.high)


def test_deltas_and_unseen_tiles_are_small() -> None:
    """A delta is the same message; a change of 5 % of the cells takes under a kilobyte, a tile well below 33 KB."""
    tile = a_tile()
    high = tile.high.copy()
    high.ravel()[::20] += np.float32(0.01)
    delta = changed(snap_outward(tile), snap_outward(Tile(4, -3, 5, 0.05, tile.low, high, tile.surely_hit)))
    assert decode(encode(delta, "map", STAMP), 4).tile == delta
    assert len(encode(delta, "map", STAMP)) < 1000
    assert len(encode(tile, "map", STAMP)) < 12_000
    assert len(encode(unseen_tile(0, 0, 0, 0.05), "map", STAMP)) < 200


def test_pure_noise_stays_below_what_a_slow_link_passes() -> None:
    """Every cell random over kilometres: below 37 KiB, and it decodes; with settled bounds below what is ever sent."""
    tile = noise(9000.0)
    payload = encode(tile, "map", STAMP)
    assert len(payload) < 37 * 1024
    assert decode(payload, 0).tile == snap_outward(tile)
    assert len(encode(settled(noise(30.0)), "map", STAMP)) < 48 * 1024
    assert len(encode(settled(noise(9000.0)), "map", STAMP)) < 63 * 1024


def noise(height_m: float) -> Tile:
    random = np.random.default_rng(3)
    low = random.uniform(-height_m, height_m, (64, 64)).astype(np.float32)
    high = low + random.uniform(0, height_m / 10, (64, 64)).astype(np.float32)
    return Tile(0, 0, 0, 0.05, low, high, random.random((64, 64)) < 0.5)


def test_the_message_is_what_the_format_page_says() -> None:
    """Field by field, as a stranger's decoder with foxglove's schema sees it."""
    tile = a_tile()
    message = Grid()
    message.ParseFromString(zstd.decompress(encode(tile, "map", STAMP)))
    assert (message.timestamp.seconds, message.timestamp.nanos) == (1_700_000_000, 123_456_789)
    assert message.frame_id == "map"
    assert (message.pose.position.x, message.pose.position.y) == (-3 * 64 * 0.05, 5 * 64 * 0.05)
    assert message.pose.orientation.w == 1.0
    assert (message.cell_size.x, message.cell_size.y) == (0.05, 0.05)
    assert (message.column_count, message.row_stride, message.cell_stride) == (64, 576, 9)
    assert [(field.name, field.offset, field.type) for field in message.fields] == [
        ("elevation_min", 0, 7),
        ("elevation_max", 4, 7),
        ("surely_hit", 8, 1),
    ]
    snapped = snap_outward(tile)
    row, column = 60, 40
    assert struct.unpack_from("<ffB", message.data, row * 576 + column * 9) == (
        snapped.low[row, column],
        snapped.high[row, column],
        column % 3 == 0,
    )
    assert struct.unpack_from("<I", message.data, 0) == (0x7FC00000,)


@given(st.binary(max_size=300))
def test_random_bytes_are_never_anything_but_a_format_error(data: bytes) -> None:
    """As they are, as a zstd frame's content, and behind a frame's magic number."""
    for payload in (data, zstd.compress(data), b"\x28\xb5\x2f\xfd" + data):
        with pytest.raises(TileFormatError):
            decode(payload, 0)


@given(st.integers(0, 10**9), st.integers(0, 255), st.booleans())
def test_a_damaged_payload_is_a_tile_or_a_format_error(place: int, value: int, inside: bool) -> None:
    """One byte changed, outside or inside the compression, never raises anything else."""
    payload = encode(a_tile(), "map", STAMP)
    damaged = bytearray(zstd.decompress(payload) if inside else payload)
    damaged[place % (200 if inside else len(damaged))] = value
    with suppress(TileFormatError):
        decode(zstd.compress(bytes(damaged)) if inside else bytes(damaged), 0)


@pytest.mark.parametrize("cut", [0, 1, 5, 100, -1])
def test_a_payload_cut_short_says_so(cut: int) -> None:
    """Truncation is always noticed."""
    with pytest.raises(TileFormatError, match="cut short"):
        decode(encode(a_tile(), "map", STAMP)[:cut], 0)


def test_bombs_and_trailing_bytes_are_refused_within_bounds() -> None:
    """A frame that grows beyond a tile, one with a huge window, an oversized payload, and bytes after the frame."""
    small = {int(zstd.CompressionParameter.window_log): 17}
    with pytest.raises(TileFormatError, match="more than"):
        decode(zstd.compress(bytes(30_000_000), options=small), 0)
    with pytest.raises(TileFormatError, match="too much memory"):
        decode(zstd.compress(bytes(30_000_000)), 0)
    with pytest.raises(TileFormatError, match="at most"):
        decode(bytes(70_000), 0)
    with pytest.raises(TileFormatError, match="after the zstd frame"):
        decode(encode(a_tile(), "map", STAMP) + b"x", 0)


def poke(value: float, lane: int) -> Callable[[Grid], object]:
    def change(message: Grid) -> None:
        data = bytearray(message.data)
        struct.pack_into("<f" if lane < 2 else "<B", data, 63 * 576 + 63 * 9 + 4 * lane, value if lane < 2 else 2)
        message.data = bytes(data)

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: setattr(m, "column_count", 32), "column_count"),
        (lambda m: setattr(m, "row_stride", 0), "row_stride"),
        (lambda m: setattr(m, "cell_stride", 16), "cell_stride"),
        (lambda m: setattr(m, "data", m.data[:-1]), "bytes of data"),
        (lambda m: setattr(m.fields[0], "name", "elevation"), "fields"),
        (lambda m: setattr(m.fields[1], "offset", 0), "fields"),
        (lambda m: setattr(m.fields[1], "type", 8), "FLOAT32"),
        (lambda m: m.fields.add(), "fields"),
        (lambda m: setattr(m.cell_size, "y", 0.1), "cell_size"),
        (lambda m: m.cell_size.Clear(), "cell_size"),
        (lambda m: setattr(m.cell_size, "x", np.nan), "cell_size"),
        (lambda m: setattr(m.pose.position, "x", 0.01), "corner"),
        (lambda m: setattr(m.pose.position, "x", np.nan), "is at"),
        (lambda m: setattr(m.pose.position, "y", np.inf), "is at"),
        (lambda m: setattr(m.pose.position, "z", 1.0), "raised"),
        (lambda m: setattr(m.pose.orientation, "z", 0.1), "turned"),
        (poke(np.inf, 1), "no interval"),
        (poke(99.0, 0), "no interval"),
        (poke(np.nan, 0), "one side"),
        (poke(1.0, 2), "surely_hit"),
    ],
)
def test_wrong_geometry_is_refused_and_named(change: Callable[[Grid], object], words: str) -> None:
    """Each field that must have one value is checked, and the error says what was found."""
    with pytest.raises(TileFormatError, match=words):
        decode(repacked(change), 0)


ODD = (0.0, -0.0, 1.0, -1.0, 2.0**-149, 3.4e38, np.inf, -np.inf, np.nan)
"""Values whose order, sign or being a number is a matter of its own."""
PATTERNS = [int(np.float32(value).view(np.uint32)) for value in ODD] + [0x7FC00001, 0xFFC00000, 0x7F800001]


@given(st.integers(0, 4095), st.sampled_from(PATTERNS), st.sampled_from(PATTERNS), st.sampled_from([0, 1, 2, 255]))
def test_whatever_stands_in_a_cell_is_taken_or_refused_as_by_the_tile_itself(
    cell: int, low: int, high: int, flag: int
) -> None:
    """Bit for bit: no NaN but one, no negative zero, and no cell that is no interval of finite numbers."""

    def change(message: Grid) -> None:
        data = bytearray(message.data)
        struct.pack_into("<IIB", data, 9 * cell, low, high, flag)
        message.data = bytes(data)

    payload, whole = repacked(change), snap_outward(a_tile())
    lows, highs, hits = whole.low.copy(), whole.high.copy(), whole.surely_hit.copy()
    lows.ravel().view(np.uint32)[cell], highs.ravel().view(np.uint32)[cell] = low, high
    hits.ravel()[cell] = flag == 1
    try:
        expected = None if flag > 1 else Tile(whole.submap, whole.ix, whole.iy, whole.resolution_m, lows, highs, hits)
    except ValueError:
        expected = None
    if expected is None:
        with pytest.raises(TileFormatError):
            decode(payload, whole.submap)
    else:
        assert decode(payload, whole.submap).tile == expected
