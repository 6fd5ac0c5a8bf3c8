"""The sliding window: what fixes of the last stretch of the way say of yaw and position now (SMF section 7).

Between remembered fixes lie blocks of preintegrated odometry, each in the yaw frame of its start, so that they need
nothing of yaw and position themselves. Chained backwards from now they give, for each remembered fix j,

    p - A_j  in  Rz(ψ) (Q_j + B_j (b - b_c) ± R_j)

with p base_link now, A_j the antenna then, ψ yaw on Earth now and b the gyro's bias: no linearisation in ψ. And A_j is
in the box of its fix. `narrowed` cuts ψ by the directions of A_k - A_j, then paves what is left of ψ with cells.
"""

from math import atan, atan2, cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.interval import Interval, down, is_empty, mid, norm, reach, up
from estimator.observations import nearest_copy

MOST_FIXES = 60
"""SMF section 13."""
CELLS = 16
ROUNDING = 1e-12
"""Relative: sums below of fewer than 10^4 products of numbers as large as the whole way."""
LEAST_SPACING_M, MOST_SPACING_M = 0.4, 2.0
"""Fixes are remembered as far apart as their own bound, within these."""


class GpsWindow:
    """Remembered fixes and the blocks between them; the last block is open and ends now."""

    def __init__(self, bias_drift: float) -> None:
        self._drift = bias_drift
        self.count = 0
        shape = (MOST_FIXES + 1,)
        self._antenna = np.zeros((*shape, 2, 2))
        self._offset = np.zeros((*shape, 2, 2))
        self._heading = np.zeros((*shape, 3))
        self._seconds = np.zeros(shape)
        self._way, self._by_bias, self._error = np.zeros((*shape, 2)), np.zeros((*shape, 2)), np.zeros((*shape, 2))
        self._bias = np.zeros(shape)
        self._path = np.zeros(shape)
        self._last = np.full(4, np.nan)
        """Axis of the last step, and its heading's τ and ρ, in the open block; NaN before its first."""

    def clear(self) -> None:
        """Forget all fixes."""
        self.count = 0

    def extend(
        self,
        step: NDArray[np.float64],
        axis: NDArray[np.float64],
        heading: NDArray[np.float64],
        quantum: float,
        bias: NDArray[np.float64],
        now_s: float,
    ) -> None:
        """The open block goes on by one step: its box [3, 2] and its middle axis [3], along the step's heading."""
        if self.count:
            extend_block(
                self.count - 1, step, axis, heading, quantum, bias, self._drift, now_s, self._heading, self._seconds,
                self._bias, self._last, self._way, self._by_bias, self._error, self._path,
            )  # fmt: skip

    def narrowed(
        self,
        antenna: NDArray[np.float64],
        offset: NDArray[np.float64],
        heading: NDArray[np.float64],
        seconds: tuple[float, float],
        bias: NDArray[np.float64],
        quantum: float,
        yaw: NDArray[np.float64],
        place: NDArray[np.float64],
    ) -> bool:
        """Contract yaw [2] (of the gyro node with `heading`) and place [2, 2] (of base_link) on Earth, now.

        antenna [2, 2] is the newest fix's box (east, north), offset [2, 2] where that antenna was from base_link, along
        the heading; seconds: of that gyro node, earliest and latest. False if nothing is left: some bound is broken.
        """
        k = self.count
        self._antenna[k], self._offset[k], self._heading[k], self._seconds[k] = antenna, offset, heading, seconds[0]
        return contract_by_window(
            k, self._antenna, self._offset, self._heading, self._seconds, self._way, self._by_bias, self._error,
            self._bias, seconds[1], quantum, bias, self._drift, yaw, place,
        )  # fmt: skip

    def remember(self, bias: NDArray[np.float64], slack: float, quantum: float) -> None:
        """Keep the fix last given to `narrowed`, if the way since the last one kept is long enough."""
        k = self.count
        box = self._antenna[k]
        spacing = min(max(0.5 * float(np.max(box[:, 1] - box[:, 0])), LEAST_SPACING_M), MOST_SPACING_M)
        if k and self._path[k - 1] < spacing:
            return
        if k == MOST_FIXES:
            self._let_go_of_the_oldest()
        self._begin_block(bias, slack, quantum)

    def _let_go_of_the_oldest(self) -> None:
        """Make room for one more fix."""
        for kept in (
            self._antenna, self._offset, self._heading, self._seconds, self._way, self._by_bias, self._error,
            self._bias, self._path,
        ):  # fmt: skip
            kept[:-1] = kept[1:]
        self.count -= 1

    def _begin_block(self, bias: NDArray[np.float64], slack: float, quantum: float) -> None:
        """The open block ends, and one begins at the fix last given to `narrowed`."""
        k = self.count
        if k:
            self._error[k - 1] = up(self._error[k - 1, 0] + quantum), up(self._error[k - 1, 1] + quantum)
        self._way[k] = self._by_bias[k] = self._path[k] = 0.0
        self._error[k] = slack
        self._bias[k] = 0.5 * (bias[0] + bias[1])
        self._last[:] = np.nan
        self.count = k + 1


