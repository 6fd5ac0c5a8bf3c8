"""One-step enclosures against brute force: corners, and rates that turn round inside the step."""

import numpy as np
import pytest
from numpy.typing import NDArray

from estimator.frames import columns
from estimator.motion import GyroBounds, TrackBounds, excursion, rotate, turn, variation
from estimator.tracks import slipping, to_and_fro, tracked, travel

STEPS = 400
"""Substeps of the brute-force integration."""
ALPHA = 7.0
GYRO = GyroBounds(noise=2e-3, scale=0.004, most_rate=1.6, most_acceleration=ALPHA, most_bias=0.02, bias_drift=0.0)
TRACKS = TrackBounds(
    slip=0.03,
    lateral=0.01,
    turning_centre=0.04,
    normal=0.01,
    quantum_left=0.001,
    quantum_right=0.001,
    most_speed=1.2,
    most_acceleration=1.0,
    most_track_acceleration=1.0 + 0.175 * ALPHA,
)


def euler_rates(a: NDArray[np.float64], w: NDArray[np.float64]) -> NDArray[np.float64]:
    """SMF equation 1 for k trials at once; a, w [k, 3]."""
    sf, cf, t, c = np.sin(a[:, 0]), np.cos(a[:, 0]), np.tan(a[:, 1]), np.cos(a[:, 1])
    sideways = w[:, 1] * sf + w[:, 2] * cf
    return np.stack([w[:, 0] + t * sideways, w[:, 1] * cf - w[:, 2] * sf, sideways / c], axis=1)


def profiles(random: np.random.Generator, k: int, time: float) -> NDArray[np.float64]:
    """Rates [STEPS + 1, k, 3] within ALPHA: held at the limit, turning round, ramping, or random."""
    t = np.linspace(0.0, time, STEPS + 1)
    kind = random.integers(4, size=(k, 3))
    turn_at = random.uniform(0.0, time, (k, 3))
    sign = random.choice([-1.0, 1.0], (k, 3))
    held = random.uniform(-1.5, 1.5, (k, 3))
    ramp = sign * ALPHA * (t[:, None, None] - turn_at)
    rates = np.where(kind == 0, held, np.where(kind == 1, ramp, np.where(kind == 2, np.abs(ramp) * sign, 0.5 * ramp)))
    return np.asarray(np.clip(rates, -1.6, 1.6))


def attitudes(start: NDArray[np.float64], w: NDArray[np.float64], time: float) -> NDArray[np.float64]:
    """[STEPS + 1, k, 3] by the midpoint rule on the fine grid."""
    path = np.empty((STEPS + 1, *start.shape))
    path[0] = start
    h = time / STEPS
    for i in range(STEPS):
        middle = 0.5 * (w[i] + w[i + 1])
        half = path[i] + 0.5 * h * euler_rates(path[i], w[i])
        path[i + 1] = path[i] + h * euler_rates(half, middle)
    return path


def random_box(random: np.random.Generator, steep: float) -> NDArray[np.float64]:
    """[3, 2] some roll, pitch, yaw with widths from nothing to a few degrees."""
    centre = np.append(random.uniform(-steep, steep, 2), random.uniform(-9.0, 9.0))
    half = 10.0 ** random.uniform(-8, -1, 3)
    return np.stack([centre - half, centre + half], axis=1)


@pytest.mark.parametrize("time", [0.005, 0.02, 0.1])
def test_a_turn_encloses_whatever_the_rates_do_inside_the_step(time: float) -> None:
    """Ends are in the new box and the way there within the swing of the two, from the corners of the old one."""
    random = np.random.default_rng(int(time * 1000))
    nearest = 0.0
    for _ in range(60):
        box = random_box(random, 0.6)
        corners = random.choice([0, 1], (40, 3))
        start = box[np.arange(3), corners]
        w = profiles(random, 40, time)
        path = attitudes(start, w, time)
        area = np.sum(0.5 * (w[1:] + w[:-1]), axis=0) * time / STEPS
        for k in range(40):
            turned, varied, swing, after = np.empty((3, 2)), np.empty(3), np.empty(3), box.copy()
            for axis in range(3):
                error = random.uniform(0.0, 1e-3)
                low = area[k, axis] - random.choice([0.0, 1.0]) * error
                turned[axis] = low - 1e-12, low + error + 1e-12
                varied[axis] = variation((turned[axis, 0], turned[axis, 1]), 0.0, ALPHA, time)
            assert turn(after, turned, varied, swing, np.zeros(5), np.zeros(3))
            assert np.all(after[:, 0] <= path[-1, k] + 1e-9)
            assert np.all(path[-1, k] - 1e-9 <= after[:, 1])
            low, high = np.minimum(path[0, k], path[-1, k]), np.maximum(path[0, k], path[-1, k])
            beyond = np.maximum(low - path[:, k].min(axis=0), path[:, k].max(axis=0) - high)
            assert np.all(beyond <= swing + 1e-9)
            half = 0.5 * (after[:, 1] - after[:, 0])
            nearest = max(nearest, float(np.max(np.abs(path[-1, k] - after.mean(axis=1)) / half)))
    assert nearest > 0.9  # the enclosure is not idle


