"""The robot's true motion: how a tracked body rides over the terrain, precomputed at 1 kHz.

The body rides on a smooth surface S(x, y): the terrain's top, low-passed over the footprint of the tracks and held as
a cubic B-spline, so that attitude and body rates are continuous. Roll and pitch are those of the surface's normal at
the given yaw; base_link moves in the tangent plane with velocity (v, v_l, v_n) along body x, y, z, where v_l is side
slip and v_n sinking and bouncing. Integrated by Runge-Kutta of fourth order, with the body rates among the integrals:
what an ideal gyro would integrate and the poses obey SMF equation (1) together, to about 1e-11 a step.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from math import pi

import numpy as np
from numpy.typing import NDArray

from simulator.body_surface import BodySurface, body_surface
from simulator.errors import ErrorLaw
from simulator.ride import integrate
from simulator.terrain import Course, Manoeuvre, Terrain

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.80665
STEP_NS = 1_000_000
STANDSTILL_NS = 2_000_000_000
"""How long the robot stands still before it drives; it stands again for the last second."""
FINAL_REST_S = 1.0
RAMP_S = 1.5
"""Time to reach the cruising speed, and to stop."""
SLIP_SLOT_NS = 20_000_000
"""A track's slip ratio keeps its value this long."""
REVERSAL_S = 0.2
"""It also keeps its value for so long before and after a track may turn round: see `_with_slip`."""
INSIDE = 1.0 - 1e-9
"""Ratios stay inside their bounds by this factor: room for rounding."""


@dataclass(frozen=True, slots=True)
class RobotModel:
    """Size and true limits of the robot's motion; names and meaning as in the configuration's [robot]."""

    track_length_m: float = 0.65
    track_gauge_m: float = 0.35
    max_speed_mps: float = 0.6
    max_acceleration_mps2: float = 1.0
    """|dv/dt| along the tracks, and each body axis of the robot's own acceleration."""
    max_turn_rate_dps: float = 60.0
    max_turn_acceleration_dps2: float = 400.0
    slip_ratio: float = 0.02
    lateral_slip_ratio: float = 0.01
    turning_centre_m: float = 0.03
    normal_slip_ratio: float = 0.01
    turning_gauge_m: tuple[float, float] | None = None
    """[least, most] distance of the tracks' turning centres, anywhere within at any time; None: always the gauge."""
    pulled: bool = False
    """Does what slips go one way wherever the track turns, as on a slope?"""
    sinks: bool = False
    """Does it sink and rise by the error law, instead of bouncing along the path?"""


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """The true motion, a row a millisecond; row 0 is the start of the standstill. World frame."""

    pose: Array
    """[N, 6] x, y, z, roll, pitch, yaw (unwrapped)."""
    turned: Array
    """[N, 3] integrals of the body rates, rad."""
    rate: Array
    """[N, 3] body rates, rad/s."""
    speed: Array
    """[N] v, along body x."""
    travelled: Array
    """[N] integral of v."""
    velocity: Array
    """[N, 3] of base_link, world axes."""
    specific_force: Array
    """[N, 3] R^T (dv/dt + g), what an ideal accelerometer in base_link feels."""
    ground: Array
    """[N, 2] travel of the left and right track over the ground."""
    tracks: Array
    """[N, 2] travel of the left and right track as its encoder sees it: with slip."""

    @property
    def duration_ns(self) -> int:
        """From the first row to the last."""
        return (len(self.pose) - 1) * STEP_NS


def plan_drive(model: RobotModel, terrain: Terrain, law: ErrorLaw, duration_s: float) -> Drive:
    """The terrain's course driven for `duration_s`, standstill included, as fast as it likes within all limits."""
    course = terrain.course
    surface = body_surface(model.track_length_m, terrain)
    for _ in range(12):
        drive = _drive(model, surface, course, law, duration_s)
        over = exceeded_limits(model, drive, margin=0.9)
        if not over:
            return drive
        course = replace(course, cruise_mps=0.85 * course.cruise_mps)
    raise ValueError(f"the robot can't drive the scene {terrain.name} within its limits: {', '.join(over)}")


def exceeded_limits(model: RobotModel, drive: Drive, margin: float = 1.0) -> list[str]:
    """Names of the limits that the drive exceeds `margin` times; empty if it keeps all of them."""
    step = STEP_NS * 1e-9
    own = drive.specific_force - _gravity_in_body(drive.pose)
    track_speed = np.diff(drive.tracks, axis=0) / step
    largest = {
        "max_speed_mps": max(np.linalg.norm(drive.velocity, axis=1).max(), np.abs(track_speed).max()),
        "max_acceleration_mps2": max(np.abs(np.diff(drive.speed)).max() / step, np.abs(own).max()),
        "max_turn_rate_dps": np.degrees(np.abs(drive.rate).max()),
        "max_turn_acceleration_dps2": np.degrees(np.abs(np.diff(drive.rate, axis=0)).max() / step),
    }
    return [name for name, value in largest.items() if value > margin * getattr(model, name)]


def motion_profile(t_s: Array, duration_s: float, course: Course) -> tuple[Array, Array]:
    """v(t) and the rate of spinning in place: standstill, smooth starts and stops, standstill again.

    dv/dt is at most 1.9 times the cruising speed over the ramp's time.
    """
    first = STANDSTILL_NS * 1e-9
    last = max(duration_s - FINAL_REST_S, first)
    if not course.manoeuvres:
        return course.cruise_mps * _pulse(t_s, first, last, RAMP_S), np.zeros_like(t_s)
    v, spin = np.zeros_like(t_s), np.zeros_like(t_s)
    for begin, move in _schedule(course, first, last):
        pulse = _pulse(t_s, begin, min(begin + move.duration_s, last), course.manoeuvre_ramp_s)
        v += course.cruise_mps * move.speed * pulse
        spin += move.spin_rps * pulse
    return v, spin


