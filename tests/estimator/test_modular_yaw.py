"""Angles that are known modulo a turn: which copy is meant, and when that can't be told."""

import numpy as np

from estimator.observations import nearest_copy

TURN = 2.0 * np.pi


def test_the_copy_that_is_taken_holds_the_true_angle() -> None:
    """Whatever both sets hold is kept, near the cut at pi too; a wide set is never cut by the wrong copy."""
    random = np.random.default_rng(1)
    narrowed = 0

    def share() -> float:
        """Often at an end: the true angle is then at the edge of a set."""
        return float(random.choice([0.0, 1.0, random.random()]))

    for _ in range(20_000):
        true = random.uniform(-20.0, 20.0)
        reach = np.exp(random.uniform(-5.0, 1.14))  # up to just under half a turn
        low, high = true - share() * 2.0 * reach, true + share() * 2.0 * reach
        if high - low >= TURN:
            continue
        spread = np.exp(random.uniform(-5.0, 0.4))
        copy = true + TURN * random.integers(-4, 5)
        measured = copy - share() * 2.0 * spread, copy + share() * 2.0 * spread
        out = nearest_copy((low, high), measured)
        assert out[0] <= true + 1e-9
        assert true - 1e-9 <= out[1]
        narrowed += out[1] - out[0] < high - low
    assert narrowed > 3_000


def test_an_angle_that_may_be_anything_is_named_by_its_first_measurement() -> None:
    """A full turn, or more, becomes the measurement's copy: true modulo a turn."""
    random = np.random.default_rng(2)
    for _ in range(2_000):
        centre, true = random.uniform(-10.0, 10.0), random.uniform(-np.pi, np.pi)
        out = nearest_copy((centre - np.pi - 1e-9, centre + np.pi + 1e-9), (true - 0.2, true + 0.3))
        turns = (0.5 * (out[0] + out[1]) - 0.05 - true) / TURN
        assert abs(turns - round(turns)) < 1e-9
        assert abs(0.5 * (out[0] + out[1]) - centre) < np.pi + 0.1


def test_of_a_wide_angle_no_more_is_left_than_the_copies_that_meet_it() -> None:
    """Known to a little less than a turn: the hull of what each copy leaves, and nothing where none meets it."""
    random = np.random.default_rng(3)
    narrowed = empty = 0
    for _ in range(20_000):
        centre, copy = random.uniform(-10.0, 10.0, 2)
        reach, spread = random.uniform(2.0, np.pi), np.exp(random.uniform(-5.0, 1.14))
        low, high = centre - reach, centre + reach
        out = nearest_copy((low, high), (copy - spread, copy + spread))
        pieces = np.array(
            [(max(low, copy - spread + n), min(high, copy + spread + n)) for n in TURN * np.arange(-9, 10)]
        )
        pieces = pieces[pieces[:, 0] <= pieces[:, 1]]
        if len(pieces) == 0:
            assert out[0] > out[1]
            empty += 1
            continue
        assert out[0] <= pieces.min() <= pieces.max() <= out[1]
        np.testing.assert_allclose(out, (pieces.min(), pieces.max()), atol=1e-9)
        narrowed += pieces.max() - pieces.min() < 0.9 * (high - low)
    assert narrowed > 3_000
    assert empty > 20
