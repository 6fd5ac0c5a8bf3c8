"""What the paper's two drives have in common: runs over error laws and seeds, tables, and what must hold.

bench/paper/stairs.py and snow.py say where; scene_drive.py drives, scene_maps.py builds and scores the maps,
scene_pictures.py draws.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.paper.experiment import Outcome, Progress, in_processes
from bench.paper.scene_drive import SETTINGS, Setting, drive_scene
from bench.paper.scene_maps import (
    METHODS,
    OURS,
    POSES,
    SIGMAS,
    Layers,
    TrueCells,
    Window,
    build,
    score,
    surely_and_touched,
    true_cells,
)
from bench.paper.scene_pictures import Line, draw_maps, draw_profiles, true_profile

LAWS = {
    "white": "uniform",
    "correlated": "switching",
    "constant bias": "constant",
}
"""What the errors are like: the simulator's law (simulator/errors.py). The last two stand at the bounds."""
MARK = 0.40
"""The share of the mixture's time that ours should take at most."""


@dataclass(frozen=True, slots=True)
class Place:
    """One of the paper's places."""

    name: str
    title: str
    scene: str
    window: Window
    lines: tuple[Line, ...]
    duration_s: float
    short_s: float
    seeds: int = 4


@dataclass(frozen=True, slots=True)
class Task:
    """One drive."""

    place: Place
    setting: Setting
    errors: str
    seed: int
    duration_s: float
    timed: bool
    """Time the maps with care, and bring their layers home for the pictures."""


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What came of it."""

    task: Task
    scores: dict[str, dict[str, float]]
    surely: dict[str, float]
    facts: dict[str, Any]
    layers: dict[str, Layers] | None
    true: TrueCells | None
    profiles: tuple[Any, ...]


def run_task(task: Task) -> Run:
    """Drive, build all maps, hold them against the truth."""
    place = task.place
    law = LAWS[task.errors]
    drive = drive_scene(place.scene, task.setting, law, task.seed, task.duration_s, place.window.cell_m, SIGMAS)
    maps = build(drive, place.window, repeats=3 if task.timed else 1)
    true = true_cells(drive.truth, drive.hits, place.window)
    facts = {
        "scans": len(drive.insertions),
        "beams_a_scan": maps.beams_a_scan,
        "true_hits": len(drive.hits),
        "driven_m": drive.insertions[-1].travelled_m,
        "poses_outside": drive.pose_violations,
        "poses": drive.poses_checked,
        "guarantee_intact": drive.intact,
        "pose_half_widths_m_rad": drive.pose_half_widths.tolist(),
        "ekf_sigma_b3_m_rad": drive.ekf_sigmas[SIGMAS[0]].tolist(),
        "bytes_a_cell": maps.bytes_a_cell,
    }
    return Run(
        task,
        {name: score(name, maps, true) for name in METHODS},
        surely_and_touched(maps, true),
        facts,
        maps.layers if task.timed else None,
        true if task.timed else None,
        tuple(true_profile(drive.truth, place.window, line) for line in place.lines) if task.timed else (),
    )


def reproduce(place: Place, output: Path, short: bool, progress: Progress) -> Outcome:
    """All runs of a place, its tables and its pictures."""
    duration_s = place.short_s if short else place.duration_s
    first = Task(place, "device", "white", 1, duration_s, True)
    tasks = [first, replace(first, setting="paper")]
    if short:
        tasks.append(replace(first, errors="constant bias", timed=False))
    else:
        seeds = range(1, place.seeds + 1)
        others = [replace(first, errors=errors, seed=seed, timed=False) for errors in LAWS for seed in seeds]
        tasks += [task for task in others if (task.errors, task.seed) != (first.errors, first.seed)]
    runs: list[Run] = []
    for run in _each(tasks, short):
        runs.append(run)
        progress(len(runs) / (len(tasks) + 1), f"{len(runs)} of {len(tasks)} drives")
    shown = runs[0]
    assert shown.layers is not None
    assert shown.true is not None
    progress(len(tasks) / (len(tasks) + 1), "pictures")
    where = f"{SETTINGS['device']}; cells of {100 * place.window.cell_m:.0f} cm; white errors, seed 1"
    pictures = (
        draw_maps(output / f"{place.name}_maps.png", place.title, where, place.window, shown.true, shown.layers),
        draw_profiles(
            output / f"{place.name}_profiles.png",
            place.title,
            where,
            place.window,
            place.lines,
            shown.profiles,
            shown.true,
            shown.layers,
        ),
    )
    return Outcome(
        f"The paper's drive: {place.title}", report(place, runs), _numbers(place, runs), pictures, tuple(_broken(runs))
    )


def _each(tasks: list[Task], short: bool) -> Iterable[Run]:
    """In processes; the short form in this one, as starting others would take longer."""
    return map(run_task, tasks) if short else in_processes(run_task, tasks)


def _broken(runs: list[Run]) -> Iterable[str]:
    for run in runs:
        where = f"{SETTINGS[run.task.setting]}, {run.task.errors} errors, seed {run.task.seed}"
        if outside := run.scores[OURS]["hit_cells_outside"]:
            yield f"{outside:.0f} truly hit cells outside our bounds ({where})"
        if run.facts["poses_outside"] or not run.facts["guarantee_intact"]:
            yield f"the true pose left its set {run.facts['poses_outside']} times ({where})"


def _numbers(place: Place, runs: list[Run]) -> dict[str, Any]:
    return {
        "cell_m": place.window.cell_m,
        "window_m": {"ahead": place.window.x_m, "left": place.window.y_m},
        "runs": [
            {
                "setting": run.task.setting,
                "errors": run.task.errors,
                "law": LAWS[run.task.errors],
                "seed": run.task.seed,
                "duration_s": run.task.duration_s,
                **run.facts,
                "maps": run.scores,
                "ours_surely_and_touched": run.surely,
            }
            for run in runs
        ],
    }


def report(place: Place, runs: list[Run]) -> str:
    """The tables."""
    device = [run for run in runs if run.task.setting == "device"]
    (paper,) = (run for run in runs if run.task.setting == "paper")
    parts = [
        _facts(place, runs),
        _map_table(device[0], place.window),
        _time_table(device[0], paper),
        _law_table(device),
        _pose_table(device),
    ]
    return "\n\n".join([*parts, _surely_table(device)])


def _facts(place: Place, runs: list[Run]) -> str:
    first, facts = runs[0], runs[0].facts
    half, sigma = facts["pose_half_widths_m_rad"], facts["ekf_sigma_b3_m_rad"]
    window = place.window
    return (
        f"{facts['driven_m']:.1f} m driven in {first.task.duration_s:.0f} s, {facts['scans']} scans of "
        f"{facts['beams_a_scan']:.0f} beams. Looked at: {window.x_m[1] - window.x_m[0]:.1f} m ahead by "
        f"{window.y_m[1] - window.y_m[0]:.1f} m across, cells of {100 * window.cell_m:.0f} cm. The last pose: our set "
        f"is ± {100 * half[0]:.1f} cm along, ± {100 * half[1]:.1f} cm across, ± {np.degrees(half[5]):.1f}° of yaw; "
        f"three sigma of the Kalman filter (bound = three sigma) {300 * sigma[0]:.1f} cm, {300 * sigma[1]:.1f} cm, "
        f"{3 * np.degrees(sigma[5]):.1f}°. Poses outside our sets, over all runs: "
        f"{sum(run.facts['poses_outside'] for run in runs)} of {sum(run.facts['poses'] for run in runs)}."
    )


def _map_table(run: Run, window: Window) -> str:
    rows = [
        f"**The maps** under {run.task.errors} errors (seed {run.task.seed}). RMSE against the true elevation at the "
        "cells' centres; flat is ground that differs by no more than "
        f"{100 * window.flat_m:.0f} cm within two cells; roughness is the RMS step of the error between neighbours "
        "there; bounds of the Gaussian maps are three sigma.",
        "",
        "| map | cells filled | RMSE all | where all are filled | flat | truly hit | roughness | bounds hold every "
        "true hit of a cell | mean width there |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, s in run.scores.items():
        rows.append(
            f"| {name} | {100 * s['filled']:.0f} % | {_mm(s['rmse_m'])} | {_mm(s['rmse_common_m'])} | "
            f"{_mm(s['rmse_flat_m'])} | {_mm(s['rmse_hit_m'])} | {_mm(s['roughness_m'])} | "
            f"{_percent(s['containment'])} | {_mm(s['width_m'])} |"
        )
    return "\n".join(rows)


def _time_table(device: Run, paper: Run) -> str:
    rows = [
        f"**CPU time of a scan** into the map, in turns in one process, each turn in the quietest of three "
        f"passes. Mark: ours at most {100 * MARK:.0f} % of the "
        "mixture's.",
        "",
        f"| map | {SETTINGS['device']} | ours takes | {SETTINGS['paper']} | ours takes | bytes a cell |",
        "|---|---|---|---|---|---|",
    ]
    for name in METHODS:
        cells = []
        for run in (device, paper):
            us = run.scores[name]["step_us"]
            cells += [f"{us:.0f} us", f"{100 * run.scores[OURS]['step_us'] / us:.0f} %"]
        rows.append(f"| {name} | {' | '.join(cells)} | {device.facts['bytes_a_cell'][name]} |")
    return "\n".join(rows)


def _law_table(runs: list[Run]) -> str:
    laws = [errors for errors in LAWS if any(run.task.errors == errors for run in runs)]
    rows = [
        "**Containment of truly hit cells**: cells that hold every true hit in them, of those that the map answers for "
        "(of ours: of all). Mean over the seeds, in brackets the worst, and the mean width.",
        "",
        "| map | " + " | ".join(f"{errors}, {_seeds(runs, errors)}" for errors in laws) + " |",
        "|---|" + "---|" * len(laws),
    ]
    for name in METHODS:
        cells = []
        for errors in laws:
            scores = [run.scores[name] for run in runs if run.task.errors == errors]
            held = [s["containment"] for s in scores]
            width = float(np.mean([s["width_m"] for s in scores]))
            cells.append(f"{_percent(float(np.mean(held)))} ({_percent(min(held))}), {_mm(width)}")
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _pose_table(runs: list[Run]) -> str:
    """Every map fed with either filter's pose."""
    laws = [errors for errors in LAWS if any(run.task.errors == errors for run in runs)]
    rows = [
        "**The pose**: the same maps, once with a Kalman filter's pose (a box of it: three sigma), once with our set "
        "(a Gaussian of it: its half-widths for three sigma). Share of truly hit cells whose bounds hold every true "
        "hit; RMSE over the cells that all maps fill, and over all a map fills; cells filled. Means over the seeds.",
        "",
        "| errors | pose | map | containment | RMSE, common cells | RMSE, all | filled |",
        "|---|---|---|---|---|---|---|",
    ]
    for errors in laws:
        for pose, names in POSES.items():
            for kind, name in zip(("set-valued", "mixture", "Kalman"), names, strict=True):
                scores = [run.scores[name] for run in runs if run.task.errors == errors]
                held, common, all_, filled = (
                    float(np.mean([s[key] for s in scores]))
                    for key in ("containment", "rmse_common_m", "rmse_m", "filled")
                )
                rows.append(
                    f"| {errors} | {pose} | {kind} | {_percent(held)} | {_mm(common)} | {_mm(all_)} "
                    f"| {100 * filled:.0f} % |"
                )
    return "\n".join(rows)


