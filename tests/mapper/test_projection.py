"""The box of a beam contains every point that errors inside their bounds can produce."""

from collections.abc import Callable
from dataclasses import dataclass

import mpmath
import numpy as np
import pytest
from numpy.typing import NDArray

from bench import prove_boxes
from bench.attained import attained
from drivers.config import LaserConfig
from drivers.samples import Scan, Stamp
from mapper.footprints import round_up
from mapper.projection import Boxes, project

Exact = NDArray[np.longdouble]
LEVELS = {"1cm": (0.01, 0.2), "5cm": (0.05, 0.5), "20cm": (0.2, 1.0), "50cm": (0.5, 3.0), "steep": (0.05, 12.0)}
BEAMS = 361


def a_laser(**changes: float) -> LaserConfig:
    """A mounting askew on every axis, calibrated badly."""
    settings = {
        "range_bound_m": 0.03,
        "angle_bound_deg": 0.4,
        "range_min_m": 0.2,
        "mount_x_m": 0.3,
        "mount_y_m": -0.15,
        "mount_z_m": 0.468,
        "mount_roll_deg": 4.0,
        "mount_pitch_deg": -12.0,
        "mount_yaw_deg": 25.0,
        "mount_position_bound_m": 0.01,
        "mount_angle_bound_deg": 0.5,
    }
    return LaserConfig(port="none", latency_ms=(0.0, 1.0), **(settings | changes))  # type: ignore[arg-type]


def a_scan(ranges: NDArray[np.float64]) -> Scan:
    beams = ranges.size
    return Scan(Stamp(0, 0), np.zeros(beams, np.int64), -np.pi / 2, np.pi / (beams - 1), ranges, 0)


@dataclass
class Case:
    """A scan, its pose boxes, and every error's nominal value and half-range, beam by beam, in extended precision.

    The 15 errors: x, y, z, roll, pitch, yaw | lever x, y, z | mount roll, pitch, yaw | scan angle | range | across.
    """

    scan: Scan
    laser: LaserConfig
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    pose_index: NDArray[np.int32]
    nominal: Exact
    """[n, 15]"""
    half: Exact
    """[n, 15]"""

    def boxes(self) -> Boxes:
        return project(self.scan, self.laser, self.low, self.high, self.pose_index)


def a_case(
    metres: float,
    degrees: float | list[float],
    seed: int = 1,
    far: float = 20.0,
    most_range: float = 12.0,
    **laser_changes: float,
) -> Case:
    """Random poses near and far; half-ranges of `metres` and `degrees` (of roll, pitch, yaw) at most."""
    random = np.random.default_rng(seed)
    laser, poses = a_laser(**laser_changes), 9
    scan = a_scan(random.uniform(0.25, most_range, BEAMS))
    middle = np.column_stack(
        [random.uniform(-far, far, (poses, 3)), random.uniform(-0.4, 0.4, (poses, 2)), random.uniform(-9, 9, poses)]
    )
    half = np.concatenate([np.full(3, metres), np.broadcast_to(np.radians(degrees), 3)]) * random.uniform(
        0.5, 1.0, (poses, 6)
    )
    low, high = middle - half, middle + half
    pose_index = random.integers(0, poses, BEAMS).astype(np.int32)

    wide_low, wide_high = low.astype(np.longdouble), high.astype(np.longdouble)
    rad = np.longdouble(np.pi) / 180
    nominal = np.empty((BEAMS, 15), np.longdouble)
    bounds = np.empty((BEAMS, 15), np.longdouble)
    nominal[:, :6], bounds[:, :6] = ((wide_low + wide_high) / 2)[pose_index], ((wide_high - wide_low) / 2)[pose_index]
    nominal[:, 6:9], bounds[:, 6:9] = [laser.mount_x_m, laser.mount_y_m, laser.mount_z_m], laser.mount_position_bound_m
    nominal[:, 9:12] = np.array([laser.mount_roll_deg, -laser.mount_pitch_deg, laser.mount_yaw_deg]) * rad
    bounds[:, 9:12] = laser.mount_angle_bound_deg * rad
    nominal[:, 12] = scan.angle_min_rad + np.arange(BEAMS) * np.longdouble(scan.angle_increment_rad)
    bounds[:, 12] = laser.angle_bound_deg * rad
    nominal[:, 13], bounds[:, 13] = scan.ranges_m, laser.range_bound_m
    across = laser.angle_bound_deg if laser.across_bound_deg is None else laser.across_bound_deg
    nominal[:, 14], bounds[:, 14] = 0.0, across * rad
    return Case(scan, laser, low, high, pose_index, nominal, bounds)


