"""The copy of a robot's map: joined from what its messages bring, held against what its digests say.

No thread, no session: `RemoteMap` feeds it, and guards it with a lock. What it holds is a past state of the robot's map
or a join of some.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Any

from estimator.bounded_pose import Anchor, BoundedPose, Guarantee
from mapper.tile import Tile, content_crc, join
from service.digest import DigestAssembly, DigestEntry, DigestPart, digest_root
from service.messages import AnchorMessage, MalformedMessage, PoseMessage, TileId, TileNote, guarantee_from
from service.rivals import FollowedRun


class CopiedMap:
    """What one run of a robot (an epoch) has told: where and how it is, its tiles, and what differs from a digest."""

    def __init__(self, counts: Counter[str], max_tiles: int) -> None:
        """What happens is counted in `counts`; tiles beyond `max_tiles` are counted, not kept."""
        self.tiles: dict[TileId, Tile] = {}
        self.guarantee: Guarantee | None = None
        self.pose: BoundedPose | None = None
        self.anchor: Anchor | None = None
        """Of the submap that is being mapped."""
        self.anchors: dict[int, Anchor] = {}
        """Of each submap, as last told."""
        self.health: Mapping[str, Any] = {}
        self.info: Mapping[str, Any] = {}
        self.stale: dict[TileId, int] = {}
        """Tiles that differed from the digest when it came, with the CRC that it listed."""
        self._differed: dict[TileId, Tile] = {}
        """Those of the stale ones that the copy held, as they were when the digest came."""
        self.listing_wanted = True
        """The robot's root differs from ours, and we have no listing to tell where."""
        self.compared = False
        """Has a listing of this epoch been compared with the copy?"""
        self.introduced = False
        """Were info, anchor and health of this epoch asked for and answered?"""
        self.in_sync = False
        """Did the copy equal what the newest digest said?"""
        self.final = False
        """Did the robot say that this is all?"""
        self.digest_count = 0
        self._counts = counts
        self._max_tiles = max_tiles
        self.run = FollowedRun()
        self._newest_submap = 0
        """Of the tiles that the followed run has sent."""
        self._crcs: dict[TileId, int] = {}
        self._beams_until_ns: dict[TileId, int | None] = {}
        self._root: tuple[int, int] | None = None
        """(tiles, root) of the newest digest."""
        self._assembly = DigestAssembly()

    def promised(self, place: TileId) -> bool:
        """Is all that is held of this tile from before the time since when the bounds are in doubt?"""
        bounds, until_ns = self.guarantee, self._beams_until_ns.get(place)
        if bounds is None or bounds.void_since_ns is None:
            return bounds is not None
        return until_ns is not None and until_ns < bounds.void_since_ns

    def robot_is_there(self, there: bool) -> None:
        """It came or went; whoever comes is asked what it has."""
        self.listing_wanted = self.listing_wanted or there
        self.in_sync = self.in_sync and there

    def take_guarantee(self, told: Guarantee) -> None:
        """As a pose or a tile says. Void stays void while a run lasts: a message that says otherwise came slower, as
        tiles do on a narrow link, which lets poses pass.
        """
        if self.guarantee is None or self.guarantee.intact or not told.intact:
            self.guarantee = told

    # Where the robot is, and how it does

    def take_pose(self, told: PoseMessage, now_ns: int) -> None:
        """A pose of the run that is followed."""
        if self._is_followed(told.epoch, now_ns):
            self.pose = told.pose()
            self.take_guarantee(self.pose.guarantee)

    def take_anchor(self, told: AnchorMessage, now_ns: int, submap: int | None = None) -> None:
        """Where the run that is followed says that its map frame stands, or that of an earlier `submap`."""
        if not self._is_followed(told.epoch, now_ns):
            return
        if submap is None:
            self.anchor = told.anchor()
        else:
            self.anchors[submap] = told.anchor()

    def take_health(self, told: Mapping[str, Any], now_ns: int) -> None:
        """How the robot does."""
        if self._is_followed(told.get("epoch"), now_ns):
            self.health = told

    def take_info(self, told: Mapping[str, Any], now_ns: int) -> None:
        """What the robot says of itself."""
        if self._is_followed(told.get("epoch"), now_ns):
            self.info = told

    def _is_followed(self, epoch: object, now_ns: int) -> bool:
        """`_follows`, where the message names a run: those of earlier versions do not."""
        return not isinstance(epoch, str) or self._follows(epoch, now_ns)

    # Tiles

    def take_tile(self, tile: Tile, note: TileNote, now_ns: int) -> None:
        """Join a tile or a delta."""
        if not self._follows(note.epoch, now_ns):
            return
        self._take_guarantee(tile, note)
        self.join(tile)

    def take_answer(self, tile: Tile, note: TileNote) -> None:
        """Join a whole tile; where ours still differs although the robot's is as listed, ours is wrong: replace it.

        Unless ours has grown since it was listed: then it may be ahead of the answer, which travels behind newer tiles.
        """
        if note.epoch != self.run.epoch:
            return
        place, crc = TileId(tile.submap, tile.ix, tile.iy), content_crc(tile)
        self._take_guarantee(tile, note)
        listed = self.stale.pop(place, None)
        self._counts["repaired"] += 1
        old = self.tiles.get(place)
        if (
            crc == listed
            and old is not None
            and old is self._differed.get(place)
            and (old.resolution_m != tile.resolution_m or content_crc(join(old, tile)) != crc)
        ):
            self._counts["replaced"] += 1
            self._set(place, tile)
        else:
            self.join(tile)
        if not self.stale:
            self.in_sync = self.introduced and self._equals_digest()

    def join(self, tile: Tile) -> None:
        """Hull of what we have and what came."""
        place = TileId(tile.submap, tile.ix, tile.iy)
        old = self.tiles.get(place)
        if old is None and len(self.tiles) >= self._max_tiles:
            self._counts["too_many_tiles"] += 1
            return
        if old is not None and old.resolution_m != tile.resolution_m:
            raise MalformedMessage("a tile of another resolution")
        self._set(place, tile if old is None else join(old, tile))

    def _set(self, place: TileId, tile: Tile) -> None:
        self.tiles[place] = tile
        self._newest_submap = max(self._newest_submap, place.submap)
        self._crcs.pop(place, None)

    def _take_guarantee(self, tile: Tile, note: TileNote) -> None:
        """What a tile of the newest submap says of the bounds; earlier runs are over, and had their own."""
        place, until_ns = TileId(tile.submap, tile.ix, tile.iy), note.beams_until_ns
        known = self._beams_until_ns.get(place, until_ns)
        self._beams_until_ns[place] = None if known is None or until_ns is None else max(known, until_ns)
        if tile.submap >= self._newest_submap:
            self.take_guarantee(guarantee_from(note.guarantee))

    def _follows(self, epoch: str, now_ns: int) -> bool:
        """Is this the run that is followed? Another one is another map, in another frame perhaps: begin anew."""
        before = self.run.epoch
        if not self.run.hear(epoch, now_ns):
            self._counts["left_epoch"] += 1
            return False
        if epoch != before:
            self._begin_anew(first=before is None)
        return True

    def _begin_anew(self, first: bool) -> None:
        self._counts["epochs"] += 1
        self.tiles.clear()
        self._newest_submap = 0
        self._crcs.clear()
        self._beams_until_ns.clear()
        self.anchors.clear()
        self.stale.clear()
        self._differed.clear()
        self._root = None
        if not first:
            self.guarantee = self.pose = self.anchor = None
            self.health, self.info = {}, {}
        self.introduced = self.introduced and first
        self.compared = self.in_sync = self.final = False
        self.listing_wanted = True

    # Digests

    def take_digest(self, part: DigestPart, now_ns: int) -> None:
        """Compare the copy with what the robot says it has."""
        if not self._follows(part.epoch, now_ns):
            return
        self.final = part.final
        self._root = (part.tiles, part.root)
        equal = self._equals_digest()
        self.in_sync = equal and self.introduced
        listed = self._assembly.add(part) if part.parts else None
        if equal:
            self.stale.clear()
            self.listing_wanted = False
        elif listed is not None:
            self._compare(listed)
        elif part.parts == 0:
            self.listing_wanted = True
        self.listing_wanted = self.listing_wanted or not self.introduced
        if equal or listed is not None or part.parts == 0:
            self.digest_count += 1

    def _equals_digest(self) -> bool:
        """Is the copy what the newest digest says?"""
        return self._root is not None and self._root == (len(self.tiles), digest_root(self._entries()))

    def _compare(self, listed: Mapping[TileId, int]) -> None:
        """Note what differs from the listing, and let go of what the robot doesn't have."""
        self.listing_wanted, self.compared = False, True
        own = {entry.tile: entry.crc for entry in self._entries()}
        for place in own.keys() - listed.keys():
            del self.tiles[place]
            self._beams_until_ns.pop(place, None)
            self._crcs.pop(place, None)
            self._counts["unlisted"] += 1
        self.stale = {place: crc for place, crc in listed.items() if own.get(place) != crc}
        self._differed = {place: self.tiles[place] for place in self.stale if place in self.tiles}
        self._counts["stale"] += len(self.stale)

    def _entries(self) -> list[DigestEntry]:
        """The copy as a digest would list it."""
        for place, tile in self.tiles.items():
            if place not in self._crcs:
                self._crcs[place] = content_crc(tile)
        return [DigestEntry(*place, crc) for place, crc in self._crcs.items()]
