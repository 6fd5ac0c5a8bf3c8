"""Looking for a witness (witness.py): a linear programme over deviations from the truth, linearised in yaw.

    python -m bench.witness_search        the table of bench/POSE_FAULTS.md

The first pass linearises around the truth and keeps yaw near it, the next around what was found. It needs scipy.
"""

from math import radians

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from bench.fault_drive import RTK, world_of
from bench.pose_faults import LAWS, cases, way_driven, when
from bench.soonest import soonest_s
from bench.witness import ROWS, STEP_S, Array, Readings, Truth, Witness, motion_of, readings_of, usage
from simulator.faults import Fault, WrongTracks
from simulator.world import World

LONGEST_S = 60.0
"""For one programme; what takes longer counts as not found."""
TIGHTER = 1e-5
"""Relative: the programme's bounds are narrower than the declared ones, so that its tolerance doesn't matter."""
BETWEEN = 3e-3
"""... sideways and normal to the ground, where it looks every half step only;"""
SECOND_ORDER_MMPS2 = 0.3
"""... of accelerometers, whose terms of second order it leaves out;"""
SPARE_M = 2e-4
"""... and fixes are this much narrower, for what is left of the linearisation."""


class Programme:
    """The linear programme: rows are appended one kind after the other."""

    def __init__(self, sizes: dict[str, int]) -> None:
        self._first, total = {}, 0
        for name, size in sizes.items():
            self._first[name] = slice(total, total + size)
            total += size
        self.low, self.high = np.full(total, -np.inf), np.full(total, np.inf)
        self.cost = np.zeros(total)
        self._rows: list[tuple[sparse.csr_array, Array, Array]] = []

    def at(self, name: str) -> slice:
        """Where a variable stands."""
        return self._first[name]

    def within(self, terms: dict[str, sparse.csr_array], low: Array, high: Array) -> None:
        """low <= sum of the terms <= high."""
        count = len(low)
        blocks = [terms.get(name, sparse.csr_array((count, s.stop - s.start))) for name, s in self._first.items()]
        self._rows.append((sparse.hstack(blocks, format="csr"), low, high))

    def solved(self) -> Array | None:
        """The best values; None where nothing fulfils all."""
        matrix = sparse.vstack([row[0] for row in self._rows], format="csr")
        low, high = (np.concatenate([row[i] for row in self._rows]) for i in (1, 2))
        same = low == high
        above, below = np.isfinite(high) & ~same, np.isfinite(low) & ~same
        result = linprog(
            self.cost,
            A_ub=sparse.vstack([matrix[above], -matrix[below]]),
            b_ub=np.concatenate([high[above], -low[below]]),
            A_eq=matrix[same],
            b_eq=low[same],
            bounds=np.column_stack([self.low, self.high]),
            method="highs-ipm",
            options={"time_limit": LONGEST_S},
        )

        return None if result.x is None or result.status != 0 else np.asarray(result.x)


