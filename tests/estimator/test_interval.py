"""Interval operations against multiple-precision arithmetic."""

from collections.abc import Callable
from math import pi

import mpmath
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from estimator import interval as iv
from estimator.interval import Interval

PRECISE = mpmath.MPContext()
PRECISE.prec = 200

number = st.one_of(
    st.floats(-1e6, 1e6),
    st.floats(-1e-3, 1e-3),
    st.sampled_from([0.0, 1.0, -1.0, 0.1, pi, -pi, pi / 2, 1e-310, 1e6]),
)
fraction = st.floats(0.0, 1.0)


@st.composite
def interval(draw: Callable[..., float]) -> Interval:
    """Any finite interval, often of no width."""
    a, b = draw(number), draw(st.one_of(st.just(0.0), number))
    return (a, a) if b == 0.0 else (min(a, b), max(a, b))


def inside(x: object, a: Interval) -> bool:
    """Is the precise number x in [a]?"""
    return bool(PRECISE.mpf(a[0]) <= x <= PRECISE.mpf(a[1]))


def point(a: Interval, s: float) -> float:
    """A float of [a]."""
    return min(max(a[0] + s * (a[1] - a[0]), a[0]), a[1])


@settings(max_examples=400)
@given(interval(), interval(), fraction, fraction)
def test_sums_and_products_hold_the_exact_result(a: Interval, b: Interval, s: float, t: float) -> None:
    """For any x in [a] and y in [b], x op y, without rounding, is in [a] op [b]."""
    x, y = point(a, s), point(b, t)
    px, py = PRECISE.mpf(x), PRECISE.mpf(y)
    assert inside(px + py, iv.add(a, b))
    assert inside(px - py, iv.sub(a, b))
    assert inside(px * py, iv.mul(a, b))
    assert inside(px * py, iv.scale(x, (y, y)))
    assert inside(px + abs(py), iv.widen(a, abs(y)))
    assert inside(px - abs(py), iv.widen(a, abs(y)))
    if b[0] > 1e-6:
        assert inside(px / py, iv.divide(a, b))
    assert PRECISE.sqrt(px * px + py * py) <= PRECISE.mpf(iv.norm((x, x), (y, y)))
    assert abs(px - py) <= PRECISE.mpf(iv.reach(a, y))
    assert iv.mig(a) <= abs(x) <= iv.mag(a)


@settings(max_examples=400)
@given(st.floats(-50.0, 50.0), st.one_of(st.just(0.0), st.floats(0.0, 8.0), st.floats(0.0, 1e-6)), fraction)
def test_sine_and_cosine_hold_every_value(low: float, width: float, s: float) -> None:
    """For any x in [a], sin x and cos x are inside, and so are the extrema that [a] contains."""
    a = (low, low + width)
    x = PRECISE.mpf(point(a, s))
    assert inside(PRECISE.sin(x), iv.sine(a))
    assert inside(PRECISE.cos(x), iv.cosine(a))


@pytest.mark.parametrize("turns", [-3, 0, 1, 7])
@pytest.mark.parametrize("angle", [-pi / 2, 0.0, pi / 2, pi])
def test_sine_and_cosine_know_their_extrema(turns: int, angle: float) -> None:
    """Just around an extremum both ends of the interval are lower than it."""
    x = angle + turns * 2 * pi
    a = (x - 1e-3, x + 1e-3)
    assert iv.sine(a)[1] >= np.sin(x)
    assert iv.sine(a)[0] <= np.sin(x)
    assert iv.cosine(a)[1] >= np.cos(x)
    assert iv.cosine(a)[0] <= np.cos(x)
    assert iv.sine(a)[1] - iv.sine(a)[0] < 0.0021


@settings(max_examples=300)
@given(st.floats(-1.0, 1.0))
def test_arcsine_holds_the_exact_result(x: float) -> None:
    """asin x is inside asin [x, x], and nothing is left of an interval beyond 1."""
    assert inside(PRECISE.asin(PRECISE.mpf(x)), iv.arcsine((x, x)))
    assert iv.is_empty(iv.arcsine((1.0 + 1e-9, 2.0)))


@settings(max_examples=400)
@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(0, 4), st.floats(0, 4), fraction, fraction)
@example(0.0, 1.6720429865575655e-248, 3.70430824849643e-250, 0.0, 0.0, 0.0)  # products underflow
def test_direction_holds_every_point_of_the_box(
    x: float, y: float, width: float, height: float, s: float, t: float
) -> None:
    """The direction of any point of a box without the origin is inside, up to full turns; with the origin: empty."""
    a, b = (x, x + width), (y, y + height)
    seen = iv.direction(a, b)
    if a[0] <= 0.0 <= a[1] and b[0] <= 0.0 <= b[1]:
        assert iv.is_empty(seen)
    elif not iv.is_empty(seen):
        angle = PRECISE.atan2(PRECISE.mpf(point(b, t)), PRECISE.mpf(point(a, s)))
        assert any(inside(angle + turn * 2 * PRECISE.pi, seen) for turn in (-1, 0, 1))
        assert seen[1] - seen[0] < 3.2


def test_an_interval_with_nan_is_empty() -> None:
    """NaN never passes for a bound."""
    assert iv.is_empty((np.nan, 1.0))
    assert iv.is_empty((1.0, np.nan))
