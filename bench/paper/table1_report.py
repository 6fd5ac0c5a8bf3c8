"""The tables of the paper's simulation, as Markdown."""

from typing import Any

from bench.paper.error_laws import BROKEN, HOLDING
from bench.paper.profile_drive import RATE_HZ
from bench.paper.profile_runs import Scores
from bench.paper.table1_cost import Cost
from bench.paper.table1_reference import Check

_COLUMNS = {
    "rmse_all": "RMSE all [m]", "rmse_flat": "RMSE flat [m]", "roughness": "roughness [m]", "width_flat": "width [m]",
}  # fmt: skip


def report(
    runs: int,
    averages: Scores,
    sweep: dict[float, tuple[float, float]],
    joins: dict[str, dict[str, int]],
    costs: list[Cost],
    found: list[Check],
) -> str:
    """All tables."""
    sections = (
        _quality(runs, averages),
        _broken(averages),
        _edges(averages),
        _sweep(sweep),
        _joins(joins),
        _costs(costs),
        _reference(found),
    )
    return "\n\n".join(sections) + "\n"


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _quality(runs: int, averages: Scores) -> str:
    rows = [
        [law, name, *(f"{mean[key]:.3f}" for key in _COLUMNS), f"{100 * mean['contained_all']:.1f} %",
         f"{100 * mean['contained_hit']:.2f} %", f"{mean['false']:.2f}", str(mean["total_hits_outside"]),
         f"{mean['observed']:.0f}", _certified(mean)]
        for law in HOLDING for name, mean in averages[law].items()
    ]  # fmt: skip
    head = ["errors", "map", *_COLUMNS.values(), "truth in bound, all cells", "hit cells", "false hit cells a run",
            "true hits outside, all runs", "cells", "certified (false)"]  # fmt: skip
    return (
        "b: the declared bounds. paper: its set-valued map as written; ours: the same made rigorous, in one dimension; "
        "ours, in space: the mapper that drives on the robot; intersection: what the paper argues against.\n\n"
        f"## Errors that keep their bounds\n\n{runs} runs of each law ({runs * 3150 // 1000} thousand measurements). "
        "RMSE and roughness over the cells that each map has; width of the bound on flat ground (mixture and Kalman: "
        "six sigma); certified: cells that a run of beams surely visited, in all runs.\n\n" + _table(head, rows)
    )


def _certified(mean: dict[str, Any]) -> str:
    if "total_certified" not in mean:
        return "-"
    return f"{mean['total_certified']} ({mean['total_certified_false'] + mean['total_certified_not_hit']})"


def _broken(averages: Scores) -> str:
    rows = [
        [law, name, f"{100 * mean['contained_hit']:.2f} %", f"{mean['false']:.2f}", str(mean["total_hits_outside"]),
         f"{mean['width_flat']:.3f}", _certified(mean)]
        for law in BROKEN for name, mean in averages[law].items()
    ]  # fmt: skip
    head = ["errors", "map", "truth in bound, hit cells", "false hit cells a run", "true hits outside, all runs",
            "width [m]", "certified (false)"]  # fmt: skip
    return (
        "## Errors that break their bounds\n\nNothing is promised here; this is how much goes wrong when an owner "
        "declares too little.\n\n" + _table(head, rows)
    )


def _edges(averages: Scores) -> str:
    rows = [
        [law, name, f"{mean['rmse_edge']:.3f}", f"{mean['jump']:.3f}", f"{mean['never_hit']:.1f}",
         f"{mean['rmse_never_hit']:.3f}", f"{100 * mean['wall_bounded']:.0f} %", f"{mean['wall_span']:.2f}"]
        for law in HOLDING for name, mean in averages[law].items()
    ]  # fmt: skip
    head = ["errors", "map", "RMSE near edges [m]", "largest step between cells [m]", "cells mapped but never hit",
            "their RMSE [m]", "wall bounded, of the runs", "span there [m]"]  # fmt: skip
    return (
        "## Edges, occlusions, the wall\n\nThe ground steps by 1 m at the wall and at the ditch. Behind a step down no "
        "beam ends: what a map has there came from its neighbours. Wall bounded: the bounds of the two cells at it "
        "together hold both its foot and its top.\n\n" + _table(head, rows)
    )


def _sweep(sweep: dict[float, tuple[float, float]]) -> str:
    rows = [[f"x {scale}", f"{mixture:.3f}", f"{hull:.3f}"] for scale, (mixture, hull) in sweep.items()]
    head = ["heights", "mixture, sigma = b/3: RMSE [m]", "set-valued: RMSE [m]"]
    return (
        f"## Where each is the better estimate\n\nUniform errors, the ground's heights scaled.\n\n{_table(head, rows)}"
    )


def _joins(joins: dict[str, dict[str, int]]) -> str:
    rows = [[name, *map(str, row.values())] for name, row in joins.items()]
    head = [
        "map",
        "shuffled: bound differs",
        "estimate by > 1 mm",
        "a third twice: bound differs",
        "estimate by > 1 mm",
    ]
    return (
        f"## Order and repetition\n\nCells that change when the same readings come otherwise.\n\n{_table(head, rows)}"
    )


def _costs(costs: list[Cost]) -> str:
    rows = [
        [cost.form, cost.method, f"{cost.median_ns:.1f}", f"{cost.quietest_ns:.1f}", f"{100 * cost.of_mixture:.0f} %"]
        for cost in costs
    ]
    head = ["form", "map", "CPU a measurement, median [ns]", "least [ns]", "of the mixture's (b/3, same form)"]
    return (
        f"## Cost\n\nA step of the simulation is one measurement ({RATE_HZ:.0f} a second). Process time, all maps in "
        "turn, projection included, each drive into an empty map. As written: a loop a measurement, with the library's "
        "erf; by blocks: vector instructions for all but the cells, and Φ from a table.\n\n" + _table(head, rows)
    )


def _reference(found: list[Check]) -> str:
    missed = [check for check in found if not check.met]
    rows = [
        [check.law, check.method, check.score, f"{check.theirs:.3f}", f"{check.ours:.3f}", f"{check.tolerance:.3f}"]
        for check in missed
    ]
    head = ["errors", "map", "score", "theirs", "ours", "tolerance"]
    text = (
        f"## Beside an earlier program\n\n{len(found) - len(missed)} of {len(found)} numbers are within the tolerance."
    )
    return f"{text}\n\n{_table(head, rows)}" if missed else text
