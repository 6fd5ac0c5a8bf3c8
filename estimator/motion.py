"""How far the robot can have moved during a step: verified enclosures of its kinematics (SMF sections 2 and 4).

Both steps, the turn here and the travel in tracks.py, enclose an integral of f(t) u(t) dt, where f depends on the
attitude and u is a rate whose integral is measured. With a constant c near the middle of [f], the hull of f over the
step,

    integral f u dt  in  c [integral u] + [-1, 1] max|f - c| integral |u|,

whatever u does inside the step. So two numbers are needed of each rate: an interval for its integral, and an upper
bound of its *variation*, the integral of its absolute value, which is larger where the rate may change its sign.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled_bare
from drivers.samples import Vector3
from estimator.interval import (
    ULP,
    Interval,
    add,
    cosine,
    divide,
    down,
    is_empty,
    mag,
    meet,
    mid,
    mig,
    mul,
    neg,
    outward,
    reach,
    scale,
    sine,
    up,
    widen,
)

STEEPEST = 1.4
"""Beyond this pitch (80 degrees) Euler rates are not enclosed any more: the attitude counts as lost."""
UNKNOWN_TILT = 1.5707963267948968
"""Roll and pitch are taken to stay within 90 degrees."""
UNKNOWN_YAW = 3.1415926535897936
CAREFUL = 0.2
"""rad: an excursion guessed larger than this is enclosed step by step."""
QUANTUM = 2.0**-40
"""Variations are summed in whole numbers of this (rad), so that sums over hours are exact."""


class GyroBounds(NamedTuple):
    """Declared errors of the gyroscope, rad and s."""

    noise: float
    scale: float
    most_rate: float
    """|body rate| of the robot, any axis."""
    most_acceleration: float
    """|d(body rate)/dt|."""
    most_bias: float
    bias_drift: float
    """|d(bias)/dt|."""
    most_tilt_rate: float = 1e3
    """|body rate| about x and y, where it is slower."""

    def __deepcopy__(self, memo: dict[int, object]) -> "GyroBounds":
        return self


class TrackBounds(NamedTuple):
    """Declared errors of the tracks, m, s and rad."""

    slip: float
    lateral: float
    turning_centre: float
    normal: float
    quantum_left: float
    """How far a difference of two left counts is off, in metres."""
    quantum_right: float
    most_speed: float
    most_acceleration: float
    most_track_acceleration: float
    """Of one track's travel: most_acceleration and half the gauge's turn acceleration."""
    turning_spread: float = 0.0
    """How far a track's turning centre can be from the middle of its range, as its travel shows it."""
    most_turn_acceleration: float = 0.0
    """rad/s^2, about z."""

    def __deepcopy__(self, memo: dict[int, object]) -> "TrackBounds":
        return self


@compiled_bare
def variation(net: Interval, error: float, most_acceleration: float, time: float, loose: float = 0.0) -> float:
    """Upper bound of the integral of |u| over `time`, where the integral of u is in [net] ± error, |du/dt| bounded.

    SMF equation 5: a rate that vanishes inside the step has a net integral of at most a T^2 / 2; if it changes its
    sign, variation - |net| is twice the smaller of the two areas, at most a T^2 / 4.

    loose: u may differ from a rate with that bound by up to loose / T, and jump. Where it vanishes the other is at most
    loose / T, so that |net| <= a T^2 / 2 + 2 loose; and either area is larger than the other's by `loose` at most.
    """
    total = up(mag(net) + error)
    if not runs_one_way(net, error, most_acceleration, time, loose):
        total = up(total + (0.25 * up(up(most_acceleration * time) * time) + 2.0 * loose))
    return total


@compiled_bare
def runs_one_way(net: Interval, error: float, most_acceleration: float, time: float, loose: float = 0.0) -> bool:
    """Is that u sure not to vanish, not even at either end?"""
    square = up(up(most_acceleration * time) * time)
    return down(mig(net) - error) > 0.5 * square + 2.0 * loose