def _seeds(runs: list[Run], errors: str) -> str:
    count = sum(run.task.errors == errors for run in runs)
    return "seed 1" if count == 1 else f"seeds 1 to {count}"


def _surely_table(runs: list[Run]) -> str:
    rows = [
        "**Surely hit and merely touched**, ours, white errors: surely hit is a cell that a whole footprint lies in.",
        "",
        "| cells | how many | of them truly hit | centre inside | width | RMSE |",
        "|---|---|---|---|---|---|",
    ]
    s = runs[0].surely
    for name, words in (("surely", "surely hit"), ("touched", "merely touched")):
        rows.append(
            f"| {words} | {s[f'{name}_cells']:.0f} | {_percent(s[f'{name}_truly_hit'])} | "
            f"{_percent(s[f'{name}_centre_inside'])} | {_mm(s[f'{name}_width_m'])} | {_mm(s[f'{name}_rmse_m'])} |"
        )
    return "\n".join(rows)


def _mm(metres: float) -> str:
    return "-" if np.isnan(metres) else f"{1e3 * metres:.0f} mm" if metres >= 0.00995 else f"{1e3 * metres:.1f} mm"


def _percent(share: float) -> str:
    """100 % is said of nothing less."""
    if share in (0.0, 1.0):
        return f"{100 * share:.0f} %"
    return f"{min(max(100 * share, 0.01), 99.99):.1f} %" if 0.0005 < share < 0.9995 else f"{100 * share:.3f} %"
