"""What waits for the publisher: whole, once, and in no more memory than the map itself may take."""

import numpy as np

from mapper.tile import Tile, join
from service.messages import TileId
from service.unsent_tiles import Unsent, UnsentTiles


def tile(ix: int, seen: int) -> Tile:
    """A tile of which one row is seen."""
    low = np.full((64, 64), np.nan, np.float32)
    low[seen] = 0.5
    return Tile(0, ix, 0, 0.05, low, low + np.float32(0.1))


def test_of_a_tile_that_changes_again_all_is_kept() -> None:
    """What waited may have left the map's memory: the newer part alone would not be the tile."""
    unsent = UnsentTiles(None)
    unsent.add([tile(1, 0)])
    unsent.add([tile(1, 1), tile(2, 0)])
    assert unsent.take() == Unsent((join(tile(1, 0), tile(1, 1)), tile(2, 0)), (), ())
    assert not unsent
    assert unsent.take() == Unsent((), (), ())


def test_beyond_its_memory_places_are_kept_alone_and_none_twice() -> None:
    """The store gives them, with all that changed since; what changes after that waits as ever."""
    unsent = UnsentTiles(2)
    unsent.add([tile(1, 0), tile(2, 0)])
    assert len(unsent) == 2
    unsent.add([tile(3, 0)])
    assert len(unsent) == 0
    unsent.add([tile(2, 1), tile(4, 0)])
    assert unsent.take() == Unsent((tile(4, 0),), (TileId(0, 1, 0), TileId(0, 2, 0), TileId(0, 3, 0)), ())


def test_what_the_map_forgot_is_told_once_and_not_sent() -> None:
    """However often it was mapped and forgotten while nobody took anything."""
    unsent = UnsentTiles(None)
    for _ in range(100):
        unsent.add([tile(1, 0), tile(2, 0)])
        unsent.forget([TileId(0, 1, 0)])
    assert unsent.take() == Unsent((tile(2, 0),), (), (TileId(0, 1, 0),))
