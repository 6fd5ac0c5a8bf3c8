"""The maps over one horizontal dimension against plain forms of the same equations, and ours against the truth."""

from math import inf, sqrt
from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from bench.baselines import gaussian_mixture_1d, guaranteed_1d, kalman_1d, numpy_1d, paper_set_valued_1d, plain_1d
from bench.baselines.beam_1d import STEEPEST_RAD, new_scratch, sine_cosine
from bench.baselines.normal_table import normal_cdf
from bench.paper.error_laws import HOLDING
from bench.paper.profile_drive import BOUNDS, CELL_COUNT, HEIGHT_M, PITCH_RAD, STEP_M, cast, drive
from bench.paper.profile_methods import GRID, Readings, guaranteed, literal, mapper_in_the_plane, read

Floats = NDArray[np.float64]
SIGMA = BOUNDS / 3.0


@pytest.fixture(scope="module")
def readings() -> Readings:
    """One drive under uniform errors."""
    true = drive(0.4)
    return read(true, HOLDING["uniform"](np.random.default_rng(5), 0, true.x_m.size) * BOUNDS)


def columns(*starts: float) -> list[Any]:
    """Cells of a plain form."""
    return [np.full(CELL_COUNT, start) for start in starts]


def lists(readings: Readings) -> tuple[list[float], list[float], list[float]]:
    """The readings as a plain form takes them."""
    return readings.x_m.tolist(), readings.pitch_rad.tolist(), readings.ranges_m.tolist()


def test_phi_is_as_exact_as_its_page_says() -> None:
    """Within 2e-6 of mpmath's, inside the table and beyond."""
    for t in np.linspace(-9.0, 9.0, 4001):
        exact = float(mpmath.ncdf(t))
        assert abs(normal_cdf(t) - exact) < 2e-6


def test_sine_and_cosine_are_as_exact_as_the_rounding_argument_needs() -> None:
    """Within 8 * 2^-53 of mpmath's, up to the steepest pitch."""
    for angle in np.linspace(-STEEPEST_RAD, STEEPEST_RAD, 3001):
        sine, cosine = sine_cosine(angle)
        assert abs(mpmath.sin(mpmath.mpf(angle)) - sine) < 8 * 2.0**-53
        assert abs(mpmath.cos(mpmath.mpf(angle)) - cosine) < 8 * 2.0**-53


@pytest.mark.parametrize("sigma", [SIGMA, BOUNDS / sqrt(3.0), np.array([0.1, 0.05, 0.4])])
@pytest.mark.parametrize("steep", [False, True])
def test_the_fast_mixture_is_the_plain_one(readings: Readings, sigma: Floats, steep: bool) -> None:
    """All three sums of every cell, to what float32 and the table of Φ leave; the numpy form too.

    On steep beams place and elevation err together, which the drive's flat ones hardly do.
    """
    if steep:
        readings = Readings(readings.x_m, 4.0 * readings.pitch_rad - 0.3, readings.ranges_m)
    fast, (s0, s1, s2), sums = np.zeros((CELL_COUNT, 3), np.float32), columns(0.0, 0.0, 0.0), np.zeros((3, CELL_COUNT))
    gaussian_mixture_1d.insert_mixture(*readings.columns, sigma, *GRID, fast, new_scratch())
    plain_1d.mixture(*lists(readings), sigma.tolist(), *GRID, s0, s1, s2)
    numpy_1d.mixture(*readings.columns, sigma, *GRID, sums)
    assert s0.max() > 10.0
    for i, exact in enumerate((s0, s1, s2)):
        np.testing.assert_allclose(fast[:, i], exact, atol=2e-4, rtol=1e-4)
        np.testing.assert_allclose(sums[i], exact, atol=2e-4, rtol=1e-4)


def test_the_fast_kalman_map_is_the_plain_one(readings: Readings) -> None:
    """Elevation and variance of every cell; gate, replacement and drop all happen."""
    fast, (elevation, variance) = kalman_1d.unseen_cells(CELL_COUNT), columns(0.0, inf)
    kalman_1d.insert_kalman(*readings.columns, SIGMA, *GRID, fast, STEP_M, 0.0, new_scratch())
    plain_1d.kalman(*lists(readings), SIGMA.tolist(), *GRID, elevation, variance)
    mean, sd = kalman_1d.kalman_moments(fast)
    seen = variance < inf
    np.testing.assert_array_equal(~np.isnan(mean), seen)
    np.testing.assert_allclose(mean[seen], elevation[seen], atol=1e-5)
    np.testing.assert_allclose(sd[seen], np.sqrt(variance[seen]), rtol=1e-4)


