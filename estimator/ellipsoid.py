"""Ellipsoids E(c, P) = {c + L u : |u| <= 1, L Lᵀ = P}, the sets of the extended set-membership filter.

Also E(c, P) = {x : lᵀx <= lᵀc + sqrt(lᵀ P l) for each l}: an ellipsoid holds another set where its support is the
larger in each direction. All operations work in place and are outer: what comes out contains the exact result,
rounding included (docs/rounding.md). "Exact" below means: but for rounding.

P may be singular, even zero (a point). It is stored symmetric and, by the same argument that covers rounding, never
has a negative eigenvalue: so neither a factorisation (UD, square root) nor a repair of P is needed.

Sources: Schweppe 1968; Fogel and Huang 1982; Durieu, Walter and Polyak 2001; Scholte and Campbell 2003.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_bare, plain_or_compiled
from estimator.interval import Interval, down, is_empty, meet, mid, mig, outward, reach, up

SLACK = 2.0**-42
"""Relative: an entry of P is a sum of fewer than 80 products, in at most 9 dimensions (docs/rounding.md, Lemma 6)."""
CENTRE = 2.0**-48
"""Relative: a component of the centre is a sum of fewer than 12 products."""
TINY = 1e-300
"""Absolute: covers all that underflows."""
SHORTEST = 1e-140
"""A set counts as at least this long where the shares of a sum are chosen, so that their quotients stay finite."""
THINNEST = 2.0**-40
"""A strip never cuts the square of a half-width to less than this part of itself."""
FLATTEST = 1e4
"""Across a direction in which the set is thinner than its coordinates by more than this, no strip is tried."""

EMPTY, UNCUT, CUT = 0, 1, 2
"""What `meet_strip` did."""


class Ellipsoid(NamedTuple):
    """E(centre, shape) in n <= 9 dimensions."""

    centre: NDArray[np.float64]
    """[n] c."""
    shape: NDArray[np.float64]
    """[n, n] P."""
    units: NDArray[np.float64]
    """[n] > 0, what counts as one in each coordinate wherever the sum of squared half-widths is made least."""
    work: NDArray[np.float64]
    """[2 n + 8, n] room for what comes between, so that nothing is allocated; the last n + 4 are `nothing_yet`'s."""


@plain_or_compiled
def stored(rows: NDArray[np.float64]) -> Ellipsoid:
    """The ellipsoid that stands in the rows [3 n + 10, n] of one array: its centre, its shape, its units, its work."""
    n = rows.shape[1]
    return Ellipsoid(rows[0], rows[1 : n + 1], rows[n + 1], rows[n + 2 :])


def point(centre: NDArray[np.float64], units: NDArray[np.float64]) -> Ellipsoid:
    """{c}, exact."""
    n = len(centre)
    e = stored(np.zeros((3 * n + 10, n)))
    e.centre[:], e.units[:] = centre, units
    return e


def box(centre: NDArray[np.float64], half_widths: NDArray[np.float64], units: NDArray[np.float64]) -> Ellipsoid:
    """c ± h, outer: P = diag(h_i u_i) sum h_j / u_j, the least in trace.

    (A ball around a box is sqrt(n) times as wide as the box: P = n diag(h_i²) where all h_i / u_i are alike.)
    """
    e = point(centre, units)
    plus(e, np.zeros((len(centre), 0)), half_widths)
    return e


@compiled_bare
def half_width(e: Ellipsoid, i: int) -> float:
    """h_i = sqrt(P_ii), exact: |x_i - c_i| <= h_i."""
    return up(sqrt(max(e.shape[i, i], 0.0)))


@compiled_bare
def extent(e: Ellipsoid, i: int) -> Interval:
    """Coordinate i of the outer box, [c_i - h_i, c_i + h_i], exact."""
    h = half_width(e, i)
    return outward(e.centre[i] - h, e.centre[i] + h)


