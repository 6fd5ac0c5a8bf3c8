"""How the map is cut into cells and tiles."""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from drivers.config import STRICT, Positive


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class ContactConfig:
    """What the tracks tell of the ground under them (docs/contact.md)."""

    track_width_m: Positive
    bound_m: Positive
    """How far the ground can be from a track's underside, the plane z = 0 of base_link, where it touches: sinkage, the
    track's give, grousers."""


MOST_TILES = 1_000_000
WIDEST_FOOTPRINT_CELLS = 2000
"""A beam of such a footprint widens four million cells, which takes some milliseconds: no scan is to take minutes."""


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class MapConfig:
    """The elevation map."""

    resolution_m: Annotated[float, Field(ge=0.005, le=10.0)]
    """Side of a cell."""
    max_tiles: Annotated[int, Field(ge=16, le=MOST_TILES)] = 4096
    """Memory cap, in tiles of 64 x 64 cells (33 KiB each). With a store, the farthest tiles leave for it well before;
    otherwise what falls outside is counted, not mapped."""
    rolling: bool = False
    """Without a store: forget the tiles farthest from the robot instead, and count them."""
    max_footprint_m: Positive = 3.0
    """A beam whose footprint is wider than this tells too little: it is skipped and counted. 2000 cells at most."""
    contact: ContactConfig | None = None
    """Map the ground that the tracks touch, too. Absent: only what beams hit."""
    evidence_slots: Annotated[int, Field(ge=0, le=16)] = 0
    """Keep cells apart by so many time slots, dealt round robin, to tell what was seen only for a moment (settled
    bounds, docs/ghosts.md). Each slot takes another 8 bytes a cell, and 8 more for all. 0: none."""
    evidence_slot_ms: Annotated[float, Field(ge=1.0, le=3.6e6)] = 1000.0
    """Length of a slot: what lasts no longer is in two slots at most."""
    evidence_set_aside: Annotated[int, Field(ge=1, le=8)] = 1
    """So many slots' extremes are set aside: 1 against rain and single bad beams, 2 against what passes by."""

    def __post_init__(self) -> None:
        if self.max_footprint_m > (most := WIDEST_FOOTPRINT_CELLS * self.resolution_m):
            raise ValueError(
                f"max_footprint_m = {self.max_footprint_m:g} is more than {WIDEST_FOOTPRINT_CELLS} cells of "
                f"{self.resolution_m:g} m: give at most {most:g}, or no scan would be done in time"
            )
        if 0 < self.evidence_slots <= 2 * self.evidence_set_aside:
            raise ValueError(
                f"evidence_slots = {self.evidence_slots} can't outvote evidence_set_aside = {self.evidence_set_aside}: "
                f"give at least {2 * self.evidence_set_aside + 1} slots, or 0 for none"
            )