@compiled
def extend_block(
    k: int,
    step: NDArray[np.float64],
    axis: NDArray[np.float64],
    heading: NDArray[np.float64],
    quantum: float,
    bias: NDArray[np.float64],
    drift: float,
    now_s: float,
    starts: NDArray[np.float64],
    seconds: NDArray[np.float64],
    references: NDArray[np.float64],
    last: NDArray[np.float64],
    ways: NDArray[np.float64],
    by_biases: NDArray[np.float64],
    errors: NDArray[np.float64],
    paths: NDArray[np.float64],
) -> None:
    """SMF equation 19: block k, way + by_bias (b - reference) ± error in the yaw frame of its start, a step longer.

    The step's heading is that of the block turned by α + τ (b - reference) + ν, |ν| <= ρ, with b the bias now; since
    the block's start it drifted by no more than `drift` a second. The error of the count telescopes as in
    motion.travel: a quantum for each change of the axis.
    """
    start, reference, way, by_bias, error = starts[k], references[k], ways[k], by_biases[k], errors[k]
    aged = up(drift * up(now_s - seconds[k]))
    tau = heading[1] - start[1]
    rho = up(up(abs(heading[2] - start[2])) + up(abs(tau) * aged))
    alpha = heading[0] - start[0] + tau * reference
    h = reach((bias[0], bias[1]), reference)
    spread = up(up(abs(tau) * h) + rho)
    c, s = cos(alpha), sin(alpha)
    dx, dy = mid((step[0, 0], step[0, 1])), mid((step[1, 0], step[1, 1]))
    rx, ry = reach((step[0, 0], step[0, 1]), dx), reach((step[1, 0], step[1, 1]), dy)
    ux, uy = c * dx - s * dy, s * dx + c * dy
    tx, ty = abs(c) * rx + abs(s) * ry, abs(s) * rx + abs(c) * ry
    if spread < 1.0:
        bend, twist = 0.5 * spread * spread, spread * spread * spread / 6.0
        way[0] += ux
        way[1] += uy
        by_bias[0] -= tau * uy
        by_bias[1] += tau * ux
        tx, ty = tx + spread * ty, ty + spread * tx
        error[0] += tx + rho * abs(uy) + bend * abs(ux) + twist * abs(uy)
        error[1] += ty + rho * abs(ux) + bend * abs(uy) + twist * abs(ux)
    else:
        most = norm((step[0, 0], step[0, 1]), (step[1, 0], step[1, 1]))
        error[0] += most
        error[1] += most
    ax, ay = c * axis[0] - s * axis[1], s * axis[0] + c * axis[1]
    if last[0] == last[0]:
        turned = abs(tau - last[2]) * h + abs(rho - last[3])
        bent = 1.001 * quantum * (sqrt((ax - last[0]) ** 2 + (ay - last[1]) ** 2) + turned)
        error[0] += bent
        error[1] += bent
    last[0], last[1], last[2], last[3] = ax, ay, tau, rho
    paths[k] += sqrt(dx * dx + dy * dy)
    rounding = ROUNDING * (abs(way[0]) + abs(way[1]) + paths[k] + 1e-3)
    error[0] += rounding
    error[1] += rounding


