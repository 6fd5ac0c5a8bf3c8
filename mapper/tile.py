"""A tile: 64 x 64 cells of a map, each an interval of elevation or unseen. What is published, stored and joined.

Elevations are joined by hull, the flag by OR. Both are commutative, associative and idempotent, bit for bit: late,
repeated, reordered and re-sent tiles change nothing. So is everything here that is built from them.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_into_callers
from mapper.grid import TILE_SIDE

Layer = NDArray[np.float32]
Flags = NDArray[np.bool_]

SNAP_M = 2.0**-9
"""Step of the published elevations."""
_STEP, _PER_STEP = np.float32(SNAP_M), np.float32(1 / SNAP_M)
ZERO = np.float32(0.0)
"""-0 + 0 is +0."""
NAN = np.uint32(0x7FC00000).view(np.float32)
_ALL_STEPS_M = np.float32(2.0**14)
"""From here on every float32 is a multiple of SNAP_M."""

NOWHERE: Layer = np.full((TILE_SIDE, TILE_SIDE), NAN)
"""The layer that says nothing; shared by all tiles whose map keeps no evidence."""
NOWHERE.flags.writeable = False
NO_CELL: Flags = np.zeros((TILE_SIDE, TILE_SIDE), np.bool_)
NO_CELL.flags.writeable = False
_new, _set = object.__new__, object.__setattr__


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """Layers of 64 x 64 cells: row = y, column = x, from the tile's low corner; NaN where unseen.

    Always canonical (one NaN, no negative zero) and read-only, so equal tiles are equal bytes.
    """

    submap: int
    ix: int
    iy: int
    resolution_m: float
    low: Layer
    """[64, 64] float32, metres in the map frame."""
    high: Layer
    surely_hit: Flags = field(default_factory=lambda: NO_CELL)
    """[64, 64] bool: a beam certainly ended in this cell (docs/surely-hit.md); of a seen cell only."""
    settled_low: Layer = field(default_factory=lambda: NOWHERE)
    """[64, 64] float32: what several separate times agree on (docs/ghosts.md), inside [low, high]; NaN: not yet."""
    settled_high: Layer = field(default_factory=lambda: NOWHERE)

    def __post_init__(self) -> None:
        low, high = _intervals(self.low, self.high)
        settled_low, settled_high = _intervals(self.settled_low, self.settled_high)
        flags = self.surely_hit
        if flags.shape != (TILE_SIDE, TILE_SIDE) or flags.dtype != np.bool_:
            raise ValueError(f"flags are bool [{TILE_SIDE}, {TILE_SIDE}], not {flags.dtype} {list(flags.shape)}")
        if flags is not NO_CELL:
            if np.any(flags & np.isnan(low)):
                raise ValueError("a cell is surely hit, but unseen")
            flags = flags.copy()
        if settled_low is not NOWHERE:
            inside = (settled_low >= low) & (settled_high <= high) | np.isnan(settled_low)
            if not inside.all():
                raise ValueError("a cell's settled interval is not inside [low, high]")
        _seal(self, low, high, flags, settled_low, settled_high)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Tile)
            and _same_place(self, other)
            and all(a is b or a.tobytes() == b.tobytes() for a, b in zip(self.layers, other.layers, strict=True))
        )

    def __hash__(self) -> int:
        return hash((self.submap, self.ix, self.iy))

    @property
    def layers(self) -> tuple[Layer, Layer, Flags, Layer, Layer]:
        """low, high, surely_hit, settled_low, settled_high."""
        return self.low, self.high, self.surely_hit, self.settled_low, self.settled_high

    @property
    def cells_seen(self) -> int:
        """How many cells hold an interval."""
        return _count_seen(self.low)

    @property
    def has_settled(self) -> bool:
        """Is any cell settled? Never so where the map keeps no evidence."""
        return self.settled_low is not NOWHERE


def sealed_tile(
    submap: int,
    ix: int,
    iy: int,
    resolution_m: float,
    low: Layer,
    high: Layer,
    surely_hit: Flags = NO_CELL,
    settled_low: Layer = NOWHERE,
    settled_high: Layer = NOWHERE,
) -> Tile:
    """The tile of layers that are canonical already and nobody else's: neither checked nor copied."""
    made: Tile = _new(Tile)
    _set(made, "submap", submap)
    _set(made, "ix", ix)
    _set(made, "iy", iy)
    _set(made, "resolution_m", resolution_m)
    _seal(made, low, high, surely_hit, settled_low, settled_high)
    return made