@compiled_bare
def plus(e: Ellipsoid, columns: NDArray[np.float64], half_widths: NDArray[np.float64]) -> None:
    """E ⊕ {Σ g_j ξ_j : |ξ_j| <= 1} ⊕ [-h, h], outer: the Minkowski sum with segments g_j and a box.

    columns [n, m] are the g_j, half_widths [n] h >= 0. With P_j = g_j g_jᵀ, one for each edge of the box too,

        P⁺ = Σ P_j / α_j,   Σ α_j <= 1   (Cauchy and Schwarz: (Σ sqrt(lᵀP_j l))² <= Σ α_j Σ lᵀP_j l / α_j),

    least in trace for α_j = sqrt(tr P_j) / Σ sqrt(tr P_i), each in its units (SMF equation 13).
    """
    n = len(e.centre)
    own = max(_trace_root(e), SHORTEST)
    total = own
    for j in range(columns.shape[1]):
        total += max(_length(e, columns, j), SHORTEST)
    for i in range(n):
        total += max(half_widths[i] / e.units[i], SHORTEST)
    total *= 1.0 + SLACK
    share = total / own
    for i in range(n):
        for k in range(i + 1):
            e.shape[i, k] *= share
    for j in range(columns.shape[1]):
        share = total / max(_length(e, columns, j), SHORTEST)
        for i in range(n):
            for k in range(i + 1):
                e.shape[i, k] += share * columns[i, j] * columns[k, j]
    for i in range(n):
        share = total / max(half_widths[i] / e.units[i], SHORTEST)
        e.shape[i, i] += share * half_widths[i] * half_widths[i]
    for i in range(n):
        e.shape[i, i] += SLACK * e.shape[i, i] + TINY
        for k in range(i):
            e.shape[k, i] = e.shape[i, k]