def turn(vector: Exact, axis: int, angle: Exact) -> Exact:
    """Rotate [n, 3] vectors about a coordinate axis."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(angle), np.sin(angle)
    out = vector.copy()
    out[:, a], out[:, b] = c * vector[:, a] - s * vector[:, b], s * vector[:, a] + c * vector[:, b]
    return out


def hit(e: Exact) -> Exact:
    """[n, 3] where beams with the parameters [n, 15] hit: the point model, written down a second time."""
    point = np.zeros((len(e), 3), np.longdouble)
    point[:, 0], point[:, 2] = e[:, 13] * np.cos(e[:, 14]), e[:, 13] * np.sin(e[:, 14])
    point = turn(point, 2, e[:, 12])
    for axis, parameter in ((0, 9), (1, 10), (2, 11)):
        point = turn(point, axis, e[:, parameter])
    point = point + e[:, 6:9]
    for axis, parameter in ((0, 3), (1, 4), (2, 5)):
        point = turn(point, axis, e[:, parameter])
    return point + e[:, :3]


def jacobian(case: Case) -> Exact:
    """[n, 3, 15] by central differences."""
    columns = []
    for k in range(15):
        step = np.zeros(15, np.longdouble)
        step[k] = 1e-6
        columns.append((hit(case.nominal + step) - hit(case.nominal - step)) / np.longdouble(2e-6))
    return np.stack(columns, axis=-1)


def at_sign_vectors(case: Case) -> list[Exact]:
    """Errors at the corners that move each axis farthest, to first order: [n, 3] points for each axis and sense."""
    signs = np.sign(jacobian(case))
    return [hit(case.nominal + way * signs[:, axis] * case.half) for axis in range(3) for way in (-1, 1)]


def at_corners(case: Case) -> list[Exact]:
    random = np.random.default_rng(5)
    return [hit(case.nominal + random.choice([-1.0, 1.0], case.half.shape) * case.half) for _ in range(30)]


def uniform(case: Case) -> list[Exact]:
    random = np.random.default_rng(6)
    return [hit(case.nominal + random.uniform(-1.0, 1.0, case.half.shape) * case.half) for _ in range(20)]


SLOPPY = {
    "attitude": {"mount_angle_bound_deg": 0.0, "angle_bound_deg": 0.0, "mount_position_bound_m": 0.0},
    "mounting": {"mount_angle_bound_deg": 40.0, "angle_bound_deg": 0.0, "mount_position_bound_m": 0.0},
    "scan angle": {"mount_angle_bound_deg": 0.0, "angle_bound_deg": 40.0, "mount_position_bound_m": 0.0},
    "across": {
        "mount_angle_bound_deg": 0.0,
        "angle_bound_deg": 0.0,
        "across_bound_deg": 40.0,
        "mount_position_bound_m": 0.0,
    },
    "long lever": {
        "mount_x_m": 4.0,
        "mount_y_m": 3.0,
        "mount_z_m": -5.0,
        "mount_angle_bound_deg": 0.0,
        "most_range": 0.3,
    },
    "lever": {"mount_x_m": 0.0, "mount_y_m": 0.0, "mount_z_m": 0.0, "mount_position_bound_m": 2.0, "most_range": 0.3},
    "range": {"range_bound_m": 3.0, "mount_position_bound_m": 0.0, "most_range": 0.3},
}


@pytest.mark.parametrize("dominant", SLOPPY)
@pytest.mark.parametrize(
    "degrees", [[40, 0, 0], [0, 40, 0], [0, 0, 40], [40, 40, 0], [40, 0, 40], [0, 40, 40], [40, 40, 40]]
)
def test_whichever_errors_dominate_the_box_holds(dominant: str, degrees: list[float]) -> None:
    """Few and large errors of one kind leave no slack in other terms' bounds: each term must be there."""
    case = a_case(0.0, degrees, **SLOPPY[dominant])  # type: ignore[arg-type]  # `seed` is none of the keys
    boxes = case.boxes()
    assert outside(at_sign_vectors(case), boxes.low, boxes.high) == 0
    assert outside(at_corners(case), boxes.low, boxes.high) == 0


