"""What a measurement costs each map, from the same readings to the cells, in four ways of writing it.

All are run in turn, so that a busy machine slows them alike; process time, every run on an empty map.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import inf, sqrt
from typing import Any

import numpy as np

from bench.baselines import (
    gaussian_mixture_1d,
    guaranteed_1d,
    kalman_1d,
    numpy_1d,
    paper_set_valued_1d,
    plain_1d,
)
from bench.paper.error_laws import uniform
from bench.paper.experiment import Progress
from bench.paper.profile_drive import BOUNDS, CELL_COUNT, STEP_M, drive
from bench.paper.profile_methods import GRID, ODOMETRY_VARIANCE_PER_M, SCRATCH, Readings, read
from drivers.compiled import compiled

MIXTURE = "mixture, sigma = b/3"
DRIVES = 4
"""In one call: Python's call, 3.5 us whatever the map, would be a fifth of what is measured of a single one."""
INTERPRETED, NUMPY, PLAIN, FAST = "interpreted", "numpy", "compiled as written", "compiled, by blocks"


@dataclass(frozen=True, slots=True)
class Cost:
    """CPU time of a measurement."""

    form: str
    method: str
    median_ns: float
    quietest_ns: float
    of_mixture: float
    """Share of what the mixture (sigma = b/3) of the same form took: median of the ratios run by run."""


def measure(repeats: int, seconds: float, progress: Progress) -> list[Cost]:
    """Each map's cost from `repeats` runs of `seconds` each, all maps in turn."""
    runs, count = _runs()
    loops = {}
    for key, run in runs.items():
        run()  # compiles
        began = time.process_time()
        run()
        loops[key] = max(1, round(seconds / max(1e-6, time.process_time() - began)))
    taken: dict[tuple[str, str], list[float]] = {key: [] for key in runs}
    for repeat in range(repeats):
        progress(repeat / repeats, f"cost: round {repeat + 1} of {repeats}")
        for key, run in runs.items():
            began = time.process_time()
            for _ in range(loops[key]):
                run()
            taken[key].append((time.process_time() - began) / loops[key] / count * 1e9)
    costs = []
    for (form, method), times in taken.items():
        ratios = np.array(times) / np.array(taken[form, MIXTURE])
        costs.append(Cost(form, method, float(np.median(times)), min(times), float(np.median(ratios))))
    return costs


def _runs() -> tuple[dict[tuple[str, str], Callable[[], Any]], int]:
    """By form and method: DRIVES drives into an empty map, in one call; and how many measurements they have."""
    true, rng = drive(0.0), np.random.default_rng(0)
    drives = [read(true, uniform(rng, 0, true.x_m.size) * BOUNDS) for _ in range(DRIVES)]
    readings = Readings(*(np.concatenate(columns) for columns in zip(*(one.columns for one in drives), strict=True)))
    arrays, lists = readings.columns, [column.tolist() for column in readings.columns]
    third, root = BOUNDS / 3.0, BOUNDS / sqrt(3.0)
    sums = np.zeros((CELL_COUNT, gaussian_mixture_1d.SUMS), np.float32)
    kalman_cells, paper_cells = kalman_1d.unseen_cells(CELL_COUNT), paper_set_valued_1d.unseen_cells(CELL_COUNT)
    kalman_empty, paper_empty = kalman_cells.copy(), paper_cells.copy()
    our_cells, certified = guaranteed_1d.unseen_cells(CELL_COUNT), np.zeros(CELL_COUNT, np.bool_)
    columns = np.zeros((3, CELL_COUNT))

    def mixture(sigma: Any) -> None:
        sums.fill(0.0)
        gaussian_mixture_1d.insert_mixture(*arrays, sigma, *GRID, sums, SCRATCH)

    def kalman(growth: float) -> None:
        kalman_cells[:] = kalman_empty
        kalman_1d.insert_kalman(*arrays, third, *GRID, kalman_cells, STEP_M, growth, SCRATCH)

    def paper(form: int) -> None:
        paper_cells[:] = paper_empty
        paper_set_valued_1d.insert_set_valued(*arrays, BOUNDS, *GRID, paper_cells, form, SCRATCH)

    def ours(certify: bool) -> None:
        our_cells.fill(-np.inf)
        step_m = STEP_M if certify else inf
        if certify:
            certified.fill(False)
        guaranteed_1d.insert_guaranteed(*arrays, BOUNDS, *GRID, our_cells, certified, step_m, SCRATCH)

    def plain(function: Any, spread: Any, starts: tuple[float, ...], interpreted: bool) -> None:
        if interpreted:
            cells: list[Any] = [[start] * CELL_COUNT for start in starts]
            function(*lists, spread.tolist(), *GRID, *cells)
        else:
            for row, start in zip(columns, starts, strict=False):
                row.fill(start)
            function(*arrays, spread, *GRID, *columns[: len(starts)])

    def numpy_mixture() -> None:
        columns.fill(0.0)
        numpy_1d.mixture(*arrays, third, *GRID, columns)

    def numpy_hull() -> None:
        columns[0].fill(inf)
        columns[1].fill(-inf)
        numpy_1d.hull(*arrays, BOUNDS, *GRID, columns[0], columns[1])

    runs: dict[tuple[str, str], Callable[[], Any]] = {
        (INTERPRETED, MIXTURE): lambda: plain(plain_1d.mixture, third, (0.0, 0.0, 0.0), True),
        (INTERPRETED, "Kalman"): lambda: plain(plain_1d.kalman, third, (0.0, inf), True),
        (INTERPRETED, "paper, first order"): lambda: plain(plain_1d.hull, BOUNDS, (inf, -inf), True),
        (NUMPY, MIXTURE): numpy_mixture,
        (NUMPY, "paper, first order"): numpy_hull,
        (PLAIN, MIXTURE): lambda: plain(_plain_mixture, third, (0.0, 0.0, 0.0), False),
        (PLAIN, "Kalman"): lambda: plain(_plain_kalman, third, (0.0, inf), False),
        (PLAIN, "paper, first order"): lambda: plain(_plain_hull, BOUNDS, (inf, -inf), False),
        (FAST, MIXTURE): lambda: mixture(third),
        (FAST, "mixture, sigma = b/sqrt 3"): lambda: mixture(root),
        (FAST, "Kalman"): lambda: kalman(0.0),
        (FAST, "Kalman, inflated"): lambda: kalman(ODOMETRY_VARIANCE_PER_M),
        (FAST, "paper, first order"): lambda: paper(paper_set_valued_1d.FIRST_ORDER),
        (FAST, "paper, natural"): lambda: paper(paper_set_valued_1d.NATURAL),
        (FAST, "ours, bounds"): lambda: ours(False),
        (FAST, "ours, bounds and certified cells"): lambda: ours(True),
    }
    return runs, readings.x_m.size


_plain_mixture: Any = compiled(plain_1d.mixture)
_plain_kalman: Any = compiled(plain_1d.kalman)
_plain_hull: Any = compiled(plain_1d.hull)
