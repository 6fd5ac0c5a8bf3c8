"""Broken sensors, on the emulated robot's declared bounds: who is named, how soon, and does the set hold meanwhile?

    python -m bench.pose_faults [SECTION...] [--seconds S] [--seeds N] [--page]

The robot of `terrabound demo` (RTK fixes of 5 cm at 10 Hz, 50 Hz inertial packets and counts, tilt at 10 Hz) over open
ground. The fault begins while it drives, and lasts; all else stays within its bounds.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.fault_drive import RTK, FaultDrive, declared, drive, settings, world_of
from bench.machine import heading
from bench.soonest import soonest_s
from estimator.bounded_pose import Status
from estimator.config import SetName
from simulator.faults import FalseFixes, Fault, FaultMaker, GpsJump, StuckGyro, TiltSpike, WrongTracks
from simulator.robot import STEP_NS
from simulator.sample_stream import Rates
from simulator.world import World

Array = NDArray[np.float64]

PAGE = Path(__file__).with_name("POSE_FAULTS.md")
LASTS_S = 5.0
EARLIEST_S = 14.0
LAWS = ("uniform", "constant", "switching")
DRIVES_MPS, TURNS_RPS = 0.25, 0.3
"""A fault of the tracks or of GPS begins while the robot drives, one of the gyroscope while it turns."""
TURNING_SEEDS = (6, 7, 10, 11)
"""Drives that turn before long."""


@dataclass(frozen=True, slots=True)
class Case:
    """One kind of fault."""

    name: str
    sensor: str
    """Whose it is."""
    make: FaultMaker
    turning: bool = False
    """Does it begin in a turn?"""


def cases() -> list[Case]:
    """Those of issue 4, on the declared bounds of the demo."""
    robot, devices = declared()
    slip, tick_m = robot.slip_ratio, devices.encoders.left_metres_per_tick
    doubled = 1.0 + 2.0 * slip
    spin = 0.3 / tick_m

    def jump(metres: float) -> Case:
        return Case(f"GPS jumps {metres:g} m", "gps", lambda t: GpsJump(t, t + LASTS_S, metres))

    return [
        *(jump(metres) for metres in (2.0, 5.0, 10.0, 20.0, 50.0, 100.0)),
        Case("gyroscope stuck in a turn", "gyro", lambda t: StuckGyro(t, t + LASTS_S), turning=True),
        Case("gyroscope stuck on the way", "gyro", lambda t: StuckGyro(t, t + LASTS_S)),
        Case(
            f"both wheels' scale wrong by {2e2 * slip:g} %, for 20 s",
            "encoders",
            lambda t: WrongTracks(t, t + 20.0, (doubled, doubled)),
        ),
        Case("both wheels' scale wrong by 20 %", "encoders", lambda t: WrongTracks(t, t + LASTS_S, (1.2, 1.2))),
        Case("one track slips by 50 %", "encoders", lambda t: WrongTracks(t, t + LASTS_S, (1.5, 1.0))),
        Case(
            "both tracks spin by 0.3 m/s", "encoders", lambda t: WrongTracks(t, t + LASTS_S, ticks_per_s=(spin, spin))
        ),
        Case("tilt spike of 6 degrees, 0.2 s", "tilt", lambda t: TiltSpike(t, t + 0.2, 6.0)),
        Case("tilt spike of 6 degrees, 5 s", "tilt", lambda t: TiltSpike(t, t + LASTS_S, 6.0)),
    ]


NOTHING = Case("none", "-", lambda t: GpsJump(np.inf, np.inf))


@dataclass(slots=True)
class Outcome:
    """What became of one drive."""

    named: str | None = None
    """In the end, in the first fault's name."""
    after_s: float = np.inf
    """From the fault's beginning until it was told;"""
    after_m: float = np.inf
    soonest_m: float = np.nan
    """... and the way after which somebody could have told, at the earliest; NaN: not worked out."""
    untold: int = 0
    """True poses outside of sets that were called intact at the time,"""
    untold_s: list[float] = field(default_factory=list)
    """... so long after the fault's beginning;"""
    told: int = 0
    """... and of sets that were called void;"""
    not_taken_back: int = 0
    """... and of either, where the filter's last word still promises them."""
    checks: int = 0
    restored_s: float = np.inf
    """From the fault's end until the pose was good again, for good."""
    too_early: bool = False
    """Was something called broken before anything was?"""


