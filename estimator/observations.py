"""What a measurement says about the state: contractors (SMF section 6). Each returns False where nothing is left.

A contractor removes only values that contradict the measurement's bounds; on False its caller drops the result.
"""

from math import pi

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled, compiled_bare
from estimator.frames import columns, turned
from estimator.interval import (
    TURN,
    Interval,
    add,
    arcsine,
    cosine,
    direction,
    divide,
    hull,
    is_empty,
    meet,
    mid,
    neg,
    reach,
    scale,
    sub,
    widen,
)
from estimator.motion import excursion

QUARTER = 0.5 * pi + 1e-15
GRAVITY: Interval = (9.76, 9.84)
"""m/s^2: at sea level from the equator to the poles, and up to 5000 m."""


@compiled_bare
def accelerometer_tilt(
    ahead: float, left: float, error: float, pitch: Interval, gravity: Interval
) -> tuple[Interval, Interval]:
    """Roll and pitch from specific forces (SMF equation 17): f_x = -g sθ, f_y = g cθ sφ, each ± error; NaN: absent.

    `pitch` is what is known of the pitch before. |roll| and |pitch| are taken to be at most 90 degrees.
    """
    theta = (-QUARTER, QUARTER)
    phi = (-QUARTER, QUARTER)
    if ahead == ahead:
        theta = arcsine(neg(divide(widen((ahead, ahead), error), gravity)))
    both = meet(theta, pitch)
    if left == left and not is_empty(both):
        ct = cosine(both)
        if ct[0] > 1e-3:
            phi = arcsine(divide(divide(widen((left, left), error), gravity), ct))
    return phi, theta


@compiled_bare
def contract_tilt(
    attitude: NDArray[np.float64],
    known: bool,
    tilt_roll: float,
    tilt_pitch: float,
    tilt_error: float,
    ahead: float,
    left: float,
    accel_error: float,
    varied: NDArray[np.float64],
    moved: NDArray[np.float64],
) -> int:
    """Contract roll and pitch of attitude [3, 2] in place by a reading from a little before; NaN: not measured.

    Since the reading the body rates varied by at most `varied` [3], so the angles moved no further than their excursion
    (moved [3]): from the attitude's own box back in time where that is `known`, else from the reading on.
    Returns 0: done; 1: it contradicts the box, which stays; 2: it says too little to begin with.
    """
    roll = (attitude[0, 0], attitude[0, 1])
    pitch = (attitude[1, 0], attitude[1, 1])
    known = known and excursion(roll, pitch, varied, moved)
    phi = (-QUARTER, QUARTER)
    theta = (-QUARTER, QUARTER)
    if tilt_roll == tilt_roll:
        phi = meet(phi, widen((tilt_roll, tilt_roll), tilt_error))
    if tilt_pitch == tilt_pitch:
        theta = meet(theta, widen((tilt_pitch, tilt_pitch), tilt_error))
    if ahead == ahead or left == left:
        before = meet(theta, widen(pitch, moved[1])) if known else theta
        seen_roll, seen_pitch = accelerometer_tilt(ahead, left, accel_error, before, GRAVITY)
        phi = meet(phi, seen_roll)
        theta = meet(theta, seen_pitch)
    if is_empty(phi) or is_empty(theta):
        return 1
    if not known and not excursion(phi, theta, varied, moved):
        return 2
    phi = meet(roll, widen(phi, moved[0]))
    theta = meet(pitch, widen(theta, moved[1]))
    if is_empty(phi) or is_empty(theta):
        return 1
    attitude[0, 0], attitude[0, 1] = phi
    attitude[1, 0], attitude[1, 1] = theta
    return 0


