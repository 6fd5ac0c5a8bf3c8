"""What the JSON messages say: pose, anchor, digest, and the note on each tile. Writing and reading side by side.

docs/wire.md describes them for other programs. Unknown keys are ignored, so that later versions may add some; whatever
else doesn't fit is refused with `MalformedMessage`. A bound that is infinite is `null`.
"""

import json
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import isfinite
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from estimator.bounded_pose import INTACT, Anchor, BoundedPose, Guarantee, PlanarEllipsoid, Status
from estimator.inconsistency import Fault

MAX_BYTES = 1 << 18
"""Longer messages are refused unread."""
DIGEST_PART_TILES = 1000
"""Tiles that one message of a digest lists: below 48 KiB, beyond which a slow link loses fragments."""

_WIRE = ConfigDict(extra="ignore", allow_inf_nan=False, strict=True, defer_build=True)
_Crc = Annotated[int, Field(ge=0, lt=2**32)]
_Count = Annotated[int, Field(ge=0)]
_Index = Annotated[int, Field(ge=-(2**31), lt=2**31)]
_Name = Annotated[str, Field(min_length=1, max_length=64)]
_Bounds6 = Annotated[list[float | None], Field(min_length=6, max_length=6)]
_Numbers3 = Annotated[list[float], Field(min_length=3, max_length=3)]
_Bounds4 = Annotated[list[float | None], Field(min_length=4, max_length=4)]
T = TypeVar("T")


class MalformedMessage(ValueError):
    """A message that isn't what its key says."""


class TileId(NamedTuple):
    """Which tile."""

    submap: int
    ix: int
    iy: int


class DigestEntry(NamedTuple):
    """One tile of the robot's map: where, and the CRC-32 of its published content."""

    submap: _Count
    ix: _Index
    iy: _Index
    crc: _Crc

    @property
    def tile(self) -> TileId:
        """Which tile."""
        return TileId(self.submap, self.ix, self.iy)


@dataclass(frozen=True, slots=True, config=_WIRE)
class GuaranteeMessage:
    """Do the bounds hold?"""

    intact: bool
    void_since_ns: int | None = None
    sensor: str | None = None
    excess: float | None = None
    unit: str | None = None
    status: str = "NOMINAL"
    restored_ns: int | None = None
    contradicted_ns: int | None = None


@dataclass(frozen=True, slots=True, config=_WIRE)
class EllipsoidMessage:
    """A PlanarEllipsoid."""

    earliest_ns: int
    latest_ns: int
    centre: _Numbers3
    shape: Annotated[list[_Numbers3], Field(min_length=3, max_length=3)]


@dataclass(frozen=True, slots=True, config=_WIRE)
class PoseMessage:
    """A BoundedPose."""

    earliest_ns: int
    latest_ns: int
    low: _Bounds6
    high: _Bounds6
    guarantee: GuaranteeMessage
    ellipsoid: EllipsoidMessage | None = None
    epoch: _Name | None = None
    """Of the run whose pose it is; absent in files, and of earlier versions."""

    @classmethod
    def of(cls, pose: BoundedPose, epoch: str | None = None) -> "PoseMessage":
        """What is written of a pose."""
        e = pose.ellipsoid
        ellipsoid = (
            None if e is None else EllipsoidMessage(e.earliest_ns, e.latest_ns, e.centre.tolist(), e.shape.tolist())
        )
        bounds = _finite(pose.low), _finite(pose.high)
        return cls(
            pose.earliest_ns, pose.latest_ns, *bounds, guarantee_message(pose.guarantee), ellipsoid, epoch
        )  # fmt: skip

    def pose(self) -> BoundedPose:
        """The pose; MalformedMessage where its bounds are none."""
        low, high = _bounds(self.low, self.high)
        e = self.ellipsoid
        ellipsoid = (
            None if e is None else PlanarEllipsoid(e.earliest_ns, e.latest_ns, np.array(e.centre), np.array(e.shape))
        )
        return BoundedPose(self.earliest_ns, self.latest_ns, low, high, guarantee_from(self.guarantee), ellipsoid)


@dataclass(frozen=True, slots=True, config=_WIRE)
class AnchorMessage:
    """An Anchor."""

    origin_lat_deg: float
    origin_lon_deg: float
    origin_alt_m: float
    low: _Bounds4
    high: _Bounds4
    guarantee: GuaranteeMessage
    epoch: _Name | None = None
    """Of the run that tells it; absent in stores and files, and of earlier versions."""

    @classmethod
    def of(cls, anchor: Anchor, epoch: str | None = None) -> "AnchorMessage":
        """What is written of an anchor."""
        origin = anchor.origin_lat_deg, anchor.origin_lon_deg, anchor.origin_alt_m
        return cls(*origin, _finite(anchor.low), _finite(anchor.high), guarantee_message(anchor.guarantee), epoch)

    def anchor(self) -> Anchor:
        """The anchor; MalformedMessage where its bounds are none."""
        low, high = _bounds(self.low, self.high)
        origin = self.origin_lat_deg, self.origin_lon_deg, self.origin_alt_m
        return Anchor(*origin, low, high, guarantee_from(self.guarantee))


@dataclass(frozen=True, slots=True, config=_WIRE)
class TileNote:
    """What accompanies a tile, as Zenoh attachment."""

    epoch: _Name
    """Which run of the publisher: tiles of different epochs must not be joined."""
    version: _Count
    """Counts the published changes of this tile."""
    guarantee: GuaranteeMessage
    released_ns: int | None = None
    """Monotonic clock of the robot's host when the update's last sample had been read; absent in answers."""
    beams_until_ns: int | None = None
    """No beam in the tile's present cells is newer; None: not known."""


