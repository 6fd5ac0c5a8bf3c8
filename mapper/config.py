"""How the map is cut into cells and tiles."""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from drivers.config import STRICT, Positive


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class MapConfig:
    """The elevation map."""

    resolution_m: Annotated[float, Field(ge=0.005, le=10.0)]
    """Side of a cell."""
    max_tiles: Annotated[int, Field(ge=16, le=1_000_000)] = 4096
    """Memory cap, in tiles of 64 x 64 cells (33 KiB each). With a store, the farthest tiles leave for it well before;
    otherwise what falls outside is counted, not mapped."""
    rolling: bool = False
    """Without a store: forget the tiles farthest from the robot instead, and count them."""
    max_footprint_m: Positive = 3.0
    """A beam whose footprint is wider than this tells too little: it is skipped and counted."""
