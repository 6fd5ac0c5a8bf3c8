"""Ellipsoids against 60-digit arithmetic, at points on the very boundary of what must stay inside."""

import inspect
from types import ModuleType

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator import ellipsoid as el
from estimator.ellipsoid import Ellipsoid

EXACT = mpmath.MPContext()
EXACT.dps = 60

Vector = NDArray[np.float64]
UNITS = np.array([1.0, 1.0, 0.1, 0.01])
COMPILED = "from drivers.compiled import compiled_bare, plain_or_compiled"
PLAIN = "compiled_bare = plain_or_compiled = lambda function: function"


def drawn(rng: np.random.Generator, n: int = 4) -> Ellipsoid:
    """Any ellipsoid: of any size, far away or near, thin or round."""
    size = 10.0 ** rng.uniform(-4.0, 2.0)
    away = rng.integers(0, 2) * 10.0 ** rng.uniform(-3.0, 5.0)
    e = el.point(rng.normal(size=n) * away, np.resize(UNITS, n))
    root = rng.normal(size=(n, n)) * size * 10.0 ** rng.uniform(-2.0, 0.0, size=n)
    e.shape[:] = root @ root.T
    e.shape[:] = np.tril(e.shape) + np.tril(e.shape, -1).T + np.eye(n) * 1e-12 * np.trace(e.shape)
    return e


def exact(a: NDArray[np.float64]) -> mpmath.matrix:
    """The same numbers, as 60-digit ones."""
    return EXACT.matrix(a.tolist())


def root(e: Ellipsoid) -> mpmath.matrix:
    """L with L Lᵀ = P, exact."""
    return EXACT.cholesky(exact(e.shape))


def on_sphere(rng: np.random.Generator, n: int) -> mpmath.matrix:
    """|u| = 1 to 60 digits."""
    u = exact(rng.normal(size=n))
    return u / EXACT.norm(u)


def holds(e: Ellipsoid, x: mpmath.matrix) -> bool:
    """Is x in E? Exactly."""
    try:
        lower, y = root(e), x - exact(e.centre)
    except ValueError:
        return False  # a negative eigenvalue
    for i in range(len(y)):
        y[i] = (y[i] - EXACT.fsum(lower[i, k] * y[k] for k in range(i))) / lower[i, i]
    return bool(EXACT.fdot(y, y) <= 1)


def a_step(rng: np.random.Generator) -> tuple[Vector, Vector, Vector, Vector]:
    """A, v, segments, half-widths; some of them zero."""
    matrix = np.eye(4) + np.triu(rng.normal(size=(4, 4)), 1) * 10.0 ** rng.uniform(-3.0, 1.0)
    columns = rng.normal(size=(4, 3)) * 10.0 ** rng.uniform(-9.0, 0.0) * rng.integers(0, 2, size=3)
    half_widths = np.abs(rng.normal(size=4)) * 10.0 ** rng.uniform(-9.0, 0.0) * rng.integers(0, 2, size=4)
    return matrix, rng.normal(size=4) * rng.integers(0, 2), columns, half_widths


def check_image(code: ModuleType, rng: np.random.Generator) -> bool:
    """A x + v + corners of the added sets stay inside, for x on the boundary of E."""
    e = drawn(rng)
    before = root(e), exact(e.centre)
    matrix, shift, columns, half_widths = a_step(rng)
    code.image(e, matrix, shift, columns, half_widths)
    kept = True
    for _ in range(4):
        # in the direction in which all sets reach furthest, the sum touches the outer ellipsoid most nearly
        way = exact(rng.normal(size=4))
        pulled = before[0].T * (exact(matrix).T * way)
        u = pulled / EXACT.norm(pulled)
        x = exact(matrix) * (before[1] + before[0] * u) + exact(shift)
        for j in range(3):
            x += exact(columns[:, j]) * EXACT.sign(EXACT.fdot(exact(columns[:, j]), way))
        for i in range(4):
            x[i] += EXACT.mpf(half_widths[i]) * EXACT.sign(way[i])
        kept = kept and holds(e, x)
    return kept