def _schedule(course: Course, first: float, last: float) -> Iterator[tuple[float, Manoeuvre]]:
    """The course's manoeuvres and when they begin, again and again."""
    begin = first
    for move in cycle(course.manoeuvres):
        if begin >= last:
            return
        yield begin, move
        begin += move.duration_s


def _pulse(t_s: Array, first: float, last: float, ramp_s: float) -> Array:
    """From 0 smoothly to 1 after `first`, and back to 0 before `last`."""
    ramp = max(min(ramp_s, 0.5 * (last - first)), 1e-9)
    rise = np.clip((t_s - first) / ramp, 0.0, 1.0)
    fall = np.clip((last - t_s) / ramp, 0.0, 1.0)
    return _smooth_step(rise) * _smooth_step(fall)


def _smooth_step(u: Array) -> Array:
    """From 0 to 1 with vanishing first and second derivatives at both ends."""
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2))


def _drive(model: RobotModel, surface: BodySurface, course: Course, law: ErrorLaw, duration_s: float) -> Drive:
    """Integrate one drive, then derive what the sensors feel."""
    count = round(duration_s * 1e9 / STEP_NS) + 1
    half_ns = np.arange(2 * count - 1, dtype=np.int64) * (STEP_NS // 2)
    v, spin = motion_profile(np.asarray(half_ns * 1e-9, np.float64), duration_s, course)
    side = law.channel("slip.lateral").smooth(half_ns) * model.lateral_slip_ratio * INSIDE
    centre = law.channel("slip.centre").smooth(half_ns) * model.turning_centre_m * INSIDE
    normal = np.full(len(half_ns), model.normal_slip_ratio * INSIDE)
    if model.sinks:
        normal *= law.channel("slip.normal").smooth(half_ns)
    path = np.array(
        [
            course.straight_m,
            1.0 / course.circle_radius_m,
            course.weave_rad * 2.0 * pi / course.weave_length_m,
            2.0 * pi / course.weave_length_m,
        ]
    )
    pose, turned, rate, velocity, travelled = (np.empty((count, n)) for n in (6, 3, 3, 3, 1))
    integrate(
        surface.coefficients,
        surface.x0_m,
        surface.y0_m,
        surface.step_m,
        np.array([course.x_m, course.y_m, surface.height(course.x_m, course.y_m), course.heading_rad]),
        path,
        v,
        spin,
        side,
        centre,
        normal,
        model.sinks,
        pose,
        turned,
        rate,
        velocity,
        travelled,
    )
    force = np.gradient(velocity, STEP_NS * 1e-9, axis=0)
    force = np.einsum("nji,nj->ni", rotations(pose), force) + _gravity_in_body(pose)
    half = 0.5 * _wound(model, law, turned[:, 2])
    ground = np.column_stack([travelled[:, 0] - half, travelled[:, 0] + half])
    first = STANDSTILL_NS * 1e-9
    reversals = [begin for begin, _ in _schedule(course, first, duration_s)] if course.manoeuvres else []
    tracks = _with_slip(model, law, ground, reversals)
    return Drive(pose, turned, rate, v[::2].copy(), travelled[:, 0], velocity, force, ground, tracks)


def _wound(model: RobotModel, law: ErrorLaw, turned: Array) -> Array:
    """[N] integral of ω_z times the distance of the turning centres: what one track goes further than the other."""
    if model.turning_gauge_m is None:
        return model.track_gauge_m * turned
    least, most = model.turning_gauge_m
    t_ns = np.arange(len(turned) - 1, dtype=np.int64) * STEP_NS
    share = 0.5 + 0.5 * INSIDE * law.channel("turning.gauge").over(t_ns // SLIP_SLOT_NS * SLIP_SLOT_NS)
    return np.concatenate([[0.0], np.cumsum((least + (most - least) * share) * np.diff(turned))])


def _with_slip(model: RobotModel, law: ErrorLaw, ground: Array, reversals: Sequence[float]) -> Array:
    """Encoder travel: |ground - encoder| <= slip_ratio * |encoder| in each step and so, in one direction, in all.

    A track that turns round (at one of the `reversals`, in seconds) keeps its slip meanwhile: so the bound holds also
    for the short intervals that reach over the turn, whose travel is next to nothing.
    """
    t_ns = np.arange(len(ground) - 1, dtype=np.int64) * STEP_NS
    slot_ns = t_ns // SLIP_SLOT_NS * SLIP_SLOT_NS
    for reversal in reversals:
        slot_ns[np.abs(t_ns * 1e-9 - reversal) <= REVERSAL_S] = round(reversal * 1e9)
    tracks = np.zeros_like(ground)
    for side, name in enumerate(("slip.left", "slip.right")):
        share = law.channel(name).over(slot_ns)
        way = np.diff(ground[:, side])
        if model.pulled:
            share = share * np.sign(way)
        steps = way / (1.0 + model.slip_ratio * INSIDE * share)
        tracks[1:, side] = np.cumsum(steps)
    return tracks


def rotations(pose: Array) -> Array:
    """[N, 3, 3] R = Rz(yaw) Ry(pitch) Rx(roll) of poses [N, 6]."""
    cr, sr = np.cos(pose[:, 3]), np.sin(pose[:, 3])
    cp, sp = np.cos(pose[:, 4]), np.sin(pose[:, 4])
    cy, sy = np.cos(pose[:, 5]), np.sin(pose[:, 5])
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _gravity_in_body(pose: Array) -> Array:
    """[N, 3] R^T (0, 0, g)."""
    return GRAVITY_MPS2 * rotations(pose)[:, 2, :]