def unseen_tile(submap: int, ix: int, iy: int, resolution_m: float) -> Tile:
    """The tile that says nothing: neutral to `join`."""
    return Tile(submap, ix, iy, resolution_m, NOWHERE, NOWHERE)


def compile_tiles() -> None:
    """Have the machine code made now (a second at first, then cached), so that no tile waits for it."""
    level = np.zeros((TILE_SIDE, TILE_SIDE), np.float32)
    nothing, flat = unseen_tile(0, 0, 0, 1.0), Tile(0, 0, 0, 1.0, level, level, NO_CELL, level, level)
    snap_outward(join(flat, changed(nothing, flat)))
    assert nothing.cells_seen == 0


def join(a: Tile, b: Tile) -> Tile:
    """Cell by cell the hull [min of lows, max of highs], and OR of flags; an unseen cell takes the other's. Exact."""
    if not _same_place(a, b):
        raise ValueError(f"can't join {_place(a)} with {_place(b)}")
    low, high = _pair(_join, a.low, a.high, b.low, b.high)
    if not (a.has_settled and b.has_settled):
        settled = (a if a.has_settled else b).layers[3:]
    else:
        settled = _pair(_join, a.settled_low, a.settled_high, b.settled_low, b.settled_high)
    return _like(a, low, high, _either(a.surely_hit, b.surely_hit), *settled)


def changed(old: Tile | None, new: Tile) -> Tile:
    """The delta: cells of `new` that differ from `old`, others unseen. join(old, delta) == join(old, new). Exact."""
    if old is None:
        return new
    if not _same_place(old, new):
        raise ValueError(f"can't compare {_place(old)} with {_place(new)}")
    both = old.surely_hit is NO_CELL and new.surely_hit is NO_CELL
    differs = NO_CELL.copy() if both else old.surely_hit != new.surely_hit
    _mark_changed(old.low, old.high, new.low, new.high, differs)
    if new.has_settled:
        _mark_changed(old.settled_low, old.settled_high, new.settled_low, new.settled_high, differs)
    settled = (new.settled_low, new.settled_high)
    if new.has_settled:
        settled = _pair(_only, differs, *settled)
        if not _count_seen(settled[0]):
            settled = NOWHERE, NOWHERE
    surely_hit = NO_CELL if new.surely_hit is NO_CELL else new.surely_hit & differs
    return _like(new, *_pair(_only, differs, new.low, new.high), surely_hit, *settled)


def snap_outward(tile: Tile) -> Tile:
    """Each low down, each high up to a multiple of 2^-9 m. Outer, idempotent, exact in float32, commutes with join."""
    low, high = _pair(_snap, tile.low, tile.high)
    settled = (tile.settled_low, tile.settled_high)
    return _like(tile, low, high, tile.surely_hit, *(_pair(_snap, *settled) if tile.has_settled else settled))


def content_crc(tile: Tile) -> int:
    """CRC-32 of the snapped tile's layers: what the digest lists.

    low and high (and, where any cell is settled, settled_low and settled_high) as little-endian float32; surely_hit
    as bytes 0 and 1, where any is set, last.
    """
    snapped = snap_outward(tile)
    elevations = (snapped.low, snapped.high, *((snapped.settled_low, snapped.settled_high) * tile.has_settled))
    crc = 0
    for layer in elevations:
        crc = zlib.crc32(layer.astype("<f4", copy=False).tobytes(), crc)
    return zlib.crc32(tile.surely_hit.tobytes(), crc) if tile.surely_hit.any() else crc


def _intervals(low: Layer, high: Layer) -> tuple[Layer, Layer]:
    """The layers made canonical; the shared NOWHERE where they say nothing at all (of the settled ones)."""
    if low is NOWHERE and high is NOWHERE:
        return NOWHERE, NOWHERE
    canonical_low, canonical_high = _blank(), _blank()
    if not _canonical(_layer(low), _layer(high), canonical_low, canonical_high):
        if not np.array_equal(np.isnan(low), np.isnan(high)):
            raise ValueError("a cell has a bound on one side only")
        raise ValueError("a cell's low and high are no interval of finite numbers")
    if np.isnan(canonical_low).all():
        return NOWHERE, NOWHERE
    return canonical_low, canonical_high


