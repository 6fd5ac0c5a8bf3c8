"""The paper's simulation: a profile of flats, a slope, a ditch and a wall, every map of it, every law of errors.

Reconstructed where the paper's text was not at hand: the heights, the other maps' equations, and how errors drift.
"""

from dataclasses import asdict
from pathlib import Path

import numpy as np

from bench.paper import table1_pictures
from bench.paper.error_laws import HOLDING, Law, bias, uniform
from bench.paper.experiment import Outcome, Progress
from bench.paper.profile_drive import BOUNDS, drive, true_elevations
from bench.paper.profile_methods import METHODS, Estimate, read
from bench.paper.profile_runs import IN_SPACE, OURS, Scores, run_laws
from bench.paper.table1_cost import Cost, measure
from bench.paper.table1_reference import HULL, MIXTURE, SWEEP, checks
from bench.paper.table1_report import report

RUNS, SHORT_RUNS = 104, 8
"""Of each law; a multiple of eight, so that each corner of constant bias has its turn."""
MOVED_M = 1e-3


def run(output: Path, short: bool, progress: Progress) -> Outcome:
    """All runs, the cost, the pictures. Broken: true hits outside our bounds, where the errors keep theirs."""
    runs = SHORT_RUNS if short else RUNS
    averages = run_laws(runs, progress)
    sweep = run_sweep(runs)
    joins = order_and_repetition()
    costs = measure(
        3 if short else 9, 0.01 if short else 0.25, lambda share, doing: progress(0.5 + 0.45 * share, doing)
    )
    progress(0.95, "drawing")
    pictures = draw(output, averages, costs)
    found = checks(averages, sweep)
    numbers = {
        "runs": runs,
        "laws": averages,
        "height_sweep_rmse_m": {
            str(scale): dict(zip((MIXTURE, HULL), rmse, strict=True)) for scale, rmse in sweep.items()
        },
        "order_and_repetition": joins,
        "cost": [asdict(cost) for cost in costs],
        "reference": [asdict(check) | {"met": check.met} for check in found],
    }
    progress(1.0, "done")
    return Outcome(
        "The paper's simulation (table 1)",
        report(runs, averages, sweep, joins, costs, found),
        numbers,
        pictures,
        tuple(broken_promises(averages)),
    )


def run_sweep(runs: int) -> dict[float, tuple[float, float]]:
    """RMSE of mixture and hull over all cells, uniform errors, with the ground's heights scaled."""
    rmse = {}
    for scale in SWEEP:
        truth, sums = true_elevations(scale), np.zeros(2)
        for number in range(runs):
            rng = np.random.default_rng([number, 2])
            true = drive(rng.uniform(), scale)
            readings = read(true, uniform(rng, number, true.x_m.size) * BOUNDS)
            for i, method in enumerate((MIXTURE, HULL)):
                error = METHODS[method](readings, BOUNDS).mean - truth
                sums[i] += np.sqrt(np.nanmean(error * error))
        rmse[scale] = (float(sums[0]) / runs, float(sums[1]) / runs)
    return rmse


def order_and_repetition() -> dict[str, dict[str, int]]:
    """How many cells change when one drive's readings come in another order, or a third of them twice."""
    rng = np.random.default_rng(6)
    true = drive(0.0)
    readings = read(true, uniform(rng, 0, true.x_m.size) * BOUNDS)
    places = np.arange(true.x_m.size)
    shuffled = readings.at(rng.permutation(places))
    repeated = readings.at(np.sort(np.concatenate((places, rng.choice(places, places.size // 3, replace=False)))))
    changes = {}
    for name, method in METHODS.items():
        before = method(readings, BOUNDS)
        changes[name] = {
            f"{what}_by_{why}": count(before, method(otherwise, BOUNDS))
            for why, otherwise in (("order", shuffled), ("repetition", repeated))
            for what, count in (("changed", _changed), ("moved", _moved))
        }
    return changes


def _changed(before: Estimate, after: Estimate) -> int:
    """Cells whose bound is another, in any bit, or that came or went."""
    same = np.ones(before.low.size, np.bool_)
    for old, new in ((before.low, after.low), (before.high, after.high)):
        same &= (old == new) | (np.isnan(old) & np.isnan(new))
    return int((~same).sum())


def _moved(before: Estimate, after: Estimate) -> int:
    """Cells whose estimate moved by more than MOVED_M."""
    return int((np.abs(before.mean - after.mean) > MOVED_M).sum())


def draw(output: Path, averages: Scores, costs: list[Cost]) -> tuple[Path, ...]:
    """All pictures."""
    laws: dict[str, tuple[Law, str]] = {
        "uniform": (uniform, "Uniform errors"),
        "gaussian": (HOLDING["Gaussian"], "Gaussian errors, sigma = a third of the bound, cut off at the bound"),
        "drifting": (HOLDING["uniform, drifting"], "Uniform errors that drift"),
        "bias": (bias, "Constant bias: each error at its bound all the time (a calibration error)"),
    }
    pictures = []
    for name, (law, title) in laws.items():
        true = drive(0.0)
        readings = read(true, law(np.random.default_rng(7), 3, true.x_m.size) * BOUNDS)
        pictures.append(output / f"table1_{name}.png")
        table1_pictures.draw_profile(pictures[-1], readings, title)
    pictures += [output / "table1_bounds.png", output / "table1_cost.png"]
    table1_pictures.draw_bounds(pictures[-2], averages, list(HOLDING))
    table1_pictures.draw_costs(pictures[-1], costs)
    return tuple(pictures)


def broken_promises(averages: Scores) -> list[str]:
    """What of ours did not hold under the laws whose errors keep their bounds."""
    told = {
        "hits_outside": "true hits outside the bound of their cell",
        "hits_unseen": "true hits in cells without a bound",
        "certified_not_hit": "cells certified, but never hit",
    }
    return [
        f"{law}: {name}: {count} {words}"
        for law in HOLDING
        for name in (OURS, IN_SPACE)
        for score, words in told.items()
        if (count := averages[law][name].get(f"total_{score}", 0))
    ]
