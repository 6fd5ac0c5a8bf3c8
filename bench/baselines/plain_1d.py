"""The maps over one horizontal dimension as anyone would write them, reading by reading, with the library's erf.

They are what the fast forms are held against, and show what those gained. Cells are plain sequences of numbers: lists
for the interpreter, arrays for the compiler. Equations as in the fast forms.
"""

from collections.abc import MutableSequence, Sequence
from math import cos, erf, floor, inf, sin, sqrt

Numbers = Sequence[float]
Cells = MutableSequence[float]


def mixture(
    x: Numbers,
    pitch: Numbers,
    ranges: Numbers,
    sigma: Numbers,
    height_m: float,
    width_m: float,
    first_cell: int,
    s0: Cells,
    s1: Cells,
    s2: Cells,
) -> None:
    """Equations (5) to (8), each cell border's Φ once."""
    var_x, var_pitch, var_range = sigma[0] ** 2, sigma[1] ** 2, sigma[2] ** 2
    for n in range(len(x)):
        r, c, s = ranges[n], cos(pitch[n]), sin(pitch[n])
        X, Z = x[n] + r * c, height_m + r * s
        Pxx = var_x + c * c * var_range + (r * s) ** 2 * var_pitch
        Pxz = c * s * (var_range - r * r * var_pitch)
        Pzz = s * s * var_range + (r * c) ** 2 * var_pitch
        sd, gain = sqrt(Pxx), Pxz / Pxx
        variance = Pzz - gain * Pxz
        first, last = floor((X - 3.0 * sd) / width_m + 0.5), floor((X + 3.0 * sd) / width_m + 0.5)
        below = 0.5 + 0.5 * erf(((first - 0.5) * width_m - X) / sd * 0.7071067811865476)
        for j in range(first, last + 1):
            up_to = 0.5 + 0.5 * erf(((j + 0.5) * width_m - X) / sd * 0.7071067811865476)
            p, u = up_to - below, Z + gain * (j * width_m - X)
            below = up_to
            s0[j - first_cell] += p
            s1[j - first_cell] += p * u
            s2[j - first_cell] += p * (u * u + variance)


def kalman(
    x: Numbers,
    pitch: Numbers,
    ranges: Numbers,
    sigma: Numbers,
    height_m: float,
    width_m: float,
    first_cell: int,
    elevation: Cells,
    variance: Cells,
) -> None:
    """Equation (10); a variance of infinity is a cell that nothing was measured in."""
    for n in range(len(x)):
        r, c, s = ranges[n], cos(pitch[n]), sin(pitch[n])
        Z, R = height_m + r * s, s * s * sigma[2] ** 2 + (r * c) ** 2 * sigma[1] ** 2
        j = floor((x[n] + r * c) / width_m + 0.5) - first_cell
        h, v = elevation[j], variance[j]
        if v == inf:
            elevation[j], variance[j] = Z, R
        elif abs(Z - h) / sqrt(v + R) < 3.0:
            elevation[j], variance[j] = (R * h + v * Z) / (R + v), R * v / (R + v)
        elif h < Z:
            elevation[j], variance[j] = Z, R


def hull(
    x: Numbers,
    pitch: Numbers,
    ranges: Numbers,
    bounds: Numbers,
    height_m: float,
    width_m: float,
    first_cell: int,
    low: Cells,
    high: Cells,
) -> None:
    """Equation (3) without its remainder, and the hull of every cell that it meets."""
    for n in range(len(x)):
        r, c, s = ranges[n], cos(pitch[n]), sin(pitch[n])
        X, Z = x[n] + r * c, height_m + r * s
        dX = bounds[0] + abs(c) * bounds[2] + abs(r * s) * bounds[1]
        dZ = abs(s) * bounds[2] + abs(r * c) * bounds[1]
        for j in range(floor((X - dX) / width_m + 0.5), floor((X + dX) / width_m + 0.5) + 1):
            i = j - first_cell
            if Z - dZ < low[i]:
                low[i] = Z - dZ
            if Z + dZ > high[i]:
                high[i] = Z + dZ