@compiled
def chain(
    count: int,
    offset: NDArray[np.float64],
    heading: NDArray[np.float64],
    seconds: NDArray[np.float64],
    way: NDArray[np.float64],
    by_bias: NDArray[np.float64],
    error: NDArray[np.float64],
    reference: NDArray[np.float64],
    now_s: float,
    quantum: float,
    bias: NDArray[np.float64],
    drift: float,
    q: NDArray[np.float64],
    slope: NDArray[np.float64],
    half: NDArray[np.float64],
) -> None:
    """SMF equations 20 and 21: for each remembered fix the Q, B and R of this file's heading, [count + 1, 2] each.

    The last row is that of the newest fix. A vector u turned by η = τ (b - b_c) + ν, |η| <= D, is in
    u (1 - κ/2) + η J u ± (κ/2 |u| + D^3/6 |J u|), κ = D^2/2; the errors ν of the blocks turn all that is older.
    """
    b = 0.5 * (bias[0] + bias[1])
    h = reach((bias[0], bias[1]), b)
    noise = np.empty(count)
    before = np.empty((count, 2))
    w = np.zeros(2)
    centre = np.zeros(2)
    slopes = np.zeros(2)
    box = np.zeros(2)
    turned = np.zeros(8)
    total = 0.0
    length = 0.0
    known = True
    q[count, 0], q[count, 1] = (
        -mid((offset[count, 0, 0], offset[count, 0, 1])),
        -mid((offset[count, 1, 0], offset[count, 1, 1])),
    )
    for c in range(2):
        slope[count, c] = 0.0
        half[count, c] = up(reach((offset[count, c, 0], offset[count, c, 1]), -q[count, c]) + ROUNDING)
    for i in range(count - 1, -1, -1):
        tau = heading[i, 1] - heading[count, 1]
        aged = up(drift * up(now_s - seconds[i]))
        rho = up(abs(heading[i + 1, 2] - heading[i, 2])) + abs(heading[i + 1, 1] - heading[i, 1]) * aged
        noise[i] = rho
        before[i] = w
        total = up(total + up(rho * 1.000001))
        spread = up(abs(tau) * h + total)
        known = known and spread < 1.0
        angle = heading[i, 0] - heading[count, 0] + tau * b
        shift = b - reference[i]
        dx, dy = way[i, 0] + by_bias[i, 0] * shift, way[i, 1] + by_bias[i, 1] * shift
        last = quantum if i == count - 1 else 0.0
        turn_block(
            angle, tau, spread, h, dx, dy, by_bias[i, 0], by_bias[i, 1],
            error[i, 0] + last + abs(by_bias[i, 0]) * aged, error[i, 1] + last + abs(by_bias[i, 1]) * aged, turned,
        )  # fmt: skip
        w += turned[:2]
        centre += turned[2:4]
        slopes += turned[4:6]
        box += turned[6:8]
        length += abs(dx) + abs(dy)
        ox, oy = mid((offset[i, 0, 0], offset[i, 0, 1])), mid((offset[i, 1, 0], offset[i, 1, 1]))
        turn_block(
            angle, tau, spread, h, ox, oy, 0.0, 0.0, reach((offset[i, 0, 0], offset[i, 0, 1]), ox),
            reach((offset[i, 1, 0], offset[i, 1, 1]), oy), turned,
        )  # fmt: skip
        rx, ry = box[0] + turned[6], box[1] + turned[7]
        for k in range(i, count):
            rx += noise[k] * abs(w[1] - before[k, 1] - turned[1])
            ry += noise[k] * abs(w[0] - before[k, 0] - turned[0])
        slack = ROUNDING * (length + 1.0 + rx + ry)
        for c in range(2):
            q[i, c] = centre[c] - turned[2 + c]
            slope[i, c] = slopes[c] - turned[4 + c]
        half[i, 0], half[i, 1] = rx + slack, ry + slack
        if not known:
            half[i, 0] = half[i, 1] = np.inf


