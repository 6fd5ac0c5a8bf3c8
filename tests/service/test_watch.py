"""`terrabound watch`, against a publisher on loopback TCP."""

from pathlib import Path

import numpy as np
import pytest

from estimator.bounded_pose import INTACT, Anchor, BoundedPose
from mapper.saved_map import load
from mapper.tile import Tile
from service.cli import run_command
from service.loopback import free_locator
from service.map_update import MapUpdate
from service.publish_config import PublishConfig
from service.publisher import Publisher

WAIT_S = 20.0


def a_tile(submap: int, height_m: float) -> Tile:
    layer = np.full((64, 64), np.nan, np.float32)
    layer[3, 5] = height_m
    return Tile(submap, 0, 0, 0.05, layer, layer + np.float32(0.25))


def test_watch_saves_the_submap_that_was_asked_for(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """By default the newest, by number any that is published; another number is told from those there are."""
    address = free_locator()
    publisher = Publisher(PublishConfig(listen=[address], digest_period_s=0.1), "rover", {"resolution_m": 0.05})
    publisher.start()
    try:
        tiles, pose = (a_tile(1, 1.0), a_tile(3, 3.0)), BoundedPose(10, 20, np.zeros(6), np.ones(6), INTACT)
        anchor = Anchor(47.0, 8.0, 400.0, np.zeros(4), np.ones(4), INTACT)
        publisher.offer(MapUpdate(tiles, pose, anchor, {}, INTACT, 1, (), None))
        assert publisher.flush(WAIT_S)
        copy = tmp_path / "copy.npz"
        for asked, height in (([], 3.0), (["--submap", "1"], 1.0), (["--submap", "3"], 3.0)):
            assert run_command(["watch", "--connect", address, "--map", str(copy), "--once", *asked]) == 0
            assert np.nanmax(load(copy).low) == height
        assert run_command(["watch", "--connect", address, "--map", str(copy), "--once", "--submap", "2"]) == 1
        assert "--submap 2: the robot publishes no tile of it, but of [1, 3]" in capfd.readouterr().err.replace(
            "\n", " "
        )
    finally:
        publisher.close()


def test_a_robot_that_is_not_there_spoils_no_earlier_copy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """What was saved last time stays when nothing at all comes; so does a name that is free."""
    monkeypatch.setattr("service.commands.watch.FINAL_SYNC_S", 0.3)
    copy, free = tmp_path / "copy.npz", tmp_path / "free.npz"
    copy.write_bytes(b"yesterday's map")
    for path in (copy, free):
        assert run_command(["watch", "--connect", "tcp/127.0.0.1:1", "--map", str(path), "--once"]) == 1
        said = capfd.readouterr().err.replace("\n", " ")
        assert "is a robot reachable there?" in said
        assert f"{path} is {'left as it was' if path == copy else 'not written'}" in said
    assert copy.read_bytes() == b"yesterday's map"
    assert not free.exists()
