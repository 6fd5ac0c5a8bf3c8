"""A tile on the wire: `foxglove.Grid` protobuf, compressed with zstd. docs/tile-format.md says it byte by byte.

Encode and decode stand side by side. The decoder is strict: whatever is not exactly such a tile is a TileFormatError.
A cell is a record of `_PLAIN`, or of `_SETTLED` where any cell of the tile is settled; `_BARE` is what robots sent
before cells had flags.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from backports import zstd
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from drivers.compiled import compiled
from mapper.grid import TILE_CELLS, TILE_SIDE, tile_corner_m
from mapper.tile import (
    NAN,
    NO_CELL,
    NOWHERE,
    ZERO,
    Flags,
    Layer,
    Tile,
    sealed_tile,
    snapped_down,
    snapped_up,
    unseen_tile,
)

_COMPRESSOR = zstd.ZstdCompressor(level=1)
"""Each call makes a frame of its own."""
_LARGEST_PAYLOAD = 63 * 1024
"""Larger messages are cut up on the way. A plain tile takes at most 37 KiB, whatever is in it; one with settled bounds
at most 48 KiB where the elevations are noise over 60 m, and 61 KiB over 18 km."""
_LARGEST_MESSAGE = 72 * 1024
_WINDOW_LOG = 20
"""No payload can ask for more than 1 MiB of memory; level 1 asks for 512 KiB at most."""
_BARE = np.dtype([("elevation_min", "<f4"), ("elevation_max", "<f4")])
_PLAIN = np.dtype([*_BARE.descr, ("surely_hit", "u1")])
_SETTLED = np.dtype([*_BARE.descr, ("settled_min", "<f4"), ("settled_max", "<f4"), ("surely_hit", "u1")])
_TYPES = {np.dtype("<f4"): PackedElementField.FLOAT32, np.dtype("u1"): PackedElementField.UINT8}
_NS = 1_000_000_000


class TileFormatError(ValueError):
    """A payload is not a tile; the text says what was found."""


@dataclass(frozen=True, slots=True)
class ReceivedTile:
    """A tile as it came, with what else the message says."""

    tile: Tile
    frame_id: str
    stamp_ns: int
    """Wall clock, since 1970."""


def encode(tile: Tile, frame_id: str, stamp_ns: int, cells: Flags | None = None) -> bytes:
    """The payload of a tile, snapped outward to 2^-9 m; a delta where only these `cells` are told of, all of them seen.

    stamp_ns: wall clock.
    """
    wanted = tile.low == tile.low if cells is None else cells
    settled = tile.has_settled and (cells is None or bool((tile.settled_low == tile.settled_low)[cells].any()))
    record = _SETTLED if settled else _PLAIN
    seconds, nanos = divmod(stamp_ns, _NS)
    # Serialised messages, one after the other, are the serialised union of their fields.
    message = bytearray(Grid(timestamp=Timestamp(seconds=seconds, nanos=nanos)).SerializeToString())
    message += _around_cells(frame_id, tile.ix, tile.iy, tile.resolution_m, record)
    begin = len(message)
    message += _UNSEEN[record]
    records = np.frombuffer(message, np.uint8, offset=begin)
    if settled:
        _pack(tile.settled_low, tile.settled_high, tile.surely_hit, wanted, records, record.itemsize, 8)
    _pack(tile.low, tile.high, tile.surely_hit, wanted, records, record.itemsize, 0)
    return _COMPRESSOR.compress(message, zstd.ZstdCompressor.FLUSH_FRAME)


def compile_codec() -> None:
    """Have the machine code made now, so that no message waits for it."""
    decode(encode(unseen_tile(0, 0, 0, 1.0), "", 0), 0)


@compiled
def _pack(
    low: Layer, high: Layer, surely_hit: Flags, wanted: Flags, cells: NDArray[np.uint8], stride: int, at: int
) -> None:
    """Two elevations, snapped outward, into the records of wanted cells, from byte `at` on; the flag at their end.

    A NaN is written as it stands there already.
    """
    eights = wanted.view(np.uint64)
    for row in range(TILE_SIDE):
        for eight in range(TILE_SIDE // 8):
            if eights[row, eight] == np.uint64(0):
                continue
            for col in range(8 * eight, 8 * eight + 8):
                if not wanted[row, col]:
                    continue
                start = (row * TILE_SIDE + col) * stride
                a = np.float32(snapped_down(low[row, col])).view(np.uint32)
                b = np.float32(snapped_up(high[row, col])).view(np.uint32)
                for byte in range(4):
                    cells[start + at + byte] = np.uint8((a >> np.uint32(8 * byte)) & np.uint32(0xFF))
                    cells[start + at + 4 + byte] = np.uint8((b >> np.uint32(8 * byte)) & np.uint32(0xFF))
                cells[start + stride - 1] = surely_hit[row, col]


def _unseen_cells(record: np.dtype[np.void]) -> bytes:
    """The records of a tile that says nothing, byte by byte."""
    cells = np.zeros(TILE_CELLS, record)
    for name, (kind, *_) in (record.fields or {}).items():
        if kind.kind == "f":
            cells[name] = NOWHERE.ravel()
    return cells.tobytes()


_UNSEEN = {record: _unseen_cells(record) for record in (_PLAIN, _SETTLED)}


@lru_cache(maxsize=1024)
def _around_cells(frame_id: str, ix: int, iy: int, resolution_m: float, record: np.dtype[np.void]) -> bytes:
    """What a tile's messages say alike, up to the bytes of its cells: serialised."""
    around = Grid(
        frame_id=frame_id,
        column_count=TILE_SIDE,
        row_stride=TILE_SIDE * record.itemsize,
        cell_stride=record.itemsize,
    )
    around.pose.position.x, around.pose.position.y = tile_corner_m(ix, iy, resolution_m)
    around.pose.orientation.w = 1.0
    around.cell_size.x = around.cell_size.y = resolution_m
    for name, offset, kind in _fields(record):
        around.fields.add(name=name, offset=offset, type=kind)
    size = len(_UNSEEN[record])
    before_cells = Grid(data=bytes(size)).SerializeToString()[:-size]
    return around.SerializeToString(deterministic=True) + before_cells


