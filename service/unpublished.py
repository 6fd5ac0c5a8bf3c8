"""What stands in a publisher's place where nobody is to receive the map."""

from typing import Any

from service.map_keeper import EarlierSubmaps
from service.map_update import MapUpdate


class Unpublished:
    """In place of a publisher, where nobody is to receive the map."""

    ready = False
    takes_updates = False
    submap = 0
    failure: str | None = None
    rival: str | None = None

    def offer_earlier(self, earlier: EarlierSubmaps) -> None:
        """Nobody is to receive it."""

    def start(self) -> None:
        """Nothing to open."""

    def offer(self, update: MapUpdate) -> bool:
        """Never asked for: not ready."""
        return False

    def wait_until_ready(self, timeout_s: float) -> bool:
        """Never."""
        return False

    def state(self) -> dict[str, Any]:
        """Nothing to tell."""
        return {}

    def flush(self, timeout_s: float) -> bool:
        """Nothing is waiting."""
        return True

    def close(self) -> None:
        """Nothing is open."""
