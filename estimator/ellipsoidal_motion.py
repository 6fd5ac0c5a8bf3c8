"""One step of the ellipsoid over (x, y, yaw, bias): a linear map and all that it leaves out (SMF section 4, 3).

x, y are the position at an encoder reading, less what is still to come of it (`tracks.travel`); yaw and the bias of
ω_z are those at the first gyro node after the reading. Roll, pitch and z stay intervals: the tilt sensor bounds them
directly, and what they do to x, y and yaw enters as a remainder.

With δ = yaw - c the deviation from the ellipsoid's centre, the forward axis at any instant of the step is

    r(t) = k + a δ + ρ(t),   a = dr/dyaw at the middle of the step,   |ρ| bounded by Taylor's formula, as intervals,

so the displacement, the integral of r v, is k d + a d δ and a remainder of ρ times the path.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_bare
from estimator.ellipsoid import Ellipsoid, half_width, image, nothing_yet
from estimator.frames import Tilt, columns_at
from estimator.interval import (
    ULP,
    Interval,
    add,
    cosine,
    mag,
    meet,
    mid,
    mul,
    outward,
    reach,
    scale,
    sine,
    sub,
    up,
    widen,
)
from estimator.tracks import Tracked

X, Y, YAW, BIAS = range(4)
UNITS = np.array([1.0, 1.0, 0.2, 0.05])
"""m, m, rad, rad/s."""
ROUGHLY = 1.0 + 2.0**-40
"""More than all relative rounding of a remainder, a sum of non-negative numbers."""


class HeadingStep(NamedTuple):
    """What the gyroscope says of yaw from the node after one reading to the node after the next."""

    change: float
    """Yaw changed by change + per_bias * bias ± error,"""
    per_bias: float
    error: float
    inside: Interval
    """... and inside the step (from the earlier reading on) was that far from the earlier node's yaw."""
    bias: Interval
    """All that the bias can be during the step,"""
    aged: float
    """... and how much it can drift."""


def memory() -> NDArray[np.float64]:
    """What a step keeps of its predecessor: k, a [2 each], c, the half-width of yaw, its change [2], pending [2]."""
    return np.zeros(10)


@compiled_bare
def forward(
    roughly: float, away: Interval, half: float, ct: Interval
) -> tuple[tuple[Interval, Interval], tuple[float, float]]:
    """r(t) - a δ, and a, for x and y: r is the forward axis at any yaw = c + δ + s and any pitch with cosine in [ct],

    |δ| <= half, c + s in roughly + [away]. Taylor's formula with Lagrange's remainder, met with the natural enclosure,
    which is better for a wide yaw.
    """
    most = up(half + mag(away))
    s0, c0 = sine((roughly, roughly)), cosine((roughly, roughly))
    around = widen((roughly, roughly), most)
    s_all, c_all = sine(around), cosine(around)
    square = (0.0, up(0.5 * up(most * most)))
    values = (mul(ct, c0), mul(ct, s0))
    along = (mul(ct, (-s0[1], -s0[0])), mul(ct, c0))
    naturally = (mul(ct, c_all), mul(ct, s_all))
    slopes = mid(along[0]), mid(along[1])
    rx = _rest(values[0], along[0], naturally[0], slopes[0], away, half, square)
    ry = _rest(values[1], along[1], naturally[1], slopes[1], away, half, square)
    return (rx, ry), slopes


@compiled_bare
def _rest(
    value: Interval, along: Interval, naturally: Interval, slope: float, away: Interval, half: float, square: Interval
) -> Interval:
    """One component of `forward`: its second derivative is minus the component itself."""
    turned = (-half, half)
    first = add(value, add(mul(sub(along, (slope, slope)), turned), mul(along, away)))
    taylor = sub(first, mul(naturally, square))
    return meet(taylor, sub(naturally, scale(slope, turned)))


@compiled_bare
def travel_ellipsoid(
    e: Ellipsoid,
    heading: HeadingStep,
    tracked: Tracked,
    sideways: float,
    normal: float,
    tilt: Tilt,
    first: bool,
    kept: NDArray[np.float64],
) -> None:
    """E a step further, outer: `tilt` (frames.tilted) holds over the step, `first` as in `tracks.travel`.

    sideways, normal: integrals of |lateral speed| and of |normal speed|.

    kept [10] is `memory`: kept[8:] becomes how far x, y of the reading can be from the ellipsoid's. The counts' errors
    telescope as in `tracks.travel`, with k + a δ in the place of its constant axis: a step costs quantum times the
    change of k + a δ, where δ changes by the yaw's change less the centre's.
    """
    half = half_width(e, YAW)
    centre = e.centre[YAW]
    roughly = centre + mid(heading.inside)
    away = add(heading.inside, outward(centre - roughly, centre - roughly))
    axes, slopes = forward(roughly, away, half, tilt[3])
    _, left, upward = columns_at(tilt, widen(add((roughly, roughly), away), half))
    d = mid(tracked.distance)
    unsure = reach(tracked.distance, d)
    wandered = sub((kept[6], kept[7]), outward(centre - kept[4], centre - kept[4]))
    q = tracked.quantum if tracked.counted else 0.0

    matrix, shift, columns, rest = nothing_yet(e)
    for i in range(2):
        k = mid(axes[i])
        a = slopes[i]
        matrix[i, YAW] = a * d
        shift[i] = k * d - a * d * centre
        columns[i, 0] = k * unsure
        columns[i, 1] = mid(left[i]) * sideways
        rest[i] = reach(axes[i], k) * tracked.path + abs(a) * half * unsure
        rest[i] += reach(left[i], mid(left[i])) * sideways + mag(upward[i]) * normal
        if first:
            bent = 0.0
        elif q > 0.0:
            bent = abs(k - kept[i]) + abs(a - kept[2 + i]) * half + abs(kept[2 + i]) * mag(wandered)
            bent *= q
        else:
            bent = kept[8 + i]
        rest[i] += bent
        rest[i] += 8.0 * ULP * (abs(d) * (abs(k) + abs(a) * (abs(centre) + half)) + unsure + sideways)
        rest[i] = up(rest[i] * ROUGHLY)
        kept[i] = k
        kept[2 + i] = a
        kept[8 + i] = up(q * (abs(k) + abs(a) * half) * ROUGHLY)
    kept[4] = centre
    kept[5] = half
    change = widen(add(outward(heading.change, heading.change), scale(heading.per_bias, heading.bias)), heading.error)
    kept[6], kept[7] = change
    matrix[YAW, BIAS] = heading.per_bias
    shift[YAW] = heading.change
    rest[YAW] = up((heading.error + abs(heading.per_bias) * heading.aged) * ROUGHLY)
    rest[BIAS] = heading.aged
    image(e, matrix, shift, columns, rest)
