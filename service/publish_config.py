"""`[publish]`: where and how often the map is published."""

import re
from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from drivers.config import STRICT

_WITH_PORT = re.compile(r"(?:tcp|udp|tls|quic|ws)/[^\s/]+:([0-9]{1,5})(?:[?#].*)?")
_OTHER = re.compile(r"(?!tcp/|udp/|tls/|quic/|ws/)[a-z][a-z0-9_-]*/\S+")


def _address(value: str) -> str:
    """A Zenoh address, as far as it can be told without opening it."""
    with_port = _WITH_PORT.fullmatch(value)
    if int(with_port[1]) > 65535 if with_port else _OTHER.fullmatch(value) is None:
        raise ValueError("should be an address with a port up to 65535, as tcp/0.0.0.0:7447")
    return value


Address = Annotated[str, AfterValidator(_address)]
Period = Annotated[float, Field(gt=0, le=3600)]


@dataclass(frozen=True, slots=True, kw_only=True, config=STRICT)
class PublishConfig:
    """Where and how often the map is published."""

    listen: Sequence[Address] = ("tcp/127.0.0.1:7447",)
    """Zenoh addresses at which subscribers connect, as tcp/0.0.0.0:7447."""
    connect: Sequence[Address] = ()
    """Zenoh routers to connect to."""
    digest_period_s: Period = 1.0
    """How often subscribers learn what they may have missed."""
    pose_rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0
    health_period_s: Period = 1.0
    max_bytes_per_s: Annotated[float, Field(ge=10_000)] = 10e6
    """Tiles and answers together stay below this: set it below what the radio carries."""
    multicast: bool = False
    """Announce the robot on the local network, so that subscribers need no address."""
