"""The map's file, written while mapping goes on: what prevents it is told, and the next time is another try."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from estimator.bounded_pose import INTACT
from mapper.saved_map import load
from mapper.tile import Tile
from service.health import Health
from service.passing_save import PassingSave

LOW = np.zeros((64, 64), np.float32)
TILE = Tile(0, 1, 2, 0.05, LOW, LOW + np.float32(0.5))


def test_a_folder_that_is_away_is_told_until_it_is_back(tmp_path: Path) -> None:
    """A disk that isn't mounted yet: the trouble names the file, and is gone with the first save that works."""
    health, path = Health(), tmp_path / "disk" / "map.npz"
    saving = PassingSave(0.05, health)
    saving.begin([TILE], None, INTACT, path)
    saving.wait()
    assert str(path) in health.troubles["saving"]
    path.parent.mkdir()
    saving.begin([TILE], None, INTACT, path)
    saving.wait()
    assert health.troubles == {}
    assert load(path).high.max() == np.float32(0.5)


def test_whatever_else_goes_wrong_is_told_and_ends_nothing(tmp_path: Path) -> None:
    """As where tiles can't be had from the store's disk, or memory is short."""

    def tiles() -> Iterator[Tile]:
        yield TILE
        raise MemoryError

    health, path = Health(), tmp_path / "map.npz"
    saving = PassingSave(0.05, health)
    saving.begin(tiles(), None, INTACT, path)
    saving.wait()
    assert "MemoryError" in health.troubles["saving"]
    assert not saving.busy
    assert not path.exists()