def outside(points: list[Exact], low: NDArray[np.float64] | Exact, high: NDArray[np.float64] | Exact) -> int:
    return sum(int(np.count_nonzero(~np.all((low <= p) & (p <= high), axis=1))) for p in points)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("draw", [at_sign_vectors, at_corners, uniform])
def test_no_point_with_errors_inside_their_bounds_leaves_its_box(
    level: str, draw: Callable[[Case], list[Exact]]
) -> None:
    """At every pose level, with errors at sign vectors, at corners and uniform, in extended precision: 0 outside."""
    case = a_case(*LEVELS[level])
    boxes = case.boxes()
    assert np.all(np.isfinite(boxes.low))
    assert np.all(np.isfinite(boxes.high))
    assert outside(draw(case), boxes.low, boxes.high) == 0


@pytest.mark.parametrize("level", LEVELS)
def test_the_sign_vectors_find_a_missing_remainder(level: str) -> None:
    """The points of these tests are hard enough: many of them leave the first-order box, which has no remainder."""
    case = a_case(*LEVELS[level])
    half = np.einsum("nij,nj->ni", np.abs(jacobian(case)), case.half)
    centre = hit(case.nominal)
    points = at_sign_vectors(case)
    assert outside(points, centre - half, centre + half) > 0.1 * len(points) * BEAMS


@pytest.mark.parametrize("level", LEVELS)
def test_the_box_is_hardly_wider_than_what_errors_attain(level: str) -> None:
    """Sound and not slack: the mean half-width exceeds the first-order one by little more than the remainder needs."""
    case = a_case(*LEVELS[level])
    boxes = case.boxes()
    first_order = np.einsum("nij,nj->ni", np.abs(jacobian(case)), case.half)
    attained = np.full((2, BEAMS, 3), np.inf)
    attained[1] = -np.inf
    for points in at_sign_vectors(case):
        attained[0], attained[1] = np.minimum(attained[0], points), np.maximum(attained[1], points)
    slack = np.mean((boxes.high - boxes.low) / (attained[1] - attained[0])) - 1.0
    turned = float(np.max(case.half[:, 3:6].sum(axis=1) + 4 * np.radians(0.5)))
    assert 0.0 <= slack < 0.02 + 1.5 * turned
    assert np.all(boxes.high - boxes.low >= 2 * first_order)


def mp_hit(e: list[mpmath.mpf]) -> list[mpmath.mpf]:
    """The point model in mpmath, for plain numbers and for intervals alike (the context is the numbers' own)."""
    context = mpmath.iv if isinstance(e[0], mpmath.ctx_iv.ivmpf) else mpmath.mp
    reach = e[13] * context.cos(e[14])
    point = [reach * context.cos(e[12]), reach * context.sin(e[12]), e[13] * context.sin(e[14])]

    def turned(axis: int, angle: mpmath.mpf) -> None:
        a, b = (axis + 1) % 3, (axis + 2) % 3
        c, s = context.cos(angle), context.sin(angle)
        point[a], point[b] = c * point[a] - s * point[b], s * point[a] + c * point[b]

    for axis, parameter in ((0, 9), (1, 10), (2, 11)):
        turned(axis, e[parameter])
    point = [point[i] + e[6 + i] for i in range(3)]
    for axis, parameter in ((0, 3), (1, 4), (2, 5)):
        turned(axis, e[parameter])
    return [point[i] + e[i] for i in range(3)]


