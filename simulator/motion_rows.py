"""The true motion between its rows: a table with a row a millisecond, from row 0 on."""

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled
from simulator.robot import STEP_NS

Array = NDArray[np.float64]


@compiled
def between(rows: Array, t_ns: int) -> Array:
    """Row of a 1 kHz table at t_ns after its first one, linear in between, constant beyond its ends."""
    i = min(max(t_ns // STEP_NS, 0), rows.shape[0] - 2)
    part = min(max((t_ns - i * STEP_NS) / STEP_NS, 0.0), 1.0)
    row: Array = rows[i] + part * (rows[i + 1] - rows[i])
    return row


@compiled
def hermite(values: Array, slopes: Array, t_ns: int) -> Array:
    """Row of a 1 kHz table with known derivatives (per second) at t_ns, constant beyond its ends."""
    i = min(max(t_ns // STEP_NS, 0), values.shape[0] - 2)
    u = min(max((t_ns - i * STEP_NS) / STEP_NS, 0.0), 1.0)
    h = STEP_NS * 1e-9
    rise = u * u * (3.0 - 2.0 * u)
    begin = h * u * (1.0 - u) ** 2
    end = -h * u * u * (1.0 - u)
    row: Array = values[i] + rise * (values[i + 1] - values[i]) + begin * slopes[i] + end * slopes[i + 1]
    return row
