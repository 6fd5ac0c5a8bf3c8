"""A tile: 64 x 64 cells of a map, each an interval of elevation or unseen. What is published, stored and joined.

The only operation on a cell is the hull. Hull is commutative, associative and idempotent, bit for bit: late, repeated,
reordered and re-sent tiles change nothing. So is everything here that is built from it.
"""

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from mapper.grid import TILE_SIDE, tile_corner_m

Layer = NDArray[np.float32]

SNAP_M = 2.0**-9
"""Step of the published elevations."""
_STEP, _PER_STEP = np.float32(SNAP_M), np.float32(1 / SNAP_M)
_ZERO = np.float32(0.0)
"""-0 + 0 is +0."""
_NAN = np.uint32(0x7FC00000).view(np.float32)
_ALL_STEPS_M = np.float32(2.0**14)
"""From here on every float32 is a multiple of SNAP_M."""


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """Elevation intervals of 64 x 64 cells: row = y, column = x, from the tile's low corner; NaN where unseen.

    Always canonical (one NaN, no negative zero) and read-only, so equal tiles are equal bytes.
    """

    submap: int
    ix: int
    iy: int
    resolution_m: float
    low: Layer
    """[64, 64] float32, metres in the map frame."""
    high: Layer

    def __post_init__(self) -> None:
        low, high = _blank(), _blank()
        if not _canonical(_layer(self.low), _layer(self.high), low, high):
            if not np.array_equal(np.isnan(self.low), np.isnan(self.high)):
                raise ValueError("a cell has a bound on one side only")
            raise ValueError("a cell's low and high are no interval of finite numbers")
        _seal(self, low, high)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Tile)
            and _same_place(self, other)
            and self.low.tobytes() == other.low.tobytes()
            and self.high.tobytes() == other.high.tobytes()
        )

    def __hash__(self) -> int:
        return hash((self.submap, self.ix, self.iy))

    @property
    def cells_seen(self) -> int:
        """How many cells hold an interval."""
        return _count_seen(self.low)

    @property
    def corner_m(self) -> tuple[float, float]:
        """Low corner (x, y) in the map frame."""
        return tile_corner_m(self.ix, self.iy, self.resolution_m)


def unseen_tile(submap: int, ix: int, iy: int, resolution_m: float) -> Tile:
    """The tile that says nothing: neutral to `join`."""
    nothing = np.full((TILE_SIDE, TILE_SIDE), _NAN)
    return Tile(submap, ix, iy, resolution_m, nothing, nothing)


def compile_tiles() -> None:
    """Have the machine code made now (a second at first, then cached), so that no tile waits for it."""
    nothing = unseen_tile(0, 0, 0, 1.0)
    snapped_cells(snap_outward(join(nothing, changed(nothing, nothing))))
    assert nothing.cells_seen == 0


def join(a: Tile, b: Tile) -> Tile:
    """Cell by cell the hull [min of lows, max of highs]; an unseen cell takes the other's. Exact."""
    if not _same_place(a, b):
        raise ValueError(f"can't join {_place(a)} with {_place(b)}")
    low, high = _blank(), _blank()
    _join(a.low, a.high, b.low, b.high, low, high)
    return _like(a, low, high)


def changed(old: Tile | None, new: Tile) -> Tile:
    """The delta: cells of `new` that differ from `old`, others unseen. join(old, delta) == join(old, new). Exact."""
    if old is None:
        return new
    if not _same_place(old, new):
        raise ValueError(f"can't compare {_place(old)} with {_place(new)}")
    low, high = _blank(), _blank()
    _changed(old.low, old.high, new.low, new.high, low, high)
    return _like(new, low, high)


def snap_outward(tile: Tile) -> Tile:
    """Each low down, each high up to a multiple of 2^-9 m. Outer, idempotent, exact in float32, commutes with join."""
    low, high = _blank(), _blank()
    _snap(tile.low, tile.high, low, high)
    return _like(tile, low, high)


