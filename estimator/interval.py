"""Interval arithmetic on pairs (low, high): every result contains all values the exact operation can take.

Each end is computed in round-to-nearest and then moved outward by at least one unit in the last place, which covers
the half unit that the operation can be off. The elementary functions of the C library are not correctly rounded
(some vector libraries are off by up to 4 ulp), so their ends move by 8. All ends are finite; an interval with
low > high is empty.

Symbols: [a] = (a_low, a_high). "Exact" means the smallest interval up to rounding; "outer" may be wider.
"""

from math import asin, atan2, cos, floor, pi, sin, sqrt
from typing import TypeAlias

from drivers.compiled import compiled

Interval: TypeAlias = tuple[float, float]
"""(low, high)."""

ULP = 2.0**-52
"""No float's unit in the last place is larger than ULP * |x| (but for the subnormal ones)."""
TINY = 1e-300
"""Larger than any subnormal."""
TURN = 2.0 * pi
ANGLE_SLACK = 1e-9
"""How near to an extremum of sine or cosine counts as containing it."""


@compiled
def down(x: float) -> float:
    """A float at least one ulp below x."""
    return x - (abs(x) * ULP + TINY)


@compiled
def up(x: float) -> float:
    """A float at least one ulp above x."""
    return x + (abs(x) * ULP + TINY)


@compiled
def outward(low: float, high: float) -> Interval:
    """Both ends moved out by an ulp or a little more."""
    return down(low), up(high)


@compiled
def outward8(low: float, high: float) -> Interval:
    """Both ends moved out by 8 ulp: for the results of sine and its kin."""
    return low - (abs(low) * (8.0 * ULP) + TINY), high + (abs(high) * (8.0 * ULP) + TINY)


@compiled
def is_empty(a: Interval) -> bool:
    """No value at all. A NaN end counts as empty, so that it can never pass for a bound."""
    return not a[0] <= a[1]


@compiled
def add(a: Interval, b: Interval) -> Interval:
    """[a] + [b], exact."""
    return outward(a[0] + b[0], a[1] + b[1])


@compiled
def sub(a: Interval, b: Interval) -> Interval:
    """[a] - [b], exact."""
    return outward(a[0] - b[1], a[1] - b[0])


@compiled
def neg(a: Interval) -> Interval:
    """-[a], exact."""
    return -a[1], -a[0]


@compiled
def mul(a: Interval, b: Interval) -> Interval:
    """[a] * [b], exact."""
    p = a[0] * b[0]
    q = a[0] * b[1]
    r = a[1] * b[0]
    s = a[1] * b[1]
    return outward(min(min(p, q), min(r, s)), max(max(p, q), max(r, s)))


@compiled
def scale(k: float, a: Interval) -> Interval:
    """k * [a] for a number k, exact."""
    p = k * a[0]
    q = k * a[1]
    return outward(min(p, q), max(p, q))


@compiled
def divide(a: Interval, b: Interval) -> Interval:
    """[a] / [b] for [b] > 0, exact."""
    p = a[0] / b[0]
    q = a[0] / b[1]
    r = a[1] / b[0]
    s = a[1] / b[1]
    return outward(min(min(p, q), min(r, s)), max(max(p, q), max(r, s)))


@compiled
def hull(a: Interval, b: Interval) -> Interval:
    """Smallest interval that contains both."""
    return min(a[0], b[0]), max(a[1], b[1])


@compiled
def meet(a: Interval, b: Interval) -> Interval:
    """Intersection, exact; empty where low > high."""
    return max(a[0], b[0]), min(a[1], b[1])


@compiled
def widen(a: Interval, r: float) -> Interval:
    """[a] + [-r, r] for r >= 0, exact."""
    return outward(a[0] - r, a[1] + r)


@compiled
def mid(a: Interval) -> float:
    """A number near the middle; whatever it is, formulas that use it as a centre stay sound."""
    return 0.5 * a[0] + 0.5 * a[1]


@compiled
def reach(a: Interval, c: float) -> float:
    """Not less than the largest |x - c| over [a]."""
    return up(max(a[1] - c, c - a[0]))


@compiled
def mag(a: Interval) -> float:
    """Largest |x| over [a], exact."""
    return max(abs(a[0]), abs(a[1]))


@compiled
def mig(a: Interval) -> float:
    """Smallest |x| over [a], exact; 0 where [a] contains 0."""
    return max(0.0, max(a[0], -a[1]))


@compiled
def has_angle(a: Interval, angle: float) -> bool:
    """May [a] contain angle + 2 pi n for a whole n? Never wrongly false for |a| < 10^5."""
    n = floor((a[1] + ANGLE_SLACK - angle) / TURN)
    return angle + n * TURN >= a[0] - 2.0 * ANGLE_SLACK


@compiled
def sine(a: Interval) -> Interval:
    """sin [a], exact."""
    p = sin(a[0])
    q = sin(a[1])
    low, high = outward8(min(p, q), max(p, q))
    if has_angle(a, -0.5 * pi):
        low = -1.0
    if has_angle(a, 0.5 * pi):
        high = 1.0
    return max(low, -1.0), min(high, 1.0)


@compiled
def cosine(a: Interval) -> Interval:
    """cos [a], exact."""
    p = cos(a[0])
    q = cos(a[1])
    low, high = outward8(min(p, q), max(p, q))
    if has_angle(a, pi):
        low = -1.0
    if has_angle(a, 0.0):
        high = 1.0
    return max(low, -1.0), min(high, 1.0)


@compiled
def arcsine(a: Interval) -> Interval:
    """asin of the part of [a] inside [-1, 1], exact; empty where there is none."""
    if a[0] > 1.0 or a[1] < -1.0:
        return 1.0, -1.0
    return outward8(asin(max(a[0], -1.0)), asin(min(a[1], 1.0)))


@compiled
def norm(x: Interval, y: Interval) -> float:
    """Not less than the largest length of a vector (x, y)."""
    return up(up(sqrt(up(up(mag(x) * mag(x)) + up(mag(y) * mag(y))))))


@compiled
def direction(x: Interval, y: Interval) -> Interval:
    """atan2([y], [x]) around the direction of the box's middle, exact; empty where the origin is inside or near.

    A box without the origin is seen from there under less than pi, with its corners at the ends.
    """
    if x[0] <= 0.0 <= x[1] and y[0] <= 0.0 <= y[1]:
        return 1.0, -1.0
    if not 1e-100 < max(mig(x), mig(y)) < 1e100:
        return 1.0, -1.0  # so near (or far) that the products below would underflow (or overflow)
    cx = mid(x)
    cy = mid(y)
    least = 0.0
    most = 0.0
    for i in range(2):
        for j in range(2):
            # the corner's angle as seen from the middle; cross and dot lose at most a few ulp of |corner| |middle|
            turn = atan2(cx * y[j] - cy * x[i], cx * x[i] + cy * y[j])
            least = min(least, turn)
            most = max(most, turn)
    if most - least > 3.0:
        return 1.0, -1.0
    centre = atan2(cy, cx)
    slack = 64.0 * ULP * 4.0
    return centre + least - slack, centre + most + slack