@dataclass(frozen=True, slots=True, config=_WIRE)
class DigestPart:
    """One message of a digest: what the robot's map holds. `parts` is 0 where nothing changed since it was listed."""

    epoch: _Name
    sequence: _Count
    final: bool
    """The run has ended in order, and this is all of it."""
    tiles: _Count
    """Tiles in all."""
    root: _Crc
    """CRC-32 over all entries: who has the same root has the same map."""
    part: _Count
    parts: Annotated[int, Field(ge=0, le=10_000)]
    entries: Annotated[list[DigestEntry], Field(max_length=DIGEST_PART_TILES)]


_ADAPTERS: dict[type, TypeAdapter[Any]] = {}


def _adapter(kind: type) -> TypeAdapter[Any]:
    """Made when it is first wanted: a start needs few of them."""
    if kind not in _ADAPTERS:
        _ADAPTERS[kind] = TypeAdapter(kind)
    return _ADAPTERS[kind]


def write(message: object) -> bytes:
    """A message as JSON."""
    return _adapter(type(message)).dump_json(message)


def write_note(
    epoch: str, version: int, guarantee: bytes, released_ns: int | None = None, beams_until_ns: int | None = None
) -> bytes:
    """`write` of a TileNote, in a tenth of the time: hundreds are written a second. `guarantee`: written already."""
    released, until = ("null" if time is None else time for time in (released_ns, beams_until_ns))
    text = f'{{"epoch":"{epoch}","version":{version},"guarantee":{guarantee.decode()},"released_ns":{released}'
    return f'{text},"beams_until_ns":{until}}}'.encode()


def read(kind: type[T], data: bytes) -> T:
    """A message of this kind, or MalformedMessage."""
    if len(data) > MAX_BYTES:
        raise MalformedMessage(f"{len(data)} bytes are too many")
    try:
        message: T = _adapter(kind).validate_json(data)
    except ValidationError as error:
        raise MalformedMessage(str(error.errors(include_url=False)[0]["msg"])) from None
    return message


def write_plain(values: Mapping[str, Any]) -> bytes:
    """`health` and `info`: any plain values."""
    return json.dumps(values, allow_nan=False, default=str, separators=(",", ":")).encode()


def read_plain(data: bytes) -> dict[str, Any]:
    """`health` and `info`."""
    if len(data) > MAX_BYTES:
        raise MalformedMessage(f"{len(data)} bytes are too many")
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(str(error)) from None
    if not isinstance(values, dict):
        raise MalformedMessage("not an object")
    return values


def guarantee_message(guarantee: Guarantee) -> GuaranteeMessage:
    """A Guarantee for the wire."""
    excess = guarantee.excess if guarantee.excess is not None and isfinite(guarantee.excess) else None
    return GuaranteeMessage(
        guarantee.intact,
        guarantee.void_since_ns,
        guarantee.sensor,
        excess,
        guarantee.unit,
        guarantee.status.value,
        guarantee.restored_ns,
        guarantee.contradicted_ns,
    )


def guarantee_text(guarantee: Guarantee) -> str:
    """A guarantee as the store keeps it."""
    return "" if guarantee == INTACT else write(guarantee_message(guarantee)).decode()


def guarantee_of(text: str) -> GuaranteeMessage:
    """What `guarantee_text` wrote."""
    return read(GuaranteeMessage, text.encode()) if text else guarantee_message(INTACT)


def fault_values(fault: Fault) -> dict[str, Any]:
    """A fault as health tells it: plain values, a contradiction that no width helps without an excess."""
    found = fault.contradiction
    return {
        "sensor": fault.sensor,
        "suspects": list(fault.suspects),
        "contradicted_by": found.sensor,
        "contradicted_ns": found.time_ns,
        "excess": found.excess if isfinite(found.excess) else None,
        "unit": found.unit,
        "void_since_ns": fault.void_since_ns,
        "restored_ns": fault.restored_ns,
    }


def guarantee_from(message: GuaranteeMessage) -> Guarantee:
    """The Guarantee of a message; one that says no more than "not intact" is void since ever."""
    if message.intact:
        return Guarantee()
    status = Status(message.status) if message.status in Status.__members__ else Status.LOST
    return Guarantee(
        message.void_since_ns or 0,
        message.sensor,
        message.excess,
        message.unit,
        status,
        message.restored_ns,
        message.contradicted_ns,
    )


def write_pose(pose: BoundedPose, epoch: str | None = None) -> bytes:
    """A pose as JSON; numbers come back bit for bit."""
    return write(PoseMessage.of(pose, epoch))


def read_pose(data: bytes) -> BoundedPose:
    """A pose, or MalformedMessage."""
    return read(PoseMessage, data).pose()


def write_anchor(anchor: Anchor, epoch: str | None = None) -> bytes:
    """An anchor as JSON; numbers come back bit for bit."""
    return write(AnchorMessage.of(anchor, epoch))


def read_anchor(data: bytes) -> Anchor:
    """An anchor, or MalformedMessage."""
    return read(AnchorMessage, data).anchor()


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


def _finite(bounds: NDArray[np.float64]) -> list[float | None]:
    return [bound if isfinite(bound) else None for bound in bounds.tolist()]


def _bounds(
    low: Sequence[float | None], high: Sequence[float | None]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    lows = np.array([-np.inf if bound is None else bound for bound in low])
    highs = np.array([np.inf if bound is None else bound for bound in high])
    if np.any(lows > highs):
        raise MalformedMessage("a low bound above its high bound")
    return lows, highs
