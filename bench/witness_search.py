"""Looking for a witness (witness.py): a linear programme over deviations from the truth, linearised in yaw.

The first pass linearises around the truth and keeps yaw near it, the next around what was found. It needs scipy.
"""

from dataclasses import replace
from math import radians
from typing import TypeAlias

import numpy as np
from scipy import sparse
from scipy.optimize import linprog

from bench.fault_drive import RTK
from bench.pose_faults import way_driven
from bench.witness import ROWS, STEP_S, Array, Readings, Truth, Witness, by_turning, motion_of, usage
from simulator.faults import Fault
from simulator.robot import GRAVITY_MPS2
from simulator.world import World

Matrix: TypeAlias = sparse.csr_array
Terms: TypeAlias = dict[str, Matrix]

SPEEDS, ANGLES, PLACES = ("ahead", "across", "normal"), ("roll", "pitch", "yaw"), ("east", "north", "up")
TURNING, TRACKS = ("rolling", "pitching", "turn"), ("left", "right")
COLUMNS = (*SPEEDS, *TURNING)
OFF = ("off roll", "off pitch", "off yaw")
"""From the angles that it is linearised around."""

SOLVER = 1e-5
"""A witness uses up no bound by more than this beyond all of it: the programme's own tolerance."""
LONGEST_S = 900.0
"""For one programme, by the clock on the wall; what takes longer counts as not found."""
TIGHTER = 1e-5
"""Relative: where the robot drives, the programme's bounds are narrower than the declared ones."""
BETWEEN = 3e-3
"""... sideways and normal to the ground, where it looks every half step only;"""
SECOND_ORDER_MMPS2 = 0.3
"""... of accelerometers, whose terms of second order it leaves out;"""
WIDER = 3e-6
"""Relative: a part of the solver's tolerance, by which bounds may be wider where errors stand exactly at them."""
ATTEMPTS = ((False, TIGHTER), (True, -WIDER), (True, 2e-3))
"""May it roll and pitch otherwise than the truth; how much narrower the gyroscope's noise is, for terms of second order
in the angles. Errors that stand at their bounds leave no room for that: there all bounds are a little wider, or the
solver's rounding alone would leave nothing. Where nothing keeps those, nothing keeps narrower ones."""
NOTHING = 1e-11
"""Smaller factors only confuse the solver."""
SPARE_M = 2e-4
"""... and fixes are this much narrower, for what is left of the linearisation."""


class Programme:
    """The linear programme: rows are appended one kind after the other."""

    def __init__(self, sizes: dict[str, int], now: dict[str, Array]) -> None:
        """`now`: the values that it is linearised around."""
        self._first, self._now, total = {}, now, 0
        for name, size in sizes.items():
            self._first[name] = slice(total, total + size)
            total += size
        self.low, self.high = np.full(total, -np.inf), np.full(total, np.inf)
        self.cost = np.zeros(total)
        self._rows: list[tuple[Matrix, Array, Array]] = []

    def at(self, name: str) -> slice:
        """Where a variable stands."""
        return self._first[name]

    def now(self, terms: Terms) -> Array:
        """What the terms add up to there."""
        return np.asarray(sum(matrix @ self._now[name] for name, matrix in terms.items()))

    def within(self, terms: Terms, low: Array, high: Array) -> None:
        """low <= sum of the terms <= high."""
        count = len(low)
        blocks = [terms.get(name, sparse.csr_array((count, s.stop - s.start))) for name, s in self._first.items()]
        self._rows.append((sparse.hstack(blocks, format="csr"), low, high))

    def solved(self) -> Array | None:
        """The best values; None where nothing fulfils all."""
        matrix = sparse.vstack([row[0] for row in self._rows], format="csr")
        matrix.data[np.abs(matrix.data) < NOTHING] = 0.0
        matrix.eliminate_zeros()
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