def _pair(operation: Callable[..., object], *layers: NDArray[Any]) -> tuple[Layer, Layer]:
    """What a compiled operation writes into a new low and high."""
    low, high = _blank(), _blank()
    operation(*layers, low, high)
    return low, high


def _either(a: Flags, b: Flags) -> Flags:
    if a is NO_CELL or b is NO_CELL:
        return b if a is NO_CELL else a
    return a | b


def _blank() -> Layer:
    return np.empty((TILE_SIDE, TILE_SIDE), np.float32)


def _layer(given: Layer) -> Layer:
    """What was given, as the compiled code knows it: contiguous and read-only."""
    if given.shape != (TILE_SIDE, TILE_SIDE) or given.dtype != np.float32:
        raise ValueError(f"a layer is float32 [{TILE_SIDE}, {TILE_SIDE}], not {given.dtype} {list(given.shape)}")
    layer = np.ascontiguousarray(given).view()
    layer.flags.writeable = False
    return layer


def _like(tile: Tile, *layers: NDArray[Any]) -> Tile:
    """A tile at the place of `tile`, of layers that were made canonical: not checked once more."""
    return sealed_tile(tile.submap, tile.ix, tile.iy, tile.resolution_m, *layers)


def _seal(tile: Tile, low: Layer, high: Layer, surely_hit: Flags, settled_low: Layer, settled_high: Layer) -> None:
    """Hundreds of times a second, so each step by itself; what many tiles share is read-only already."""
    low.setflags(write=False)
    high.setflags(write=False)
    if surely_hit is not NO_CELL:
        surely_hit.setflags(write=False)
    if settled_low is not NOWHERE:
        settled_low.setflags(write=False)
        settled_high.setflags(write=False)
    _set(tile, "low", low)
    _set(tile, "high", high)
    _set(tile, "surely_hit", surely_hit)
    _set(tile, "settled_low", settled_low)
    _set(tile, "settled_high", settled_high)


@compiled
def _canonical(low: Layer, high: Layer, canonical_low: Layer, canonical_high: Layer) -> bool:
    """One NaN, no negative zero; False where a cell is neither unseen nor an interval of finite numbers."""
    sound = True
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            a, b = low[row, col], high[row, col]
            unseen = np.isnan(a) and np.isnan(b)
            sound = sound and (unseen or -np.inf < a <= b < np.inf)
            canonical_low[row, col] = NAN if unseen else a + ZERO
            canonical_high[row, col] = NAN if unseen else b + ZERO
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
def _mark_changed(old_low: Layer, old_high: Layer, new_low: Layer, new_high: Layer, differs: Flags) -> None:
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            a, b = new_low[row, col], new_high[row, col]
            # Cells only ever grow from unseen; what is NaN in both is the same.
            differs[row, col] |= (a != old_low[row, col] or b != old_high[row, col]) and not np.isnan(a)


@compiled
def _only(cells: Flags, low: Layer, high: Layer, only_low: Layer, only_high: Layer) -> None:
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            only_low[row, col] = low[row, col] if cells[row, col] else NAN
            only_high[row, col] = high[row, col] if cells[row, col] else NAN


@compiled_into_callers
def snapped_down(low: np.float32) -> np.float32:
    """The multiple of SNAP_M at or below; NaN stays. Scaling by powers of two, and floor, are exact in float32."""
    return np.floor(low * _PER_STEP) * _STEP if abs(low) < _ALL_STEPS_M else low


@compiled_into_callers
def snapped_up(high: np.float32) -> np.float32:
    """The multiple of SNAP_M at or above, and no negative zero, which ceil gives."""
    return np.ceil(high * _PER_STEP) * _STEP + ZERO if abs(high) < _ALL_STEPS_M else high


@compiled
def _snap(low: Layer, high: Layer, snapped_low: Layer, snapped_high: Layer) -> None:
    for row in range(TILE_SIDE):
        for col in range(TILE_SIDE):
            snapped_low[row, col] = snapped_down(low[row, col])
            snapped_high[row, col] = snapped_up(high[row, col])


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
