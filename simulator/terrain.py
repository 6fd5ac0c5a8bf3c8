"""The ground: a triangulated height grid with axis-aligned boxes on it, and the scenes made of them.

Everything is exact: a cell of the grid is two plane triangles (cut along the diagonal from its low corner), a stair
or a wall is a box with truly vertical faces. World frame: x east, y north, z up, metres.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled

Array = NDArray[np.float64]

SCENES = ("flat", "ramp", "stairs", "rough", "yard", "dem", "paper_stairs", "paper_snow")

STEP_RISE_M = 0.14
STEP_TREAD_M = 0.34


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """A move from standstill to standstill: a share of the cruising speed (negative: reverse), or a spin in place."""

    duration_s: float
    speed: float = 0.0
    spin_rps: float = 0.0


@dataclass(frozen=True, slots=True)
class Course:
    """Where the robot drives on a scene: a straight run with a slight weave, then a circle without end.

    The curvature of the path after s metres is `curvature(s)`; it is continuous, so turns begin gently.
    """

    x_m: float
    y_m: float
    heading_rad: float
    """Start: world position and yaw."""
    straight_m: float
    """Length of the straight run; the turn into the circle takes one metre more."""
    circle_radius_m: float
    """Positive: to the left."""
    weave_rad: float = 0.0
    """Amplitude of the heading's swing about the path."""
    weave_length_m: float = 3.0
    cruise_mps: float = 0.4
    """Speed aimed at; less where the robot's limits ask for less."""
    manoeuvres: tuple[Manoeuvre, ...] = ()
    """Repeated without end instead of one steady drive, if there are any."""
    manoeuvre_ramp_s: float = 0.8
    """How long a manoeuvre takes to reach its speed, and to stop again."""
    reach_m: float = 14.0
    """The drive stays within this distance of the start, along x and along y."""


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """A piece of ground.

    heights: [ny, nx] z of the grid's corners; corner [i, j] is at (x0_m + j * cell_m, y0_m + i * cell_m).
    boxes: [n, 6] x, y, z of the low corner, then of the high corner.
    """

    name: str
    seed: int
    heights: Array
    x0_m: float
    y0_m: float
    cell_m: float
    boxes: Array
    course: Course
    source: str = ""
    """File the heights were read from, for `dem`."""
    lost_echoes: float = 0.0
    """Share of the beams that never come back, whatever they meet."""

    def height(self, x: Array, y: Array) -> Array:
        """Top surface at (x, y), arrays of one shape; NaN outside the grid."""
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        top = np.empty(x.size)
        _top_surface(
            self.heights, self.x0_m, self.y0_m, self.cell_m, self.boxes, np.ravel(x).copy(), np.ravel(y).copy(), top
        )
        return top.reshape(x.shape)


@compiled
def _top_surface(
    heights: Array, x0: float, y0: float, cell: float, boxes: Array, x: Array, y: Array, out: Array
) -> None:
    """Highest of the triangle and the boxes over each point."""
    ny, nx = heights.shape
    for i in range(x.size):
        u = (x[i] - x0) / cell
        w = (y[i] - y0) / cell
        if not (0.0 <= u <= nx - 1 and 0.0 <= w <= ny - 1):
            out[i] = np.nan
            continue
        ix = min(int(u), nx - 2)
        iy = min(int(w), ny - 2)
        u -= ix
        w -= iy
        low = heights[iy, ix]
        high = heights[iy + 1, ix + 1]
        if u >= w:
            corner = heights[iy, ix + 1]
            top = low + u * (corner - low) + w * (high - corner)
        else:
            corner = heights[iy + 1, ix]
            top = low + w * (corner - low) + u * (high - corner)
        for b in range(boxes.shape[0]):
            if boxes[b, 0] <= x[i] <= boxes[b, 3] and boxes[b, 1] <= y[i] <= boxes[b, 4]:
                top = max(top, boxes[b, 5])
        out[i] = top


