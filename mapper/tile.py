"""A tile: 64 x 64 cells of a map, each an interval of elevation or unseen. What is published, stored and joined.

The only operation on a cell is the hull. Hull is commutative, associative and idempotent, bit for bit: late, repeated,
reordered and re-sent tiles change nothing. So is everything here that is built from it.
"""

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.grid import TILE_SIDE, tile_corner_m

Layer = NDArray[np.float32]

SNAP_M = 2.0**-9
"""Step of the published elevations."""
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
        low, high = _canonical(self.low), _canonical(self.high)
        seen = ~np.isnan(low)
        if not np.array_equal(seen, ~np.isnan(high)):
            raise ValueError("a cell has a bound on one side only")
        if not (np.all(np.isfinite(low[seen])) and np.all(np.isfinite(high[seen])) and np.all(low[seen] <= high[seen])):
            raise ValueError("a cell's low and high are no interval of finite numbers")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

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
        return int(np.count_nonzero(~np.isnan(self.low)))

    @property
    def corner_m(self) -> tuple[float, float]:
        """Low corner (x, y) in the map frame."""
        return tile_corner_m(self.ix, self.iy, self.resolution_m)


def unseen_tile(submap: int, ix: int, iy: int, resolution_m: float) -> Tile:
    """The tile that says nothing: neutral to `join`."""
    nothing = np.full((TILE_SIDE, TILE_SIDE), _NAN)
    return Tile(submap, ix, iy, resolution_m, nothing, nothing)


def join(a: Tile, b: Tile) -> Tile:
    """Cell by cell the hull [min of lows, max of highs]; an unseen cell takes the other's. Exact."""
    if not _same_place(a, b):
        raise ValueError(f"can't join {_place(a)} with {_place(b)}")
    return Tile(a.submap, a.ix, a.iy, a.resolution_m, np.fmin(a.low, b.low), np.fmax(a.high, b.high))


def changed(old: Tile | None, new: Tile) -> Tile:
    """The delta: cells of `new` that differ from `old`, others unseen. join(old, delta) == join(old, new). Exact."""
    if old is None:
        return new
    if not _same_place(old, new):
        raise ValueError(f"can't compare {_place(old)} with {_place(new)}")
    # As bits: NaN equals NaN.
    same = (old.low.view(np.uint32) == new.low.view(np.uint32)) & (old.high.view(np.uint32) == new.high.view(np.uint32))
    return Tile(
        *(new.submap, new.ix, new.iy, new.resolution_m),
        *(np.where(same, _NAN, new.low), np.where(same, _NAN, new.high)),
    )


def snap_outward(tile: Tile) -> Tile:
    """Each low down, each high up to a multiple of 2^-9 m. Outer, idempotent, exact in float32, commutes with join."""
    return Tile(
        *(tile.submap, tile.ix, tile.iy, tile.resolution_m),
        *(_snapped(tile.low, np.floor), _snapped(tile.high, np.ceil)),
    )


def content_crc(tile: Tile) -> int:
    """CRC-32 of the snapped tile's low, then high, as little-endian float32: what the digest lists."""
    snapped = snap_outward(tile)
    return zlib.crc32(snapped.high.astype("<f4").tobytes(), zlib.crc32(snapped.low.astype("<f4").tobytes()))


def _snapped(layer: Layer, rounding: np.ufunc) -> Layer:
    with np.errstate(over="ignore", invalid="ignore"):
        # Scaling by a power of two and rounding to an integer are exact in float32.
        snapped: Layer = rounding(layer * np.float32(1 / SNAP_M)) * np.float32(SNAP_M)
    return np.where(np.abs(layer) < _ALL_STEPS_M, snapped, layer)


def _canonical(layer: Layer) -> Layer:
    if layer.shape != (TILE_SIDE, TILE_SIDE) or layer.dtype != np.float32:
        raise ValueError(f"a layer is float32 [{TILE_SIDE}, {TILE_SIDE}], not {layer.dtype} {list(layer.shape)}")
    with np.errstate(invalid="ignore"):  # a signalling NaN
        canonical: Layer = np.where(np.isnan(layer), _NAN, layer + np.float32(0.0))  # -0 + 0 is +0
    canonical.flags.writeable = False
    return canonical


def _same_place(a: Tile, b: Tile) -> bool:
    return (a.submap, a.ix, a.iy, a.resolution_m) == (b.submap, b.ix, b.iy, b.resolution_m)


def _place(tile: Tile) -> str:
    return f"tile {tile.submap}/{tile.ix}/{tile.iy} at {tile.resolution_m} m"