def mp_bounds(case: Case, n: int) -> tuple[list[mpmath.mpf], list[mpmath.mpf]]:
    """Least and most of the 15 parameters of beam n as the configuration and the pose box declare them, exactly."""
    mp, laser, m = mpmath.mp, case.laser, case.pose_index[n]
    rad = mp.pi / 180
    angle = mp.mpf(case.scan.angle_min_rad) + n * mp.mpf(case.scan.angle_increment_rad)
    own = [
        *(
            (mp.mpf(v), mp.mpf(laser.mount_position_bound_m))
            for v in (laser.mount_x_m, laser.mount_y_m, laser.mount_z_m)
        ),
        *(
            (mp.mpf(v) * rad, mp.mpf(laser.mount_angle_bound_deg) * rad)
            for v in (laser.mount_roll_deg, -laser.mount_pitch_deg, laser.mount_yaw_deg)
        ),
        (angle, mp.mpf(laser.angle_bound_deg) * rad),
        (mp.mpf(case.scan.ranges_m[n]), mp.mpf(laser.range_bound_m)),
        (mp.mpf(0), mp.mpf(laser.angle_bound_deg if laser.across_bound_deg is None else 0.0) * rad),
    ]
    low = [mp.mpf(v) for v in case.low[m]] + [v - d for v, d in own]
    high = [mp.mpf(v) for v in case.high[m]] + [v + d for v, d in own]
    return low, high


@pytest.mark.parametrize("level", LEVELS)
def test_sixty_digit_corners_are_inside_and_interval_arithmetic_agrees(level: str) -> None:
    """Corners to 60 digits lie in the centred box; the natural interval enclosure meets it and is seldom narrower."""
    case = a_case(*LEVELS[level], seed=3)
    boxes = case.boxes()
    random = np.random.default_rng(8)
    narrower = 0
    with mpmath.workdps(60):
        mpmath.iv.dps = 30
        for n in range(0, BEAMS, 8):
            low, high = mp_bounds(case, n)
            for _ in range(4):
                ends = [(low, high)[way][k] for k, way in enumerate(random.integers(0, 2, 15))]
                for i, value in enumerate(mp_hit(ends)):
                    assert mpmath.mpf(boxes.low[n, i]) <= value <= mpmath.mpf(boxes.high[n, i])
            natural = mp_hit([mpmath.iv.mpf([a, b]) for a, b in zip(low, high, strict=True)])
            for i, interval in enumerate(natural):
                assert interval.a <= boxes.high[n, i]
                assert boxes.low[n, i] <= interval.b
                narrower += bool(interval.delta < 0.98 * (boxes.high[n, i] - boxes.low[n, i]))
    assert narrower < 0.2 * 3 * len(range(0, BEAMS, 8)) or level == "steep"


@pytest.mark.parametrize("far", [1.0, 1e4, 1e7, 1e11])
def test_rounding_is_covered_when_nothing_else_is_uncertain(far: float) -> None:
    """With a point as pose box and vanishing bounds, the exact point is inside, and the box is micrometres wide."""
    case = a_case(0.0, 0.0, far=far)
    tiny = {"mount_position_bound_m": 0.0, "mount_angle_bound_deg": 0.0, "angle_bound_deg": 0.0}
    case.laser = a_laser(range_bound_m=1e-300, **tiny)
    boxes = case.boxes()
    assert np.max(boxes.high - boxes.low) < 3e-5 + 1e-11 * far
    with mpmath.workdps(60):
        for n in range(0, BEAMS, 4):
            nominal, _ = mp_bounds(case, n)
            for i, value in enumerate(mp_hit(nominal)):
                assert mpmath.mpf(boxes.low[n, i]) <= value <= mpmath.mpf(boxes.high[n, i])


def test_rounding_is_covered_where_bounds_are_longer_than_beams() -> None:
    """Where only lengths err, and by far more than the beams are long, nothing hides what float32 loses: all inside."""
    case = a_case(0.0, 0.0, far=1.0, most_range=0.3)
    tiny = {"mount_angle_bound_deg": 0.0, "angle_bound_deg": 0.0}
    case.laser = a_laser(range_bound_m=40.0, mount_position_bound_m=70.0, **tiny)
    boxes = case.boxes()
    with mpmath.workdps(60):
        for n in range(0, BEAMS, 2):
            low, high = mp_bounds(case, n)
            rows = [mp_hit([low[k] if k != j else high[k] for k in range(15)]) for j in range(15)]
            base = mp_hit(low)
            for i in range(3):
                # The point is linear in all that errs: the farthest corner has each at its own better end.
                rises = [rows[k][i] - base[i] for k in (6, 7, 8, 13)]
                least = base[i] + sum(min(rise, mpmath.mpf(0)) for rise in rises)
                most = base[i] + sum(max(rise, mpmath.mpf(0)) for rise in rises)
                assert mpmath.mpf(boxes.low[n, i]) <= least
                assert most <= mpmath.mpf(boxes.high[n, i])