def test_an_inflated_cell_forgets_as_the_robot_drives() -> None:
    """Two readings of one cell, ten measurements apart: its variance has grown by ten steps' in between."""
    x = np.array([0.0, *np.full(9, 50.0), 0.0])
    pitch, ranges = np.full(11, PITCH_RAD), np.full(11, 10.0)
    cells = kalman_1d.unseen_cells(CELL_COUNT)
    kalman_1d.insert_kalman(x, pitch, ranges, SIGMA, *GRID, cells, 0.5, 0.01, new_scratch())
    R = (np.sin(PITCH_RAD) * SIGMA[2]) ** 2 + (10.0 * np.cos(PITCH_RAD) * SIGMA[1]) ** 2
    grown = R + 0.01 * 10 * 0.5
    cell = cells[int(np.floor(10.0 * np.cos(PITCH_RAD) + 0.5)) - GRID[2]]
    assert cell[1] == pytest.approx(R * grown / (R + grown), rel=1e-5)


def test_the_fast_hull_is_the_plain_one(readings: Readings) -> None:
    """The paper's first-order form, both ends of every cell; the numpy form too."""
    fast = paper_set_valued_1d.unseen_cells(CELL_COUNT)
    (low, high), (low_n, high_n) = columns(inf, -inf), columns(inf, -inf)
    form = paper_set_valued_1d.FIRST_ORDER
    paper_set_valued_1d.insert_set_valued(*readings.columns, BOUNDS, *GRID, fast, form, new_scratch())
    plain_1d.hull(*lists(readings), BOUNDS.tolist(), *GRID, low, high)
    numpy_1d.hull(*readings.columns, BOUNDS, *GRID, low_n, high_n)
    np.testing.assert_allclose(fast[:, 0], low, atol=1e-6)
    np.testing.assert_allclose(fast[:, 1], high, atol=1e-6)
    np.testing.assert_array_equal((low_n, high_n), (low, high))


def test_the_natural_form_is_interval_arithmetic() -> None:
    """One measurement at a time against mpmath's intervals, level and upward beams too."""
    for pitch in (-0.7, -0.3, -0.004, 0.0, 0.004, 0.4):
        cells = paper_set_valued_1d.unseen_cells(CELL_COUNT)
        one = np.array([20.0]), np.array([pitch]), np.array([10.0])
        natural = paper_set_valued_1d.NATURAL
        paper_set_valued_1d.insert_set_valued(*one, BOUNDS, *GRID, cells, natural, new_scratch())
        r = mpmath.iv.mpf([10.0 - BOUNDS[2], 10.0 + BOUNDS[2]])
        angle = mpmath.iv.mpf([pitch - BOUNDS[1], pitch + BOUNDS[1]])
        X = mpmath.iv.mpf([20.0 - BOUNDS[0], 20.0 + BOUNDS[0]]) + r * mpmath.iv.cos(angle)
        Z = HEIGHT_M + r * mpmath.iv.sin(angle)
        met = np.flatnonzero(cells[:, 0] <= cells[:, 1]) + GRID[2]
        assert met.tolist() == list(range(int(np.floor(float(X.a) + 0.5)), int(np.floor(float(X.b) + 0.5)) + 1))
        assert cells[met[0] - GRID[2]] == pytest.approx((float(Z.a), float(Z.b)), abs=1e-5)


def test_ours_is_the_papers_a_little_wider(readings: Readings) -> None:
    """The remainder and the rounding outward cost less than 5 mm at each end here, and never make a cell narrower."""
    ours, paper = guaranteed(readings, BOUNDS), literal(readings, BOUNDS, paper_set_valued_1d.FIRST_ORDER)
    both = ~np.isnan(paper.low)
    assert np.all(ours.low[both] < paper.low[both])
    assert np.all(ours.high[both] > paper.high[both])
    assert np.max(paper.low[both] - ours.low[both]) < 5e-3


def test_ours_is_what_the_mapper_on_the_robot_gives(readings: Readings) -> None:
    """Both bound what the first order leaves out, each in its own way: ends within 2 mm.

    Of two hundred cells, two at most may be an exception: those that a beam's footprint just reaches in one of them.
    """
    flat, in_space = guaranteed(readings, BOUNDS), mapper_in_the_plane(readings, BOUNDS)
    near = (np.abs(in_space.low - flat.low) < 2e-3) & (np.abs(in_space.high - flat.high) < 2e-3)
    seen = ~np.isnan(flat.low)
    assert seen.sum() > 190
    assert near.sum() >= seen.sum() - 2
    assert not np.any(~np.isnan(in_space.low) & ~seen)


