"""How far the tracks have carried the robot during a step (SMF section 4.3), as motion.py encloses it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_bare, compiled_into_callers
from estimator.frames import Box3, columns, columns_at, largest, tilted
from estimator.interval import Interval, add, is_empty, meet, mid, mig, outward, reach, scale, up, widen
from estimator.motion import TrackBounds, runs_one_way, variation


@compiled_bare
def attitude_box(attitude: NDArray[np.float64]) -> Box3:
    """[3, 2] array as three intervals."""
    return (
        (attitude[0, 0], attitude[0, 1]),
        (attitude[1, 0], attitude[1, 1]),
        (attitude[2, 0], attitude[2, 1]),
    )


class Tracked(NamedTuple):
    """What the tracks say of a step."""

    distance: Interval
    """Integral of the speed along the tracks, but for what telescopes; empty: faster than the robot can."""
    path: float
    """Integral of |speed|."""
    quantum: float
    """How much telescopes between two counts, in metres;"""
    counted: bool
    """... if both were counted."""


@compiled_bare
def to_and_fro(left: float, right: float, turning: float, time_high: float, bounds: TrackBounds) -> tuple[float, float]:
    """No less than either track ran between two counts, all ways added up; left and right: what they counted.

    A track runs forward where the ground at its turning centre comes towards it: at v -+ ω (gauge / 2), and at no more
    than that divided by 1 - slip. v and ω change as fast as declared, the gauge (if it has a range) at once: by what
    that can do, |ω| times half of it, the speed is `loose`. turning: no less than the integral of |ω| meanwhile.
    """
    loose, a = loosely(turning, time_high, bounds), bounds.most_track_acceleration
    return (
        variation((left, left), bounds.quantum_left, a, time_high, loose),
        variation((right, right), bounds.quantum_right, a, time_high, loose),
    )


@compiled_bare
def loosely(turning: float, time_high: float, bounds: TrackBounds) -> float:
    """See to_and_fro."""
    jerk = up(0.5 * up(up(bounds.most_turn_acceleration * time_high) * time_high))
    return up(bounds.turning_spread * up(turning + jerk))


@compiled_bare
def slipping(
    left: float,
    right: float,
    turning: float,
    time_high: float,
    bounds: TrackBounds,
    running: NDArray[np.bool_],
) -> float:
    """What both tracks together slip in proportion to, between two counts: `to_and_fro`, but for what telescopes.

    A track that runs one way all the time runs what was counted, and the difference of two counts' errors; and while it
    goes on so, these differences come to one quantum in all, however the slip changes. So the first step of such a run
    pays for it, and those after it don't. running [2]: did the tracks run one way in the step before? Goes on.
    """
    loose, total = loosely(turning, time_high, bounds), 0.0
    for track in range(2):
        ran, q = (left, bounds.quantum_left) if track == 0 else (right, bounds.quantum_right)
        runs = runs_one_way((ran, ran), q, bounds.most_track_acceleration, time_high, loose)
        way = variation((ran, ran), q, bounds.most_track_acceleration, time_high, loose)
        total = up(total + (abs(ran) if runs and running[track] else way))
        running[track] = runs
    return total


@compiled_bare
def tracked(left: float, right: float, counted: bool, slid: float, time_high: float, bounds: TrackBounds) -> Tracked:
    """From the tracks' travel in metres between two counts (not `counted`: unknown, the counter restarted).

    slid: what they slip in proportion to (`slipping`).
    """
    q = telescoping_quantum(bounds)
    most = up(bounds.most_speed * time_high)
    if not counted:
        return Tracked((-most, most), most, q, False)
    d = scale(0.5, add(outward(left, left), outward(right, right)))
    distance = meet(widen(d, up(up(0.5 * bounds.slip) * slid)), (-up(most + q), up(most + q)))
    path = min(variation(distance, q, bounds.most_acceleration, time_high), most)
    return Tracked(distance, path, q, True)


@compiled_bare
def telescoping_quantum(bounds: TrackBounds) -> float:
    """How far the mean of two differences of counts is off, in metres, and what these differences add to the slip."""
    return up(up(0.5 * up(bounds.quantum_left + bounds.quantum_right)) * up(1.0 + bounds.slip))


@compiled_bare
def travel(
    attitude: NDArray[np.float64],
    left: float,
    right: float,
    counted: bool,
    slid: float,
    time_high: float,
    turning: float,
    turning_telescoped: float,
    bounds: TrackBounds,
    axis: NDArray[np.float64],
    first: bool,
    core: NDArray[np.float64],
    net: NDArray[np.float64],
    swing: NDArray[np.float64],
    pending: NDArray[np.float64],
) -> bool:
    """One step of (x, y, z) between two encoder readings (SMF section 4.3, with in-step attitude hulls).

    attitude [3, 2] holds over the whole step; left, right are the tracks' travel in metres between the counts
    (`counted` False: unknown, the counter restarted); the step lasts at most time_high seconds.

    Three errors must not add up step by step, because they telescope: a difference of *any* two counts is off by at
    most q = (quantum_left + quantum_right) / 2, the slip by at most slip q for that reason (`slid`: see `slipping`; in
    what follows q stands for both), and the turning between *any* two readings is known on the gyro's clock. So `core`
    [3, 2] is a box for p minus what is still to come: p_n in core_k + steps k..n-1 + pending_n.
    - With e_k the count's error at reading k and c_k the middle of the step's forward axis, sums by parts give
      sum c_k (e_{k+1} - e_k) = c_{n-1} e_n - sum e_k (c_k - c_{k-1}): q |c_k - c_{k-1}| a step, q |c| pending.
    - A track that runs one way slips by |δ_k| <= slip (counted_k + e_{k+1} - e_k). Count e from the upper end of its
      range: where a set held p - c e and what is slip |e_k| ahead and behind it, the set that is moved by up to slip
      counted_k holds the same of k + 1. Only the beginning of such a run, and each measurement that cuts, cost slip q.
    - `turning_telescoped` is the variation of ω_z from the gyro node after reading k to the one after k+1, `turning`
      the one that surely covers the step alone.

    axis [3] is c_{k-1} and becomes c_k; `first`: this step starts from a count whose error is zero by definition.
    net [3, 2] encloses the step's displacement alone; swing [3] as in `turn`; pending [3] becomes q |c_k|. False, and
    nothing written, if the tracks ran faster than the robot can.
    """
    way = tracked(left, right, counted, slid, time_high, bounds)
    if is_empty(way.distance):
        return False
    axes = columns(attitude_box(attitude))
    for i in range(3):
        (net[i, 0], net[i, 1]), swing[i] = carry(
            i, i, axes, way, turning, turning_telescoped, bounds, axis, first, core, pending
        )
    return True


@compiled_into_callers
def carry(
    at: int,
    i: int,
    axes: tuple[Box3, Box3, Box3],
    way: Tracked,
    turning: float,
    turning_telescoped: float,
    bounds: TrackBounds,
    axis: NDArray[np.float64],
    first: bool,
    core: NDArray[np.float64],
    pending: NDArray[np.float64],
) -> tuple[Interval, float]:
    """`travel` of coordinate i, in row `at` of axis, core and pending, along the robot's axes: net and swing."""
    ahead, sideways, upward = axes
    q_now = way.quantum if way.counted else 0.0
    c = mid(ahead[i])
    bent = 0.0 if first else up(way.quantum * up(abs((c if way.counted else 0.0) - axis[at])))
    side = largest(sideways, i)
    rest = up(up(up(reach(ahead[i], c) * way.path) + up(side * up(bounds.lateral * way.path))))
    rest = up(rest + up(largest(upward, i) * up(bounds.normal * way.path)))
    main = scale(c, way.distance)
    telescoped = widen(main, up(rest + up(side * up(bounds.turning_centre * turning_telescoped))))
    core[at, 0], core[at, 1] = widen(add((core[at, 0], core[at, 1]), telescoped), bent)
    slide = up(side * up(bounds.turning_centre * turning))
    alone = widen(main, up(up(rest + slide) + up(q_now * abs(c))))
    varied = up(up(largest(ahead, i) * way.path) + up(slide + up(largest(upward, i) * up(bounds.normal * way.path))))
    varied = up(varied + up(side * up(bounds.lateral * way.path)))
    alone = meet(alone, (-varied, varied))
    axis[at] = c
    pending[at] = up(q_now * abs(c))
    return alone, max(0.0, up(0.5 * (varied - mig(alone))))


