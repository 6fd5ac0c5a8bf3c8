"""Tiles on their way from the map to the publisher: what changed since its last update, in no more memory than the map.

Normally that is a handful. But a session may not open for a whole drive, and tiles that left the map's memory for the
store would gather here. So beyond a number of them all are known by their places alone, and the store gives them.
"""

from collections.abc import Iterable
from typing import NamedTuple

from mapper.tile import Tile, join
from service.messages import TileId


class Unsent(NamedTuple):
    """What is to be published."""

    tiles: tuple[Tile, ...]
    stored: tuple[TileId, ...]
    """Further ones, as the store has them."""
    forgotten: tuple[TileId, ...]
    """Not in the map any more."""


class UnsentTiles:
    """The pipeline thread's own."""

    def __init__(self, most: int | None) -> None:
        """`most`: beyond so many the store gives them; None: there is no store, and the map itself has no more."""
        self._most = most
        self._tiles: dict[TileId, Tile] = {}
        self._stored: dict[TileId, None] = {}
        self._forgotten: dict[TileId, None] = {}

    def __bool__(self) -> bool:
        return bool(self._tiles or self._stored or self._forgotten)

    def __len__(self) -> int:
        """Tiles that are held in memory."""
        return len(self._tiles)

    def add(self, tiles: Iterable[Tile]) -> None:
        """These changed; where there is a store, it was told of them before."""
        for tile in tiles:
            place = TileId(tile.submap, tile.ix, tile.iy)
            if place in self._stored:
                continue
            # What waited may have left the map's memory meanwhile: the newer one need not contain it.
            self._tiles[place] = join(self._tiles[place], tile) if place in self._tiles else tile
        if self._most is not None and len(self._tiles) > self._most:
            self._stored |= dict.fromkeys(self._tiles)
            self._tiles.clear()

    def forget(self, places: Iterable[TileId]) -> None:
        """The map has let go of these, for good."""
        for place in places:
            self._tiles.pop(place, None)
            self._forgotten[place] = None

    def take(self) -> Unsent:
        """All that waits, once."""
        unsent = Unsent(tuple(self._tiles.values()), tuple(self._stored), tuple(self._forgotten))
        self._tiles, self._stored, self._forgotten = {}, {}, {}
        return unsent
