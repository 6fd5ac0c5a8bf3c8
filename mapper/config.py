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
    """Memory cap, in tiles of 64 x 64 cells (32 KiB each); what falls outside is counted, not mapped."""
    max_footprint_m: Positive = 3.0
    """A beam whose footprint is wider than this tells too little: it is skipped and counted."""