@compiled_bare
def rotate(
    rate: NDArray[np.float64] | Vector3,
    bias: NDArray[np.float64],
    time_low: float,
    time_high: float,
    gap: bool,
    bounds: GyroBounds,
    turned: NDArray[np.float64],
    varied: NDArray[np.float64],
    plain: NDArray[np.float64],
) -> bool:
    """Integrals of the body rates over a step of [time_low, time_high] seconds: intervals `turned` and `varied`.

    rate [3] is the mean body rate of the packet (NaN: axis not measured), bias [3, 2] (drifts on, in place), turned
    [3, 2], varied [3]. With `gap` the packet's mean covers only the last part of the step, P of T seconds: it is the
    rate at some instant s of that part, so the rest of the integral is off by at most the integral of a |s - t|, which
    is a (T^2 - P^2) / 2 or less. False if an axis turns faster than declared.

    plain [5]: the integral of ω_z is in [plain 0, plain 1] - bias * [plain 2, plain 3], plain 4 = largest |bias|; where
    the packet says nothing of it, that is `turned` and no time.
    """
    sound = True
    error = 0.0
    aged = up(bounds.bias_drift * time_high)
    for i in range(3):
        bias[i, 0] = max(down(bias[i, 0] - aged), -bounds.most_bias)
        bias[i, 1] = min(up(bias[i, 1] + aged), bounds.most_bias)
        most = up((bounds.most_rate if i == 2 else min(bounds.most_rate, bounds.most_tilt_rate)) * time_high)
        net = (-most, most)
        told = False
        if rate[i] == rate[i]:
            free = outward_sub(rate[i], bias[i, 0], bias[i, 1])
            true = up(up(mag(free) + bounds.noise) / down(1.0 - bounds.scale))
            error = up(bounds.noise + up(bounds.scale * max(abs(rate[i]), true)))
            if gap:
                error = up(error + up(0.5 * bounds.most_acceleration * time_high))
            measured = meet(mul(widen(free, error), (time_low, time_high)), net)
            if is_empty(measured):
                sound = False
            else:
                net = measured
                told = not gap
        if i == 2:
            plain[0], plain[1] = net
            plain[2] = plain[3] = 0.0
            plain[4] = mag((bias[i, 0], bias[i, 1]))
            if told:
                plain[0], plain[1] = mul(widen((rate[i], rate[i]), error), (time_low, time_high))
                plain[2], plain[3] = time_low, time_high
        turned[i, 0], turned[i, 1] = net
        varied[i] = min(variation(net, 0.0, bounds.most_acceleration, time_high), most)
    return sound


@compiled_bare
def outward_sub(x: float, low: float, high: float) -> Interval:
    """x - [low, high]."""
    return down(x - high), up(x - low)


@compiled_bare
def excursion(roll: Interval, pitch: Interval, varied: NDArray[np.float64], out: NDArray[np.float64]) -> bool:
    """How far each Euler angle can move [3] while the body rates vary by `varied` [3]; False if that is not enclosed.

    Starts (or, time running back, ends) anywhere in (roll, pitch). Picard: while the attitude is inside the box ± V
    its angles vary by no more than F(V); once F(V) <= V it can't have left. Then F(V) is a bound.
    """
    guess = up(2.0 * up(varied[0] + up(varied[1] + varied[2])))
    v0 = guess
    v1 = guess
    if guess > CAREFUL:  # so large that it may be too steep itself: come from below
        v0 = up(1.1 * varied[0])
        v1 = up(1.1 * varied[1])
    for _ in range(24):
        theta = widen(pitch, v1)
        if not mag(theta) < STEEPEST:
            return False
        sin_roll = mag(sine(widen(roll, v0)))
        cos_pitch = down(cosine(theta)[0])
        secant = up(1.0 / cos_pitch)
        tangent = up(mag(sine(theta)) * secant)
        sideways = up(up(sin_roll * varied[1]) + varied[2])
        f0 = up(varied[0] + up(tangent * sideways))
        f1 = up(varied[1] + up(sin_roll * varied[2]))
        if f0 <= v0 and f1 <= v1:
            out[0] = f0
            out[1] = f1
            out[2] = up(secant * sideways)
            return True
        v0 = max(v0, 1.2 * f0)
        v1 = max(v1, 1.2 * f1)
    return False


@compiled_bare
def weighted(f: Interval, net: Interval, varied: float) -> Interval:
    """Integral of f(t) u(t) dt, as in this file's heading."""
    c = mid(f)
    return widen(scale(c, net), up(reach(f, c) * varied))