def found(truth: Truth, near: Witness, spare: float = TIGHTER, leans: bool = False) -> Witness | None:
    """The witness whose angles are nearest to those of `near`, around which the equations are linearised; None: none.

    `leans`: it may roll and pitch otherwise than the truth.
    """
    lp = programme(truth, near, spare)
    for name in () if leans else (*ANGLES[:2], *TURNING[:2]):
        lp.low[lp.at(name)] = lp.high[lp.at(name)] = 0.0
    values = lp.solved()
    if values is None:
        return None
    start = [values[lp.at(name)][0] for name in (*PLACES, *ANGLES)]
    tracks = np.column_stack([values[lp.at(name)] for name in TRACKS])
    witness = Witness(
        np.column_stack([values[lp.at(name)] for name in COLUMNS]), np.array(start), values[lp.at("bias")], tracks
    )
    return replace(witness, tracks=_run(truth, witness))


def programme(truth: Truth, near: Witness, spare: float) -> Programme:
    """Every reading and every limit, linear in what a witness deviates by from the truth, mm and mrad.

    `spare`: by so much, relatively, the gyroscope's noise is narrower than declared, and a tenth of it slip; negative:
    all bounds that readings have to keep are so much wider.
    """
    wider = max(-spare, 0.0)
    n, robot, imu, encoders = truth.n, truth.robot, truth.devices.imu, truth.devices.encoders
    knots, nodes = n + 2, slice(None, None, ROWS)
    nowhere, anywhere = np.full(n + 1, -np.inf), np.full(n + 1, np.inf)
    motion = motion_of(truth, near)
    between, over, along = truth.between, truth.over, truth.along
    at_nodes = between[nodes]
    identity = sparse.csr_array(sparse.eye_array(n + 1))
    step = sparse.csr_array(sparse.diags_array([np.full(n, -1.0), np.full(n, 1.0)], offsets=[0, 1], shape=(n, n + 1)))
    slope = sparse.csr_array(
        sparse.diags_array([np.full(n + 1, -1.0), np.full(n + 1, 1.0)], offsets=[0, 1], shape=(n + 1, knots)) / STEP_S
    )
    sizes = dict.fromkeys(COLUMNS, knots) | dict.fromkeys((*ANGLES, *PLACES, *TRACKS, *OFF), n + 1) | {"bias": 3}
    off_angles = 1e3 * (motion.angles - truth.pose[:, 3:])[nodes]
    now = {name: near.knots[:, i] for i, name in enumerate(COLUMNS)}
    now |= {name: off_angles[:, i] for i, name in enumerate(ANGLES)}
    lp = Programme(sizes, now)
    held = np.where(truth.held, 0.0, np.inf)
    for name in COLUMNS:
        lp.low[lp.at(name)], lp.high[lp.at(name)] = -held, held

    # Angles, and the body's rates: at each row, per rate of the angles and per angle.
    zeros = np.zeros(n)
    for angle, name in zip(ANGLES, TURNING, strict=True):
        lp.within({angle: step, name: -(over @ between)}, zeros, zeros)
    for i, (angle, off) in enumerate(zip(ANGLES, OFF, strict=True)):
        lp.cost[lp.at(off)] = 1.0
        lp.within({angle: identity, off: -identity}, nowhere, off_angles[:, i])
        lp.within({angle: identity, off: identity}, off_angles[:, i], anywhere)
    by_rate = by_turning(motion.angles)
    roll, pitch, turning = motion.angles[:, 0], motion.angles[:, 1], motion.turning[:, 2]
    by_pitch = (-np.cos(pitch) * turning, -np.sin(roll) * np.sin(pitch) * turning,
                -np.cos(roll) * np.sin(pitch) * turning)  # fmt: skip
    by_roll = np.zeros_like(roll), motion.rate[:, 2], -motion.rate[:, 1]

    def rate(axis: int, where: Matrix | None = None, rows: slice = slice(None)) -> Terms:
        """Of a body rate, at rows, or summed by `where` over all."""
        terms = {name: times(by_rate[rows, axis, i], between[rows]) for i, name in enumerate(TURNING)}
        terms |= {"roll": times(by_roll[axis][rows], along[rows]), "pitch": times(by_pitch[axis][rows], along[rows])}
        return terms if where is None else {name: where @ matrix for name, matrix in terms.items()}

    # Place: its change.
    so_far = 1e3 * np.diff(motion.place[nodes], axis=0)
    by_angle = turned_by_angle(motion.angles, motion.rotation, np.broadcast_to(motion.speed, motion.speed.shape))
    for i, place in enumerate(PLACES):
        terms = {name: over @ times(motion.rotation[:, i, j], between) for j, name in enumerate(SPEEDS)}
        terms |= {name: over @ times(by_angle[j][:, i], along) for j, name in enumerate(ANGLES)}
        rest = so_far[:, i] - lp.now(terms)
        lp.within({place: step} | {name: -matrix for name, matrix in terms.items()}, rest, rest)

    # Gyroscope: noise, and a scale error that goes with the true rate.
    mean = np.vstack([np.zeros(3), np.diff(truth.turned[nodes], axis=0) / STEP_S])
    mean[1:] += over @ (motion.rate - truth.rate) / STEP_S
    driven = ~(truth.held[:-1] & truth.held[1:])
    noise = 1e3 * radians(imu.gyro_noise_bound_dps) * (1.0 + wider - max(spare, 0.0) * driven)
    for axis in range(3):
        terms = {name: sparse.vstack([sparse.csr_array((1, m.shape[1])), m / STEP_S], format="csr")
                 for name, m in rate(axis, over).items()}  # fmt: skip
        bias = sparse.csr_array((np.ones(n + 1), (np.arange(n + 1), np.full(n + 1, axis))), shape=(n + 1, 3))
        fixed = 1e3 * mean[:, axis] - lp.now(terms)
        measured, scale = 1e3 * truth.readings.gyro[: n + 1, axis], imu.gyro_scale_bound * np.sign(mean[:, axis])
        for sign in (-1.0, 1.0):  # sign (measured - true - bias) <= noise + scale true
            gain = sign + scale
            lp.within(
                {name: -times(gain, matrix) for name, matrix in terms.items()} | {"bias": -sign * bias}, nowhere,
                noise + gain * fixed - sign * measured,
            )  # fmt: skip
    most = 1e3 * radians(imu.gyro_bias_bound_dps)
    lp.low[lp.at("bias")], lp.high[lp.at("bias")] = -most, most

    # Tilt.
    for axis in range(2):
        away = 1e3 * (truth.readings.tilt[: n + 1, axis] - truth.pose[nodes, 3 + axis])
        told = np.flatnonzero(~np.isnan(away))
        bound = np.full(len(told), 1e3 * radians(imu.tilt_bound_deg) * (1.0 + wider))
        lp.within({ANGLES[axis]: identity[told]}, away[told] - bound, away[told] + bound)

    # Tracks: what they ran is told by the ticks, and slips on the ground.
    for side, sign in enumerate((-1.0, 1.0)):
        tick = 1e3 * (encoders.left_metres_per_tick, encoders.right_metres_per_tick)[side]
        counted = tick * truth.readings.ticks[: n + 1, side]
        where, edge_mm = lp.at(TRACKS[side]), tick * (-wider if wider else TIGHTER)
        lp.low[where], lp.high[where] = counted + edge_mm, counted + tick * encoders.quantisation_ticks - edge_mm
        drives, rests = np.flatnonzero(~truth.rest), np.flatnonzero(truth.rest)
        at_rest = np.union1d(rests, rests + 1)  # there the witness can't move away from a tick's edge
        true = truth.true_tracks[at_rest, side]
        lp.low[where][at_rest] = np.minimum(lp.low[where][at_rest], true)
        lp.high[where][at_rest] = np.maximum(lp.high[where][at_rest], true)
        half = sign * 0.5 * robot.track_gauge_m
        ground = {name: half * matrix for name, matrix in rate(2, over).items()} | {"ahead": over @ between}
        gone = 1e3 * (over @ (motion.speed - truth.speed)[:, 0] + half * (over @ (motion.rate - truth.rate)[:, 2]))
        gone += truth.ground[:, side] - lp.now(ground)
        ran = truth.ran[rests, side]
        still = {name: -times(ran, matrix[rests]) for name, matrix in ground.items()} | {TRACKS[side]: step[rests]}
        there = truth.run[rests, side] + ran * (gone - truth.ground[:, side])[rests]
        lp.within(still, there, there)
        slip = robot.slip_ratio * (1.0 + wider - 0.1 * max(spare, 0.0)) * truth.way[drives, side].astype(float)
        for edge in (-1.0, 1.0):  # edge (ground - run) <= slip way run
            terms = {name: edge * matrix[drives] for name, matrix in ground.items()}
            terms[TRACKS[side]] = -times(edge + slip, step[drives])
            lp.within(terms, np.full(len(drives), -np.inf), -edge * gone[drives])

    # Sideways and normal to the ground, every half step.
    half_steps = np.arange(0, n * ROWS + 1, ROWS // 2)
    half_steps = half_steps[~truth.held[(half_steps + ROWS // 2) // ROWS]]
    forward, round_ = np.sign(truth.speed[half_steps, 0]), np.sign(truth.rate[half_steps, 2])
    here, round_here = between[half_steps], rate(2, None, half_steps)  # type: ignore[arg-type]
    around = 1e3 * motion.rate[half_steps, 2] - lp.now(round_here)
    for column, (name, ratio, centre) in enumerate(
        (("across", robot.lateral_slip_ratio, robot.turning_centre_m), ("normal", robot.normal_slip_ratio, 0.0)), 1
    ):
        allowed = 1e3 * ratio * np.abs(truth.speed[half_steps, 0]) + centre * round_ * around
        for edge in (-1.0, 1.0):
            terms = {other: -times(centre * round_, matrix) for other, matrix in round_here.items()}
            terms |= {name: edge * here, "ahead": -times(ratio * forward, here)}
            beyond = edge * 1e3 * truth.speed[half_steps, column]
            lp.within(terms, np.full(len(half_steps), -np.inf), allowed * (1.0 - BETWEEN) - beyond)

    # What accelerometers feel: the robot's own acceleration and gravity, which leans with the angles.
    v, w = motion.speed[nodes], motion.rate[nodes]
    rates = [rate(axis, None, nodes) for axis in range(3)]
    swung = np.cross(w, v) - np.cross(truth.rate[nodes], truth.speed[nodes])
    pulled = motion.rotation[nodes, 2] - truth.rotation[nodes, 2]
    sr, cr, sp, cp = np.sin(roll[nodes]), np.cos(roll[nodes]), np.sin(pitch[nodes]), np.cos(pitch[nodes])
    for axis, name in enumerate(SPEEDS[:2]):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        own_terms = added(
            {name: slope, SPEEDS[two]: times(w[:, one], at_nodes)}, {SPEEDS[one]: -times(w[:, two], at_nodes)},
            scaled(v[:, two], rates[one]), scaled(-v[:, one], rates[two]),
        )  # fmt: skip
        lean = {"pitch": times(-GRAVITY_MPS2 * (sp * sr if axis else cp), identity)}
        if axis:
            lean["roll"] = times(GRAVITY_MPS2 * cp * cr, identity)
        limit, most_off = 1e3 * robot.max_acceleration_mps2 - 1.0, 1e3 * imu.accel_bound_mps2 * (1.0 - TIGHTER)
        fixed = 1e3 * (slope @ near.knots[:, axis] * 1e-3 + swung[:, axis]) - lp.now(own_terms)
        own = 1e3 * truth.own[nodes, axis] + fixed
        lp.within(own_terms, -limit - own, limit - own)
        fixed = fixed + GRAVITY_MPS2 * 1e3 * pulled[:, axis] - lp.now(lean)
        away = 1e3 * (truth.readings.force[: n + 1, axis] - truth.force[nodes, axis])
        if truth.felt:
            room = np.maximum(most_off - SECOND_ORDER_MMPS2, np.abs(away))
            lp.within(added(own_terms, lean), away - room - fixed, away + room - fixed)
    gentle = 1e3 * STEP_S * np.ones(n + 1)
    for name in TURNING:
        lp.within({name: slope * STEP_S}, -gentle, gentle)
    accelerating, limit = 1e3 * truth.acceleration[nodes], 1e3 * robot.max_acceleration_mps2 - 1.0
    lp.within({"ahead": slope}, -limit - accelerating, limit - accelerating)

    # Fixes.
    seen = np.array([k for k in truth.readings.fixes if k <= n])
    rows = seen * ROWS
    arm = np.einsum("nij,j->ni", motion.rotation[rows], truth.lever)
    fixes = np.array([truth.readings.fixes[k] for k in seen]) - truth.pose[rows, :3]
    true_away = 1e3 * np.abs(fixes - np.einsum("nij,j->ni", truth.rotation[rows], truth.lever))
    swing = turned_by_angle(motion.angles[rows], motion.rotation[rows], np.broadcast_to(truth.lever, (len(seen), 3)))
    for i, place in enumerate(PLACES):
        terms = {name: times(swing[j][:, i], identity[seen]) for j, name in enumerate(ANGLES)}
        away = 1e3 * (fixes - arm)[:, i] + lp.now(terms)
        bound = np.where(true_away[:, i] > 1e3 * (RTK[i] - SPARE_M), 1e3 * RTK[i], 1e3 * (RTK[i] - SPARE_M))
        bound *= 1.0 + wider
        lp.within({place: identity[seen]} | terms, away - bound, away + bound)
    return lp


def times(factor: Array, matrix: Matrix) -> Matrix:
    """Each row so many times."""
    return sparse.csr_array(sparse.dia_array((factor[np.newaxis], [0]), shape=(len(factor),) * 2) @ matrix)


def scaled(factor: Array, terms: Terms) -> Terms:
    """All of them so many times, row by row."""
    return {name: times(factor, matrix) for name, matrix in terms.items()}


def added(*several: Terms) -> Terms:
    """Their sum."""
    total: Terms = {}
    for terms in several:
        for name, matrix in terms.items():
            total[name] = total[name] + matrix if name in total else matrix
    return total


def turned_by_angle(angles: Array, rotation: Array, vector: Array) -> list[Array]:
    """[n, 3] each: how a body's vector [n, 3] moves in the world per roll, pitch and yaw."""
    moved = np.einsum("nij,nj->ni", rotation, vector)
    yaw, zero = angles[:, 2], np.zeros(len(angles))
    left = np.column_stack([-np.sin(yaw), np.cos(yaw), zero])
    upward = np.column_stack([zero, zero, zero + 1.0])
    return [np.cross(axis, moved) for axis in (rotation[:, :, 0], left, upward)]


def _run(truth: Truth, witness: Witness) -> Array:
    """The tracks' travel; near rest in the true proportion to the ground's."""
    steps = np.diff(witness.tracks, axis=0)
    turned = 1e3 * (truth.over @ (motion_of(truth, witness).rate - truth.rate)[:, 2])
    ahead = truth.over @ (truth.between @ witness.knots[:, 0])
    for side, sign in enumerate((-1.0, 1.0)):
        gone = ahead + sign * 0.5 * truth.robot.track_gauge_m * turned
        steps[truth.rest, side] = (truth.run[:, side] + truth.ran[:, side] * gone)[truth.rest]
    return np.vstack([witness.tracks[0], witness.tracks[0] + np.cumsum(steps, axis=0)])


def nobody(n: int) -> Witness:
    """The truth itself, but for its tracks."""
    return Witness(np.zeros((n + 2, 6)), np.zeros(6), np.zeros(3), np.zeros((n + 1, 2)))


def witnessed(truth: Truth, passes: int = 3) -> bool:
    """Is there a witness? (False: none was found.)"""
    for leans, spare in ATTEMPTS if truth.free else ():
        witness: Witness | None = nobody(truth.n)
        for number in range(passes):
            assert witness is not None
            witness = found(truth, witness, spare, leans)
            if witness is None:
                if number == 0 and spare < 0.0:
                    return False
                break
            if max(usage(truth, witness).values()) <= 1.0 + SOLVER:
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
