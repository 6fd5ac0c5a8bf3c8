"""What a copy believes of the robot's bounds, whatever way its messages come."""

from collections import Counter

import numpy as np

from estimator.bounded_pose import INTACT, Guarantee, Status
from mapper.tile import Tile, content_crc, join
from service.copied_map import CopiedMap
from service.digest import DigestEntry, DigestPart, digest_root
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
    copy.take_tile(a_tile(), note(INTACT), 0)
    copy.take_guarantee(VOID)
    copy.take_tile(a_tile(), note(INTACT, beams_until_ns=7), 0)
    assert copy.guarantee == VOID
    assert not copy.promised(TileId(0, 0, 0))
    copy.take_tile(a_tile(), note(RESTORED), 0)
    assert copy.guarantee == RESTORED
    copy.take_answer(a_tile(), note(INTACT))
    copy.take_guarantee(INTACT)
    assert copy.guarantee == RESTORED


def test_another_run_of_the_robot_is_believed_anew() -> None:
    """Its frame, its tiles and its guarantee are its own."""
    copy = CopiedMap(Counter(), 8)
    copy.take_tile(a_tile(), note(VOID), 0)
    copy.take_tile(a_tile(1), note(INTACT, epoch="two"), 0)
    assert copy.guarantee == INTACT


def part_of(height_m: float, row: int) -> Tile:
    """A tile in which one row was seen."""
    layer = np.full((64, 64), np.nan, np.float32)
    layer[row] = height_m
    return Tile(0, 0, 0, 0.05, layer, layer)


def listing(*tiles: Tile) -> DigestPart:
    entries = [DigestEntry(tile.submap, tile.ix, tile.iy, content_crc(tile)) for tile in tiles]
    return DigestPart("one", 1, False, len(entries), digest_root(entries), 0, 1, entries)


def test_an_answer_that_newer_tiles_overtook_takes_nothing_back() -> None:
    """Answers travel behind tiles: one that is as the digest listed it is older than what came since."""
    copy, lost, newer = CopiedMap(Counter(), 8), part_of(1.0, 1), part_of(2.0, 2)
    copy.introduced = True
    copy.take_tile(part_of(0.0, 0), note(INTACT), 0)
    listed = join(part_of(0.0, 0), lost)
    copy.take_digest(listing(listed), 0)
    copy.take_tile(newer, note(INTACT), 0)
    copy.take_answer(listed, note(INTACT))
    assert content_crc(copy.tiles[TileId(0, 0, 0)]) == content_crc(join(listed, newer))


def test_what_the_robot_does_not_have_is_replaced_once_the_link_is_quiet() -> None:
    """A copy that holds too much claims more than the robot's map: after a digest and an answer it is the robot's."""
    copy, true = CopiedMap(Counter(), 8), part_of(0.0, 0)
    copy.introduced = True
    copy.take_tile(join(true, part_of(5.0, 9)), note(INTACT), 0)
    copy.take_digest(listing(true), 0)
    copy.take_answer(true, note(INTACT))
    assert content_crc(copy.tiles[TileId(0, 0, 0)]) == content_crc(true)
    assert copy.in_sync
