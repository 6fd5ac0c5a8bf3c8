"""Broken sensors, on the emulated robot's declared bounds: who is named, how soon, and does the set hold meanwhile?

    python -m bench.pose_faults [--seconds S] [--seeds N] [--page]

The robot of `terrabound demo` (RTK fixes of 5 cm at 10 Hz, 50 Hz inertial packets and counts, tilt at 10 Hz) over open
ground. The fault begins while it drives, and lasts; all else stays within its bounds.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import cos, pi, remainder, sin
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.machine import heading
from estimator.filter import Filter
from service.config import Config, load
from service.robot_model import robot_model
from service.shipped import shipped_config
from simulator.errors import ErrorLaw
from simulator.faults import Fault, FaultMaker, GpsJump, StuckGyro, TiltSpike, WrongTracks
from simulator.open_ground import open_ground
from simulator.robot import STEP_NS
from simulator.sample_stream import Rates, sample_stream
from simulator.world import World

Array = NDArray[np.float64]

PAGE = Path(__file__).with_name("POSE_FAULTS.md")
START_NS = 1_000_000_000_000
LASTS_S = 5.0
EARLIEST_S = 12.0
RATES = Rates(steps_per_fix=5)
LAWS = ("uniform", "constant")
DRIVES_MPS, TURNS_RPS = 0.25, 0.3
"""A fault of the tracks or of GPS begins while the robot drives, one of the gyroscope while it turns."""


@dataclass(frozen=True, slots=True)
class Case:
    """One kind of fault."""

    name: str
    sensor: str
    """Whose it is."""
    make: FaultMaker
    turning: bool = False
    """Does it begin in a turn?"""


def cases(config: Config) -> list[Case]:
    """Those of issue 4, on the declared bounds of a configuration."""
    slip, tick_m = config.robot.slip_ratio, config.devices.encoders.left_metres_per_tick
    doubled = 1.0 + 2.0 * slip
    spin = 0.3 / tick_m

    def jump(metres: float) -> Case:
        return Case(f"GPS jumps {metres:g} m", "gps", lambda t: GpsJump(t, t + LASTS_S, metres))

    return [
        *(jump(metres) for metres in (2.0, 5.0, 10.0, 20.0, 50.0, 100.0)),
        Case("gyroscope stuck in a turn", "gyro", lambda t: StuckGyro(t, t + LASTS_S), turning=True),
        Case(
            f"both wheels' scale wrong by {2e2 * slip:g} %, for good",
            "encoders",
            lambda t: WrongTracks(t, 1e9, (doubled, doubled)),
        ),
        Case("one track slips by 50 %", "encoders", lambda t: WrongTracks(t, t + LASTS_S, (1.5, 1.0))),
        Case(
            "both tracks spin by 0.3 m/s", "encoders", lambda t: WrongTracks(t, t + LASTS_S, ticks_per_s=(spin, spin))
        ),
        Case("tilt spike of 6 degrees, 0.2 s", "tilt", lambda t: TiltSpike(t, t + 0.2, 6.0)),
        Case("tilt spike of 6 degrees, 5 s", "tilt", lambda t: TiltSpike(t, t + LASTS_S, 6.0)),
    ]


@dataclass(slots=True)
class Outcome:
    """What became of one drive."""

    named: str | None = None
    after_s: float = np.inf
    after_m: float = np.inf
    unflagged: int = 0
    """True poses outside of sets that were called intact."""
    flagged: int = 0
    """... and of sets that were called void."""
    checks: int = 0
    restored_s: float = np.inf
    """From the fault's end until the filter calls its pose good again."""
    too_early: bool = False
    """Was something called broken before anything was?"""


