"""The laws by which simulated sensors err."""

import numpy as np
import pytest

from simulator.errors import LAWS, ErrorLaw

TIMES = np.arange(0, 60_000_000_000, 5_000_000)


@pytest.mark.parametrize("name", LAWS)
def test_a_law_stays_in_its_bound_and_touches_it(name: str) -> None:
    """All shares are within [-1, 1] and come within 1 % of a bound."""
    for channel in (ErrorLaw(name, 5).channel(c) for c in ("gyro.x", "laser.range", "gps.up")):
        for shares in (channel.over(TIMES), channel.smooth(TIMES)):
            assert np.abs(shares).max() <= 1.0
            assert np.abs(shares).max() > (0.99 if name != "uniform" else 0.9)
        assert abs(channel.level) <= 1.0


@pytest.mark.parametrize("name", LAWS)
def test_the_same_seed_gives_the_same_errors(name: str) -> None:
    """A draw depends on seed, channel and time alone."""
    first, again = (ErrorLaw(name, 5).channel("tilt.roll") for _ in range(2))
    np.testing.assert_array_equal(first.over(TIMES), again.over(TIMES))
    assert first.at(int(TIMES[77])) == first.over(TIMES)[77]


@pytest.mark.parametrize("name", ["uniform", "corners", "switching"])
def test_other_seeds_and_channels_are_independent(name: str) -> None:
    """Neighbouring seeds and channel names don't share their errors."""
    one = ErrorLaw(name, 5).channel("gyro.x").over(TIMES)
    for other in (ErrorLaw(name, 6).channel("gyro.x"), ErrorLaw(name, 5).channel("gyro.y")):
        assert abs(np.mean(one * other.over(TIMES))) < 0.3


def test_constant_signs_differ_between_channels() -> None:
    """Under the constant law some channels sit at the upper bound and some at the lower."""
    levels = {ErrorLaw("constant", 1).channel(f"c{i}").level for i in range(20)}
    assert levels == {-1.0, 1.0}


@pytest.mark.parametrize("name", LAWS)
def test_a_bias_wanders_no_faster_than_its_drift(name: str) -> None:
    """|bias| and its rate of change stay in their bounds, and under drift it moves at the full rate."""
    channel = ErrorLaw(name, 2).channel("gyro.z.bias")
    bias = np.array([channel.wander(int(t), 0.05, 0.002) for t in TIMES])
    rate = np.abs(np.diff(bias)).max() / 0.005
    assert np.abs(bias).max() <= 0.05 + 1e-15
    assert rate <= 0.002 * (1 + 1e-6)
    assert (rate > 0.0019) == (name == "drift")


def test_smooth_shares_have_no_jumps() -> None:
    """What drives the robot's side slip changes by less than a thousandth of the bound in a tenth of a millisecond."""
    times = np.arange(0, 5_000_000_000, 100_000)
    for name in LAWS:
        assert np.abs(np.diff(ErrorLaw(name, 3).channel("slip.lateral").smooth(times))).max() < 1e-3


def test_an_unknown_law_is_refused() -> None:
    """The message lists the laws there are."""
    with pytest.raises(ValueError, match="uniform, corners"):
        ErrorLaw("gauss")