def check_affine(code: ModuleType, rng: np.random.Generator) -> bool:
    """With nothing added the boundary goes to the boundary, less than a millionth away from it."""
    e = drawn(rng)
    before = root(e), exact(e.centre)
    matrix, shift, _, _ = a_step(rng)
    code.image(e, matrix, shift, np.zeros((4, 0)), np.zeros(4))
    kept = True
    for _ in range(4):
        u = on_sphere(rng, 4)
        middle = exact(matrix) * before[1] + exact(shift)
        edge = exact(matrix) * (before[0] * u)
        kept = kept and holds(e, middle + edge)
    return kept


def check_box(code: ModuleType, rng: np.random.Generator) -> bool:
    """All corners of the box are inside."""
    centre = rng.normal(size=4) * 10.0 ** rng.uniform(-3.0, 5.0)
    half_widths = np.abs(rng.normal(size=4)) * UNITS * 10.0 ** rng.uniform(-5.0, 2.0)
    e = code.box(centre, half_widths, UNITS)
    corners = (np.array(np.meshgrid(*[(-1.0, 1.0)] * 4)).reshape(4, -1) * half_widths[:, None]).T
    return all(holds(e, exact(centre) + exact(corner)) for corner in corners)


def check_strip(code: ModuleType, rng: np.random.Generator) -> bool:
    """Points where the ellipsoid's boundary and the strip's meet stay inside: the fused one passes through them."""
    e = drawn(rng)
    before = root(e), exact(e.centre)
    normal = np.eye(4)[rng.integers(4)] if rng.integers(2) else rng.normal(size=4)
    pulled = before[0].T * exact(normal)
    reach = EXACT.norm(pulled)
    middle = EXACT.fdot(exact(normal), before[1])
    a, b = np.sort(rng.uniform(-1.3, 1.3, size=2))
    if rng.integers(2):
        b = a + rng.integers(0, 2) * 10.0 ** rng.uniform(-8.0, -2.0)
    low, high = float(middle + a * reach), float(middle + b * reach)
    outcome = code.meet_strip(e, normal, low, high)
    kept = True
    for level in (low, high, 0.5 * low + 0.5 * high):
        along = (EXACT.mpf(level) - middle) / reach
        if not abs(along) <= 1 or not low <= level <= high:
            continue
        kept = kept and outcome != code.EMPTY
        w = exact(rng.normal(size=4))
        w -= pulled * (EXACT.fdot(w, pulled) / reach**2)
        u = pulled / reach * along + w / EXACT.norm(w) * EXACT.sqrt(1 - along**2)
        x = before[1] + before[0] * u
        # solving for u loses a few of the 60 digits
        kept = kept and holds(e, x - (x - exact(e.centre)) * EXACT.mpf(10) ** -40)
    return kept


CHECKS = {"image": check_image, "affine": check_affine, "box": check_box, "strip": check_strip}


@pytest.mark.parametrize("check", CHECKS)
def test_no_point_is_lost_not_even_by_rounding(check: str) -> None:
    """Boundary points of the exact result, to 60 digits, are in the computed one, 80 times out of 80."""
    rng = np.random.default_rng(4)
    assert all(CHECKS[check](el, rng) for _ in range(80))


def test_the_image_is_the_formula_and_hardly_wider() -> None:
    """A c + v and Σ P_j / α_j, α_j = sqrt(tr P_j) / Σ sqrt(tr P_i), written in matrices: wider by 1e-11 at most."""
    rng = np.random.default_rng(8)
    for _ in range(200):
        e, (matrix, shift, columns, half_widths) = drawn(rng), a_step(rng)
        segments = [*columns.T, *np.diag(half_widths)]
        parts = [matrix @ e.shape @ matrix.T, *(np.outer(g, g) for g in segments)]
        roots = np.array([np.sqrt(np.trace(part / np.outer(e.units, e.units))) for part in parts])
        centre, away = matrix @ e.centre + shift, 1e-13 * (np.abs(matrix) @ np.abs(e.centre) + np.abs(shift))
        el.image(e, matrix, shift, columns, half_widths)
        formula = sum(part * roots.sum() / root for part, root in zip(parts, roots, strict=True) if root > 0.0)
        size = np.sqrt(np.diag(e.shape))
        assert np.all(np.abs(e.centre - centre) <= away)
        assert np.all(size >= np.sqrt(np.diag(formula)))
        assert np.all(size <= np.sqrt(np.diag(formula)) * (1.0 + 1e-11) + 1e3 * away)


