"""Two services under one robot's name: no subscriber can tell their poses apart, and each has a map of its own.

They meet at a router, or where robots announce themselves or connect to each other. A router passes nothing on between
services, so there only copies notice. Each run of a publisher has an epoch; what a
run that is over has sent may straggle in for a moment, a rival goes on.
"""

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh
from zenoh.handlers import RingChannel

from service.topics import INFO, topic_key

STRAGGLING_NS = 5_000_000_000
"""So long after another run was heard, messages of the one before may still have been on their way."""
SILENT_NS = 10_000_000_000
"""Who was not heard for so long is there no more."""
_KNOWN = 16
"""Runs that are remembered."""


def this_host() -> str:
    """Who one is, for `info`: the host's name, and its present address of the default route as far as there is one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing: it asks the kernel for the route
            return f"{socket.gethostname()} ({probe.getsockname()[0]})"
        except OSError:
            return socket.gethostname()


class FollowedRun:
    """Which run a copy follows: the newest, as long as it speaks. And does one that it left go on beside it?"""

    def __init__(self) -> None:
        self.epoch: str | None = None
        self._heard_ns = 0
        self._left_ns: dict[str, int] = {}
        """When runs that were followed before were left."""
        self._rival: tuple[str, int] | None = None
        """The one that was heard beside the followed one, and when."""

    def hear(self, epoch: str, now_ns: int) -> bool:
        """A message of this run has come. Is it the one to follow (from now on `epoch`)?"""
        if epoch != self.epoch:
            left_ns = self._left_ns.get(epoch)
            if left_ns is not None and now_ns - left_ns > STRAGGLING_NS:
                self._rival = epoch, now_ns
            if left_ns is not None and now_ns - self._heard_ns <= SILENT_NS:
                return False
            if self.epoch is not None:
                self._left_ns[self.epoch] = now_ns
            self._left_ns.pop(epoch, None)
            if len(self._left_ns) > _KNOWN:
                del self._left_ns[next(iter(self._left_ns))]
            self.epoch = epoch
        self._heard_ns = now_ns
        return True

    def left(self, epoch: object) -> bool:
        """Was this run followed before, and isn't any more?"""
        return epoch in self._left_ns

    def rival(self, now_ns: int) -> str | None:
        """Epoch of a run that was heard lately beside the followed one; None where there is none."""
        if self._rival is None or now_ns - self._rival[1] > SILENT_NS or self._rival[0] == self.epoch:
            return None
        return self._rival[0]


class OwnName:
    """A publisher's ear for others that publish under its robot's name."""

    def __init__(self, robot: str, epoch: str) -> None:
        self._robot, self._epoch = robot, epoch
        self._heard: zenoh.Handler[zenoh.Sample] | None = None
        self._rival: tuple[str, int] | None = None
        """Its host, and when it was heard last."""

    @contextmanager
    def listening(self, session: zenoh.Session) -> Iterator[None]:
        """Hear what others say of themselves in this session, until the end of the block."""
        key, remote = topic_key(self._robot, INFO), zenoh.Locality.REMOTE
        with session.declare_subscriber(key, RingChannel(4), allowed_origin=remote) as subscriber:
            self._heard = subscriber.handler
            try:
                yield
            finally:
                self._heard = None

    def rival(self, now_ns: int) -> str | None:
        """A sentence about another publisher of this name that was heard lately; None where there is none.

        For the thread that listens.
        """
        while self._heard is not None and (sample := self._heard.try_recv()) is not None:
            try:
                told = json.loads(bytes(sample.payload))
                if told["epoch"] != self._epoch:
                    self._rival = str(told.get("host", "unknown")), now_ns
            except (ValueError, KeyError, TypeError, AttributeError):
                continue  # whatever it is, it isn't another of us
        if self._rival is None or now_ns - self._rival[1] > SILENT_NS:
            return None
        return (
            f"another service publishes as {self._robot!r}, too, on the host {self._rival[0]}; "
            "copies can't tell the two apart: set another robot.name in one of them, or stop it"
        )