@compiled_bare
def travel_in_all_frames(
    attitude: NDArray[np.float64],
    local_yaw: Interval,
    left: float,
    right: float,
    counted: bool,
    slid: float,
    time_high: float,
    turning: float,
    turning_telescoped: float,
    bounds: TrackBounds,
    axis: NDArray[np.float64],
    first: bool,
    core: NDArray[np.float64],
    pending: NDArray[np.float64],
    net: NDArray[np.float64],
    local: NDArray[np.float64],
    swing: NDArray[np.float64],
) -> bool:
    """`travel` of one step in the map, on Earth, and along its own heading: rows 0..2, 3..5, 6..8 of axis to pending.

    attitude [4, 2]: roll, pitch, yaw in the map, yaw on Earth. In the local frame the step stands alone. net [3, 2] is
    that in the map, local [3, 3] low, high and swing along its heading, swing [6] in the map and on Earth.
    """
    way = tracked(left, right, counted, slid, time_high, bounds)
    if is_empty(way.distance):
        return False
    tilt = tilted((attitude[0, 0], attitude[0, 1]), (attitude[1, 0], attitude[1, 1]))
    core[6:] = 0.0
    for frame in range(3):
        axes = columns_at(tilt, local_yaw if frame == 2 else (attitude[2 + frame, 0], attitude[2 + frame, 1]))
        for i in range(3):
            at, alone = 3 * frame + i, first or frame == 2
            gone, beyond = carry(at, i, axes, way, turning, turning_telescoped, bounds, axis, alone, core, pending)
            if frame == 0:
                net[i, 0], net[i, 1] = gone
            if frame == 2:
                local[i, 0], local[i, 1], local[i, 2] = gone[0], gone[1], beyond
            else:
                swing[at] = beyond
    return True
