"""One step of the position chain, in one piece of machine code: from one encoder reading to the next."""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_bare
from estimator.interval import Interval, up, widen
from estimator.motion import (
    QUANTUM,
    UNKNOWN_TILT,
    UNKNOWN_YAW,
    TrackBounds,
    aged_bias,
    relative_yaw_between,
)
from estimator.tracks import slipping, travel_in_all_frames
from estimator.tube import first_not_before, hull_between, last_not_after, put_in_order


@compiled_bare
def encoder_step(
    i: int,
    begin: int,
    earliest_ns: int,
    latest_ns: int,
    left: float,
    right: float,
    counted: bool,
    fresh: bool,
    turned_until: int,
    tracks: tuple[float, ...],
    turn_begin: int,
    turn_end: int,
    turn_times: NDArray[np.int64],
    turn_box: NDArray[np.float64],
    turn_swing: NDArray[np.float64],
    turn_heading: NDArray[np.float64],
    turn_effort: NDArray[np.int64],
    bias: NDArray[np.float64],
    drift: float,
    most_rate: float,
    times: NDArray[np.int64],
    box: NDArray[np.float64],
    swing: NDArray[np.float64],
    net: NDArray[np.float64],
    local: NDArray[np.float64],
    heading: NDArray[np.float64],
    attitude: NDArray[np.float64],
    core: NDArray[np.float64],
    axis: NDArray[np.float64],
    pending: NDArray[np.float64],
    running: NDArray[np.bool_],
) -> tuple[int, int, bool, bool, float, float, float, float, int]:
    """travel: node i of the places [begin, i), at the true time of a reading in [earliest_ns, latest_ns].

    left, right: of the tracks since the reading before, in metres (`counted` False: unknown, the counter restarted;
    `fresh`: it had at that one). The turns are the nodes [turn_begin, turn_end) of the attitude chain, drift and
    most_rate their GyroBounds'; `tracks` are TrackBounds as a plain tuple, which is handed over four times as fast.
    Writes the attitude [4, 2] over the step (roll, pitch, yaw in the map, yaw on Earth), and goes on with core [9, 2],
    axis [9] and pending [9] (tracks.travel), running [2] (tracks.slipping) and with turned_until, the effort at the
    gyro node after the reading.

    Returns the gyro nodes before and after the step; did the history reach so far back; did the tracks run no faster
    than the robot can (else they are taken as not counted); what they slip in proportion to; seconds of the step, at
    most; variation of the yaw rate's
    integral, and the one that telescopes (tracks.travel's turning and turning_telescoped); turned_until.
    """
    bounds = TrackBounds(*tracks)
    began_ns = times[i - 1, 0]
    time_high = up((latest_ns - began_ns) * 1e-9)
    a, b, local_yaw, turned, until = swept_over(
        turn_times, turn_box, turn_swing, turn_heading, turn_effort, turn_begin, turn_end, began_ns, latest_ns, bias,
        drift, attitude,
    )  # fmt: skip
    until = max(turned_until, until)
    turning, telescoped = up(most_rate * time_high), (until - turned_until) * QUANTUM
    remembered = a >= turn_begin
    if remembered:
        turning = min(turning, turned)
    else:
        a, local_yaw = b, (-UNKNOWN_YAW, UNKNOWN_YAW)
        attitude[:2, 0], attitude[:2, 1] = -UNKNOWN_TILT, UNKNOWN_TILT
        attitude[2:, 0], attitude[2:, 1] = -UNKNOWN_YAW, UNKNOWN_YAW
        telescoped = up(turning + telescoped)
    slid = slipping(left, right, turning, time_high, bounds, running) if counted else 0.0
    sound = travel_in_all_frames(
        attitude, local_yaw, left, right, counted, slid, time_high, turning, telescoped, bounds, axis, fresh, core,
        pending, net[i], local[i], swing[i],
    )  # fmt: skip
    if not sound:
        travel_in_all_frames(
            attitude, local_yaw, left, right, False, slid, time_high, turning, telescoped, bounds, axis, fresh, core,
            pending, net[i], local[i], swing[i],
        )  # fmt: skip
    if not (sound and counted):
        running[0] = running[1] = False
    put_in_order(times, begin, i, earliest_ns, latest_ns)
    for c in range(3):
        heading[i, c] = turn_heading[a, c]
    for c in range(6):
        box[i, c, 0], box[i, c, 1] = widen((core[c, 0], core[c, 1]), pending[c])  # what is still to come undone
    return a, b, remembered, sound, slid, time_high, turning, telescoped, until


@compiled_bare
def swept_over(
    times: NDArray[np.int64],
    box: NDArray[np.float64],
    swing: NDArray[np.float64],
    heading: NDArray[np.float64],
    effort: NDArray[np.int64],
    begin: int,
    end: int,
    began_ns: int,
    ended_ns: int,
    bias: NDArray[np.float64],
    drift: float,
    attitude: NDArray[np.float64],
) -> tuple[int, int, Interval, float, int]:
    """The gyro nodes a and b around [began_ns, ended_ns], which the newest is not before; what they say of that time.

    attitude [4, 2] and the yaw less that at a, over all of it; how far ω_z turned (rad), and its effort at b. Where the
    history is too short, so that a is before `begin`, only the effort is of use.
    """
    a, b = last_not_after(times, begin, end, began_ns), first_not_before(times, begin, end, ended_ns)
    if a < begin:
        return a, b, (0.0, 0.0), 0.0, effort[b, 2]
    hull_between(box, swing, a, b, attitude)
    recent = aged_bias((bias[2, 0], bias[2, 1]), drift, times[a, 0], times[end - 1, 1])
    local_yaw = relative_yaw_between(heading, swing, a, b, heading[a], recent)
    return a, b, local_yaw, (effort[b, 2] - effort[a, 2]) * QUANTUM, effort[b, 2]
