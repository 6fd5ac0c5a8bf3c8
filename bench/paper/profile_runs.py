"""Many drives along the profile, under each law of errors, spread over processes, and the scores of every map."""

from typing import Any

import numpy as np

from bench.paper import profile_scores
from bench.paper.error_laws import BROKEN, HOLDING
from bench.paper.experiment import Progress, in_processes
from bench.paper.profile_drive import BOUNDS, drive, true_elevations
from bench.paper.profile_methods import METHODS, mapper_in_the_plane, read

CHUNK = 8
OURS, IN_SPACE = "ours", "ours, in space"
"""In one dimension, and the mapper that drives on the robot: the same, but for how each bounds what is left out."""
Scores = dict[str, dict[str, dict[str, Any]]]
"""By law, map and score: means over the runs, and sums as `total_*`."""
Task = tuple[str, int, int]
"""A law, the first run's number, and how many."""


def run_laws(runs: int, progress: Progress) -> Scores:
    """Every map under every law."""
    laws = [*HOLDING, *BROKEN]
    tasks = [(law, first, min(CHUNK, runs - first)) for law in laws for first in range(0, runs, CHUNK)]
    rows: dict[str, dict[str, list[dict[str, float]]]] = {law: {} for law in laws}
    for done, (task, scored) in enumerate(zip(tasks, in_processes(score_runs, tasks), strict=True), 1):
        for method, scores in scored.items():
            rows[task[0]].setdefault(method, []).extend(scores)
        progress(0.5 * done / len(tasks), f"errors: {task[0]}")
    return {law: {name: profile_scores.average(scores) for name, scores in maps.items()} for law, maps in rows.items()}


def score_runs(task: Task) -> dict[str, list[dict[str, float]]]:
    """By map, the scores of `count` runs of a law from the first on. The same task gives the same, always."""
    name, first, count = task
    law, declared = (HOLDING[name], 1.0) if name in HOLDING else BROKEN[name]
    truth = true_elevations()
    scored: dict[str, list[dict[str, float]]] = {method: [] for method in (*METHODS, IN_SPACE)}
    for number in range(first, first + count):
        rng = np.random.default_rng([number, *name.encode()])
        true = drive(rng.uniform())
        readings = read(true, law(rng, number, true.x_m.size) * BOUNDS)
        for method, estimate in METHODS.items():
            scored[method].append(profile_scores.scores(estimate(readings, declared * BOUNDS), truth, true))
        in_space = mapper_in_the_plane(readings, declared * BOUNDS)
        scored[IN_SPACE].append(profile_scores.scores(in_space, truth, true))
    return scored
