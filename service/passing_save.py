"""The map's file, written while mapping goes on."""

import threading
from collections.abc import Iterable
from pathlib import Path

from estimator.bounded_pose import Anchor, Guarantee
from mapper.tile import Tile
from service.health import Health
from service.map_file import save_tiles


class PassingSave:
    """A thread a file, one at a time; a full disk is told, and nothing ends by it."""

    def __init__(self, resolution_m: float, health: Health) -> None:
        self._resolution_m = resolution_m
        self._health = health
        self._thread: threading.Thread | None = None

    @property
    def busy(self) -> bool:
        """Is one being written?"""
        return self._thread is not None and self._thread.is_alive()

    def begin(self, tiles: Iterable[Tile], anchor: Anchor | None, guarantee: Guarantee, path: Path) -> None:
        """Write these tiles to `path`; they are taken from wherever they lie by the thread that writes."""
        self._thread = threading.Thread(
            target=self._write, args=(tiles, anchor, guarantee, path), name="saver", daemon=True
        )
        self._thread.start()

    def wait(self) -> None:
        """Return when nothing is being written."""
        if self._thread is not None:
            self._thread.join()

    def _write(self, tiles: Iterable[Tile], anchor: Anchor | None, guarantee: Guarantee, path: Path) -> None:
        try:
            save_tiles(tiles, self._resolution_m, anchor, guarantee, path)
        except Exception as error:
            # Whatever it is: mapping goes on, and the next save is another try.
            self._health.trouble("saving", str(error) or f"{path}: can't be written: {error!r}")
        else:
            self._health.trouble("saving", None)