def break_it(case: Case, law: str, seed: int, seconds: float, kept: SetName = "box") -> Outcome:
    """One drive with one fault."""
    world = world_of(law, TURNING_SEEDS[seed - 1] if case.turning else seed, seconds)
    begin_s = when(world, case.turning)
    fault = case.make(begin_s)
    config = settings(set=kept)
    ends_s = fault.end_s if np.isfinite(fault.end_s) else begin_s
    went = drive(fault.changed, config, world, until_s=ends_s + config.fault_length_s + LASTS_S)
    outcome = Outcome(untold=went.untold, told=went.told, not_taken_back=went.not_taken_back, checks=went.checks)
    outside_s = ((time_ns - world.start_ns) * 1e-9 - begin_s for time_ns in went.false_ns)
    outcome.untold_s = list(islice(outside_s, went.untold))  # they come first
    if isinstance(fault, WrongTracks) and fault.scale[0] == fault.scale[1] != 1.0:
        outcome.soonest_m = way_driven(world, begin_s, soonest_s(world, fault))
    if went.told_ns is not None:
        told_s = (went.told_ns - world.start_ns) * 1e-9
        outcome.named = went.filter.faults[0].sensor
        outcome.after_s, outcome.too_early = told_s - begin_s, told_s < begin_s
        outcome.after_m = way_driven(world, begin_s, told_s)
        outcome.restored_s = _restored_s(went, fault)
    return outcome


def _restored_s(went: FaultDrive, fault: Fault) -> float:
    """From the fault's end until the last time that the pose was called good; inf if it isn't now."""
    guarantee = went.filter.guarantee
    if guarantee.status is not Status.NOMINAL or guarantee.restored_ns is None:
        return float("inf")
    return max(0.0, (guarantee.restored_ns - went.world.start_ns) * 1e-9 - fault.end_s)


def when(world: World, turning: bool) -> float:
    """The first second, from EARLIEST_S on, at which the robot drives, or turns. ValueError: it doesn't any more."""
    first = round(EARLIEST_S * 1e9) // STEP_NS
    busy = np.abs(world.drive.rate[first:, 2]) > TURNS_RPS if turning else world.drive.speed[first:] > DRIVES_MPS
    if not busy.any():
        raise ValueError("the drive ends before the robot does what the fault begins with: make it longer (--seconds)")
    return float((first + int(np.argmax(busy))) * STEP_NS * 1e-9)


