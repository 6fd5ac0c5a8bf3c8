"""What subscribers are to have at present, and the messages that say it: tiles, anchor, health, info and digest."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from estimator.bounded_pose import INTACT, Anchor
from mapper.tile import Tile
from mapper.tile_codec import encode
from service.digest import DigestPart, digest_parts, digest_root
from service.map_update import MAP_FRAME, MapUpdate
from service.messages import (
    AnchorMessage,
    MalformedMessage,
    TileId,
    guarantee_message,
    read,
    write,
    write_anchor,
    write_note,
    write_plain,
)
from service.published_map import EarlierSubmap, PublishedMap
from service.topics import ANCHOR, DIGEST, HEALTH, INFO, Kind, Topic


class TileMessage(NamedTuple):
    """A tile as it goes out."""

    kind: Kind
    payload: bytes
    note: bytes


class PublishedState:
    """The publisher thread's own: no other touches it."""

    def __init__(
        self,
        epoch: str,
        info: Mapping[str, Any],
        published: PublishedMap,
        counts: Counter[str],
        about_publisher: Callable[[], Mapping[str, Any]],
    ) -> None:
        """`about_publisher` tells what `.../health` says of the publisher itself."""
        self.map = published
        self.earlier: Mapping[int, EarlierSubmap] = {}
        self.submap = 0
        """The one that is being mapped."""
        self.final = False
        """Is everything that was offered, all of it, sent? From a flush until the next offer."""
        self.health: Mapping[str, Any] | None = None
        self.anchor: bytes | None = None
        """As it was written last."""
        self.unsent_anchor = False
        """Is it another one than was sent?"""
        self.epoch = epoch
        self._info = info
        self._counts = counts
        self._about_publisher = about_publisher
        self._guarantee, self._guarantee_json = INTACT, write(guarantee_message(INTACT))
        self._beams_until_ns: dict[TileId, int] = {}
        """Of the tiles that this run has sent."""
        self._newest_anchor: Anchor | None = None
        """Not written yet: that is done when one could be sent."""
        self._sequence = 0

    def take(self, update: MapUpdate) -> None:
        """An update has come; its tiles come one by one, see `news`."""
        self.map.forget(update.forgotten)
        for place in update.forgotten:
            self._beams_until_ns.pop(place, None)
        self.final = False
        self.health = update.health
        self._newest_anchor = update.anchor or self._newest_anchor
        if update.guarantee != self._guarantee:
            self._guarantee, self._guarantee_json = update.guarantee, write(guarantee_message(update.guarantee))

    def adopt(self, earlier: Mapping[int, EarlierSubmap]) -> None:
        """Earlier submaps have come: from now on the digest lists them."""
        self.earlier = {number: replace(submap, anchor=self._told_now(submap)) for number, submap in earlier.items()}
        for submap in earlier.values():
            self.map.adopt(submap.tiles)

    def _told_now(self, submap: EarlierSubmap) -> bytes | None:
        """An earlier run's anchor, as this run tells it."""
        try:
            return submap.anchor and write(replace(read(AnchorMessage, submap.anchor), epoch=self.epoch))
        except MalformedMessage:
            self._counts["unreadable_anchors"] += 1
            return None

    def news(self, tile: Tile, update: MapUpdate) -> TileMessage | None:
        """What changed of one tile of an update since it was last sent."""
        news = self.map.update(tile)
        if news is None:
            return None
        payload = encode(news.tile, MAP_FRAME, time.time_ns(), news.cells)
        if update.beams_until_ns is not None:
            self._beams_until_ns[TileId(tile.submap, tile.ix, tile.iy)] = update.beams_until_ns
        times = update.released_ns, update.beams_until_ns
        return TileMessage(news.kind, payload, write_note(self.epoch, news.version, self._guarantee_json, *times))

    def whole(self, place: TileId) -> TileMessage | None:
        """A tile as it was published last; None where it isn't there any more."""
        published = self.map.get(place)
        if published is None:
            return None
        earlier = self.earlier.get(place.submap)
        guarantee = self._guarantee_json if earlier is None else write(earlier.guarantee)
        note = write_note(self.epoch, published.version, guarantee, None, self._beams_until_ns.get(place))
        return TileMessage("full", encode(published.tile, MAP_FRAME, time.time_ns()), note)

    def write_anchor(self) -> None:
        """The newest anchor as it is sent, and whether it is another one than before."""
        if self._newest_anchor is not None:
            anchor, self._newest_anchor = write_anchor(self._newest_anchor, self.epoch), None
            self.unsent_anchor = self.unsent_anchor or anchor != self.anchor
            self.anchor = anchor

    def anchor_of(self, submap: int) -> bytes | None:
        """The anchor of the present submap, or what an earlier run left of its own."""
        return self.earlier[submap].anchor if submap in self.earlier else self.anchor

    def digest(self, summary_if_root: int | None = None) -> Iterator[DigestPart]:
        """The present digest; a summary alone where its root is this one."""
        self._sequence += 1
        entries = self.map.entries()
        root = digest_root(entries)
        if root == summary_if_root:
            return iter([DigestPart(self.epoch, self._sequence, self.final, len(entries), root, 0, 0, [])])
        return digest_parts(self.epoch, self._sequence, self.final, entries, root)

    def said(self, topic: Topic) -> list[bytes]:
        """What a get on a topic brings; none where there is nothing to say yet."""
        if topic is DIGEST:
            return [write(part) for part in self.digest()]
        if topic is ANCHOR:
            return [] if self.anchor is None else [self.anchor]
        if topic is HEALTH and self.health is None:
            return []
        return [self.plain(topic)]

    def plain(self, topic: Topic) -> bytes:
        """`info` and `health` as they are now."""
        if topic is INFO:
            return write_plain({**self._info, "submap": self.submap, "tiles": len(self.map)})
        own = {"publisher": self._about_publisher(), "epoch": self.epoch}
        try:
            return write_plain({**(self.health or {}), **own})
        except (ValueError, TypeError) as error:
            self._counts["unsendable_health"] += 1
            return write_plain({"failure": f"health can't be written: {error}", **own})