@plain_or_compiled
def nothing_yet(
    e: Ellipsoid,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A = 1, v = 0, two segments and a box of no length: for a step to write into and `image` to read; in E's room."""
    n = len(e.centre)
    room = e.work[n + 4 :]
    room[:] = 0.0
    for i in range(n):
        room[i, i] = 1.0
    return room[:n], room[n], room[n + 2 :].reshape((n, 2)), room[n + 1]


@compiled_bare
def image(
    e: Ellipsoid,
    matrix: NDArray[np.float64],
    shift: NDArray[np.float64],
    columns: NDArray[np.float64],
    half_widths: NDArray[np.float64],
) -> None:
    """A E + v ⊕ segments ⊕ box: c⁺ = A c + v, P⁺ = A P Aᵀ, exact; then `plus`, outer.

    matrix [n, n] A with entries below 10^6, shift [n] v, columns [n, m] and half_widths [n] as in `plus`.
    """
    n = len(e.centre)
    moved = e.work[n]
    rest = e.work[n + 1]
    size = e.work[n + 2]
    size[:] = 0.0
    for k in range(n):
        h = half_width(e, k)
        for i in range(n):
            size[i] += abs(matrix[i, k]) * h
    for i in range(n):
        total = shift[i]
        terms = abs(shift[i])
        for k in range(n):
            total += matrix[i, k] * e.centre[k]
            terms += abs(matrix[i, k] * e.centre[k])
            product = 0.0
            for m in range(n):
                product += matrix[i, m] * e.shape[m, k]
            e.work[i, k] = product
        moved[i] = total
        rest[i] = up(half_widths[i] + CENTRE * terms)
    for i in range(n):
        e.centre[i] = moved[i]
        for k in range(i + 1):
            product = 0.0
            for m in range(n):
                product += e.work[i, m] * matrix[k, m]
            e.shape[i, k] = product
            e.shape[k, i] = product
        e.shape[i, i] += SLACK * size[i] * size[i] + TINY
    plus(e, columns, rest)


@compiled_bare
def meet_strip(e: Ellipsoid, normal: NDArray[np.float64], low: float, high: float) -> int:
    """E ∩ {x : low <= hᵀx <= high}, outer: EMPTY (E stays), UNCUT (E stays: the strip says nothing new), or CUT.

    normal [n] is h. The strip is first met with what E itself says of hᵀx, and so becomes |hᵀx - y| <= r. For q >= 0
    all x of both satisfy (x-c)ᵀP⁻¹(x-c) + q (hᵀx-y)²/r² <= 1 + q, again an ellipsoid (SMF equation 14). With g = hᵀPh,
    δ = y - hᵀc and λ = q / (r² + q g) in [0, 1/g):

        c⁺ = c + λ δ P h,   P⁺ = N (P - λ P h hᵀ P),   N = 1 + λ r² / (1 - λ g) - λ δ².

    Any λ is sound, however roughly it was found; P⁺, N and the place of c⁺ are what rounding must not spoil.
    """
    n = len(e.centre)
    ph = e.work[0]
    size = e.work[1]
    rest = e.work[2]
    dot = 0.0
    terms = 0.0
    coarse = 0.0
    for i in range(n):
        dot += normal[i] * e.centre[i]
        terms += abs(normal[i] * e.centre[i])
        size[i] = half_width(e, i)
        coarse += abs(normal[i]) * size[i]
    square = SLACK * coarse * coarse + TINY
    for i in range(n):
        ph[i] = 0.0
        for k in range(n):
            ph[i] += e.shape[i, k] * normal[k]
        square += normal[i] * ph[i]
    square = up(square)  # not less than g: its own error is a part of the slack
    if not square >= TINY:
        square = TINY
    along = up(sqrt(square))
    middle = outward(dot - CENTRE * terms, dot + CENTRE * terms)
    own = (down(middle[0] - along), up(middle[1] + along))
    seen = meet((low, high), own)
    if is_empty(seen):
        return EMPTY
    if (low <= own[0] and high >= own[1]) or square < 1e-200 or coarse > FLATTEST * along:
        return UNCUT
    y = mid(seen)
    r = reach(seen, y)
    delta = outward(y - middle[1], y - middle[0])

    trace = 0.0
    cut = 0.0
    for i in range(n):
        unit = e.units[i] * e.units[i]
        trace += e.shape[i, i] / unit
        cut += ph[i] * ph[i] / (unit * square)
    kept = least_trace(trace, cut, mid(delta) ** 2 / square, r * r / square)
    if kept >= 1.0:
        return UNCUT
    weight = (1.0 - kept) / square
    left = down(1.0 - up(weight * square))
    if not left > 0.0:
        return UNCUT
    grown = up(1.0 + up(up(up(weight * r) * r) / left))
    factor = up(grown - down(down(weight * mig(delta)) * mig(delta)))
    if factor < 0.0:
        return EMPTY
    if not factor * (trace - (1.0 - kept) * cut) < trace * (1.0 - 1e-9):
        return UNCUT

    step = weight * mid(delta)
    unsure = weight * up(0.5 * (delta[1] - delta[0]))
    ratio = 1.0 + coarse / along
    slack = SLACK * ratio * ratio
    for i in range(n):
        spread = size[i] * coarse
        rest[i] = CENTRE * (abs(e.centre[i]) + abs(step) * spread) + 2.0 * unsure * spread
        e.centre[i] += step * ph[i]
        for k in range(i):
            e.shape[i, k] = factor * (e.shape[i, k] - weight * ph[i] * ph[k])
            e.shape[k, i] = e.shape[i, k]
        spread = slack * size[i] * size[i]
        e.shape[i, i] = factor * (e.shape[i, i] - weight * ph[i] * ph[i] + spread) + TINY
    plus(e, e.work[:n, :0], rest)
    return CUT


@compiled_bare
def meet_axis(e: Ellipsoid, i: int, low: float, high: float) -> int:
    """E ∩ {x : low <= x_i <= high}, outer; as `meet_strip`."""
    normal = e.work[3]
    normal[:] = 0.0
    normal[i] = 1.0
    return meet_strip(e, normal, low, high)


@compiled_bare
def least_trace(trace: float, cut: float, delta: float, r: float) -> float:
    """The t = 1 - λ g in (0, 1] for which the trace of P⁺ in `meet_strip` is least; 1: better not cut.

    trace = tr P, cut = |P h|² / g (both in units), delta = δ² / g, r = r² / g. The trace is

        F(t) = ((1 - delta - r) + r / t + delta t) ((trace - cut) + cut t),

    convex for t > 0 where the strip was met with the set's own (then delta + r <= 1); F'(t) t² = 0 is a cubic with a
    single positive root, reached by Newton's method from above.
    """
    across = max(trace - cut, 0.0)
    cubic = 2.0 * delta * cut
    quadratic = max(1.0 - delta - r, 0.0) * cut + delta * across
    constant = r * across
    if not cubic + quadratic > constant:
        return 1.0
    t = 1.0
    if quadratic > 0.0:
        t = min(t, sqrt(constant / quadratic))
    if cubic > 0.0:
        t = min(t, (constant / cubic) ** (1.0 / 3.0))
    for _ in range(6):
        slope = (3.0 * cubic * t + 2.0 * quadratic) * t
        if slope > 0.0:
            t -= ((cubic * t + quadratic) * t * t - constant) / slope
    return max(t, THINNEST)


@compiled_bare
def _trace_root(e: Ellipsoid) -> float:
    """sqrt(tr P), in units."""
    total = 0.0
    for i in range(len(e.centre)):
        total += max(e.shape[i, i], 0.0) / (e.units[i] * e.units[i])
    return sqrt(total)


@compiled_bare
def _length(e: Ellipsoid, columns: NDArray[np.float64], j: int) -> float:
    """|g_j|, in units."""
    total = 0.0
    for i in range(len(e.centre)):
        total += (columns[i, j] / e.units[i]) ** 2
    return sqrt(total)