def test_height_does_not_depend_on_yaw() -> None:
    """A yaw that nobody knows leaves the z interval as it was, up to the inflation for rounding."""
    case = a_case(0.05, 0.5)
    known = case.boxes()
    case.low[:, 5] -= np.pi
    case.high[:, 5] += np.pi
    unknown = case.boxes()
    assert np.max(np.abs(known.low[:, 2] - unknown.low[:, 2])) < 1e-9
    assert np.max(np.abs(known.high[:, 2] - unknown.high[:, 2])) < 1e-9
    assert np.min(unknown.high[:, 0] - unknown.low[:, 0]) > np.min(known.high[:, 0] - known.low[:, 0])


def test_attitudes_nobody_knows_still_give_boxes_that_hold() -> None:
    """The remainder is global: with half-ranges up to a full turn no point leaves its box."""
    for degrees in (45.0, 120.0, 360.0):
        case = a_case(0.1, degrees)
        boxes = case.boxes()
        for draw in (at_sign_vectors, at_corners, uniform):
            assert outside(draw(case), boxes.low, boxes.high) == 0


def test_a_beam_without_range_or_pose_has_no_box() -> None:
    """NaN, infinite, too short and too long ranges, bad pose numbers and unbounded poses: NaN, and the rest stands."""
    case = a_case(0.05, 0.5)
    case.scan.ranges_m[:6] = [np.nan, np.inf, -np.inf, -1.0, 0.1, 31.0]
    case.pose_index[6:9] = [-1, 99, np.iinfo(np.int32).max]
    case.low[0, 2], case.high[1, 4], case.high[2, 0] = np.nan, np.inf, case.low[2, 0] - 1e-9
    boxes = case.boxes()
    bad = np.isin(case.pose_index, [0, 1, 2])
    bad[:9] = True
    assert np.array_equal(np.all(np.isnan(boxes.low), axis=1), bad)
    assert np.array_equal(np.isfinite(boxes.high).all(axis=1), ~bad)


def test_storage_as_float32_rounds_up_and_only_just() -> None:
    """Never below the value, of any size and sign, and at most two steps of float32 above it."""
    random = np.random.default_rng(2)
    values = random.choice([-1.0, 1.0], 20_000) * 10.0 ** random.uniform(-45, 9, 20_000)
    near = np.float32(random.uniform(-100, 100, 2_000)).astype(np.float64)
    for value in np.concatenate([[0.0, -0.0], values, near, np.nextafter(near, np.inf), np.nextafter(near, -np.inf)]):
        stored = round_up(float(value))
        assert np.float64(stored) >= value
        assert np.float64(stored) <= value + abs(value) * 2.0**-21 + 2.0**-99


@pytest.mark.parametrize("level", [0, 1, 2])
def test_up_to_20_cm_and_one_degree_no_interval_is_wider_than_errors_attain_by_more_than_one_and_a_half_percent(
    level: int,
) -> None:
    """Every interval of every fourth beam, not only their mean, against the farthest points that a search finds."""
    metres, degrees = prove_boxes.LEVELS[level]
    case = prove_boxes.a_case(metres, degrees, seed=level)
    boxes = project(case.scan, prove_boxes.LASER, case.low, case.high, case.index)
    least, most = attained(prove_boxes.hits, case.middle[::4], case.half[::4], prove_boxes.ANGLES)
    assert np.all((boxes.low[::4] <= least) & (most <= boxes.high[::4]))
    assert np.max((boxes.high - boxes.low)[::4] / (most - least)) < 1.015
