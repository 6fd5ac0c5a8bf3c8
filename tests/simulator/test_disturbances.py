"""Disturbances stand in front of the ground, and are there as often and for as long as they say."""

import numpy as np
import pytest

from simulator.disturbances import Droplets, Walker

SEEN_FROM = np.tile([0.0, 0.0, 1.0], (3, 1))
AHEAD = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])


def test_drops_are_as_many_as_declared_and_never_behind_the_ground() -> None:
    """Of 200,000 beams over 5 m in air with 0.1 echoes a metre, 1 - exp(-0.5) meet a drop; the others the ground."""
    distances = np.full(200_000, 5.0)
    nowhere = np.empty((0, 3))
    seen = Droplets(0.1, 1).seen(nowhere, nowhere, distances, 7)
    assert np.all(seen <= distances)
    assert np.mean(seen < distances) == pytest.approx(1 - np.exp(-0.5), abs=0.01)
    assert np.array_equal(seen, Droplets(0.1, 1).seen(nowhere, nowhere, distances, 7))
    assert not np.array_equal(seen, Droplets(0.1, 1).seen(nowhere, nowhere, distances, 8))


def test_a_walker_is_met_where_he_is_at_the_time() -> None:
    """The front of a cylinder of 20 cm radius, over whose head a beam passes, and which has gone a second later."""
    walker = Walker(2.0, 0.0, 0.0, 1.5)
    assert walker.seen(SEEN_FROM, AHEAD, np.full(3, 9.0), 0).tolist() == pytest.approx([1.8, 9.0, 9.0])
    assert walker.seen(SEEN_FROM, AHEAD, np.full(3, 1.0), 0).tolist() == [1.0, 1.0, 1.0]
    assert walker.seen(SEEN_FROM, AHEAD, np.full(3, 9.0), 1_000_000_000).tolist() == [9.0, 9.0, 9.0]