def snapped_cells(tile: Tile) -> Layer:
    """[64, 64, 2] the snapped tile's low and high, cell by cell: what stands on the wire."""
    cells = np.empty((TILE_SIDE, TILE_SIDE, 2), np.float32)
    _snap(tile.low, tile.high, cells[..., 0], cells[..., 1])
    return cells


def content_crc(tile: Tile) -> int:
    """CRC-32 of the snapped tile's low, then high, as little-endian float32: what the digest lists."""
    snapped = snap_outward(tile)
    return zlib.crc32(snapped.high.astype("<f4").tobytes(), zlib.crc32(snapped.low.astype("<f4").tobytes()))


def _blank() -> Layer:
    return np.empty((TILE_SIDE, TILE_SIDE), np.float32)


def _layer(given: Layer) -> Layer:
    """What was given, as the compiled code knows it: contiguous and read-only."""
    if given.shape != (TILE_SIDE, TILE_SIDE) or given.dtype != np.float32:
        raise ValueError(f"a layer is float32 [{TILE_SIDE}, {TILE_SIDE}], not {given.dtype} {list(given.shape)}")
    layer = np.ascontiguousarray(given).view()
    layer.flags.writeable = False
    return layer


def _like(tile: Tile, low: Layer, high: Layer) -> Tile:
    """A tile at the place of `tile`, of layers that were made canonical: not checked once more."""
    made = object.__new__(Tile)
    for name in ("submap", "ix", "iy", "resolution_m"):
        object.__setattr__(made, name, getattr(tile, name))
    _seal(made, low, high)
    return made


def _seal(tile: Tile, low: Layer, high: Layer) -> None:
    low.flags.writeable = high.flags.writeable = False
    object.__setattr__(tile, "low", low)
    object.__setattr__(tile, "high", high)


@compiled
def _canonical(low: Layer, high: Layer, canonical_low: Layer, canonical_high: Layer) -> bool:
    """One NaN, no negative zero; False where a cell is neither unseen nor an interval of finite numbers."""
    sound = True
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            a, b = low[row, col], high[row, col]
            unseen = np.isnan(a) and np.isnan(b)
            sound = sound and (unseen or -np.inf < a <= b < np.inf)
            canonical_low[row, col] = _NAN if unseen else a + _ZERO
            canonical_high[row, col] = _NAN if unseen else b + _ZERO
    return sound


@compiled
def _join(a_low: Layer, a_high: Layer, b_low: Layer, b_high: Layer, low: Layer, high: Layer) -> None:
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            a, b = a_low[row, col], b_low[row, col]
            low[row, col] = b if np.isnan(a) or b < a else a
            a, b = a_high[row, col], b_high[row, col]
            high[row, col] = b if np.isnan(a) or b > a else a


@compiled
def _changed(old_low: Layer, old_high: Layer, new_low: Layer, new_high: Layer, low: Layer, high: Layer) -> None:
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            a, b = new_low[row, col], new_high[row, col]
            # Cells only ever grow from unseen; what is NaN in both is the same.
            same = (a == old_low[row, col] and b == old_high[row, col]) or np.isnan(a)
            low[row, col] = _NAN if same else a
            high[row, col] = _NAN if same else b


@compiled
def _snap(low: Layer, high: Layer, snapped_low: Layer, snapped_high: Layer) -> None:
    """Scaling by a power of two and rounding to an integer are exact in float32."""
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            a, b = low[row, col], high[row, col]
            # NaN stays as it is; ceil gives negative zeros.
            snapped_low[row, col] = np.floor(a * _PER_STEP) * _STEP if abs(a) < _ALL_STEPS_M else a
            snapped_high[row, col] = np.ceil(b * _PER_STEP) * _STEP + _ZERO if abs(b) < _ALL_STEPS_M else b


@compiled
def _count_seen(low: Layer) -> int:
    seen = 0
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            seen += not np.isnan(low[row, col])
    return seen


def _same_place(a: Tile, b: Tile) -> bool:
    return (a.submap, a.ix, a.iy, a.resolution_m) == (b.submap, b.ix, b.iy, b.resolution_m)


def _place(tile: Tile) -> str:
    return f"tile {tile.submap}/{tile.ix}/{tile.iy} at {tile.resolution_m} m"