def break_it(case: Case, config: Config, law: str, seed: int, seconds: float) -> Outcome:
    """One drive with one fault; a pose is asked for and held against the truth ten times a second."""
    world = _world(config, law, seed, seconds)
    begin_s = _when(world, case.turning)
    fault = case.make(begin_s)
    devices, outcome = config.devices, Outcome()
    gps = devices.gps
    assert gps is not None
    bound = gps.rtk_fixed_horizontal_m or 0.0, gps.rtk_fixed_horizontal_m or 0.0, gps.rtk_fixed_vertical_m or 0.0
    pose_filter = Filter(config.robot, config.filter, devices.encoders, devices.imu, gps)
    start = world.pose(world.start_ns)
    path = np.abs(np.diff(world.drive.travelled, prepend=0.0)).cumsum()
    for k, (now_ns, readings) in enumerate(sample_stream(world, bound, RATES)):
        t_s = (now_ns - world.start_ns) * 1e-9
        for reading in readings:
            pose_filter.accept(fault.changed(reading, t_s))
        guarantee = pose_filter.guarantee
        if not guarantee.intact and outcome.named is None:
            row = (now_ns - world.start_ns) // STEP_NS
            outcome.named, outcome.after_s = guarantee.sensor, t_s - begin_s
            outcome.after_m = float(path[row] - path[round(begin_s * 1e9) // STEP_NS])
            outcome.too_early = t_s < begin_s
        if guarantee.restored_ns is not None and t_s >= _end(fault) and outcome.restored_s == np.inf:
            outcome.restored_s = max(0.0, t_s - _end(fault))
        pose = pose_filter.pose_over(now_ns, now_ns) if k % 5 == 4 else None
        if pose is not None:
            outcome.checks += 1
            if not _inside(world.pose(now_ns), start, pose.low, pose.high):
                outcome.unflagged += guarantee.intact
                outcome.flagged += not guarantee.intact
    return outcome


def _world(config: Config, law: str, seed: int, seconds: float) -> World:
    ground = open_ground(seed, 5.0, seconds)
    model = robot_model(config.robot)
    return World(ground, model, config.devices, ErrorLaw(law, seed), START_NS, seconds)


def _when(world: World, turning: bool) -> float:
    """The first second, from EARLIEST_S on, at which the robot drives, or turns."""
    first = round(EARLIEST_S * 1e9) // STEP_NS
    busy = np.abs(world.drive.rate[first:, 2]) > TURNS_RPS if turning else world.drive.speed[first:] > DRIVES_MPS
    return float((first + int(np.argmax(busy))) * STEP_NS * 1e-9)


def _end(fault: Fault) -> float:
    return fault.end_s


def _inside(world_pose: Array, start: Array, low: Array, high: Array) -> bool:
    """Is the true pose, seen from the map frame, in the box? Yaw modulo a turn."""
    x, y, z = world_pose[:3] - start[:3]
    c, s = cos(start[5]), sin(start[5])
    middle = 0.5 * (low[5] + high[5])
    yaw = middle + remainder(world_pose[5] - start[5] - middle, 2 * pi)
    seen = np.array([c * x + s * y, c * y - s * x, z, world_pose[3], world_pose[4], yaw])
    return bool(np.all((low <= seen) & (seen <= high)))


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
        back = [o.restored_s for o in told if np.isfinite(o.restored_s)]
        restored = f"{len(back)} of {len(told)}" + (f", {np.median(back):.1f} s" if back else "")
        checks = sum(o.checks for o in self.outcomes)
        unflagged, flagged = (sum(getattr(o, kind) for o in self.outcomes) for kind in ("unflagged", "flagged"))
        return (
            f"| {case.name} | {case.sensor} | {names} | {soon} | {in_time} of {len(self.outcomes)} | {unflagged} "
            f"| {flagged} | {checks:,} | {restored} |"
        )


def table(seeds: int, seconds: float) -> Iterator[str]:
    """Markdown, line by line as the drives come in; the last row is without a fault."""
    config = load(shipped_config("demo.toml")).config
    config = replace(config, robot=replace(config.robot, max_speed_mps=1.2))
    yield (
        "| fault | whose | named, drives | told after: median (most) | within 1 s or 1 m | outside, not told "
        "| outside, told | poses | good again after the end |"
    )
    yield "|---" * 9 + "|"
    nothing = Case("none", "-", lambda t: GpsJump(1e9, 1e9))
    for case in [*cases(config), nothing]:
        row = Row()
        for law in LAWS:
            for seed in range(1, seeds + 1):
                row.outcomes.append(break_it(case, config, law, seed, seconds))
        yield row.text(case)


PAGE_TEXT = """The robot of `terrabound demo` (slip 2 %, gyroscope bias 0.3 and noise 0.05 deg/s, tilt 0.3 degrees) with
RTK fixes of 5 cm at 10 Hz, over open ground, every other error uniform, or constant at its bound. A fault begins while
the robot drives (the gyroscope's: while it turns) and lasts 5 s where nothing else is said. `outside, not told`: true
poses outside of sets that were called intact; until enough metres have shown it, a fault is a violation that nobody can
know of. `outside, told`: the same of sets that were called void; docs/faults.md says what is promised of these.

"""


def main() -> None:
    """The table, as asked for."""
    parser = argparse.ArgumentParser(prog="python -m bench.pose_faults", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--page", action="store_true", help="rewrite bench/POSE_FAULTS.md")
    options = parser.parse_args()
    lines = []
    for line in table(options.seeds, options.seconds):
        lines.append(line)
        print(line, flush=True)
    if options.page:
        drives = f"{2 * options.seeds} drives of {options.seconds:g} s a row.\n\n"
        text = heading("Broken sensors", "python -m bench.pose_faults --page") + PAGE_TEXT + drives
        PAGE.write_text(text + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