@compiled
def lever(attitude: NDArray[np.float64], arm: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """R(attitude) arm, [3, 2] outer: where a point of the robot is from base_link, along the map's axes."""
    box = (
        (attitude[0, 0], attitude[0, 1]),
        (attitude[1, 0], attitude[1, 1]),
        (attitude[2, 0], attitude[2, 1]),
    )
    one, two, three = columns(box)
    for i in range(3):
        out[i, 0], out[i, 1] = add(scale(arm[0], one[i]), add(scale(arm[1], two[i]), scale(arm[2], three[i])))


TWO_PI = 6.283185307179586, 6.283185307179587


@compiled
def nearest_copy(angle: Interval, measured: Interval) -> Interval:
    """[angle] intersected with [measured] + 2 pi n for every n that can meet it: the hull of what they leave.

    [angle] at least a full turn wide is unknown: then the copy nearest its middle is taken, which names the turn.
    """
    centre = mid(angle)
    width = reach(angle, centre)
    copy = mid(measured)
    spread = reach(measured, copy)
    turns = round((centre - copy) / TURN)
    shifted = add(measured, scale(turns, TWO_PI))
    if width >= pi:
        return shifted if spread < 3.0 else angle
    if spread >= 3.14:
        return angle
    seen = meet(angle, shifted)
    if width + spread >= 3.14:
        for neighbour in (turns - 1, turns + 1):
            other = meet(angle, add(measured, scale(neighbour, TWO_PI)))
            if not is_empty(other):
                seen = other if is_empty(seen) else hull(seen, other)
    return seen


@compiled
def anchored(antenna: NDArray[np.float64], anchor: NDArray[np.float64], point: NDArray[np.float64]) -> bool:
    """Contract anchor [4, 2] (east, north, up, yaw) and point [3, 2] (map) by antenna = t + Rz(Ψ) point (HC4).

    antenna [3, 2] in ENU. Forward: W = antenna - t meets Rz(Ψ) u; backward: t, u, and Ψ = atan2(W) - atan2(u) where
    both boxes leave out the origin. Repeated while each narrows the others, thrice at most.
    """
    for _ in range(3):
        psi = (anchor[3, 0], anchor[3, 1])
        x = (point[0, 0], point[0, 1])
        y = (point[1, 0], point[1, 1])
        east = (anchor[0, 0], anchor[0, 1])
        north = (anchor[1, 0], anchor[1, 1])
        rx, ry = turned(psi, x, y)
        wx = meet(sub((antenna[0, 0], antenna[0, 1]), east), rx)
        wy = meet(sub((antenna[1, 0], antenna[1, 1]), north), ry)
        if is_empty(wx) or is_empty(wy):
            return False
        east = meet(east, sub((antenna[0, 0], antenna[0, 1]), wx))
        north = meet(north, sub((antenna[1, 0], antenna[1, 1]), wy))
        bx, by = turned(neg(psi), wx, wy)
        x = meet(x, bx)
        y = meet(y, by)
        if is_empty(x) or is_empty(y) or is_empty(east) or is_empty(north):
            return False
        seen = direction(wx, wy)
        own = direction(x, y)
        if not is_empty(seen) and not is_empty(own):
            psi = nearest_copy(psi, sub(seen, own))
            if is_empty(psi):
                return False
        same = equal(x, point[0]) and equal(y, point[1]) and equal(psi, anchor[3])
        if same and equal(east, anchor[0]) and equal(north, anchor[1]):
            break
        point[0, 0], point[0, 1] = x
        point[1, 0], point[1, 1] = y
        anchor[0, 0], anchor[0, 1] = east
        anchor[1, 0], anchor[1, 1] = north
        anchor[3, 0], anchor[3, 1] = psi
    # heights don't turn
    height = (antenna[2, 0], antenna[2, 1])
    z = (point[2, 0], point[2, 1])
    t = (anchor[2, 0], anchor[2, 1])
    z_new = meet(z, sub(height, t))
    t_new = meet(t, sub(height, z))
    if is_empty(z_new) or is_empty(t_new):
        return False
    point[2, 0], point[2, 1] = z_new
    anchor[2, 0], anchor[2, 1] = t_new
    return True


@compiled
def equal(a: Interval, b: NDArray[np.float64]) -> bool:
    """Are both ends the same?"""
    return bool(a[0] == b[0] and a[1] == b[1])


@compiled
def anchored_by_all(
    antennas: NDArray[np.float64], points: NDArray[np.float64], count: int, anchor: NDArray[np.float64]
) -> bool:
    """`anchored` by each of the first `count` remembered fixes (antennas, points [k, 3, 2]).

    What an early fix says of t is of use only when later ones have narrowed Ψ.
    """
    agree = True
    for i in range(count):
        agree = agree and anchored(antennas[i], anchor, points[i])
    return agree


@compiled
def tied(anchor: NDArray[np.float64], yaws: NDArray[np.float64], box: NDArray[np.float64]) -> bool:
    """Contract anchor [4, 2], yaws [2, 2] and box [6, 2] (each in the map, then on Earth) by each other.

    The pose on Earth is the anchor's times the pose in the map: p_E = t + Rz(Ψ) p, ψ_E = Ψ + ψ.
    """
    own, earth = (yaws[0, 0], yaws[0, 1]), (yaws[1, 0], yaws[1, 1])
    psi = nearest_copy((anchor[3, 0], anchor[3, 1]), sub(earth, own))
    if is_empty(psi):
        return False
    anchor[3, 0], anchor[3, 1] = psi
    if not anchored(box[3:], anchor, box[:3]):
        return False
    psi = (anchor[3, 0], anchor[3, 1])
    earth = nearest_copy(earth, add(psi, own))
    own = nearest_copy(own, sub(earth, psi))
    if is_empty(own) or is_empty(earth):
        return False
    yaws[0, 0], yaws[0, 1] = own
    yaws[1, 0], yaws[1, 1] = earth
    # the other way round: the place on Earth from that in the map
    x, y = turned(psi, (box[0, 0], box[0, 1]), (box[1, 0], box[1, 1]))
    moved = (x, y, (box[2, 0], box[2, 1]))
    for c in range(3):
        seen = meet((box[3 + c, 0], box[3 + c, 1]), add((anchor[c, 0], anchor[c, 1]), moved[c]))
        if is_empty(seen):
            return False
        box[3 + c, 0], box[3 + c, 1] = seen
    return True
