"""Faults that show late, drive by drive: when the filter told, and until when no method could.

It needs scipy (witness_search.py).
"""

from collections.abc import Iterator

import numpy as np

from bench.fault_drive import world_of
from bench.pose_faults import LAWS, Case, Outcome, break_it, cases, when
from bench.witness import STEP_S, Readings, Truth, readings_of
from bench.witness_search import until_m, witnessed
from simulator.faults import Fault
from simulator.robot import STEP_NS
from simulator.world import World

SECONDS = 60.0
MARK_S = MARK_M = 1.0
WAYS_M = (1.0,)
"""A witness is looked for at the mark; more ways, and it is looked for at those too, as long as there is one."""
LATE = ("scale wrong by 4 %", "gyroscope stuck on the way")

TEXT = """`nobody before`: until then there is a *witness* (`bench/witness.py`): a motion, held against all readings and
every declared limit by the nonlinear equations (to a hundred-thousandth of each bound), that explains them all; as long
as there is one, no sound method may name anybody. Looked for at the first fix after 1 m, where the filter told later
than 1 s and 1 m: **so where it stands there, the mark is out of reach of any sound method.** `tilt`: of any that
reads accelerometers as tilt sensors, which the robot's own acceleration disturbs (so the filter reads them); `any`: of
those too that read them as sensors of that acceleration, 0.1 m/s² at 50 Hz. `none`: none was found at 1 m, which
proves nothing. `soonest.py` is given the true turning, and no ticks; the limit of acceleration it leaves out.
`outside before told`: poses, as in the table above; **nobody knew**: a witness explains all readings up to the last of
them.
"""
HEAD = (
    "| fault | errors | drive | speed | told after | in time | nobody before: tilt | any | `soonest.py` "
    "| outside before told |"
)


def section() -> Iterator[str]:
    """Markdown, line by line as the drives come in."""
    yield from TEXT.splitlines()
    yield ""
    yield HEAD
    yield "|---" * 10 + "|"
    for case in (case for case in cases() if any(late in case.name for late in LATE)):
        for law in LAWS:
            for seed in (1, 2, 3):
                yield _row(case, law, seed)


def _row(case: Case, law: str, seed: int) -> str:
    outcome = break_it(case, law, seed, SECONDS)
    world = world_of(law, seed, SECONDS)
    begin_s = when(world, case.turning)
    fault = case.make(begin_s)
    readings = readings_of(world, case.make(begin_s))
    in_time = outcome.after_s <= MARK_S or outcome.after_m <= MARK_M
    tilt = any_ = "-"
    if not in_time:
        until = _witnessed(world, fault, readings, outcome, felt=False)
        tilt = f"**{until:.1f} m**" if until else "none"
        if until:
            felt = _witnessed(world, fault, readings, outcome, felt=True)
            any_ = f"**{felt:.1f} m**" if felt else "none"
    outside = "0"
    if outcome.untold:
        last = round((begin_s + outcome.untold_s[-1]) / STEP_S)
        explained = witnessed(Truth(world, fault, readings, last, felt=False))
        outside = f"{outcome.untold}, **nobody knew**" if explained else f"{outcome.untold}, no witness found"
    speed = abs(world.drive.speed[round(begin_s * 1e9) // STEP_NS])
    soonest = "-" if np.isnan(outcome.soonest_m) else f"{outcome.soonest_m:.1f} m"
    told = f"{outcome.after_m:.2f} m, {outcome.after_s:.1f} s" if outcome.named else "never"
    yes = "yes" if in_time else "no"
    return (
        f"| {case.name} | {law} | {seed} | {speed:.1f} m/s | {told} | {yes} | {tilt} | {any_} | {soonest} | {outside} |"
    )


def _witnessed(world: World, fault: Fault, readings: Readings, outcome: Outcome, felt: bool) -> float:
    """The way until which there is a witness, one of WAYS_M before it was told; 0: none at the first."""
    return until_m(world, fault, readings, felt, tuple(way for way in WAYS_M if way < outcome.after_m))