def smoothed(field: Array, sigma: float) -> Array:
    """Gaussian low-pass of a 2-D field with `sigma` in cells; edges repeat the border."""
    reach = int(np.ceil(4 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    for _ in range(2):  # rows, then columns
        padded = np.pad(field, ((0, 0), (reach, reach)), mode="edge")
        total = np.zeros_like(field)
        for k, weight in enumerate(kernel):
            total += weight * padded[:, k : k + field.shape[1]]
        field = np.ascontiguousarray(total.T)
    return field


def build_terrain(scene: str, seed: int = 1, source: Path | str | None = None) -> Terrain:
    """The named scene; the same arguments give the same ground. `dem` needs an elevation model in `source`."""
    if scene == "flat":
        return _flat(seed)
    if scene == "ramp":
        return _ramp(seed)
    if scene == "stairs":
        return _stairs(seed)
    if scene == "rough":
        return _rough(seed)
    if scene == "yard":
        return _yard(seed)
    if scene == "dem":
        if source is None:
            raise ValueError("the scene dem needs the file of an elevation model")
        return _dem(seed, Path(source))
    if scene in ("paper_stairs", "paper_snow"):
        from simulator import paper_scenes  # it is made of what stands here

        return paper_scenes.paper_stairs(seed) if scene == "paper_stairs" else paper_scenes.paper_snow(seed)
    raise ValueError(f"no scene is called {scene!r}; there are {', '.join(SCENES)}")


_NO_BOXES: Array = np.zeros((0, 6))


def _flat(seed: int) -> Terrain:
    course = Course(0.0, 0.0, 0.3, straight_m=3.0, circle_radius_m=4.0, weave_rad=0.1)
    return Terrain("flat", seed, np.zeros((25, 25)), -30.0, -30.0, 2.5, _NO_BOXES, course)


def _ramp(seed: int) -> Terrain:
    """Level ground, a ramp of 10 degrees, four metres long, and a plateau."""
    course = Course(0.0, 0.0, 0.12, straight_m=9.5, circle_radius_m=3.0, weave_rad=0.05)
    x = np.arange(-20.0, 40.1, 0.5)
    rise = np.tan(np.radians(10.0)) * np.clip(x - 2.0, 0.0, 4.0)
    return Terrain("ramp", seed, np.tile(rise, (121, 1)), -20.0, -30.0, 0.5, _NO_BOXES, course)


def _stairs(seed: int) -> Terrain:
    """Six steps up to a wide landing with a wall of one metre behind it; the robot comes 7 degrees off square."""
    steps, first, half_width = 6, 3.5, 7.0
    boxes = []
    for k in range(steps):
        x = first + k * STEP_TREAD_M
        far = x + STEP_TREAD_M if k < steps - 1 else x + 13.0
        boxes.append((x, -half_width, -0.5, far, half_width, (k + 1) * STEP_RISE_M))
    wall = first + (steps - 1) * STEP_TREAD_M + 13.0
    boxes.append((wall, -half_width, -0.5, wall + 0.3, half_width, steps * STEP_RISE_M + 1.0))
    course = Course(0.0, -0.6, 0.12, straight_m=8.8, circle_radius_m=2.6, weave_rad=0.02)
    return Terrain("stairs", seed, np.zeros((25, 25)), -30.0, -30.0, 2.5, np.array(boxes), course)


def _rough(seed: int) -> Terrain:
    """Random rough ground, a ditch half a metre deep beside the course, walls inside and outside of it."""
    cell, count = 0.15, 241
    low = -18.0
    x, y = np.meshgrid(low + cell * np.arange(count), low + 5.0 + cell * np.arange(count))
    ground = _random_ground(seed, count, cell)
    ditch = (np.abs(x - 8.3) < 0.45) & (y > -4.0) & (y < 12.0)
    ground[ditch] -= 0.5
    boxes = np.array(
        [
            (-1.5, 4.0, -1.0, 1.5, 4.3, 1.2),
            (-1.5, 4.3, -1.0, -1.2, 6.5, 0.8),
            (-9.0, 12.5, -1.0, 7.0, 12.8, 2.0),
            (-10.0, -3.0, -1.0, -9.7, 9.0, 1.5),
            (3.0, -3.2, -1.0, 3.6, -2.6, 0.9),
        ]
    )
    course = Course(0.0, 0.0, 0.0, straight_m=0.5, circle_radius_m=5.0, weave_rad=0.1, cruise_mps=0.4)
    return Terrain("rough", seed, ground, low, low + 5.0, cell, boxes, course)


def _yard(seed: int) -> Terrain:
    """Random rough ground between walls, where the robot stops, spins in place both ways, and reverses."""
    cell, count, low = 0.15, 161, -12.0
    wall = 8.0
    boxes = np.array(
        [
            (-wall, -wall, -1.0, wall, -wall + 0.3, 1.0),
            (-wall, wall - 0.3, -1.0, wall, wall, 1.0),
            (wall - 0.3, -wall, -1.0, wall, wall, 1.0),
        ]
    )
    moves = (
        Manoeuvre(5.0, speed=1.0),
        Manoeuvre(4.0, spin_rps=0.6),
        Manoeuvre(4.0, speed=-0.8),
        Manoeuvre(3.0, spin_rps=-0.8),
        Manoeuvre(3.0, speed=-1.0),
        Manoeuvre(4.0, spin_rps=0.7),
    )
    course = Course(0.0, 0.0, 2.8, straight_m=1e6, circle_radius_m=1.0, weave_rad=0.1, manoeuvres=moves)
    return Terrain("yard", seed, _random_ground(seed, count, cell), low, low, cell, boxes, course)


def _random_ground(seed: int, count: int, cell: float) -> Array:
    """[count, count] heights of rough ground: waves, bumps and stones."""
    random = np.random.default_rng(seed)
    ground = np.zeros((count, count))
    for wavelength_m, rms_m in ((4.0, 0.10), (1.2, 0.03), (0.4, 0.01)):
        bumps = smoothed(random.standard_normal((count, count)), 0.25 * wavelength_m / cell)
        ground += rms_m * bumps / bumps.std()
    return ground


_HIGHEST_M = 1e5


def _dem(seed: int, path: Path) -> Terrain:
    """The middle of a real elevation model, shrunk to 40 m and flattened until a robot can drive on it."""
    model = read_elevation_model(path)
    if model.ndim != 2 or min(model.shape) < 2:
        raise ValueError(f"heights {list(model.shape)}; at least [2, 2] are needed")
    model[np.abs(model) > _HIGHEST_M] = np.nan  # no ground: a file's own sign for "no data"
    if not np.isfinite(model).any():
        raise ValueError("no height in it is a number")
    side = min(48, *model.shape)
    top, left = _most_filled_window(np.isfinite(model), side)
    patch = model[top : top + side, left : left + side]
    patch = np.where(np.isfinite(patch), patch, np.nanmean(patch))
    width, cell = 40.0, 0.2
    count = round(width / cell) + 1
    fine = _bilinear(patch, count)
    fine = smoothed(fine, 0.5 * (count - 1) / (side - 1))
    rise, run = np.gradient(fine, cell)
    steepest = float(np.percentile(np.hypot(rise, run), 98))
    fine *= 0.2 / max(steepest, 1e-9)
    fine -= fine[count // 2, count // 2]
    course = Course(0.0, -4.0, 0.0, straight_m=0.5, circle_radius_m=4.5, weave_rad=0.15)
    return Terrain("dem", seed, fine, -width / 2, -width / 2, cell, _NO_BOXES, course, str(path))


def read_elevation_model(path: Path) -> Array:
    """[rows, columns] heights, first row south, NaN without data: from an ESRI .asc or an .npz with `elevation`."""
    if path.suffix == ".npz":
        with np.load(path) as stored:
            elevation: Array = np.flipud(stored["elevation"]).astype(float)
            return elevation
    header: dict[str, float] = {}
    with path.open(encoding="ascii") as text:
        while True:
            at = text.tell()
            words = text.readline().split()
            if len(words) != 2 or not words[0][:1].isalpha():
                text.seek(at)
                break
            header[words[0].lower()] = float(words[1])
        values = np.array(text.read().split(), float)
    heights = values.reshape(int(header["nrows"]), int(header["ncols"]))
    heights[heights == header.get("nodata_value", -9999.0)] = np.nan
    return np.flipud(heights)


def _most_filled_window(filled: NDArray[np.bool_], side: int) -> tuple[int, int]:
    """Low corner of the side x side window with most data; of equals, the one nearest to the middle."""
    total = np.pad(np.cumsum(np.cumsum(filled, 0), 1), ((1, 0), (1, 0)))
    count = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    rows, columns = np.nonzero(count == count.max())
    nearest = np.argmin((rows - count.shape[0] / 2) ** 2 + (columns - count.shape[1] / 2) ** 2)
    return int(rows[nearest]), int(columns[nearest])


def _bilinear(patch: Array, count: int) -> Array:
    """The patch resampled to count x count corners, borders kept."""
    at = np.linspace(0, patch.shape[0] - 1, count)
    known = np.arange(patch.shape[0])
    rows = np.array([np.interp(at, known, row) for row in patch])
    return np.array([np.interp(at, known, column) for column in rows.T]).T