@settings(max_examples=150)
@given(
    steps=st.lists(st.tuples(st.integers(1, 25), st.floats(-1.2, 1.2)), min_size=2, max_size=8),
    scale=st.sampled_from([0.01, 0.3, 1.0]),
    law=st.sampled_from(sorted(HOLDING)),
    seed=st.integers(0, 2**32 - 1),
)
def test_ours_bounds_every_hit_on_any_ground(steps: list[tuple[int, float]], scale: float, law: str, seed: int) -> None:
    """Random ground, bounds and errors up to their corners: every hit is in its bound, every certified cell hit."""
    corners, x, z = [(-60.0, 0.0)], -20.0, 0.0
    for length, height in steps:
        corners += [(x, z), (x, height)]
        x, z = x + length + 0.5, height
    ground, rng, bounds = np.array([*corners, (x, z), (400.0, z)]), np.random.default_rng(seed), scale * BOUNDS
    true_x = np.arange(-5.0, 150.0, STEP_M)
    hit_x, hit_z = cast(true_x, ground)
    errors = HOLDING[law](rng, seed % 8, true_x.size) * bounds
    ranges = (hit_x - true_x) / np.cos(PITCH_RAD)
    estimate = guaranteed(Readings(true_x + errors[:, 0], PITCH_RAD + errors[:, 1], ranges + errors[:, 2]), bounds)
    cells = np.floor(hit_x + 0.5).astype(np.int64) - GRID[2]
    assert np.all((estimate.low[cells] <= hit_z) & (hit_z <= estimate.high[cells]))
    hit = np.zeros(CELL_COUNT, np.bool_)
    hit[cells] = True
    assert estimate.certified is not None
    assert not np.any(estimate.certified & ~hit)


def test_cells_beyond_a_jump_are_not_certified() -> None:
    """The range jumps from 10 m to 30 m: no cell between is certified, though both runs' own are."""
    count = 200
    x = 0.01 * np.arange(count, dtype=np.float64)
    ranges = np.repeat(np.array([10.0, 30.0]), count // 2)
    cells, certified = guaranteed_1d.unseen_cells(CELL_COUNT), np.zeros(CELL_COUNT, np.bool_)
    bounds = np.array([0.05, 1e-4, 0.01])
    pitch = np.full(count, PITCH_RAD)
    guaranteed_1d.insert_guaranteed(x, pitch, ranges, bounds, *GRID, cells, certified, 0.01, new_scratch())
    assert (np.flatnonzero(certified) + GRID[2]).tolist() == [10, 11, 31, 32]


def test_what_lies_outside_the_cells_or_is_no_number_harms_nothing() -> None:
    """Readings far to both sides, and NaN: no cell changes, and nothing crashes."""
    x = np.array([-1e4, 1e4, np.nan, 1e300])
    pitch, ranges = np.full(4, PITCH_RAD), np.full(4, 10.0)
    sums, hulls = np.zeros((CELL_COUNT, 3), np.float32), guaranteed_1d.unseen_cells(CELL_COUNT)
    paper, kalman = paper_set_valued_1d.unseen_cells(CELL_COUNT), kalman_1d.unseen_cells(CELL_COUNT)
    flags = np.zeros(CELL_COUNT, np.bool_)
    gaussian_mixture_1d.insert_mixture(x, pitch, ranges, SIGMA, *GRID, sums, new_scratch())
    guaranteed_1d.insert_guaranteed(x, pitch, ranges, BOUNDS, *GRID, hulls, flags, STEP_M, new_scratch())
    paper_set_valued_1d.insert_set_valued(x, pitch, ranges, BOUNDS, *GRID, paper, 1, new_scratch())
    paper_set_valued_1d.insert_intersecting(x, pitch, ranges, BOUNDS, *GRID, paper, flags.copy(), 1, new_scratch())
    kalman_1d.insert_kalman(x, pitch, ranges, SIGMA, *GRID, kalman, STEP_M, 0.0, new_scratch())
    assert not sums.any()
    assert not flags.any()
    assert np.all(np.isneginf(hulls))
    assert np.all(paper[:, 0] > paper[:, 1])
    assert np.all(kalman[:, 1] < 0.0)
