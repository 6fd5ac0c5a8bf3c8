"""Answers to gets, for late joiners and for repair: a message at a time, so that nothing else waits for them."""

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass

import zenoh

from service.messages import TileId
from service.published_state import PublishedState
from service.token_bucket import TokenBucket
from service.topics import (
    ANCHOR,
    ANCHOR_OF,
    DIGEST,
    HEALTH,
    INFO,
    TILE,
    Topic,
    anchor_key,
    parse_tile_key,
    tile_key,
    topic_key,
)


@dataclass(slots=True)
class _Answer:
    """A question, and the keys still to be sent for it."""

    query: zenoh.Query
    tiles: Iterator[TileId]
    topics: Iterator[Topic]
    anchors: Iterator[int]
    """Submaps whose anchors are asked for."""


class Answers:
    """The publisher thread's questions that are not answered yet."""

    def __init__(self, robot: str, state: PublishedState, bucket: TokenBucket, counts: Counter[str]) -> None:
        """What is sent is taken from `bucket`."""
        self._robot, self._state, self._bucket, self._counts = robot, state, bucket, counts
        self._answers: deque[_Answer] = deque()

    def __bool__(self) -> bool:
        return bool(self._answers)

    def clear(self) -> None:
        """The session is gone, and who asked in it."""
        self._answers.clear()

    def take(self, query: zenoh.Query) -> None:
        """Work out which keys a question asks for."""
        asked, published, robot = query.key_expr, self._state.map, self._robot
        single = parse_tile_key(str(asked))
        if single is not None:
            place = TileId(single.submap, single.ix, single.iy)
            tiles = iter([place] if single.kind == "full" and place in published else [])
            self._answers.append(_Answer(query, tiles, iter([]), iter([])))
            return
        topics = [t for t in (INFO, ANCHOR, HEALTH, DIGEST) if asked.intersects(topic_key(robot, t))]
        matching = (place for place in published if asked.intersects(tile_key(robot, *place, "full")))
        submaps = [*self._state.earlier, self._state.submap]
        anchors = (number for number in submaps if asked.intersects(anchor_key(robot, number)))
        self._answers.append(_Answer(query, matching, iter(topics), anchors))

    def send_next(self) -> None:
        """Send one message of the oldest question's answer; a question whose answer is complete is let go."""
        answer = self._answers[0]
        try:
            if self._send(answer):
                return
        except zenoh.ZError:
            # Who asked is gone.
            self._counts["answers_failed"] += 1
        self._answers.popleft()
        answer.query.drop()  # type: ignore[no-untyped-call]  # the stub lacks a return type

    def _send(self, answer: _Answer) -> bool:
        """One message; False where the answer is complete."""
        if (topic := next(answer.topics, None)) is not None:
            for payload in self._state.said(topic):
                self._bucket.spend(len(payload))
                answer.query.reply(topic_key(self._robot, topic), payload, encoding=topic.encoding)
            return True
        if (submap := next(answer.anchors, None)) is not None:
            if (anchor := self._state.anchor_of(submap)) is not None:
                self._bucket.spend(len(anchor))
                answer.query.reply(anchor_key(self._robot, submap), anchor, encoding=ANCHOR_OF.encoding)
            return True
        place = next(answer.tiles, None)
        message = None if place is None else self._state.whole(place)
        if place is None or message is None:
            return False
        self._bucket.spend(len(message.payload))
        key = tile_key(self._robot, *place, "full")
        answer.query.reply(key, message.payload, encoding=TILE.encoding, attachment=message.note)
        self._counts["tiles_answered"] += 1
        return True