@compiled
def turn_block(
    angle: float,
    tau: float,
    spread: float,
    h: float,
    dx: float,
    dy: float,
    gx: float,
    gy: float,
    ex: float,
    ey: float,
    out: NDArray[np.float64],
) -> None:
    """A block d + g (b - b_c) ± e turned by angle + η, see `chain`. out [8]: u, centre, slope in b, rest."""
    c, s = cos(angle), sin(angle)
    ux, uy = c * dx - s * dy, s * dx + c * dy
    px, py = c * gx - s * gy, s * gx + c * gy
    kappa, twist = 0.5 * spread * spread, spread * spread * spread / 6.0
    rx, ry = abs(c) * ex + abs(s) * ey, abs(s) * ex + abs(c) * ey
    bx, by = abs(px) * h, abs(py) * h
    out[0], out[1] = ux, uy
    out[2], out[3] = ux * (1.0 - 0.5 * kappa), uy * (1.0 - 0.5 * kappa)
    out[4], out[5] = px - tau * uy, py + tau * ux
    out[6] = rx + spread * ry + 0.5 * kappa * abs(ux) + twist * abs(uy) + kappa * bx + spread * by
    out[7] = ry + spread * rx + 0.5 * kappa * abs(uy) + twist * abs(ux) + kappa * by + spread * bx


@compiled
def contract_by_window(
    count: int,
    antenna: NDArray[np.float64],
    offset: NDArray[np.float64],
    heading: NDArray[np.float64],
    seconds: NDArray[np.float64],
    way: NDArray[np.float64],
    by_bias: NDArray[np.float64],
    error: NDArray[np.float64],
    reference: NDArray[np.float64],
    now_s: float,
    quantum: float,
    bias: NDArray[np.float64],
    drift: float,
    yaw: NDArray[np.float64],
    place: NDArray[np.float64],
) -> bool:
    """Chain, cut, pave; see GpsWindow.narrowed."""
    q, slope, half = np.empty((count + 1, 2)), np.empty((count + 1, 2)), np.empty((count + 1, 2))
    chain(count, offset, heading, seconds, way, by_bias, error, reference, now_s, quantum, bias, drift, q, slope, half)
    h = reach((bias[0], bias[1]), 0.5 * (bias[0] + bias[1]))
    psi = (yaw[0], yaw[1])
    for j in range(count):
        seen = yaw_by_displacement(antenna[count], antenna[j], q[j] - q[count], slope[j] * h, half[j] + half[count])
        if not is_empty(seen):
            psi = nearest_copy(psi, seen)
            if is_empty(psi):
                return False
    yaw[0], yaw[1] = psi
    for _ in range(3):
        width = yaw[1] - yaw[0]
        if not pave(count, antenna, q, slope, half, h, yaw, place):
            return False
        if yaw[1] - yaw[0] > 0.9 * width:
            break
    return True


