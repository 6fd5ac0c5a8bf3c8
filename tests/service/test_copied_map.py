"""What a copy believes of the robot's bounds, whatever way its messages come."""

from collections import Counter

import numpy as np

from estimator.bounded_pose import INTACT, Guarantee, Status
from mapper.tile import Tile
from service.copied_map import CopiedMap
from service.messages import TileId, TileNote, guarantee_message

VOID = Guarantee(5, "gps", 0.1, "m", Status.DEGRADED, contradicted_ns=8)
RESTORED = Guarantee(5, "gps", 0.1, "m", Status.NOMINAL, restored_ns=20, contradicted_ns=8)


def a_tile(submap: int = 0) -> Tile:
    layer = np.zeros((64, 64), np.float32)
    return Tile(submap, 0, 0, 0.05, layer, layer)


def note(guarantee: Guarantee, epoch: str = "one", beams_until_ns: int = 3) -> TileNote:
    return TileNote(epoch, 1, guarantee_message(guarantee), beams_until_ns=beams_until_ns)


def test_a_tile_that_was_slow_does_not_take_a_doubt_back() -> None:
    """A pose overtakes tiles: one that was sent while all was well doesn't say that all is well again."""
    copy = CopiedMap(Counter(), 8)
    copy.take_tile(a_tile(), note(INTACT))
    copy.take_guarantee(VOID)
    copy.take_tile(a_tile(), note(INTACT, beams_until_ns=7))
    assert copy.guarantee == VOID
    assert not copy.promised(TileId(0, 0, 0))
    copy.take_tile(a_tile(), note(RESTORED))
    assert copy.guarantee == RESTORED
    copy.take_answer(a_tile(), note(INTACT))
    copy.take_guarantee(INTACT)
    assert copy.guarantee == RESTORED


def test_another_run_of_the_robot_is_believed_anew() -> None:
    """Its frame, its tiles and its guarantee are its own."""
    copy = CopiedMap(Counter(), 8)
    copy.take_tile(a_tile(), note(VOID))
    copy.take_tile(a_tile(1), note(INTACT, epoch="two"))
    assert copy.guarantee == INTACT
