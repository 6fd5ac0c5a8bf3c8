"""A motion that explains everything: while there is one, no sound method whatsoever may name anybody.

`soonest.py` bounds what a method could do that knew the true attitude and turning. This is the other side, a proof by
example: a *witness* is a motion of the robot, beside the true one, that keeps every declared limit and from which every
reading that the filter was given lies within its declared error. A method that called a bound broken would be wrong if
the witness were the truth, and nothing it was given tells the two apart.

The witness deviates from the truth in its speed along, across and normal to the tracks, and in the rates of roll, pitch
and yaw: piecewise linear in time, with a knot in the middle between any two readings; and in its gyroscope's biases,
its pose at the beginning and what its tracks ran. `witness_search.py` looks for one; how it was found proves nothing.
`usage` then holds it against every reading, by the nonlinear equations at a thousand instants a second, and that is
the proof. Millimetres and milliradians inside.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import radians

import numpy as np
import pymap3d
from numpy.typing import NDArray
from scipy import sparse

from bench.fault_drive import RATES, RTK, Reading, declared
from drivers.samples import Fix, InertialSample, WheelTicks
from simulator.faults import Fault
from simulator.robot import GRAVITY_MPS2, STEP_NS, rotations
from simulator.sample_stream import sample_stream
from simulator.world import World

Array = NDArray[np.float64]

ROWS = RATES.step_ns // STEP_NS
"""Of the truth's table in a step."""
STEP_S = RATES.step_ns * 1e-9
SPEEDS, ANGLES = slice(0, 3), slice(3, 6)
"""Columns of a witness's deviations: along, across, normal in mm/s; roll, pitch, yaw in mrad/s."""
NEAR_REST_MPS = 0.02
"""A track slower than this may be about to turn round: there the witness moves as the truth."""


@dataclass(frozen=True, slots=True)
class Readings:
    """What the filter was given, step by step."""

    gyro: Array
    """[n, 3] rad/s"""
    force: Array
    """[n, 2] m/s^2"""
    tilt: Array
    """[n, 2] rad, NaN where there is none"""
    ticks: Array
    """[n, 2]"""
    fixes: dict[int, Array]
    """By step: [3] of the antenna, ENU at the world's origin."""


def readings_of(world: World, fault: Fault) -> Readings:
    """Of the whole drive, broken ones included."""
    gyro, force, tilt, ticks, fixes = [], [], [], [], {}
    for k, (now_ns, readings) in enumerate(sample_stream(world, RTK, RATES)):
        t_s = (now_ns - world.start_ns) * 1e-9
        for plain in readings:
            reading: Reading = fault.changed(plain, t_s)
            if isinstance(reading, InertialSample):
                gyro.append(reading.gyro_rps)
                force.append(reading.accel_mps2[:2])
                tilt.append(reading.tilt_rad)
            elif isinstance(reading, WheelTicks):
                ticks.append((reading.left, reading.right))
            elif isinstance(reading, Fix):
                place = reading.lat_deg, reading.lon_deg, reading.alt_m
                fixes[k] = np.array(pymap3d.geodetic2enu(*place, *world.origin))
    return Readings(np.array(gyro), np.array(force), np.array(tilt), np.array(ticks, dtype=float), fixes)


@dataclass(frozen=True, slots=True)
class Witness:
    """Deviations from the truth, from the beginning of the drive to step n."""

    knots: Array
    """[n + 2, 6] at (j - 1/2) steps."""
    start: Array
    """[6] mm, mrad"""
    bias: Array
    """[3] of the gyroscope, mrad/s."""
    tracks: Array
    """[n + 1, 2] what the tracks have run at each reading, mm, from the counters' zero."""