@compiled
def yaw_by_displacement(
    newer: NDArray[np.float64],
    older: NDArray[np.float64],
    q: NDArray[np.float64],
    by_bias: NDArray[np.float64],
    half: NDArray[np.float64],
) -> Interval:
    """SMF equation 22: yaw from the way between two fixes and the same way by odometry; empty where they are too near.

    A vector g with error g_∥ along itself and g_⊥ across is off its direction by no more than atan(g_⊥ / (|g| - g_∥)).
    """
    gx = mid((newer[0, 0], newer[0, 1])) - mid((older[0, 0], older[0, 1]))
    gy = mid((newer[1, 0], newer[1, 1])) - mid((older[1, 0], older[1, 1]))
    ex = reach((down(newer[0, 0] - older[0, 1]), up(newer[0, 1] - older[0, 0])), gx)
    ey = reach((down(newer[1, 0] - older[1, 1]), up(newer[1, 1] - older[1, 0])), gy)
    far = sqrt(gx * gx + gy * gy)
    long = sqrt(q[0] * q[0] + q[1] * q[1])
    if not (far > 1e-6 and long > 1e-6):
        return 1.0, -1.0
    tx, ty = abs(gx) / far, abs(gy) / far
    ux, uy = abs(q[0]) / long, abs(q[1]) / long
    along, across = ex * tx + ey * ty, ex * ty + ey * tx
    own_along = abs(by_bias[0] * q[0] + by_bias[1] * q[1]) / long + half[0] * ux + half[1] * uy
    own_across = abs(by_bias[1] * q[0] - by_bias[0] * q[1]) / long + half[0] * uy + half[1] * ux
    if not (far > 1.000001 * along and long > 1.000001 * own_along):
        return 1.0, -1.0
    off = atan(across / (far - along)) + atan(own_across / (long - own_along))
    off = off * (1.0 + 1e-9) + 1e-12
    angle = atan2(gy, gx) - atan2(q[1], q[0])
    return angle - off, angle + off


@compiled
def pave(
    count: int,
    antenna: NDArray[np.float64],
    q: NDArray[np.float64],
    slope: NDArray[np.float64],
    half: NDArray[np.float64],
    h: float,
    yaw: NDArray[np.float64],
    place: NDArray[np.float64],
) -> bool:
    """SMF equation 23 on cells of yaw: the hull of those that contradict no fix, and of their places; False if none."""
    width = (yaw[1] - yaw[0]) / CELLS
    low, high = np.inf, -np.inf
    hull = np.array([[np.inf, -np.inf], [np.inf, -np.inf]])
    for cell in range(CELLS):
        first = yaw[0] if cell == 0 else yaw[0] + cell * width
        last = yaw[1] if cell == CELLS - 1 else yaw[0] + (cell + 1) * width
        psi = mid((first, last))
        w = reach((first, last), psi)
        c, s = cos(psi), sin(psi)
        kappa = min(0.5 * w * w, 2.0)
        x_low, x_high, y_low, y_high = place[0, 0], place[0, 1], place[1, 0], place[1, 1]
        for j in range(count, -1, -1):
            if not half[j, 0] < np.inf:
                break
            ux, uy = c * q[j, 0] - s * q[j, 1], s * q[j, 0] + c * q[j, 1]
            fx = abs(c * slope[j, 0] - s * slope[j, 1]) * h + abs(c) * half[j, 0] + abs(s) * half[j, 1]
            fy = abs(s * slope[j, 0] + c * slope[j, 1]) * h + abs(s) * half[j, 0] + abs(c) * half[j, 1]
            rx = w * abs(uy) + 0.5 * kappa * abs(ux) + fx + w * fy
            ry = w * abs(ux) + 0.5 * kappa * abs(uy) + fy + w * fx
            ux *= 1.0 - 0.5 * kappa
            uy *= 1.0 - 0.5 * kappa
            slack = ROUNDING * (abs(ux) + abs(uy) + rx + ry + 1.0)
            rx += slack
            ry += slack
            x_low = max(x_low, down(antenna[j, 0, 0] + (ux - rx)))
            x_high = min(x_high, up(antenna[j, 0, 1] + (ux + rx)))
            y_low = max(y_low, down(antenna[j, 1, 0] + (uy - ry)))
            y_high = min(y_high, up(antenna[j, 1, 1] + (uy + ry)))
            if x_low > x_high or y_low > y_high:
                break
        if x_low <= x_high and y_low <= y_high:
            low, high = min(low, first), max(high, last)
            hull[0, 0], hull[0, 1] = min(hull[0, 0], x_low), max(hull[0, 1], x_high)
            hull[1, 0], hull[1, 1] = min(hull[1, 0], y_low), max(hull[1, 1], y_high)
    if not low <= high:
        return False
    yaw[0], yaw[1] = low, high
    place[:] = hull
    return True