def decode(payload: bytes, submap: int) -> ReceivedTile:
    """The tile in a payload; its submap stands in the key, not in the payload."""
    message = Grid()
    try:
        message.ParseFromString(_decompress(payload))
    except DecodeError as error:
        raise TileFormatError(f"no protobuf message: {error}") from error
    record = _layout(message)
    resolution = message.cell_size.x
    ix, iy = _check_geometry(message, record.itemsize)
    tile = _plain_tile(submap, ix, iy, resolution, message.data) if record is _PLAIN else None
    if tile is None:
        cells = np.frombuffer(message.data, record).reshape(TILE_SIDE, TILE_SIDE)
        try:
            tile = Tile(submap, ix, iy, resolution, *_layers(cells))
        except ValueError as error:
            raise TileFormatError(str(error)) from error
    return ReceivedTile(tile, message.frame_id, message.timestamp.seconds * _NS + message.timestamp.nanos)


def _plain_tile(submap: int, ix: int, iy: int, resolution_m: float, data: bytes) -> Tile | None:
    """The tile in the bytes of plain records, most of all that come; None where it isn't one, or says nothing."""
    shape = TILE_SIDE, TILE_SIDE
    low, high, hit = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.bool_)
    seen, hits = _unpack(np.frombuffer(data, np.uint8), _PLAIN.itemsize, low, high, hit)
    return sealed_tile(submap, ix, iy, resolution_m, low, high, hit if hits else NO_CELL) if seen else None


@compiled
def _unpack(cells: NDArray[np.uint8], stride: int, low: Layer, high: Layer, hit: Flags) -> tuple[int, int]:
    """Plain records into canonical layers; how many cells are seen and hit, 0 and 0 where one is no cell's record."""
    seen = hits = 0
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            start = (row * TILE_SIDE + col) * stride
            a = b = np.uint32(0)
            for byte in range(4):
                a |= np.uint32(cells[start + byte]) << np.uint32(8 * byte)
                b |= np.uint32(cells[start + 4 + byte]) << np.uint32(8 * byte)
            least, most, flag = np.uint32(a).view(np.float32), np.uint32(b).view(np.float32), cells[start + 8]
            if -np.inf < least <= most < np.inf and flag <= 1:
                low[row, col], high[row, col] = least + ZERO, most + ZERO
                hit[row, col] = flag == 1
                seen += 1
                hits += flag
            elif least != least and most != most and flag == 0:
                low[row, col] = high[row, col] = NAN
                hit[row, col] = False
            else:
                return 0, 0
    return seen, hits