def way_driven(world: World, first_s: float, last_s: float) -> float:
    """Metres driven meanwhile, forward or back; inf where `last_s` is."""
    if not np.isfinite(last_s):
        return float("inf")
    rows = [min(round(t * 1e9) // STEP_NS, len(world.drive.travelled) - 1) for t in (first_s, last_s)]
    return float(np.abs(np.diff(world.drive.travelled[rows[0] : rows[1] + 1])).sum())


@dataclass(slots=True)
class Row:
    """All drives of one case."""

    outcomes: list[Outcome] = field(default_factory=list)

    def text(self, case: Case) -> str:
        """A line of the table."""
        named = Counter(outcome.named or "nobody" for outcome in self.outcomes)
        told = [outcome for outcome in self.outcomes if outcome.named is not None]
        names = ", ".join(f"{name} {count}" for name, count in named.most_common())
        soon = "-"
        if told:
            seconds, metres = [o.after_s for o in told], [o.after_m for o in told]
            soon = f"{np.median(seconds):.1f} ({max(seconds):.1f}) s, {np.median(metres):.2f} ({max(metres):.2f}) m"
        in_time = sum(o.after_s <= 1.0 or o.after_m <= 1.0 for o in told)
        possible = [o.soonest_m for o in self.outcomes if not np.isnan(o.soonest_m)]
        soonest = f"{np.median(possible):.1f} ({max(possible):.1f}) m" if possible else "-"
        back = [o.restored_s for o in told if np.isfinite(o.restored_s)]
        restored = f"{len(back)} of {len(told)}" + (f", {np.median(back):.1f} ({max(back):.1f}) s" if back else "")
        sums = (sum(getattr(o, kind) for o in self.outcomes) for kind in ("untold", "told", "not_taken_back", "checks"))
        counts = " | ".join(f"{total:,}" for total in sums)
        return (
            f"| {case.name} | {case.sensor} | {names} | {soon} | {in_time} of {len(self.outcomes)} | {soonest} "
            f"| {counts} | {restored} |"
        )


def table(kept: SetName, seeds: int, seconds: float) -> Iterator[str]:
    """Markdown, line by line as the drives come in; the last row is without a fault."""
    yield (
        "| fault | whose | named, drives | told after: median (most) | within 1 s or 1 m | possible after "
        "| outside, before told | outside, after | outside, not taken back | poses | good again after the end |"
    )
    yield "|---" * 11 + "|"
    rows = [(case, Row()) for case in (*cases(), NOTHING)]
    for law in LAWS:
        for seed in range(1, seeds + 1):
            for case, row in rows:
                row.outcomes.append(break_it(case, law, seed, seconds, kept))
    for case, row in rows:
        yield row.text(case)


RELAXED = (
    ("RTK 5 cm, 10 Hz", RTK, Rates(steps_per_fix=5)),
    ("RTK 5 cm, 1 Hz", RTK, Rates(steps_per_fix=50)),
    ("DGPS 0.6 m, 5 Hz", (0.6, 0.6, 1.2), Rates(steps_per_fix=10)),
)


def relaxed_table(seeds: int, seconds: float) -> Iterator[str]:
    """What `wrong_fixes` costs in width, and whether it holds, with 8 % of the fixes false."""
    yield "| fixes | wrong_fixes | of | false fixes | outside | voided | x, y on Earth | z | yaw | poses |"
    yield "|---" * 10 + "|"
    for name, bound_m, rates in RELAXED:
        for wrong, of in ((0, 20), (1, 20), (2, 20), (3, 20), (3, 60)):
            outside = voided = false = checks = 0
            widths: list[Array] = []
            for law in LAWS:
                for seed in range(1, seeds + 1):
                    fault = FalseFixes(0.0, 1e9, share=0.08, most=wrong, of=of, seed=seed)
                    config = settings(wrong_fixes=wrong, wrong_fixes_of=of)
                    went = drive(fault.changed, config, world_of(law, seed, seconds, bound_m), bound_m, rates)
                    outside, voided = outside + len(went.false_ns), voided + (not went.filter.guarantee.intact)
                    false, checks = false + fault.count, checks + went.checks
                    widths += went.widths
            x, y, z, _, _, yaw = np.mean(widths, axis=0)
            yield (
                f"| {name} | {wrong} | {of} | {false} | {outside} | {voided} | {0.5 * (x + y):.3f} m | {z:.3f} m "
                f"| {np.degrees(yaw):.1f} deg | {checks:,} |"
            )


PAGE_TEXT = """`python -m bench.pose_faults SECTION --page` makes one section anew; the others stay as they were.

The robot of `terrabound demo` (slip 2 %, gyroscope bias 0.3 and noise 0.05 deg/s, tilt 0.3 degrees) with
RTK fixes of 5 cm at 10 Hz, over open ground; every other error uniform, constant at its bound, or switching between its
ends. A fault begins while the robot drives (one gyroscope's: while it turns) and lasts 5 s where nothing else is said.

- `told after`: from the fault's beginning until the guarantee was void. `possible after`: the way after which a
  sound method could tell at the earliest, even one that knew the true attitude and turning at every instant
  (`bench/soonest.py`), unless it took accelerometers for speedometers: so long there is a motion within the bounds of
  tracks, gyroscope, tilt and fixes that explains all of their measurements.
- `outside, before told`: true poses outside of sets that were called intact then; whether anybody could have known is
  told drive by drive below. `outside, after`: the same of sets that were called void. **`outside, not taken back`: of
  either, those that `void_since_ns` and `restored_ns` of the last word still promise**
  ([faults.md](../docs/faults.md)). This must be 0.
- `good again`: drives that ended NOMINAL again, and how long after the fault's end (`fault_length_s` is 10 s after the
  contradiction; a fault that outlasts it is told again). A drive goes on for 15 s after its fault.
"""
RELAXED_TEXT = """`[filter] wrong_fixes` of `wrong_fixes_of` fixes in succession may be anywhere: 8 % of all are, by 1.5
to 30 times their bound, never more at a time than declared. Mean half-widths on Earth in the second half of each drive.
`0`: all fixes keep their bound, and are trusted.
"""
TITLES = {
    "box": "Boxes and window (the default)",
    "late": "Those that show late, drive by drive",
    "ellipsoid": '`set = "ellipsoid"`',
    "relaxed": "Fixes that are wrong now and then",
}
"""The page's sections."""


def section(name: str, seeds: int, seconds: float) -> Iterator[str]:
    """Its lines below the title."""
    if name == "late":
        from bench.pose_faults_by_drive import section as late  # it needs scipy, which the others do without

        yield from late()
        return
    if name == "relaxed":
        yield from RELAXED_TEXT.splitlines()
        yield ""
    yield f"{datetime.now(UTC):%Y-%m-%d}, {len(LAWS) * seeds} drives a row."
    yield ""
    yield from relaxed_table(seeds, seconds) if name == "relaxed" else table(SETS[name], seeds, seconds)


SETS: dict[str, SetName] = {"box": "box", "ellipsoid": "ellipsoid"}


def kept_sections() -> dict[str, str]:
    """What the page says now, by title."""
    if not PAGE.exists():
        return {}
    parts = PAGE.read_text(encoding="utf-8").split("\n## ")[1:]
    return {part.partition("\n")[0]: part.partition("\n")[2].strip() for part in parts}


def main() -> None:
    """The sections asked for, or all; on the page the others stay as they were."""
    parser = argparse.ArgumentParser(prog="python -m bench.pose_faults", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"of {', '.join(TITLES)}; all if none is named")
    parser.add_argument("--seconds", type=float, default=60.0, help="at most; a drive ends when its fault is over")
    parser.add_argument("--seeds", type=int, default=3, help="drives for each law of errors")
    parser.add_argument("--page", action="store_true", help="rewrite bench/POSE_FAULTS.md")
    options = parser.parse_args()
    if wrong := set(options.sections) - set(TITLES):
        parser.error(f"no such section: {', '.join(sorted(wrong))}; there are {', '.join(TITLES)}")
    made: dict[str, str] = {}
    for name in options.sections or TITLES:
        print(f"\n## {TITLES[name]}\n", flush=True)
        lines = []
        for line in section(name, options.seeds, options.seconds):
            lines.append(line)
            print(line, flush=True)
        made[TITLES[name]] = "\n".join(lines)
    if options.page:
        text = heading("Broken sensors", "python -m bench.pose_faults --page") + PAGE_TEXT
        sections = kept_sections() | made
        for title in TITLES.values():
            text += f"\n## {title}\n\n{sections[title]}\n" if title in sections else ""
        PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
