"""What the JSON messages say: pose, anchor, and the note on each tile. Writing and reading side by side.

docs/wire.md describes them for other programs; the digest stands in digest.py. Unknown keys are ignored, so that later
versions may add some; whatever else doesn't fit is refused with `MalformedMessage`. A bound that is infinite is `null`.
"""

import json
from collections.abc import Mapping, Sequence
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

WIRE = ConfigDict(extra="ignore", allow_inf_nan=False, strict=True, defer_build=True)
Count = Annotated[int, Field(ge=0)]
Name = Annotated[str, Field(min_length=1, max_length=64)]
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


@dataclass(frozen=True, slots=True, config=WIRE)
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


@dataclass(frozen=True, slots=True, config=WIRE)
class EllipsoidMessage:
    """A PlanarEllipsoid."""

    earliest_ns: int
    latest_ns: int
    centre: _Numbers3
    shape: Annotated[list[_Numbers3], Field(min_length=3, max_length=3)]


@dataclass(frozen=True, slots=True, config=WIRE)
class PoseMessage:
    """A BoundedPose."""

    earliest_ns: int
    latest_ns: int
    low: _Bounds6
    high: _Bounds6
    guarantee: GuaranteeMessage
    ellipsoid: EllipsoidMessage | None = None
    epoch: Name | None = None
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


@dataclass(frozen=True, slots=True, config=WIRE)
class AnchorMessage:
    """An Anchor."""

    origin_lat_deg: float
    origin_lon_deg: float
    origin_alt_m: float
    low: _Bounds4
    high: _Bounds4
    guarantee: GuaranteeMessage
    epoch: Name | None = None
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


@dataclass(frozen=True, slots=True, config=WIRE)
class TileNote:
    """What accompanies a tile, as Zenoh attachment."""

    epoch: Name
    """Which run of the publisher: tiles of different epochs must not be joined."""
    version: Count
    """Counts the published changes of this tile."""
    guarantee: GuaranteeMessage
    released_ns: int | None = None
    """Monotonic clock of the robot's host when the update's last sample had been read; absent in answers."""
    beams_until_ns: int | None = None
    """No beam in the tile's present cells is newer; None: not known."""


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