@settings(max_examples=40)
@given(st.integers(0, 2**32), st.sampled_from(sorted(CHECKS)))
def test_no_point_is_lost_whatever_is_drawn(seed: int, check: str) -> None:
    """The same for any seed."""
    assert CHECKS[check](el, np.random.default_rng(seed))


BREAKS = {
    "the box's ellipsoid as wide as the box": ("share * half_widths[i] * half_widths[i]", "half_widths[i] ** 2", "box"),
    "factor two for the box, whatever the dimension": (
        "share * half_widths[i] * half_widths[i]",
        "2.0 * half_widths[i] ** 2",
        "box",
    ),
    "segments added without their share": ("share * columns[i, j] *", "columns[i, j] *", "image"),
    "the set itself without its share": ("e.shape[i, k] *= share", "e.shape[i, k] *= 1.0", "image"),
    "shares that sum to more than one": ("total *= 1.0 + SLACK", "total *= 0.999", "image"),
    "A P in place of A P Aᵀ": ("e.work[i, m] * matrix[k, m]", "e.work[i, m] * float(k == m)", "affine"),
    "the centre not shifted": ("total = shift[i]", "total = 0.0 * shift[i]", "affine"),
    "the scale divided in place of multiplied": ("factor * (e.shape", "1.0 / factor * (e.shape", "strip"),
    "no scale at all": ("factor = up(grown", "factor = min(1.0, grown) + 0.0 * up(grown", "strip"),
    "the centre moved twice as far": ("step = weight * mid(delta)", "step = 2.0 * weight * mid(delta)", "strip"),
    "the strip inverted": ("step = weight * mid(delta)", "step = -weight * mid(delta)", "strip"),
    "half the strip": ("r = reach(seen, y)", "r = 0.5 * reach(seen, y)", "strip"),
    "the remainder left out": ("rest[i] = up(half_widths[i] + CENTRE * terms)", "rest[i] = CENTRE * terms", "image"),
    "rounding not covered": ("SLACK = 2.0**-42", "SLACK = 0.0", "affine"),
    "rounding of the centre not covered": ("CENTRE = 2.0**-48", "CENTRE = 0.0", "affine"),
    "rounding inward in the fusion": ("factor = up(grown", "factor = (1.0 - 2.0**-36) * up(grown", "strip"),
    "rounding inward": ("SLACK = 2.0**-42", "SLACK = -(2.0**-42)", "image"),
}


@pytest.mark.parametrize("name", BREAKS)
def test_a_broken_formula_is_caught(name: str) -> None:
    """Each of these mistakes, written into the code, loses a point within 300 draws."""
    right, wrong, check = BREAKS[name]
    source = inspect.getsource(el)
    assert COMPILED in source
    assert source.count(right) >= 1, "the line to break is gone"
    broken = ModuleType("broken")
    plain = source.replace(COMPILED, PLAIN)
    exec(plain.replace(right, wrong), broken.__dict__)
    rng = np.random.default_rng(5)
    assert not all(CHECKS[check](broken, rng) for _ in range(300))


@pytest.mark.parametrize("check", CHECKS)
def test_plain_floating_point_loses_points(check: str) -> None:
    """With every outward rounding taken out, right formulas are not enough: points are lost within 300 draws."""
    plain = inspect.getsource(el).replace(COMPILED, PLAIN)
    for rounded, unrounded in (
        (" up(", " ("),
        ("(up(", "(("),
        (" down(", " ("),
        ("(down(", "(("),
        ("SLACK = 2.0**-42", "SLACK = 0.0"),
        ("CENTRE = 2.0**-48", "CENTRE = 0.0"),
        ("SHORTEST = 1e-140", "SHORTEST = 1e-200"),
    ):
        assert rounded in plain
        plain = plain.replace(rounded, unrounded)
    broken = ModuleType("broken")
    exec(plain, broken.__dict__)
    rng = np.random.default_rng(5)
    assert not all(CHECKS[check](broken, rng) for _ in range(300))


