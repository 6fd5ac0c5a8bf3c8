"""A Zenoh session set up for a robot's radio: found by address alone, quick to come back, never full of stale data."""

import json
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Literal, TypeVar

import zenoh
from zenoh.handlers import Callback

from drivers.errors import LinkError

LEASE_MS = 4000
"""A peer that was silent for this long is gone."""
SEND_BUFFER_BYTES = 65536
"""Of each link: what lies in it on a slow link is stale when it arrives."""
CALLBACK_ENDS_S = 5.0
_RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}


Heard = TypeVar("Heard")


class NotAnAddress(LinkError):
    """What no waiting mends. Every other LinkError may pass: the radio comes up, another program ends."""


@contextmanager
def open_session(
    mode: Literal["peer", "client"], listen: Sequence[str] = (), connect: Sequence[str] = (), multicast: bool = False
) -> Iterator[zenoh.Session]:
    """An open session, surely closed at the end. Raises LinkError that names the address and what to do.

    A peer keeps trying `connect` in the background; a client gives up at once. Both come back by themselves after
    a link was lost.
    """
    config = session_config(mode, listen, connect, multicast)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise LinkError(_advice(str(error), listen, connect)) from None
    with session:
        yield session


@contextmanager
def ended_callback(callback: Callable[[Heard], object]) -> Iterator["Callback[Heard]"]:
    """A handler for one declaration that is undeclared inside the block; after it, the callback's thread has ended.

    Zenoh calls back on a Python thread of its own, which outlives the session by a moment: if the interpreter ends in
    that moment, the thread is torn out of Zenoh's code, and the process aborts.
    """
    last: list[threading.Thread] = []
    dropped = threading.Event()

    def drop() -> None:
        last.append(threading.current_thread())
        dropped.set()

    try:
        yield Callback(callback, drop)
    finally:
        if dropped.wait(CALLBACK_ENDS_S):
            last[0].join(CALLBACK_ENDS_S)


def session_config(
    mode: Literal["peer", "client"], listen: Sequence[str] = (), connect: Sequence[str] = (), multicast: bool = False
) -> zenoh.Config:
    """Settings of a session. Raises NotAnAddress where an address isn't one."""
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "scouting/multicast/enabled": multicast,
        "scouting/gossip/enabled": multicast,
        # Shared memory leaves segments behind when a process is killed.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "connect/timeout_ms": -1 if mode == "peer" else 0,
        "connect/exit_on_failure": False,
        "connect/retry": _RETRY,
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    for key, endpoints in (("listen/endpoints", listen), ("connect/endpoints", connect)):
        try:
            config.insert_json5(key, json.dumps([with_send_buffer(endpoint) for endpoint in endpoints]))
        except zenoh.ZError:
            named = ", ".join(endpoints)
            raise NotAnAddress(f"{named}: not an address; write it as tcp/192.168.1.5:7447") from None
    return config


def with_send_buffer(endpoint: str) -> str:
    """A TCP or TLS endpoint with a short send buffer, unless it sets one itself."""
    if not endpoint.startswith(("tcp/", "tls/")) or "so_sndbuf=" in endpoint:
        return endpoint
    return f"{endpoint}{';' if '#' in endpoint else '#'}so_sndbuf={SEND_BUFFER_BYTES}"


def _advice(cause: str, listen: Sequence[str], connect: Sequence[str]) -> str:
    """One line from Zenoh's own words: which address, what was found, what to do."""
    # Zenoh names the endpoint that failed; its words end with a source file of its own, which helps nobody.
    named = next((endpoint for endpoint in (*listen, *connect) if endpoint in cause), ", ".join((*listen, *connect)))
    if "Address already in use" in cause:
        return f"{named}: the address is in use; stop the program that listens there, or choose another publish.listen"
    if "Cannot assign requested address" in cause:
        return f"{named}: this host has no such address; look at `ip address`, or listen at tcp/0.0.0.0:7447"
    if "Unable to connect" in cause or "refused" in cause:
        return f"{named}: nobody answers; is the robot's service running, and is this its address?"
    return f"{named}: the session can't be opened: {cause.split(' at /')[0]}"
