"""`[publish]`: where and how often the map is published."""

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from drivers.config import STRICT, Positive


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class PublishConfig:
    """Where and how often the map is published."""

    listen: Sequence[str] = ("tcp/127.0.0.1:7447",)
    """Zenoh addresses at which subscribers connect, as tcp/0.0.0.0:7447."""
    connect: Sequence[str] = ()
    """Zenoh routers to connect to."""
    digest_period_s: Positive = 1.0
    """How often subscribers learn what they may have missed."""
    pose_rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0
    health_period_s: Positive = 1.0
    max_bytes_per_s: Annotated[float, Field(ge=10_000)] = 10e6
    """Tiles and answers together stay below this: set it below what the radio carries."""
    multicast: bool = False
    """Announce the robot on the local network, so that subscribers need no address."""