class Truth:
    """The true motion from the beginning to step n, and what the programme needs of it. Rows: milliseconds."""

    def __init__(self, world: World, fault: Fault, readings: Readings, n: int, felt: bool = True) -> None:
        """`felt`: accelerometers tell of the robot's own acceleration; else it only disturbs them, as tilt sensors."""
        self.felt = felt
        robot, devices = declared(RTK)
        assert devices.gps is not None
        self.robot, self.devices, self.readings, self.n = robot, devices, readings, n
        drive, rows = world.drive, slice(0, n * ROWS + 1)
        self.pose, self.rate, self.turned = drive.pose[rows], drive.rate[rows], drive.turned[rows]
        self.rotation = rotations(self.pose)
        self.speed = np.einsum("nji,nj->ni", self.rotation, drive.velocity[rows])
        """[rows, 3] along, across, normal."""
        self.force, self.acceleration = drive.specific_force[rows], np.gradient(drive.speed, 1e-3)[rows]
        self.own = self.force - GRAVITY_MPS2 * self.rotation[:, 2]
        self.lever = np.array([devices.gps.antenna_x_m, devices.gps.antenna_y_m, devices.gps.antenna_z_m])
        self.turning = euler_rates(self.pose[:, 3:], self.rate)
        """[rows, 3] rates of roll, pitch and yaw."""
        half = 0.5 * robot.track_gauge_m * drive.rate[rows, 2]
        self.track_speed = np.column_stack([drive.speed[rows] - half, drive.speed[rows] + half])
        self.ground, self.run = (
            1e3 * np.diff(drive.ground[rows][::ROWS], axis=0),
            1e3 * np.diff(drive.tracks[rows][::ROWS], axis=0),
        )
        self.true_tracks = 1e3 * drive.tracks[rows][::ROWS]
        steps = [self.track_speed[k * ROWS : (k + 1) * ROWS + 1] for k in range(n)]
        self.way = np.array(
            [np.where(s.min(axis=0) > NEAR_REST_MPS, 1, np.where(s.max(axis=0) < -NEAR_REST_MPS, -1, 0)) for s in steps]
        )
        """[n, 2] whether a track runs forward all of a step, or back; 0: neither."""
        rest: NDArray[np.bool_] = np.asarray(~self.way.all(axis=1))
        self.rest = rest
        first = round(fault.begin_s / STEP_S)
        moves = np.abs(self.ground) > 1e-6
        self.ran = np.where(moves, self.run / np.where(moves, self.ground, 1.0), 1.0)
        """[n, 2] of a track's way over the ground in a step."""
        self.free = not rest[first:].any()
        """Does the robot drive on from the fault's beginning to step n?"""
        held = np.zeros(n + 2, dtype=bool)
        for k in range(3):
            held[k : k + n] |= rest
        self.held = held
        i = np.arange(n * ROWS + 1)
        knot, part = np.divmod(i + ROWS // 2, ROWS)
        self.between = _hats(i, knot, part / ROWS, n + 2)
        """[rows, knots]"""
        node = np.minimum(i // ROWS, n - 1)
        self.along = _hats(i, node, i / ROWS - node, n + 1)
        """[rows, n + 1] from values at the readings."""
        weights = np.full(ROWS + 1, 1e-3)
        weights[[0, -1]] = 5e-4
        row = np.repeat(np.arange(n), ROWS + 1)
        column = row * ROWS + np.tile(np.arange(ROWS + 1), n)
        self.over = sparse.csr_array((np.tile(weights, n), (row, column)), shape=(n, n * ROWS + 1))
        """[n, rows] integral over each step."""


def _hats(i: NDArray[np.int64], first: NDArray[np.int64], part: Array, count: int) -> sparse.csr_array:
    """[len(i), count] linear interpolation."""
    values = np.concatenate([1.0 - part, part])
    return sparse.csr_array(
        (values, (np.concatenate([i, i]), np.concatenate([first, first + 1]))), shape=(len(i), count)
    )


@dataclass(frozen=True, slots=True)
class Motion:
    """A witness's motion, at every row."""

    speed: Array
    """[rows, 3] m/s"""
    angles: Array
    """[rows, 3] roll, pitch, yaw;"""
    turning: Array
    """[rows, 3] ... their rates;"""
    rate: Array
    """[rows, 3] ... and the body's."""
    rotation: Array
    place: Array
    """[rows, 3] m beside the true place."""


def motion_of(truth: Truth, witness: Witness) -> Motion:
    """The nonlinear equations: angles from their rates, place from speeds and angles."""
    off = 1e-3 * (truth.between @ witness.knots)
    pose = truth.pose.copy()
    pose[:, 3:] += 1e-3 * witness.start[3:] + _summed(off[:, ANGLES])
    turning, rotation, speed = truth.turning + off[:, ANGLES], rotations(pose), truth.speed + off[:, SPEEDS]
    velocity = np.einsum("nij,nj->ni", rotation, speed) - np.einsum("nij,nj->ni", truth.rotation, truth.speed)
    place = 1e-3 * witness.start[:3] + _summed(velocity)
    return Motion(speed, pose[:, 3:], turning, body_rates(pose[:, 3:], turning), rotation, place)


def euler_rates(angles: Array, rate: Array) -> Array:
    """[n, 3] rates of roll, pitch and yaw from body rates (SMF equation 1)."""
    roll, pitch = angles[:, 0], angles[:, 1]
    sideways = np.sin(roll) * rate[:, 1] + np.cos(roll) * rate[:, 2]
    tilting = np.cos(roll) * rate[:, 1] - np.sin(roll) * rate[:, 2]
    return np.column_stack([rate[:, 0] + np.tan(pitch) * sideways, tilting, sideways / np.cos(pitch)])


def body_rates(angles: Array, turning: Array) -> Array:
    """[n, 3] the other way round."""
    return np.asarray(np.einsum("nij,nj->ni", by_turning(angles), turning))


def by_turning(angles: Array) -> Array:
    """[n, 3, 3] body rates per rate of roll, pitch and yaw."""
    sr, cr, sp, cp = *_sine_cosine(angles[:, 0]), *_sine_cosine(angles[:, 1])
    one, zero = np.ones_like(sr), np.zeros_like(sr)
    return np.moveaxis(np.array([[one, zero, -sp], [zero, cr, sr * cp], [zero, -sr, cr * cp]]), 2, 0)


def _sine_cosine(angle: Array) -> tuple[Array, Array]:
    return np.sin(angle), np.cos(angle)


def _summed(values: Array) -> Array:
    """Integral from the first row on (trapezoids of a millisecond)."""
    total = np.zeros_like(values)
    total[1:] = np.cumsum(5e-4 * (values[1:] + values[:-1]), axis=0)
    return total


def usage(truth: Truth, witness: Witness) -> dict[str, float]:
    """How much of each declared bound the witness uses up, at most: it stands if none is beyond 1."""
    robot, imu, encoders = truth.robot, truth.devices.imu, truth.devices.encoders
    motion, readings, n = motion_of(truth, witness), truth.readings, truth.n
    nodes = slice(None, None, ROWS)
    rate = motion.rate
    used: dict[str, float] = {}

    def uses(what: str, size: Array, bound: Array | float) -> None:
        used[what] = max(used.get(what, 0.0), float(np.nanmax(np.abs(size) / bound)))

    mean = np.diff(truth.turned[nodes], axis=0) + truth.over @ (rate - truth.rate)
    mean = np.vstack([np.zeros(3), mean / STEP_S])
    bias = 1e-3 * witness.bias
    noise = radians(imu.gyro_noise_bound_dps) + imu.gyro_scale_bound * np.abs(mean)
    uses("gyroscope", readings.gyro[: n + 1] - mean - bias, noise)
    uses("its bias", bias, radians(imu.gyro_bias_bound_dps))
    uses("tilt", readings.tilt[: n + 1] - motion.angles[nodes, :2], radians(imu.tilt_bound_deg))
    slope = 1e-3 * np.diff(witness.knots[:, SPEEDS], axis=0) / STEP_S
    swirl = np.cross(rate, motion.speed)[nodes] - np.cross(truth.rate, truth.speed)[nodes]
    own = truth.own[nodes, :2] + (slope + swirl)[:, :2]
    felt = readings.force[: n + 1] - GRAVITY_MPS2 * motion.rotation[nodes, 2, :2]
    if truth.felt:
        uses("accelerometers", felt - own, imu.accel_bound_mps2)
    uses("accelerometers as tilt sensors", felt, imu.accel_bound_mps2 + robot.max_acceleration_mps2)
    uses("own acceleration", own, robot.max_acceleration_mps2)
    uses("acceleration", truth.acceleration[nodes] + slope[:, 0], robot.max_acceleration_mps2)
    uses("turn acceleration", np.gradient(rate, 1e-3, axis=0), radians(robot.max_turn_acceleration_dps2))
    uses("turn rate", rate, radians(robot.max_turn_rate_dps))
    uses("speed", motion.speed[:, 0], robot.max_speed_mps)
    path = np.abs(motion.speed[:, 0])
    uses("normal slip", motion.speed[:, 2], robot.normal_slip_ratio * path + 1e-12)
    side = robot.lateral_slip_ratio * path + robot.turning_centre_m * np.abs(rate[:, 2])
    uses("lateral slip", motion.speed[:, 1], side + 1e-12)
    _use_tracks(truth, witness, motion, uses)
    ticks = np.array([encoders.left_metres_per_tick, encoders.right_metres_per_tick]) * 1e3
    off = witness.tracks / ticks - readings.ticks[: n + 1]
    uses("quantisation", np.ptp(off, axis=0), encoders.quantisation_ticks)
    for k, fix in readings.fixes.items():
        if k <= n:
            antenna = truth.pose[k * ROWS, :3] + motion.place[k * ROWS] + motion.rotation[k * ROWS] @ truth.lever
            uses("fixes", fix - antenna, np.array(RTK))
    return used


def _use_tracks(
    truth: Truth, witness: Witness, motion: Motion, uses: Callable[[str, Array, Array | float], None]
) -> None:
    """Slip of each track: within a step, which none turns round in, what it runs and its ground go on in proportion.

    Near rest that proportion is the true one.
    """
    run = np.diff(witness.tracks, axis=0)
    for side, sign in enumerate((-1.0, 1.0)):
        half = sign * 0.5 * truth.robot.track_gauge_m
        speed = motion.speed[:, 0] - truth.speed[:, 0] + half * (motion.rate - truth.rate)[:, 2]
        ground = truth.ground[:, side] + 1e3 * (truth.over @ speed)
        drives = ~truth.rest
        uses("slip", (ground - run[:, side])[drives], truth.robot.slip_ratio * np.abs(run[drives, side]))
        now = truth.track_speed[:, side] + speed
        steps = np.array(
            [
                [now[k * ROWS : (k + 1) * ROWS + 1].min(), now[k * ROWS : (k + 1) * ROWS + 1].max()]
                for k in range(truth.n)
            ]
        )
        turns_round = (steps[:, 0] <= 0.0) & (steps[:, 1] >= 0.0) & drives
        uses("turning round", turns_round.astype(float), 0.5)
        as_the_truth = truth.run[:, side] + truth.ran[:, side] * (ground - truth.ground[:, side])
        uses("slip at rest", (run[:, side] - as_the_truth)[truth.rest], 1e-9)