def test_a_bound_of_half_the_variation_is_caught() -> None:
    """The same comparison fails when the term for rates that change their sign is left out."""
    random = np.random.default_rng(1)
    time, outside = 0.1, 0
    w = profiles(random, 400, time)
    area = np.sum(0.5 * (w[1:] + w[:-1]), axis=0) * time / STEPS
    absolute = np.sum(np.abs(0.5 * (w[1:] + w[:-1])), axis=0) * time / STEPS
    for net, true in zip(area.ravel(), absolute.ravel(), strict=True):
        assert true <= variation((net, net), 0.0, ALPHA, time) + 1e-9
        outside += true > variation((net, net), 0.0, 0.0, time) + 1e-9
    assert outside > 100


def test_excursions_are_never_exceeded() -> None:
    """No path whose rates vary by no more than stated leaves the box by more than the excursion."""
    random = np.random.default_rng(4)
    for _ in range(40):
        box = random_box(random, 0.7)
        w = profiles(random, 50, 0.15)
        varied = np.sum(np.abs(0.5 * (w[1:] + w[:-1])), axis=0) * 0.15 / STEPS
        start = box[np.arange(3), random.choice([0, 1], (50, 3))]
        path = attitudes(start, w, 0.15)
        for k in range(50):
            out = np.empty(3)
            if excursion((box[0, 0], box[0, 1]), (box[1, 0], box[1, 1]), varied[k] + 1e-9, out):
                assert np.all(np.abs(path[:, k] - start[k]).max(axis=0) <= out + 1e-9)


def test_an_attitude_too_steep_for_euler_rates_is_refused() -> None:
    """Near the gimbal lock the step says so instead of giving a wrong box."""
    box = np.array([[-0.1, 0.1], [1.3, 1.45], [0.0, 0.0]])
    assert not turn(box, np.zeros((3, 2)), np.full(3, 0.01), np.empty(3), np.zeros(5), np.zeros(3))


def test_the_mean_rate_is_enclosed_for_all_errors_at_their_corners() -> None:
    """true = (measured - bias - noise) / (1 + scale) is inside, and an absent axis is anything up to the fastest."""
    random = np.random.default_rng(2)
    for _ in range(2000):
        true = random.uniform(-1.6, 1.6, 3)
        bias = random.uniform(-0.01, 0.01, 3)
        box = np.stack([bias - random.uniform(0, 1e-3, 3), bias + random.uniform(0, 1e-3, 3)], axis=1)
        noise, scale = random.choice([-1, 1], 3) * GYRO.noise, random.choice([-1, 1], 3) * GYRO.scale
        measured = true * (1 + scale) + bias + noise
        measured[0] = np.nan
        turned, varied = np.empty((3, 2)), np.empty(3)
        assert rotate(measured, box, 0.005, 0.0051, False, GYRO, turned, varied, np.empty(5))
        for time in (0.005, 0.0051):
            assert np.all(turned[:, 0] <= true * time)
            assert np.all(true * time <= turned[:, 1])
            assert np.all(np.abs(true) * time <= varied)


