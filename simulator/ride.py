"""A tracked body that rides over a surface: the derivatives of its motion, and their integration, as machine code.

The equations are those of simulator/robot.py.
"""

from math import atan, atan2, cos, pi, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from simulator.body_surface import surface_at

Array = NDArray[np.float64]

BOUNCE_LENGTH_M = 0.7
"""The body bounces with this wavelength along the path."""


@compiled
def _curvature(path: Array, s: float) -> float:
    """Of the course after s metres: a weave, and a smooth entry into the circle."""
    u = min(max(s - path[0], 0.0), 1.0)
    curvature: float = path[1] * u**3 * (10.0 - 15.0 * u + 6.0 * u**2) + path[2] * sin(path[3] * s)
    return curvature


@compiled
def _rates(
    sxx: float, sxy: float, syy: float, a: float, b: float, yaw: float, yaw_rate: float, vx: float, vy: float
) -> tuple[float, float, float]:
    """Body rates while base_link moves with world velocity (vx, vy) over the surface.

    (a, b, 1) is the surface's normal turned by -yaw: pitch = atan a, roll = -atan(b / sqrt(1 + a^2)).
    """
    c, s = cos(yaw), sin(yaw)
    slope_x = sxx * vx + sxy * vy
    slope_y = sxy * vx + syy * vy
    a_rate = -(c * slope_x + s * slope_y) + yaw_rate * b
    b_rate = s * slope_x - c * slope_y - yaw_rate * a
    q = sqrt(1.0 + a * a)
    u = b / q
    pitch_rate = a_rate / (q * q)
    roll_rate = -(b_rate / q - b * a * a_rate / q**3) / (1.0 + u * u)
    roll, pitch = -atan(u), atan(a)
    return (
        roll_rate - sin(pitch) * yaw_rate,
        cos(roll) * pitch_rate + sin(roll) * cos(pitch) * yaw_rate,
        -sin(roll) * pitch_rate + cos(roll) * cos(pitch) * yaw_rate,
    )


@compiled
def _motion(
    c: Array,
    x0: float,
    y0: float,
    step: float,
    path: Array,
    state: Array,
    v: float,
    spin: float,
    side: float,
    centre: float,
    normal: float,
    sinks: bool,
    out: Array,
    attitude: Array,
) -> None:
    """Derivatives of the state [travelled, x, y, z, yaw, three turned angles]; roll and pitch into `attitude`."""
    yaw = state[4]
    _, sx, sy, sxx, sxy, syy = surface_at(c, x0, y0, step, state[1], state[2])
    cy, sn = cos(yaw), sin(yaw)
    a = -(cy * sx + sn * sy)
    b = sn * sx - cy * sy
    pitch = atan(a)
    roll = -atan2(b, sqrt(1.0 + a * a))
    cp, sp, cr, sr = cos(pitch), sin(pitch), cos(roll), sin(roll)
    yaw_rate = _curvature(path, state[0]) * v + spin
    v_n = normal * v * (1.0 if sinks else sin(2.0 * pi / BOUNCE_LENGTH_M * state[0]))
    forward_x = cy * cp * v + (cy * sp * cr + sn * sr) * v_n
    forward_y = sn * cp * v + (sn * sp * cr - cy * sr) * v_n
    left_x = cy * sp * sr - sn * cr
    left_y = sn * sp * sr + cy * cr
    # The side slip depends on the turn rate (turning centre) and the turn rate, on a bent surface, on the side slip:
    # both are linear in it.
    _, _, turn = _rates(sxx, sxy, syy, a, b, yaw, yaw_rate, forward_x, forward_y)
    _, _, turn_with_unit = _rates(sxx, sxy, syy, a, b, yaw, yaw_rate, forward_x + left_x, forward_y + left_y)
    v_l = (side * v + centre * turn) / (1.0 - centre * (turn_with_unit - turn))
    vx = forward_x + left_x * v_l
    vy = forward_y + left_y * v_l
    wx, wy, wz = _rates(sxx, sxy, syy, a, b, yaw, yaw_rate, vx, vy)
    out[0] = v
    out[1] = vx
    out[2] = vy
    out[3] = -sp * v + cp * sr * v_l + cp * cr * v_n
    out[4] = yaw_rate
    out[5] = wx
    out[6] = wy
    out[7] = wz
    attitude[0] = roll
    attitude[1] = pitch


@compiled
def integrate(
    c: Array,
    x0: float,
    y0: float,
    step: float,
    start: Array,
    path: Array,
    v: Array,
    spin: Array,
    side: Array,
    centre: Array,
    normal: Array,
    sinks: bool,
    pose: Array,
    turned: Array,
    rate: Array,
    velocity: Array,
    travelled: Array,
) -> None:
    """Runge-Kutta 4 with steps of 1 ms; v, spin, side, centre and normal are given every half step.

    Element by element: whole-array statements would make this eight times slower to compile.
    """
    h = 1e-3
    state, trial, slope, total = np.zeros(8), np.zeros(8), np.zeros(8), np.zeros(8)
    attitude = np.zeros(2)
    for k in range(4):
        state[1 + k] = start[k]
    count = pose.shape[0]
    for i in range(count):
        for stage in range(4):
            m = min(2 * i + (stage + 1) // 2, 2 * count - 2)
            ahead = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
            for k in range(8):
                trial[k] = state[k] + ahead * slope[k]
            _motion(
                c, x0, y0, step, path, trial, v[m], spin[m], side[m], centre[m], normal[m], sinks, slope, attitude
            )  # fmt: skip
            if stage == 0:
                for k in range(3):
                    pose[i, k] = state[1 + k]
                    turned[i, k] = state[5 + k]
                    rate[i, k] = slope[5 + k]
                    velocity[i, k] = slope[1 + k]
                pose[i, 3], pose[i, 4], pose[i, 5] = attitude[0], attitude[1], state[4]
                travelled[i, 0] = state[0]
            weight = h / 6.0 if stage in (0, 3) else h / 3.0
            for k in range(8):
                total[k] = (total[k] if stage > 0 else 0.0) + weight * slope[k]
        for k in range(8):
            state[k] += total[k]
