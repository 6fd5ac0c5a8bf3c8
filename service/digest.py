"""The digest: what the robot's map holds, listed tile by tile, so that a copy learns what it lacks.

A listing goes out in parts (docs/wire.md); writing and putting together stand side by side.
"""

import zlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from service.messages import WIRE, Count, MalformedMessage, Name, TileId

DIGEST_PART_TILES = 1000
"""Tiles that one message of a digest lists: below 48 KiB, beyond which a slow link loses fragments."""

_Crc = Annotated[int, Field(ge=0, lt=2**32)]
_Index = Annotated[int, Field(ge=-(2**31), lt=2**31)]


class DigestEntry(NamedTuple):
    """One tile of the robot's map: where, and the CRC-32 of its published content."""

    submap: Count
    ix: _Index
    iy: _Index
    crc: _Crc

    @property
    def tile(self) -> TileId:
        """Which tile."""
        return TileId(self.submap, self.ix, self.iy)


@dataclass(frozen=True, slots=True, config=WIRE)
class DigestPart:
    """One message of a digest: what the robot's map holds. `parts` is 0 where nothing changed since it was listed."""

    epoch: Name
    sequence: Count
    final: bool
    """The run has ended in order, and this is all of it."""
    tiles: Count
    """Tiles in all."""
    root: _Crc
    """CRC-32 over all entries: who has the same root has the same map."""
    part: Count
    parts: Annotated[int, Field(ge=0, le=10_000)]
    entries: Annotated[list[DigestEntry], Field(max_length=DIGEST_PART_TILES)]


def digest_root(entries: Iterable[DigestEntry]) -> int:
    """CRC-32 over the entries in rising order, each as four little-endian 64-bit integers."""
    rows = np.array(sorted(entries), dtype="<i8").reshape(-1, 4)
    return zlib.crc32(rows.tobytes())


def digest_parts(
    epoch: str, sequence: int, final: bool, entries: Sequence[DigestEntry], root: int
) -> Iterator[DigestPart]:
    """The messages that list everything; an empty map is one part without entries."""
    parts = max(1, -(-len(entries) // DIGEST_PART_TILES))
    for part in range(parts):
        listed = list(entries[part * DIGEST_PART_TILES : (part + 1) * DIGEST_PART_TILES])
        yield DigestPart(epoch, sequence, final, len(entries), root, part, parts, listed)


class DigestAssembly:
    """Puts the parts of one listing together; a newer listing pushes an unfinished one out."""

    def __init__(self) -> None:
        self._listing: tuple[str, int, int] | None = None
        self._parts: dict[int, list[DigestEntry]] = {}

    def add(self, part: DigestPart) -> dict[TileId, int] | None:
        """The CRC of every tile once the listing is complete and its root fits; None before."""
        listing = (part.epoch, part.sequence, part.parts)
        if listing != self._listing:
            self._listing, self._parts = listing, {}
        if part.part >= part.parts:
            return None
        self._parts[part.part] = part.entries
        if len(self._parts) < part.parts:
            return None
        entries = [entry for number in range(part.parts) for entry in self._parts[number]]
        self._listing, self._parts = None, {}
        crcs = {entry.tile: entry.crc for entry in entries}
        if len(crcs) != part.tiles or digest_root(entries) != part.root:
            raise MalformedMessage("the digest's parts don't fit together")
        return crcs
