"""The long proof: drives under every error law over every scene, each pose and each hit held against the truth.

Run with `python -m bench.prove`; `--help` lists the options. Rounds of all laws and scenes go on, a
new seed each, until at least N true hits and N filter steps were checked. Exit code 1 on any violation, or where a
guarantee was voided although every declared bound held.
"""

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import get_args

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from bench.machine import heading
from estimator.config import SetName
from service.commands.virtual_drive import drive_virtually
from service.config import load
from service.shipped import shipped_config
from simulator.errors import LAWS

SETS: tuple[SetName, ...] = get_args(SetName)
SCENES = ("stairs", "rough", "ramp", "yard", "flat")
PAGE = Path(__file__).with_name("PROVED.md")
PROVED_TEXT = """Drives of the emulated robot, other seeds in each, with sensor errors drawn inside their declared
bounds by five laws, each with both sets (`[filter] set`). `poses`: published pose sets, each held against every true
pose of its stretch of time (1 kHz); `hits`: true hits of beams in the map, each held against the interval of its cell;
`voided`: guarantees lost although every bound held.

"""
HITS, STEPS = 10_000_000, 1_000_000
"""DESIGN section 8: points with errors at the corners of their bounds; steps of the filter."""


@dataclass(frozen=True, slots=True)
class Case:
    """One drive."""

    set: SetName
    """What the filter keeps the pose as, `[filter] set`."""
    law: str
    scene: str
    seed: int
    seconds: float


@dataclass(slots=True)
class Score:
    """What drives came to, added up."""

    drives: int = 0
    steps: int = 0
    poses: int = 0
    hits: int = 0
    pose_violations: int = 0
    cell_violations: int = 0
    voided: int = 0
    """Drives whose guarantee was voided."""

    def add(self, other: "Score") -> None:
        """Add another score to this one."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def sound(self) -> bool:
        """Did everything hold?"""
        return self.pose_violations == self.cell_violations == self.voided == 0


def prove(case: Case) -> Score:
    """Drive once, and hold what came out against the truth."""
    loaded = load(shipped_config("demo.toml"))
    config = replace(loaded.config, filter=replace(loaded.config.filter, set=case.set))
    loaded = replace(loaded, config=config)
    drive = drive_virtually(loaded, scene=case.scene, law=case.law, seed=case.seed, duration_s=case.seconds)
    pose_violations, cell_violations, hits = drive.violations()
    return Score(
        drives=1,
        steps=drive.filter_steps,
        poses=len(drive.poses.earliest_ns),
        hits=hits,
        pose_violations=pose_violations,
        cell_violations=cell_violations,
        voided=int(not drive.pipeline.filter.guarantee.intact),
    )


def cases(sets: Sequence[SetName], seconds: float, first_seed: int) -> Iterator[Case]:
    """All laws over all scenes with each set, then again with the next seed, without end."""
    for seed in count(first_seed):
        for law in LAWS:
            for scene in SCENES:
                for kept in sets:
                    yield Case(kept, law, scene, seed, seconds)


def main() -> int:
    """Prove until enough was checked; 0 if everything held."""
    parser = argparse.ArgumentParser(prog="python -m bench.prove", description="drives held against their truth")
    parser.add_argument("--hits", type=int, default=HITS, help="true hits to check with each set, at least")
    parser.add_argument("--steps", type=int, help="filter steps to check, at least (default: a tenth of --hits)")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=SETS, help="each is given as much to do")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each drive")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="drives at a time")
    parser.add_argument("--first-seed", type=int, default=1000)
    options = parser.parse_args()
    steps = (options.hits * STEPS // HITS if options.steps is None else options.steps) * len(options.sets)
    hits = options.hits * len(options.sets)
    console = Console(stderr=True)
    total, rows, broken = Score(), dict[tuple[str, str, str], Score](), list[Case]()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:,.0f} of {task.total:,.0f}"),
        TimeElapsedColumn(),
    )
    with (
        ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool,
        Progress(*columns, console=console, disable=not console.is_terminal) as progress,
    ):
        tasks = progress.add_task("true hits", total=hits), progress.add_task("filter steps", total=steps)
        supply = cases(options.sets, options.seconds, options.first_seed)
        running: dict[Future[Score], Case] = {}
        while running or total.hits < hits or total.steps < steps:
            while len(running) < options.jobs and (total.hits < hits or total.steps < steps):
                case = next(supply)
                running[pool.submit(prove, case)] = case
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                case, score = running.pop(future), future.result()
                total.add(score)
                rows.setdefault((case.set, case.law, case.scene), Score()).add(score)
                if not score.sound:
                    broken.append(case)
                    console.print(f"broken: {case}: {score}")
            progress.update(tasks[0], completed=total.hits)
            progress.update(tasks[1], completed=total.steps)
    Console(width=120).print(_table(rows, total))
    if options.hits >= HITS:
        PAGE.write_text(heading("Truth against bounds", "make prove") + _markdown(rows, total), encoding="utf-8")
    return 0 if total.sound and not broken else 1


def _table(rows: dict[tuple[str, str, str], Score], total: Score) -> Table:
    """The scores by set, law and scene."""
    names = ("drives", "steps", "poses", "hits", "poses out", "hits out", "voided")
    table = Table("set", "law", "scene", title="truth against bounds", title_justify="left")
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    for case, score in sorted(rows.items()):
        table.add_row(*case, *_numbers(score))
    table.add_section()
    table.add_row("all", "all", "all", *_numbers(total))
    return table


def _markdown(rows: dict[tuple[str, str, str], Score], total: Score) -> str:
    """The same table as a page."""
    names = " | ".join(Score.__slots__)
    lines = [f"| set | law | scene | {names} |", "|---" * (3 + len(Score.__slots__)) + "|"]
    for case, score in [*sorted(rows.items()), (("all", "all", "all"), total)]:
        lines.append(f"| {' | '.join((*case, *_numbers(score)))} |")
    return PROVED_TEXT + "\n".join(lines) + "\n"


def _numbers(score: Score) -> list[str]:
    return [f"{getattr(score, name):,}" for name in Score.__slots__]


if __name__ == "__main__":
    sys.exit(main())
