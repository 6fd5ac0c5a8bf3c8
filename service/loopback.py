"""A Zenoh address of this host's own, for a demo or a rehearsal: nobody outside reaches it."""

import random
import socket

from drivers.errors import LinkError

PORTS = range(20_000, 32_768)
"""Below those that systems give to outgoing connections: between the look and the use nobody takes one by itself."""
TRIES = 100


def free_locator() -> str:
    """`tcp/127.0.0.1:<port>` at which nobody listens. Raises LinkError where no port is found."""
    # Not seeded: two processes that look at the same time should not look at the same ports.
    for port in random.SystemRandom().sample(PORTS, TRIES):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return f"tcp/127.0.0.1:{port}"
    raise LinkError(f"no free TCP port among {TRIES} tried in {PORTS.start} to {PORTS.stop - 1} on 127.0.0.1")
