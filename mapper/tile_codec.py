"""A tile on the wire: `foxglove.Grid` protobuf, compressed with zstd. docs/tile-format.md says it byte by byte.

Encode and decode stand side by side. The decoder is strict: whatever is not exactly such a tile is a TileFormatError.
"""

from dataclasses import dataclass

import numpy as np
from backports import zstd
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from google.protobuf.message import DecodeError

from mapper.grid import TILE_CELLS, TILE_SIDE, tile_corner_m
from mapper.tile import Tile, snapped_cells

ENCODING = "application/protobuf;foxglove.Grid+zstd"
"""Zenoh's encoding string of a tile."""

_COMPRESSOR = zstd.ZstdCompressor(level=1)
"""Each call makes a frame of its own."""
_LARGEST_PAYLOAD = 48 * 1024
"""A tile of pure noise takes 33 KiB; links cut larger messages up and lose them."""
_LARGEST_MESSAGE = 40 * 1024
_WINDOW_LOG = 20
"""No payload can ask for more than 1 MiB of memory; level 1 asks for 512 KiB at most."""
_CELL_BYTES = 8
_FIELDS = (("elevation_min", 0), ("elevation_max", 4))
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


def encode(tile: Tile, frame_id: str, stamp_ns: int) -> bytes:
    """The payload of a tile, or of a delta, snapped outward to 2^-9 m. stamp_ns: wall clock."""
    message = Grid(
        frame_id=frame_id,
        column_count=TILE_SIDE,
        row_stride=TILE_SIDE * _CELL_BYTES,
        cell_stride=_CELL_BYTES,
        data=snapped_cells(tile).astype("<f4", copy=False).tobytes(),
    )
    message.timestamp.seconds, message.timestamp.nanos = divmod(stamp_ns, _NS)
    message.pose.position.x, message.pose.position.y = tile.corner_m
    message.pose.orientation.w = 1.0
    message.cell_size.x = message.cell_size.y = tile.resolution_m
    for name, offset in _FIELDS:
        message.fields.add(name=name, offset=offset, type=PackedElementField.FLOAT32)
    return _COMPRESSOR.compress(message.SerializeToString(deterministic=True), zstd.ZstdCompressor.FLUSH_FRAME)


def decode(payload: bytes, submap: int) -> ReceivedTile:
    """The tile in a payload; its submap stands in the key, not in the payload."""
    message = Grid()
    try:
        message.ParseFromString(_decompress(payload))
    except DecodeError as error:
        raise TileFormatError(f"no protobuf message: {error}") from error
    resolution = message.cell_size.x
    ix, iy = _check_geometry(message)
    cells = np.frombuffer(message.data, "<f4").astype(np.float32).reshape(TILE_SIDE, TILE_SIDE, 2)
    try:
        tile = Tile(submap, ix, iy, resolution, cells[..., 0], cells[..., 1])
    except ValueError as error:
        raise TileFormatError(str(error)) from error
    return ReceivedTile(tile, message.frame_id, message.timestamp.seconds * _NS + message.timestamp.nanos)


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


def _check_geometry(message: Grid) -> tuple[int, int]:
    """The tile's indices, if the message is laid out as a tile."""
    layout = (message.column_count, message.row_stride, message.cell_stride, len(message.data))
    expected = (TILE_SIDE, TILE_SIDE * _CELL_BYTES, _CELL_BYTES, TILE_CELLS * _CELL_BYTES)
    if layout != expected:
        raise TileFormatError(f"column_count, row_stride, cell_stride, bytes of data are {layout}, not {expected}")
    fields = tuple((field.name, field.offset) for field in message.fields)
    if fields != _FIELDS or any(field.type != PackedElementField.FLOAT32 for field in message.fields):
        raise TileFormatError(f"fields are {fields}, not {_FIELDS}, each FLOAT32")
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
