"""What the pipeline hands over to the publisher."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from estimator.bounded_pose import Anchor, BoundedPose, Guarantee
from mapper.tile import Tile
from service.messages import TileId

MAP_FRAME = "map"


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """News of pose and map."""

    tiles: tuple[Tile, ...]
    """Whole tiles that changed since the last update."""
    pose: BoundedPose | None
    anchor: Anchor | None
    health: Mapping[str, Any]
    guarantee: Guarantee
    released_ns: int
    """Host's monotonic clock when the last sample in it had been read."""
    forgotten: tuple[TileId, ...] = ()
    """Tiles that the map has let go of since the last update: they are listed no more."""
    beams_until_ns: int | None = None
    """No beam in the tiles is newer."""
    stored: tuple[TileId, ...] = ()
    """Tiles that changed, too, as the store has them."""
