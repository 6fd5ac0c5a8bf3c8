"""Rotations of boxes: map_from_base = Rz(yaw) Ry(pitch) Rx(roll), x ahead, y left, z up, pitch > 0 nose down."""

from math import sqrt
from typing import TypeAlias

from drivers.compiled import compiled_bare
from estimator.interval import (
    Interval,
    add,
    cosine,
    direction,
    down,
    is_empty,
    mag,
    meet,
    mig,
    mul,
    neg,
    norm,
    sine,
    sub,
)

Box3: TypeAlias = tuple[Interval, Interval, Interval]
"""Three intervals: of a vector, or of (roll, pitch, yaw)."""
Tilt: TypeAlias = tuple[Interval, Interval, Interval, Interval, Interval, Interval]
"""sφ, cφ, sθ, cθ, sθ sφ, sθ cφ."""


@compiled_bare
def columns(attitude: Box3) -> tuple[Box3, Box3, Box3]:
    """R's (SMF section 1), the robot's axes in the map: ahead (cψ cθ, sψ cθ, -sθ),

    left (cψ sθ sφ - sψ cφ, sψ sθ sφ + cψ cφ, cθ sφ), up (cψ sθ cφ + sψ sφ, sψ sθ cφ - cψ sφ, cθ cφ).
    """
    return columns_at(tilted(attitude[0], attitude[1]), attitude[2])


@compiled_bare
def tilted(roll: Interval, pitch: Interval) -> Tilt:
    """What the same roll and pitch have in common, whatever the yaw: for `columns_at`."""
    sf, cf = sine(roll), cosine(roll)
    st, ct = sine(pitch), cosine(pitch)
    return sf, cf, st, ct, mul(st, sf), mul(st, cf)


@compiled_bare
def columns_at(tilt: Tilt, yaw: Interval) -> tuple[Box3, Box3, Box3]:
    """`columns` with that yaw."""
    sf, cf, st, ct, stsf, stcf = tilt
    sp, cp = sine(yaw), cosine(yaw)
    return (
        (mul(cp, ct), mul(sp, ct), neg(st)),
        (sub(mul(cp, stsf), mul(sp, cf)), add(mul(sp, stsf), mul(cp, cf)), mul(ct, sf)),
        (add(mul(cp, stcf), mul(sp, sf)), sub(mul(sp, stcf), mul(cp, sf)), mul(ct, cf)),
    )


@compiled_bare
def turned(yaw: Interval, x: Interval, y: Interval) -> tuple[Interval, Interval]:
    """Rz(yaw) (x, y), outer: the Cartesian enclosure, met with the polar one, ρ (cos, sin)(α + yaw).

    The first is better for a narrow yaw, the second for a far point: there its radius stays as sharp as it was.
    """
    c = cosine(yaw)
    s = sine(yaw)
    most = norm(x, y)
    ahead = meet(sub(mul(c, x), mul(s, y)), (-most, most))
    left = meet(add(mul(s, x), mul(c, y)), (-most, most))
    alpha = direction(x, y)
    if not is_empty(alpha):
        least = max(0.0, down(down(sqrt(max(0.0, down(down(mig(x) * mig(x)) + down(mig(y) * mig(y))))))))
        angle = add(alpha, yaw)
        ahead = meet(ahead, mul((least, most), cosine(angle)))
        left = meet(left, mul((least, most), sine(angle)))
    return ahead, left


@compiled_bare
def largest(axis: Box3, i: int) -> float:
    """Largest |component i| of a unit vector inside a box."""
    return min(1.0, mag(axis[i]))