def found(truth: Truth, near: Witness) -> Witness | None:
    """The witness whose yaw is nearest to that of `near`, around which the equations are linearised; None: none."""
    n, robot, imu, encoders = truth.n, truth.robot, truth.devices.imu, truth.devices.encoders
    knots, nodes = n + 2, slice(None, None, ROWS)
    columns = ("ahead", "across", "normal", "turn")
    sizes = dict.fromkeys(columns, knots) | {"yaw": n + 1, "bias": 3, "off": n + 1}
    lp = Programme(sizes | {f"place{i}": n + 1 for i in range(3)} | {f"track{i}": n + 1 for i in range(2)})
    held = np.where(truth.held, 0.0, np.inf)
    for name in columns:
        lp.low[lp.at(name)], lp.high[lp.at(name)] = -held, held
    lp.cost[lp.at("off")] = 1.0
    motion = motion_of(truth, near)
    between, over, along = truth.between, truth.over, truth.along
    at_nodes = between[nodes]

    def times(factor: Array, matrix: sparse.csr_array) -> sparse.csr_array:
        return sparse.csr_array(sparse.dia_array((factor[np.newaxis], [0]), shape=(len(factor),) * 2) @ matrix)

    step = sparse.csr_array(sparse.diags_array([np.full(n, -1.0), np.full(n, 1.0)], offsets=[0, 1], shape=(n, n + 1)))
    slope = sparse.csr_array(
        sparse.diags_array([np.full(n + 1, -1.0), np.full(n + 1, 1.0)], offsets=[0, 1], shape=(n + 1, knots)) / STEP_S
    )
    identity = sparse.csr_array(sparse.eye_array(n + 1))
    zeros = np.zeros(n)
    lp.within({"yaw": step, "turn": -(over @ between)}, zeros, zeros)
    yaw = 1e3 * motion.yaw[nodes]
    lp.within({"yaw": identity, "off": -identity}, np.full(n + 1, -np.inf), yaw)
    lp.within({"yaw": identity, "off": identity}, yaw, np.full(n + 1, np.inf))

    # Place: its change, linear in the speeds and around the yaw of `near`.
    velocity = np.einsum("nij,nj->ni", motion.rotation, motion.speed)
    beside = np.column_stack([-velocity[:, 1], velocity[:, 0], np.zeros(len(velocity))])
    so_far = 1e3 * np.diff(motion.place[nodes], axis=0)
    for i in range(3):
        terms = {name: over @ times(motion.rotation[:, i, j], between) for j, name in enumerate(columns[:3])}
        by_yaw = over @ times(beside[:, i], along)
        rest = so_far[:, i] - by_yaw @ yaw
        for j, name in enumerate(columns[:3]):
            rest = rest - terms[name] @ near.knots[:, j]
        lp.within({f"place{i}": step, "yaw": -by_yaw} | {name: -m for name, m in terms.items()}, rest, rest)

    # Gyroscope: noise, and a scale error that goes with the true rate.
    mean = 1e3 * np.vstack([np.zeros(3), np.diff(truth.turned[nodes], axis=0) / STEP_S])
    noise = 1e3 * radians(imu.gyro_noise_bound_dps) * (1.0 - TIGHTER)
    for axis in range(3):
        turned = over @ times(truth.axis[:, axis], between) / STEP_S
        turned = sparse.vstack([sparse.csr_array((1, knots)), turned], format="csr")
        bias = sparse.csr_array((np.ones(n + 1), (np.arange(n + 1), np.full(n + 1, axis))), shape=(n + 1, 3))
        away = 1e3 * truth.readings.gyro[: n + 1, axis] - mean[:, axis]
        scale = imu.gyro_scale_bound * np.sign(mean[:, axis])
        for sign in (-1.0, 1.0):  # |away - turned - bias| <= noise + scale (mean + turned)
            gain = sparse.csr_array(times(1.0 + sign * scale, turned))
            # sign (away - turned - bias) <= noise + scale (mean + turned)
            lp.within(
                {"turn": -sign * gain, "bias": -sign * bias}, np.full(n + 1, -np.inf),
                noise + scale * mean[:, axis] - sign * away,
            )  # fmt: skip
    most = 1e3 * radians(imu.gyro_bias_bound_dps) * (1.0 - 0.1 * TIGHTER)
    lp.low[lp.at("bias")], lp.high[lp.at("bias")] = -most, most

    # Tracks: what they ran is told by the ticks, and slips on the ground.
    for side, sign in enumerate((-1.0, 1.0)):
        tick = 1e3 * (encoders.left_metres_per_tick, encoders.right_metres_per_tick)[side]
        counted = tick * truth.readings.ticks[: n + 1, side]
        where, spare = lp.at(f"track{side}"), TIGHTER * tick
        lp.low[where], lp.high[where] = counted + spare, counted + tick * encoders.quantisation_ticks - spare
        drives, rests = np.flatnonzero(~truth.rest), np.flatnonzero(truth.rest)
        at_rest = np.union1d(rests, rests + 1)  # there the witness can't move away from a tick's edge
        true = truth.true_tracks[at_rest, side]
        lp.low[where][at_rest] = np.minimum(lp.low[where][at_rest], true)
        lp.high[where][at_rest] = np.maximum(lp.high[where][at_rest], true)
        lp.within({f"track{side}": step[rests]}, truth.run[rests, side], truth.run[rests, side])
        ground = {
            "ahead": (over @ between)[drives],
            "turn": (sign * 0.5 * robot.track_gauge_m * (over @ times(truth.axis[:, 2], between)))[drives],
        }
        way = truth.way[drives, side].astype(float)
        slip = robot.slip_ratio * (1.0 - TIGHTER)
        for edge in (-1.0, 1.0):  # edge (ground - run) <= slip way run
            terms = {name: edge * matrix for name, matrix in ground.items()}
            terms[f"track{side}"] = -times(edge + slip * way, step[drives])
            lp.within(terms, np.full(len(drives), -np.inf), -edge * truth.ground[drives, side])

    # Sideways and normal to the ground, every half step.
    half = np.arange(0, n * ROWS + 1, ROWS // 2)
    half = half[~truth.held[np.minimum((half + ROWS // 2) // ROWS, n + 1)] | ~truth.held[(half + ROWS // 2) // ROWS]]
    here = between[half]
    forward = np.sign(truth.speed[half, 0])
    round_ = np.sign(truth.rate[half, 2])
    for name, column, ratio, centre in (
        ("across", 1, robot.lateral_slip_ratio, robot.turning_centre_m),
        ("normal", 2, robot.normal_slip_ratio, 0.0),
    ):
        allowed = 1e3 * (ratio * np.abs(truth.speed[half, 0]) + centre * np.abs(truth.rate[half, 2]))
        for edge in (-1.0, 1.0):
            terms = {
                name: edge * here,
                "ahead": -times(ratio * forward, here),
                "turn": -times(centre * round_ * truth.axis[half, 2], here),
            }
            lp.within(
                terms, np.full(len(half), -np.inf),
                allowed * (1.0 - BETWEEN) - edge * 1e3 * truth.speed[half, column],
            )  # fmt: skip

    # What accelerometers feel.
    rate, speed = truth.rate[nodes], truth.speed[nodes]
    axis_z, axis_x, axis_y = truth.axis[nodes, 2], truth.axis[nodes, 0], truth.axis[nodes, 1]
    felt = (
        {
            "ahead": slope,
            "across": -times(rate[:, 2], at_nodes),
            "normal": times(rate[:, 1], at_nodes),
            "turn": times(axis_y * speed[:, 2] - axis_z * speed[:, 1], at_nodes),
        },
        {
            "across": slope,
            "ahead": times(rate[:, 2], at_nodes),
            "normal": -times(rate[:, 0], at_nodes),
            "turn": times(axis_z * speed[:, 0] - axis_x * speed[:, 2], at_nodes),
        },
    )
    for axis in range(2):
        away = 1e3 * (truth.readings.force[: n + 1, axis] - truth.force[nodes, axis])
        bound = 1e3 * imu.accel_bound_mps2 * (1.0 - TIGHTER) - SECOND_ORDER_MMPS2
        own, limit = 1e3 * truth.own[nodes, axis], 1e3 * robot.max_acceleration_mps2 - 1.0
        moving = np.flatnonzero(~(truth.held[:-1] & truth.held[1:]))
        terms = {name: matrix[moving] for name, matrix in felt[axis].items()}
        low, high = np.maximum(away - bound, -limit - own), np.minimum(away + bound, limit - own)
        if not truth.felt:
            low, high = -limit - own, limit - own
        lp.within(terms, low[moving], high[moving])
    gentle = 1e3 * STEP_S * np.ones(n + 1)
    lp.within({"turn": slope * STEP_S}, -gentle, gentle)
    accelerating, limit = 1e3 * truth.acceleration[nodes], 1e3 * robot.max_acceleration_mps2 - 1.0
    lp.within({"ahead": slope}, -limit - accelerating, limit - accelerating)

    # Fixes.
    seen = np.array([k for k in truth.readings.fixes if k <= n])
    arm = np.einsum("nij,j->ni", motion.rotation[seen * ROWS], truth.lever)
    true_arm = np.einsum("nij,j->ni", truth.rotation[seen * ROWS], truth.lever)
    fixes = np.array([truth.readings.fixes[k] for k in seen])
    swing = np.column_stack([-arm[:, 1], arm[:, 0], np.zeros(len(seen))])
    for i in range(3):
        away = 1e3 * (fixes - truth.pose[seen * ROWS, :3] - arm)[:, i] + swing[:, i] * yaw[seen]
        bound = 1e3 * (RTK[i] - SPARE_M)
        if near is not None and np.max(np.abs(1e3 * (fixes - truth.pose[seen * ROWS, :3] - true_arm)[:, i])) > bound:
            bound = 1e3 * RTK[i] * (1.0 - TIGHTER)
        lp.within({f"place{i}": identity[seen], "yaw": times(swing[:, i], identity[seen])}, away - bound, away + bound)

    values = lp.solved()
    if values is None:
        return None
    place = [values[lp.at(f"place{i}")][0] for i in range(3)]
    return Witness(
        np.column_stack([values[lp.at(name)] for name in columns]),
        np.array([*place, values[lp.at("yaw")][0]]),
        values[lp.at("bias")],
        _run(truth, np.column_stack([values[lp.at(f"track{i}")] for i in range(2)])),
    )


def _run(truth: Truth, tracks: Array) -> Array:
    """The tracks' travel, exactly the true one where the robot rests."""
    steps = np.diff(tracks, axis=0)
    steps[truth.rest] = truth.run[truth.rest]
    return np.vstack([tracks[0], tracks[0] + np.cumsum(steps, axis=0)])


def nobody(n: int) -> Witness:
    """The truth itself, but for its tracks."""
    return Witness(np.zeros((n + 2, 4)), np.zeros(4), np.zeros(3), np.zeros((n + 1, 2)))


def witnessed(truth: Truth, passes: int = 2) -> bool:
    """Is there a witness? (False: none was found.)"""
    witness: Witness | None = nobody(truth.n)
    for _ in range(passes if truth.free else 0):
        assert witness is not None
        witness = found(truth, witness)
        if witness is None:
            return False
        if max(usage(truth, witness).values()) <= 1.0:
            return True
    return False


def until_m(world: World, fault: Fault, readings: Readings, felt: bool, ways_m: tuple[float, ...]) -> float:
    """The way since the fault's beginning, one of ways_m, until which a witness was found; 0: none."""
    last = 0.0
    fixes = [k for k in readings.fixes if k * STEP_S >= fault.begin_s]
    ways = [(way_driven(world, fault.begin_s, k * STEP_S), k) for k in fixes]
    for way_m in ways_m:
        k = next((k for way, k in ways if way >= way_m), None)
        if k is None or not witnessed(Truth(world, fault, readings, k, felt)):
            break
        last = way_m
    return last


WAYS_M = (0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)


def main() -> None:
    """A line for each drive with both wheels' scale wrong by twice the slip bound."""
    case = next(case for case in cases() if "scale wrong by 4" in case.name)
    print("| errors | drive | nobody before, accelerometers as tilt sensors | nobody before | `soonest.py` |")
    print("|---" * 5 + "|")
    for law in LAWS:
        for seed in (1, 2, 3):
            world = world_of(law, seed, 40.0)
            begin_s = when(world, turning=False)
            fault = case.make(begin_s)
            assert isinstance(fault, WrongTracks)
            readings = readings_of(world, fault)
            without, felt = (until_m(world, fault, readings, one, WAYS_M) for one in (False, True))
            soonest_m = way_driven(world, begin_s, soonest_s(world, case.make(begin_s)))  # type: ignore[arg-type]
            print(f"| {law} | {seed} | {without:g} m | {felt:g} m | {soonest_m:.1f} m |", flush=True)


if __name__ == "__main__":
    main()