@compiled_bare
def turn(
    attitude: NDArray[np.float64],
    turned: NDArray[np.float64],
    varied: NDArray[np.float64],
    swing: NDArray[np.float64],
    plain: NDArray[np.float64],
    heading: NDArray[np.float64],
) -> bool:
    """One step of (roll, pitch, yaw, yaw...), attitude [c, 2] in place (SMF equation 1); False if it can't be enclosed.

    Yaw may be counted from several directions: each row from the third on is one, and all change alike. swing [c]: how
    far an angle can go beyond the hull of its two ends inside the step. A path of variation V and net change D leaves
    the hull of its ends by at most (V - |D|) / 2. heading [3] goes on by the same step, see `relative_yaw`; `plain` is
    what `rotate` says.
    """
    roll = (attitude[0, 0], attitude[0, 1])
    pitch = (attitude[1, 0], attitude[1, 1])
    if not excursion(roll, pitch, varied, swing):
        return False
    phi = widen(roll, swing[0])
    theta = widen(pitch, swing[1])
    sf, cf = sine(phi), cosine(phi)
    st, ct = sine(theta), cosine(theta)
    wx = (turned[0, 0], turned[0, 1])
    wy = (turned[1, 0], turned[1, 1])
    wz = (turned[2, 0], turned[2, 1])
    secant_y = divide(sf, ct)
    secant_z = divide(cf, ct)
    droll = add(wx, add(weighted(mul(st, secant_y), wy, varied[1]), weighted(mul(st, secant_z), wz, varied[2])))
    dpitch = add(weighted(cf, wy, varied[1]), weighted(neg(sf), wz, varied[2]))
    sideways = weighted(secant_y, wy, varied[1])
    dyaw = add(sideways, weighted(secant_z, wz, varied[2]))
    step = (droll, dpitch, dyaw)
    swung = swing[2]
    for i in range(len(attitude)):
        attitude[i, 0], attitude[i, 1] = add((attitude[i, 0], attitude[i, 1]), step[min(i, 2)])
        swing[i] = max(0.0, up(0.5 * ((swing[i] if i < 2 else swung) - mig(step[min(i, 2)]))))
    go_on(heading, sideways, secant_z, plain, varied[2])
    return True


@compiled_bare
def go_on(
    heading: NDArray[np.float64], sideways: Interval, secant: Interval, plain: NDArray[np.float64], varied: float
) -> None:
    """heading [3] a step further: yaw changed by [sideways] + integral of [secant] ω_z, with ω_z as `plain` says."""
    c = mid(secant)
    change = widen(add(sideways, scale(c, (plain[0], plain[1]))), up(reach(secant, c) * varied))
    seconds = 0.5 * (plain[2] + plain[3])
    nominal = mid(change)
    error = up(reach(change, nominal) + up(up(abs(c) * up(plain[3] - plain[2])) * plain[4]))
    heading[0] += nominal
    heading[1] -= c * seconds
    rounding = ULP * (abs(heading[0]) + abs(heading[1]) * plain[4])
    heading[2] = up(heading[2] + up(error + 4.0 * rounding))


@compiled_bare
def relative_yaw(of: NDArray[np.float64], to: NDArray[np.float64], bias: Interval) -> Interval:
    """Yaw at one gyro node less yaw at another, from their headings (N, τ, ρ): N + τ bias ± ρ.

    Each is a sum from the beginning (SMF section 7.1): N of the changes as measured, τ of their derivatives with
    respect to the bias of ω_z, ρ of the half-widths of all other errors. `bias` is [b] over all of the time between.
    """
    return widen(add(outward(of[0] - to[0], of[0] - to[0]), scale(of[1] - to[1], bias)), up(abs(of[2] - to[2])))


@compiled_bare
def relative_yaw_between(
    heading: NDArray[np.float64],
    swing: NDArray[np.float64],
    first: int,
    last: int,
    to: NDArray[np.float64],
    bias: Interval,
) -> Interval:
    """Hull of the relative yaw over all that lies between the gyro nodes first..last; headings [n, 3], swing [n, c]."""
    low, high = relative_yaw(heading[first], to, bias)
    before = (low, high)
    for i in range(first + 1, last + 1):
        after = relative_yaw(heading[i], to, bias)
        low = min(low, down(min(before[0], after[0]) - swing[i, 2]))
        high = max(high, up(max(before[1], after[1]) + swing[i, 2]))
        before = after
    return low, high


@compiled_bare
def aged_bias(bias: Interval, drift: float, since_ns: int, now_ns: int) -> Interval:
    """[bias] as it is now, and as it was at any time since then."""
    return widen(bias, up(drift * up((now_ns - since_ns) * 1e-9)))
