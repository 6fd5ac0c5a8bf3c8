"""How far base_link has come since an instant known as an interval (SMF equation 26, with the signs kept)."""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from estimator.frames import turned
from estimator.interval import Interval, cosine, down, hull, mag, meet, mig, sine, up, widen
from estimator.motion import relative_yaw


@compiled
def travelled_since(
    net: NDArray[np.float64], swing: NDArray[np.float64], first: int, last: int, newest: int
) -> NDArray[np.float64]:
    """[3, 2] p(newest) - p(τ) for any τ between the nodes `first` and `last`; net [n, 3, 2], swing [n, >= 3] per step.

    From `last` on by the net displacements; between the two by their variation: a path that varies by V and comes
    D far leaves the hull of its ends by at most (V - |D|) / 2.
    """
    out = np.zeros((3, 2))
    for c in range(3):
        total = (0.0, 0.0)
        variation = 0.0
        for k in range(first + 1, last + 1):
            step = (net[k, c, 0], net[k, c, 1])
            total = (down(total[0] + step[0]), up(total[1] + step[1]))
            variation = up(variation + up(2.0 * swing[k, c] + mig(step)))
        total = meet(total, (-variation, variation))
        inside = widen(hull((0.0, 0.0), total), up(0.5 * max(0.0, variation - mig(total))))
        for k in range(last + 1, newest + 1):
            inside = (down(inside[0] + net[k, c, 0]), up(inside[1] + net[k, c, 1]))
        out[c, 0], out[c, 1] = inside
    return out


@compiled
def travelled_along(
    heading: NDArray[np.float64],
    bias: Interval,
    step_heading: NDArray[np.float64],
    local: NDArray[np.float64],
    first: int,
    last: int,
    newest: int,
) -> NDArray[np.float64]:
    """The same seen along `heading` [3]: each step's local (low, high, swing) [n, 3, 3] is turned from its own."""
    count = newest - first
    net = np.zeros((count + 1, 3, 2))
    swing = np.zeros((count + 1, 3))
    for k in range(1, count + 1):
        step = local[first + k]
        yaw = relative_yaw(step_heading[first + k], heading, bias)
        x, y = turned(yaw, (step[0, 0], step[0, 1]), (step[1, 0], step[1, 1]))
        c, s = mag(cosine(yaw)), mag(sine(yaw))
        vx = up(2.0 * step[0, 2] + mig((step[0, 0], step[0, 1])))
        vy = up(2.0 * step[1, 2] + mig((step[1, 0], step[1, 1])))
        net[k, 0, 0], net[k, 0, 1] = x
        net[k, 1, 0], net[k, 1, 1] = y
        net[k, 2, 0], net[k, 2, 1] = step[2, 0], step[2, 1]
        swing[k, 0] = max(0.0, up(0.5 * up(up(up(c * vx) + up(s * vy)) - mig(x))))
        swing[k, 1] = max(0.0, up(0.5 * up(up(up(s * vx) + up(c * vy)) - mig(y))))
        swing[k, 2] = step[2, 2]
    return travelled_since(net, swing, 0, last - first, count)
