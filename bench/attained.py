"""How far errors inside their bounds really move a point: the farthest found, each error's best place taken in turn.

Along one angle a coordinate of the point is a sinusoid, along a length a straight line: so the best place of one
error, the others held, is known exactly, at an end of its bound or between. From several starts (the corner that the
Jacobian's signs name, others at random, and all angles at their middles) this climbs to the farthest point in a few
rounds. What it finds is attained, so no sound box is narrower.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Points = Callable[[Array], Array]
"""[n, errors] to [n, 3]."""

ROUNDS = 4
RANDOM_STARTS = 2


def attained(points: Points, middle: Array, half: Array, angles: Sequence[int]) -> tuple[Array, Array]:
    """[n, 3] least and most of each coordinate; `middle`, `half` [n, errors], `angles` which of the errors are."""
    n = len(middle)
    least, most = np.full((n, 3), np.inf), np.full((n, 3), -np.inf)
    random = np.random.default_rng(0)
    farthest = jacobian_signs(points, middle)
    for axis in range(3):
        for way in (-1.0, 1.0):
            corner = middle + way * farthest[axis] * half
            level = corner.copy()
            level[:, angles] = middle[:, angles]
            starts = [
                corner,
                level,
                *(middle + random.choice([-1.0, 1.0], half.shape) * half for _ in range(RANDOM_STARTS)),
            ]
            for start in starts:
                found = points(climb(points, middle, half, angles, start, axis, way))[:, axis]
                np.minimum(least[:, axis], found, out=least[:, axis])
                np.maximum(most[:, axis], found, out=most[:, axis])
    return least, most


def jacobian_signs(points: Points, middle: Array) -> Array:
    """[3, n, errors], row by row."""
    columns = []
    for k in range(middle.shape[1]):
        step = np.zeros(middle.shape[1])
        step[k] = 1e-6
        columns.append(points(middle + step) - points(middle - step))
    return np.sign(np.stack(columns, axis=-1)).transpose(1, 0, 2)


def climb(
    points: Points, middle: Array, half: Array, angles: Sequence[int], start: Array, axis: int, way: float
) -> Array:
    """[n, errors] from which no single error leads farther along `axis`, towards `way`."""
    e = start.copy()

    def value(k: int, offset: Array | float) -> Array:
        moved = e.copy()
        moved[:, k] = middle[:, k] + offset
        reached: Array = way * points(moved)[:, axis]
        return reached

    for _ in range(ROUNDS):
        for k in range(e.shape[1]):
            ends = -half[:, k], half[:, k]
            if k in angles:
                # A + B cos + C sin of the offset
                ahead, aside, behind = value(k, 0.0), value(k, np.pi / 2), value(k, np.pi)
                A, B = (ahead + behind) / 2, (ahead - behind) / 2
                C = aside - A
                offsets = np.stack((*ends, np.clip(np.arctan2(C, B), *ends)))
                values = A + B * np.cos(offsets) + C * np.sin(offsets)
            else:
                offsets = np.stack(ends)
                values = np.stack([value(k, end) for end in ends])
            e[:, k] = middle[:, k] + np.take_along_axis(offsets, values.argmax(axis=0)[None], 0)[0]
    return e
