"""The map as subscribers are to have it: each tile snapped outward, with a version and a CRC.

Memory holds the tiles that changed last. Of the others it knows version and CRC, and recalls them from the store when
they are asked for or change: what is listed and answered is the whole map, wherever it lies.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from mapper.tile import Flags, Tile, compile_tiles, content_crc, snap_outward
from mapper.tile_growth import compile_growth, grown
from service.digest import DigestEntry
from service.messages import GuaranteeMessage, TileId
from service.topics import Kind

Recall: TypeAlias = Callable[[TileId], Tile | None]
"""All that was ever handed over of a tile; None where it can't be had."""


def nothing_kept(place: TileId) -> Tile | None:
    """Where there is no store, everything stays in memory."""
    return None


@dataclass(frozen=True, slots=True)
class PublishedTile:
    """The last published state of a tile."""

    tile: Tile
    version: int


@dataclass(frozen=True, slots=True)
class EarlierSubmap:
    """What an earlier run left of its map frame."""

    anchor: bytes | None
    """As published then."""
    guarantee: GuaranteeMessage
    tiles: tuple[DigestEntry, ...]


class TileNews(NamedTuple):
    """What is to be sent of a tile."""

    kind: Kind
    tile: Tile
    cells: Flags | None
    """Of a delta: those that it tells of, where it doesn't tell of all that are seen."""
    version: int


class _Away(NamedTuple):
    """What is known of a tile that is not in memory."""

    version: int
    crc: int


class PublishedMap:
    """Present states, tile by tile; nothing else is remembered."""

    def __init__(self, recall: Recall = nothing_kept, tiles_in_memory: int | None = None) -> None:
        """`tiles_in_memory` None: all. What `recall` gives must contain what was published."""
        compile_tiles()
        compile_growth()
        self.not_recalled = 0
        """Tiles that the store could not give any more: they are listed no longer."""
        self._recall = recall
        self._tiles_in_memory = tiles_in_memory
        self._tiles: dict[TileId, PublishedTile] = {}
        """Those that changed last are last."""
        self._away: dict[TileId, _Away] = {}
        self._crcs: dict[TileId, int] = {}
        """Of tiles in memory. Worked out for a digest: a tile changes many times a second, a digest comes once."""

    def __len__(self) -> int:
        return len(self._tiles) + len(self._away)

    def __iter__(self) -> Iterator[TileId]:
        return iter([*self._tiles, *self._away])

    def __contains__(self, place: TileId) -> bool:
        return place in self._tiles or place in self._away

    def get(self, place: TileId) -> PublishedTile | None:
        """The present state of a tile, brought from the store where it isn't in memory."""
        published = self._tiles.get(place)
        away = self._away.get(place)
        if published is not None or away is None:
            return published
        recalled = self.recall(place)
        if recalled is None:
            del self._away[place]
            return None
        tile = snap_outward(recalled)
        crc = content_crc(tile)
        if crc != away.crc:
            # The store has more than was published by now: the next digest lists it.
            self._away[place] = away = _Away(away.version + 1, crc)
        return PublishedTile(tile, away.version)

    def recall(self, place: TileId) -> Tile | None:
        """All that the store has of a tile; None, and counted, where it can't give it."""
        tile = self._recall(place)
        self.not_recalled += tile is None
        return tile

    def update(self, tile: Tile) -> TileNews | None:
        """Take what a tile holds: what to send for it; None where nothing changed.

        It is joined to what was published: a tile that had left the map's memory comes with its newest cells alone.
        """
        place = TileId(tile.submap, tile.ix, tile.iy)
        away, old = self._away.get(place), self.get(place)
        if away is not None:
            return self._update_away(place, tile, away, old)
        if old is None:
            new = snap_outward(tile)
            return self._news(place, "full", new, None, 1) if new.cells_seen else None
        new, differs, cells_changed, cells_seen = grown(old.tile, tile)
        if cells_changed == 0:
            return None
        if 2 * cells_changed > cells_seen:
            return self._news(place, "full", new, None, old.version + 1)
        return self._news(place, "delta", new, differs, old.version + 1)

    def _update_away(self, place: TileId, tile: Tile, away: _Away, old: PublishedTile | None) -> TileNews | None:
        """The same where what was published is known by its CRC alone: all that came is news."""
        delta = snap_outward(tile)
        new = delta if old is None else grown(old.tile, tile).tile
        if content_crc(new) == away.crc:
            self._keep(place, PublishedTile(new, away.version))
            return None
        cells = delta.cells_seen
        if cells == 0:
            return None
        if old is None or 2 * cells > new.cells_seen:
            return self._news(place, "full", new, None, away.version + 1)
        self._keep(place, PublishedTile(new, away.version + 1))
        return TileNews("delta", delta, None, away.version + 1)

    def _news(self, place: TileId, kind: Kind, new: Tile, cells: Flags | None, version: int) -> TileNews:
        """A new state, which is kept."""
        self._keep(place, PublishedTile(new, version))
        return TileNews(kind, new, cells, version)

    def adopt(self, entries: Iterable[DigestEntry]) -> None:
        """Publish tiles that only the store holds."""
        for entry in entries:
            if entry.tile not in self:
                self._away[entry.tile] = _Away(0, entry.crc)

    def forget(self, places: Iterable[TileId]) -> None:
        """List these tiles no more."""
        for place in places:
            self._tiles.pop(place, None)
            self._away.pop(place, None)
            self._crcs.pop(place, None)

    def entries(self) -> list[DigestEntry]:
        """What a digest lists, in rising order."""
        for place in self._tiles:
            self._crc(place)
        crcs = self._crcs | {place: away.crc for place, away in self._away.items()}
        return sorted(DigestEntry(*place, crc) for place, crc in crcs.items())

    def _crc(self, place: TileId) -> int:
        if place not in self._crcs:
            self._crcs[place] = content_crc(self._tiles[place].tile)
        return self._crcs[place]

    def _keep(self, place: TileId, published: PublishedTile) -> None:
        """Hold a state in memory; what changed longest ago leaves."""
        self._tiles.pop(place, None)
        self._away.pop(place, None)
        self._crcs.pop(place, None)
        self._tiles[place] = published
        while self._tiles_in_memory is not None and len(self._tiles) > self._tiles_in_memory:
            oldest = next(iter(self._tiles))
            crc = self._crc(oldest)
            self._away[oldest] = _Away(self._tiles.pop(oldest).version, crc)
            del self._crcs[oldest]
