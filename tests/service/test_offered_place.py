"""What publisher and keeper are told of pose and anchor."""

import numpy as np

from estimator.bounded_pose import Anchor, BoundedPose
from estimator.filter import Filter
from service.offered_place import OfferedPlace

MS = 1_000_000


class Looked(Filter):
    """A filter whose pose and anchor are as often new as it is asked."""

    def __init__(self) -> None:
        self.times = 0

    def latest(self) -> BoundedPose | None:
        """Another each time."""
        self.times += 1
        return BoundedPose(self.times, self.times, np.zeros(6), np.zeros(6))

    @property
    def anchor(self) -> Anchor | None:
        """Another each time."""
        return Anchor(48.0, 11.0, float(self.times), np.zeros(4), np.zeros(4))


def test_a_pose_is_looked_up_as_often_as_it_can_be_published() -> None:
    """Ten times a second at 10 Hz, however many scans there are; the anchor stays, a pose is handed over once."""
    state = Looked()
    place = OfferedPlace(state, 10.0)
    given = []
    for tick in range(75):  # a second of scans
        place.look_up(1_000 * MS + tick * 13_333_333, False)
        assert place.anchor is not None
        given.append(place.take_pose())
    assert 10 <= state.times <= 11
    assert [pose is not None for pose in given].count(True) == state.times
    assert place.take_pose() is None


def test_a_pose_that_found_the_mailbox_full_is_the_next_one_or_a_newer() -> None:
    """It is kept until it is offered; the last look is in any case at what is the newest then."""
    state = Looked()
    place = OfferedPlace(state, 10.0)
    place.look_up(1_000 * MS, False)
    place.look_up(1_010 * MS, False)
    place.look_up(1_020 * MS, True)
    pose = place.take_pose()
    assert pose is not None
    assert pose.earliest_ns == state.times == 2
