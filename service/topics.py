"""Wiring table of the wire: every key the robot publishes, how often, and how urgent it is.

Keys are `terrabound/v1/<robot>/<topic>`; a tile's topic is `map/<submap>/<ix>/<iy>/{full,delta}`. Nothing blocks the
sender: a message that finds its queue full is dropped, and the digest tells who missed it.
"""

import re
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

from zenoh import Priority

ROOT = "terrabound/v1"
JSON = "application/json"
GRID = "application/protobuf;foxglove.Grid+zstd"
"""Encoding string of every tile."""

Kind: TypeAlias = Literal["full", "delta"]


@dataclass(frozen=True, slots=True)
class Topic:
    """One row of the table."""

    name: str
    """Key expression below `terrabound/v1/<robot>/`."""
    encoding: str
    when: str
    """When it is sent; the periods are set under [publish]."""
    priority: Priority
    """Smaller is sent first: a narrow link drops tiles before it drops the pose."""
    express: bool = False
    """Sent at once rather than batched with its neighbours for up to a millisecond."""
    queried: bool = False
    """Answered to a get as well."""


POSE = Topic("pose", JSON, "at most pose_rate_hz", Priority.INTERACTIVE_HIGH, express=True)
HEALTH = Topic("health", JSON, "every health_period_s", Priority.INTERACTIVE_LOW, queried=True)
INFO = Topic("info", JSON, "with each digest", Priority.DATA_HIGH, queried=True)
ANCHOR = Topic("anchor", JSON, "when it changes, and with each digest", Priority.DATA_HIGH, queried=True)
ANCHOR_OF = Topic("anchor/*", JSON, "of earlier runs, when a digest lists all", Priority.DATA_HIGH, queried=True)
"""Of one submap, also of those that earlier runs left: `anchor/<submap>`."""
DIGEST = Topic("digest", JSON, "every digest_period_s, and at the end", Priority.DATA_LOW, queried=True)
"""As urgent as the tiles it lists, so that it never overtakes them: who compares on arrival sees only true losses."""
TILE = Topic("map/*/*/*/{full,delta}", GRID, "when cells changed", Priority.DATA_LOW, express=True, queried=True)
REPAIR_PRIORITY = Priority.BACKGROUND
"""Of a client's gets; answers travel at the priority of their question."""

TOPICS = (POSE, HEALTH, INFO, ANCHOR, ANCHOR_OF, DIGEST, TILE)


class TileKey(NamedTuple):
    """What a tile's key says."""

    robot: str
    submap: int
    ix: int
    iy: int
    kind: Kind


_TILE = re.compile(
    rf"{ROOT}/(?P<robot>[A-Za-z0-9_-]+)/map/(?P<submap>\d{{1,10}})"
    r"/(?P<ix>-?\d{1,10})/(?P<iy>-?\d{1,10})/(?P<kind>full|delta)",
    re.ASCII,
)


def topic_key(robot: str, topic: Topic) -> str:
    """Key of a topic that has one key: `pose`, `anchor`, `health`, `digest`, `info`."""
    return f"{ROOT}/{robot}/{topic.name}"


def anchor_key(robot: str, submap: int) -> str:
    """Key of one submap's anchor."""
    return f"{ROOT}/{robot}/anchor/{submap}"


def submap_of_anchor(name: str) -> int | None:
    """The submap in a topic's name that `anchor_key` made; None where it isn't one."""
    match = re.fullmatch(r"anchor/(\d{1,10})", name, re.ASCII)
    return None if match is None else int(match[1])


def robot_key(robot: str) -> str:
    """Key of the robot's liveliness token."""
    return f"{ROOT}/{robot}"


def tile_key(robot: str, submap: int, ix: int, iy: int, kind: Kind) -> str:
    """Key of one tile."""
    return f"{ROOT}/{robot}/map/{submap}/{ix}/{iy}/{kind}"


def parse_tile_key(key: str) -> TileKey | None:
    """What a tile's key says; None where it isn't exactly what `tile_key` writes."""
    match = _TILE.fullmatch(key)
    if match is None:
        return None
    kind: Kind = "full" if match["kind"] == "full" else "delta"
    parsed = TileKey(match["robot"], int(match["submap"]), int(match["ix"]), int(match["iy"]), kind)
    return parsed if tile_key(*parsed) == key else None


def split_key(key: str) -> tuple[str, str] | None:
    """(robot, topic's name) of any key of ours; the name of the robot's own key is empty."""
    if not key.startswith(f"{ROOT}/"):
        return None
    robot, _, name = key[len(ROOT) + 1 :].partition("/")
    return robot, name