@pytest.mark.parametrize("reverse", [False, True])
def test_travel_encloses_drives_with_slip_and_quantised_counts(reverse: bool) -> None:
    """Sums of many steps hold the truth though the count's quantum is paid once, not at every step."""
    random = np.random.default_rng(3)
    time, count = 0.01, 60
    half = 10.0 ** random.uniform(-6, -2, (200, 3))
    widths = []
    for trial in range(200):
        sign = random.choice([-1.0, 1.0], 6)
        core, axis, pending = np.zeros((3, 2)), np.zeros(3), np.zeros(3)
        net, swing, true, track = np.empty((3, 2)), np.empty(3), np.zeros(3), np.zeros(2)
        running = np.zeros(2, np.bool_)
        phase = random.random(2)
        counts = np.floor(track / 0.001 + phase)
        attitude = np.append(random.uniform(-0.4, 0.4, 2), random.uniform(-3, 3))
        for k in range(count):
            v = 0.8 * (-1.0 if reverse and k >= count // 2 else 1.0) * random.uniform(0.5, 1.0)
            attitude = attitude + random.uniform(-0.01, 0.01, 3)
            wz = 0.5 * sign[3]
            centre = attitude + random.choice([-1.0, 1.0], 3) * half[trial]
            box = np.stack([centre - half[trial], centre + half[trial]], axis=1)
            roll, pitch, yaw = (float(a) for a in attitude)
            frame = ((roll, roll), (pitch, pitch), (yaw, yaw))
            ahead, left, above = (np.array(axis)[:, 0] for axis in columns(frame))
            lateral = sign[0] * (TRACKS.lateral * abs(v) + TRACKS.turning_centre * abs(wz))
            true = true + time * (v * ahead + lateral * left + sign[1] * TRACKS.normal * abs(v) * above)
            track = track + time * np.array([v - 0.1, v + 0.1]) / (1.0 + TRACKS.slip * sign[4:6])
            after = np.floor(track / 0.001 + phase)
            left_m, right_m = (after - counts) * 0.001
            counts = after
            slid = slipping(left_m, right_m, abs(wz) * time, time, TRACKS, running)
            assert travel(
                box, left_m, right_m, True, slid, time, abs(wz) * time, abs(wz) * time, TRACKS, axis, k == 0, core, net,
                swing, pending,
            )  # fmt: skip
            assert np.all(core[:, 0] - pending <= true + 1e-9)
            assert np.all(true <= core[:, 1] + pending + 1e-9)
        widths.append(np.max(core[:, 1] - core[:, 0]))
    assert np.median(widths) < count * 0.002  # a quantum at every step would cost as much alone


def test_the_counts_errors_make_the_slip_larger_once_in_a_run_not_at_every_step() -> None:
    """Counts off by a quantum or not at every reading, runs ahead and back with stops: no stretch ran farther."""
    random, q, time = np.random.default_rng(6), 0.001, 0.02
    bounds = TRACKS._replace(quantum_left=q, quantum_right=q)
    for _ in range(300):
        running, off = np.zeros(2, np.bool_), random.choice([0.0, q], 2)
        ran, slid, way = [0.0], [0.0], random.choice([-1.0, 1.0]) * 0.02
        for _ in range(40):
            way = 0.0 if random.random() < 0.1 else (way or float(random.choice([-1.0, 1.0]) * 0.02))
            true = way * random.uniform(0.5, 1.0, 2)
            before, off = off, random.choice([0.0, q], 2)
            left, right = true - (off - before)
            ran.append(ran[-1] + float(np.abs(true).sum()))
            slid.append(slid[-1] + slipping(left, right, 0.0, time, bounds, running))
        farther = np.array(ran) - np.array(slid)
        # whichever stretch: what it ran beyond what is paid for is a quantum of each track, paid for at its end
        assert max(float((farther[k:] - farther[k]).max()) for k in range(len(farther))) <= 2.0 * q + 1e-12
        assert farther[1:].max() <= 1e-12  # from the beginning of a run on nothing at all


@pytest.mark.parametrize("turn_m", [0.05, -0.05])
def test_tracks_that_run_against_each_other_slip_each_by_their_own_way(turn_m: float) -> None:
    """On the spot the mean of the counts is zero, but not that of the slips: the robot may creep ahead or back."""
    held = tracked(
        -turn_m, turn_m, True, sum(to_and_fro(-turn_m, turn_m, 2.0 * turn_m / 0.35, 0.1, TRACKS)), 0.1, TRACKS
    ).distance
    for left in (-1.0, 1.0):
        for right in (-1.0, 1.0):
            crept = 0.5 * (-turn_m * (1.0 + left * TRACKS.slip) + turn_m * (1.0 + right * TRACKS.slip))
            assert held[0] <= crept <= held[1]


def test_tracks_whose_turning_centres_jump_slip_by_no_more_than_is_allowed_for() -> None:
    """A track near its turning point runs to and fro as often as the centre moves; each bit of that way may slip."""
    random, time, substeps = np.random.default_rng(3), 0.02, 100
    slip, (least, most) = 0.1, (0.35, 0.6)
    tracks = TRACKS._replace(
        slip=slip, quantum_left=0.0, quantum_right=0.0, most_track_acceleration=(1.0 + 0.2375 * ALPHA) / (1.0 - slip),
        turning_spread=0.25 * (most - least) / (1.0 - slip), most_turn_acceleration=ALPHA,
    )  # fmt: skip
    outside = 0
    for trial in range(2000):
        rate = random.uniform(-1.5, 1.5)
        speed = random.choice([-0.5, 0.5]) * rate * random.uniform(0.9 * least, 1.1 * most)
        often = random.random(substeps) < 0.5 if trial % 2 else np.arange(substeps) < random.integers(substeps)
        gauge = np.where(often, least, most)
        ground = speed + rate * 0.5 * np.outer((-1.0, 1.0), gauge)
        ran = ground / (1.0 + slip * random.choice([-1.0, 1.0]) * np.sign(ground))
        left, right = (ran.sum(axis=1) * time / substeps).tolist()

        def way(tracks: TrackBounds, left: float = left, right: float = right, rate: float = rate) -> float:
            return sum(to_and_fro(left, right, abs(rate) * time, time, tracks))

        held = tracked(left, right, True, way(tracks), time, tracks).distance
        assert held[0] <= speed * time <= held[1]
        held = tracked(left, right, True, way(tracks._replace(turning_spread=0.0)), time, tracks).distance
        outside += not held[0] <= speed * time <= held[1]
    assert outside > 100  # as if the centres stood still