def test_a_strip_that_misses_is_empty_and_one_that_holds_all_says_nothing() -> None:
    """EMPTY and UNCUT leave the set as it was; a strip that touches leaves almost a point."""
    e = el.box(np.array([1.0, 2.0, 0.0, 0.0]), np.array([0.5, 0.25, 0.1, 0.01]), UNITS)
    before = e.centre.copy(), e.shape.copy()
    low, high = el.extent(e, 0)
    assert el.meet_axis(e, 0, high + 1e-9, high + 1.0) == el.EMPTY
    assert el.meet_axis(e, 0, -np.inf, low - 1e-9) == el.EMPTY
    assert el.meet_axis(e, 0, np.nan, np.nan) == el.EMPTY
    assert el.meet_axis(e, 0, low, high) == el.UNCUT
    assert el.meet_axis(e, 0, -np.inf, np.inf) == el.UNCUT
    assert np.array_equal(e.centre, before[0])
    assert np.array_equal(e.shape, before[1])
    assert el.meet_axis(e, 0, high - 1e-12, np.inf) == el.CUT
    assert max(el.half_width(e, i) for i in range(4)) < 1e-2
    assert el.extent(e, 0)[1] >= high - 1e-12


def test_the_fusion_has_the_least_trace_of_its_family() -> None:
    """No other λ gives a smaller trace: found by trying 2000 of them, for 200 sets and strips."""
    rng = np.random.default_rng(6)
    for _ in range(200):
        trace, part, a, b = rng.uniform(size=4)
        cut, d = part * trace, a * 0.98
        r = b * (1.0 - d)
        delta, square = d * d, r * r

        def size(t: float | Vector, delta: float = delta, r2: float = square, tau: float = trace, k: float = cut):  # type: ignore[no-untyped-def]
            return ((1 - delta - r2) + r2 / t + delta * t) * (tau - k + k * t)

        best = float(np.min(size(np.linspace(1e-4, 1.0, 2000))))
        assert size(el.least_trace(trace, cut, delta, square)) <= best * (1.0 + 1e-6)


def test_the_sum_has_the_least_trace_of_its_family() -> None:
    """Other shares than those chosen give no smaller sum of squared half-widths."""
    rng = np.random.default_rng(7)
    for _ in range(50):
        e = drawn(rng)
        before = e.shape.copy()
        columns = rng.normal(size=(4, 2)) * np.sqrt(np.trace(before))
        el.plus(e, columns, np.zeros(4))
        least = np.sum(np.diag(e.shape) / UNITS**2)
        parts = [before, *(np.outer(g, g) for g in columns.T)]
        for _ in range(50):
            shares = rng.dirichlet(np.ones(3))
            other = sum(part / share for part, share in zip(parts, shares, strict=True))
            assert least <= np.sum(np.diag(other) / UNITS**2) * (1.0 + 1e-9)


@compiled
def wander(e: Ellipsoid, steps: int, matrix: Vector, columns: Vector, rest: Vector, truth: Vector) -> int:
    """Steps, each with noise at a corner, and a strip of 0.1 around the truth's first coordinates; lost: how often."""
    lost = 0
    sign = 1.0
    shift = np.zeros(4)
    moved = np.zeros(4)
    for k in range(steps):
        if k % 97 == 0:
            sign = -sign
        turn = 0.01 * k
        matrix[0, 2] = -0.01 * np.sin(turn)
        matrix[1, 2] = 0.01 * np.cos(turn)
        for i in range(4):
            moved[i] = sign * (columns[i, 0] - columns[i, 1] + rest[i])
            for m in range(4):
                moved[i] += matrix[i, m] * truth[m]
        truth[:] = moved
        el.image(e, matrix, shift, columns, rest)
        if k % 50 == 0:
            for i in range(2):
                if el.meet_axis(e, i, truth[i] - 0.1, truth[i] + 0.1) == el.EMPTY:
                    lost += 1
        for i in range(4):
            low, high = el.extent(e, i)
            if not low <= truth[i] <= high:
                lost += 1
    return lost


def test_ten_to_the_fifth_steps_keep_the_truth_and_no_negative_eigenvalue() -> None:
    """Drive and fuse 10^5 times: the truth is in the set at each step, and P is positive semidefinite, exactly."""
    e = el.point(np.zeros(4), UNITS)
    matrix = np.eye(4)
    matrix[2, 3] = -0.01
    columns = np.array([[1e-4, 0.0], [0.0, 1e-4], [1e-5, 0.0], [0.0, 1e-9]])
    truth = np.zeros(4)
    for _ in range(10):
        assert wander(e, 10_000, matrix, columns, np.full(4, 1e-9), truth) == 0
        assert np.array_equal(e.shape, e.shape.T)
        root(e)  # raises unless P is positive definite
    assert el.half_width(e, 0) < 1.0