def _fields(record: np.dtype[np.void]) -> list[tuple[str, int, int]]:
    """Name, offset and Foxglove's type of each field of a cell."""
    fields: Mapping[str, tuple[Any, ...]] = record.fields or {}
    return [(name, offset, _TYPES[kind]) for name, (kind, offset, *_) in fields.items()]


_FIELDS = {record: _fields(record) for record in (_PLAIN, _SETTLED, _BARE)}


def _layers(cells: NDArray[np.void]) -> tuple[Layer, Layer, Flags, Layer, Layer]:
    """The layers of received cells; a field that the robot does not send says nothing."""
    names = cells.dtype.names or ()
    flags = cells["surely_hit"] if "surely_hit" in names else NO_CELL
    if np.any(flags > 1):
        raise ValueError("surely_hit is neither 0 nor 1")
    low, high, settled_low, settled_high = (
        cells[name].astype(np.float32) if name in names else NOWHERE
        for name in ("elevation_min", "elevation_max", "settled_min", "settled_max")
    )
    return low, high, flags.astype(np.bool_), settled_low, settled_high


def _decompress(payload: bytes) -> bytes:
    """Undo zstd, bounded whatever the frame's header claims."""
    if len(payload) > _LARGEST_PAYLOAD:
        raise TileFormatError(f"{len(payload)} bytes; a tile has at most {_LARGEST_PAYLOAD}")
    frame = zstd.ZstdDecompressor(options={zstd.DecompressionParameter.window_log_max: _WINDOW_LOG})
    try:
        message = frame.decompress(payload, max_length=_LARGEST_MESSAGE)
    except zstd.ZstdError as error:
        raise TileFormatError(f"no zstd frame: {error}") from error
    if not frame.eof:
        found = "a frame cut short" if frame.needs_input else f"more than {_LARGEST_MESSAGE} bytes when decompressed"
        raise TileFormatError(found)
    if frame.unused_data:
        raise TileFormatError(f"{len(frame.unused_data)} bytes after the zstd frame")
    return message


def _check_geometry(message: Grid, stride: int) -> tuple[int, int]:
    """The tile's indices, if the message is laid out as a tile of records of so many bytes."""
    layout = (message.column_count, message.row_stride, message.cell_stride, len(message.data))
    expected = (TILE_SIDE, TILE_SIDE * stride, stride, TILE_CELLS * stride)
    if layout != expected:
        raise TileFormatError(f"column_count, row_stride, cell_stride, bytes of data are {layout}, not {expected}")
    side, position, turn = message.cell_size.x, message.pose.position, message.pose.orientation
    if not (0.0 < side < 1e6 and message.cell_size.y == side):
        raise TileFormatError(f"cell_size is {side} x {message.cell_size.y} m")
    if (turn.x, turn.y, turn.z, turn.w) != (0.0, 0.0, 0.0, 1.0) or position.z != 0.0:
        raise TileFormatError("the pose is turned or raised")
    if not (abs(position.x) < 2**31 * side and abs(position.y) < 2**31 * side):  # False for NaN
        raise TileFormatError(f"the tile is at ({position.x}, {position.y}) m")
    indices = round(position.x / (TILE_SIDE * side)), round(position.y / (TILE_SIDE * side))
    if tile_corner_m(*indices, side) != (position.x, position.y):
        raise TileFormatError(f"({position.x}, {position.y}) m is no corner of a tile of {side} m cells")
    return indices


def _layout(message: Grid) -> np.dtype[np.void]:
    """The record of one cell."""
    fields = [(field.name, field.offset, field.type) for field in message.fields]
    for record, its_fields in _FIELDS.items():
        if fields == its_fields:
            return record
    raise TileFormatError(f"fields are {fields}, not {_fields(_PLAIN)} nor {_fields(_SETTLED)} (type 7 is FLOAT32)")
