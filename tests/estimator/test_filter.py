"""The filter against a small kinematic truth of its own, whose errors stay at the corners of their bounds."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import nan, pi

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray

from drivers.compiled import compiled
from drivers.config import EncodersConfig, GpsConfig, ImuConfig
from drivers.samples import Fix, InertialSample, Stamp, WheelTicks
from estimator.bounded_pose import BoundedPose
from estimator.config import FilterConfig, RobotConfig
from estimator.filter import Filter

ROBOT = RobotConfig(
    name="test",
    track_length_m=0.65,
    track_gauge_m=0.35,
    max_speed_mps=1.2,
    max_acceleration_mps2=1.0,
    max_turn_rate_dps=90.0,
    max_turn_acceleration_dps2=400.0,
    slip_ratio=0.03,
    lateral_slip_ratio=0.01,
    turning_centre_m=0.04,
    normal_slip_ratio=0.01,
)
CONFIG = FilterConfig(standstill_s=0.5, standstill_rate_dps=0.02)
ENCODERS = EncodersConfig(
    port="", dbc="", left="", right="", left_metres_per_tick=0.001, right_metres_per_tick=-0.001, latency_ms=(0.0, 6.0)
)
IMU = ImuConfig(
    port="",
    latency_ms=(0.5, 6.0),
    clock_drift_ppm=100.0,
    gyro_bias_bound_dps=0.3,
    gyro_bias_drift_dps2=0.0005,
    gyro_noise_bound_dps=0.05,
    gyro_scale_bound=0.003,
    tilt_bound_deg=0.5,
    accel_bound_mps2=0.1,
)
GPS = GpsConfig(
    port="",
    latency_ms=(20.0, 60.0),
    gst_factor=5.0,
    range_error_m=5.0,
    floor_horizontal_m=0.1,
    floor_vertical_m=0.1,
    antenna_x_m=-0.1,
    antenna_y_m=0.05,
    antenna_z_m=0.6,
)
BOX, ELLIPSOID = CONFIG, replace(CONFIG, set="ellipsoid")
both = pytest.mark.parametrize("config", [BOX, ELLIPSOID], ids=["box", "ellipsoid"])
MODES = ("corner", "constant", "uniform", "switching", "slow")
SUBSTEP_NS = 500_000
HOME = (47.4, 8.5, 450.0)


@compiled
def rates(state: NDArray[np.float64], w: NDArray[np.float64], v: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """d(x, y, z, roll, pitch, yaw)/dt for body rates w and body velocity v."""
    sf, cf = np.sin(state[3]), np.cos(state[3])
    st, ct = np.sin(state[4]), np.cos(state[4])
    sp, cp = np.sin(state[5]), np.cos(state[5])
    out[0] = cp * ct * v[0] + (cp * st * sf - sp * cf) * v[1] + (cp * st * cf + sp * sf) * v[2]
    out[1] = sp * ct * v[0] + (sp * st * sf + cp * cf) * v[1] + (sp * st * cf - cp * sf) * v[2]
    out[2] = -st * v[0] + ct * sf * v[1] + ct * cf * v[2]
    out[3] = w[0] + st / ct * (w[1] * sf + w[2] * cf)
    out[4] = w[1] * cf - w[2] * sf
    out[5] = (w[1] * sf + w[2] * cf) / ct


@compiled
def integrate(
    step: float,
    wanted: NDArray[np.float64],
    tilt: NDArray[np.float64],
    slide: NDArray[np.float64],
    limits: NDArray[np.float64],
    pose: NDArray[np.float64],
    turned: NDArray[np.float64],
    tracked: NDArray[np.float64],
) -> None:
    """Poses [n+1, 6], integrals of the body rates [n+1, 3] and tracks' travel [n+1, 2] on the fine grid.

    wanted [n, 4]: speed and body rates to slew to; tilt [n, 2]: roll and pitch to steer to besides; slide [n, 4] in
    [-1, 1]: lateral, normal, left and right slip. Speeds and rates are linear in time inside a substep (RK4).
    """
    accel, spin, most_v, most_w, slip, lateral, centre, normal, half_gauge = limits
    v = 0.0
    w = np.zeros(3)
    w2 = np.zeros(3)
    k = np.zeros((4, 6))
    wt = np.zeros(3)
    vt = np.zeros(3)
    for i in range(len(wanted)):
        aim = min(max(wanted[i, 0], -most_v), most_v)
        v2 = v + min(max(aim - v, -accel * step), accel * step)
        for j in range(3):
            aim = wanted[i, 1 + j]
            if j < 2:
                aim += 4.0 * (tilt[i, j] - pose[i, 3 + j])
            aim = min(max(aim, -most_w), most_w)
            w2[j] = w[j] + min(max(aim - w[j], -spin * step), spin * step)
        for stage in range(4):
            s = (0.0, 0.5, 0.5, 1.0)[stage]
            for j in range(3):
                wt[j] = w[j] + s * (w2[j] - w[j])
            vt[0] = v + s * (v2 - v)
            vt[1] = slide[i, 0] * (lateral * abs(vt[0]) + centre * abs(wt[2]))
            vt[2] = slide[i, 1] * normal * abs(vt[0])
            rates(pose[i] if stage == 0 else pose[i] + s * step * k[stage - 1], wt, vt, k[stage])
        pose[i + 1] = pose[i] + step / 6.0 * (k[0] + 2.0 * k[1] + 2.0 * k[2] + k[3])
        turned[i + 1] = turned[i] + 0.5 * step * (w + w2)
        for side in range(2):
            sign = 2.0 * side - 1.0
            ground = 0.5 * step * (v + v2 + sign * half_gauge * (w[2] + w2[2]))
            tracked[i + 1, side] = tracked[i, side] + ground / (1.0 + slip * slide[i, 2 + side])
        v = v2
        w[:] = w2


@dataclass
class World:
    """One drive: the truth on a fine grid and the samples that its sensors give."""

    seed: int
    mode: str = "corner"
    seconds: float = 12.0
    stand_s: float = 1.6
    script: str = "wander"
    steep_deg: float = 6.0
    gps: bool = True
    gyro_axes: tuple[bool, bool, bool] = (True, True, True)
    tilt: bool = True
    accelerometers: bool = True
    loss: float = 0.0
    exceed: dict[str, float] = field(default_factory=dict)
    """How many times larger than declared an error is: gyro, slip, tilt, gps, latency."""

    def __post_init__(self) -> None:
        self.random = np.random.default_rng(self.seed)
        self.n = int(self.seconds * 1e9) // SUBSTEP_NS
        self.time_ns = 10_000_000_000 + np.arange(self.n + 1, dtype=np.int64) * SUBSTEP_NS
        self._drive()
        samples: list[WheelTicks | InertialSample | Fix] = [*self._encoders(), *self._inertial()]
        if self.gps:
            samples += self._fixes()
        self.samples = sorted(samples, key=lambda sample: sample.stamp.mid_ns)

    def error(self, n: int, *, hold: float = 0.0) -> NDArray[np.float64]:
        """n errors in [-1, 1] in the drive's mode; `hold`: mean number of samples without a change."""
        mode = self.mode if self.mode != "mixed" else MODES[self.random.integers(len(MODES))]
        if mode == "constant":
            return np.full(n, self.random.choice([-1.0, 1.0]))
        if mode == "uniform":
            return self.random.uniform(-1.0, 1.0, n)
        if mode == "switching" and not hold:
            return np.where(np.arange(n) % 2, 1.0, -1.0)
        if mode == "slow" or hold:
            flips = self.random.random(n) < 1.0 / (hold or 200.0)
            return np.where((np.cumsum(flips) + self.random.integers(2)) % 2, 1.0, -1.0)
        return self.random.choice([-1.0, 1.0], n)

    def _drive(self) -> None:
        n, t = self.n, np.arange(self.n) * SUBSTEP_NS * 1e-9
        piece = (t / 1.3).astype(int)
        pieces = piece.max() + 1
        most_w = np.radians(ROBOT.max_turn_rate_dps)
        speed = self.random.choice([-0.6, 0.0, 0.5, 1.0, ROBOT.max_speed_mps], pieces)[piece]
        spin = self.random.uniform(-0.5, 0.5, pieces)[piece] * most_w
        tilt = np.radians(self.steep_deg) * self.random.uniform(-1.0, 1.0, (pieces, 2))[piece]
        flip = self.random.choice([-1.0, 1.0], n)
        if self.script == "spin":
            speed, spin = 0.0 * speed, self.random.choice([-1.0, 1.0], pieces)[piece] * most_w
        elif self.script == "shake":  # the rates turn round every few milliseconds, at the limits
            speed = np.where((t / 0.05).astype(int) % 2, 1.0, -1.0) * ROBOT.max_speed_mps
            spin = np.where((t / 0.008).astype(int) % 2, 1.0, -1.0) * most_w
        elif self.script == "straight":
            speed, spin = np.full(n, 0.7), np.zeros(n)
        elif self.script == "stand":
            speed, spin, tilt, flip = 0.0 * speed, 0.0 * spin, 0.0 * tilt, 0.0 * flip
        wanted = np.stack([speed, 0.3 * flip, -0.3 * flip, spin], axis=1)
        moving = t >= self.stand_s
        wanted[~moving] = 0.0
        start = np.radians(self.steep_deg) * self.random.uniform(-1.0, 1.0, 2)
        tilt[~moving] = start
        if self.script == "stand":
            tilt[:] = start
        slide = np.stack([self.error(n, hold=400.0) if k < 2 else self.error(n, hold=900.0) for k in range(4)], axis=1)
        slide[:, 2:] *= self.exceed.get("slip", 1.0)
        limits = np.array(
            [
                ROBOT.max_acceleration_mps2,
                np.radians(ROBOT.max_turn_acceleration_dps2),
                ROBOT.max_speed_mps,
                most_w,
                ROBOT.slip_ratio,
                ROBOT.lateral_slip_ratio,
                ROBOT.turning_centre_m,
                ROBOT.normal_slip_ratio,
                0.5 * ROBOT.track_gauge_m,
            ]
        )
        self.pose = np.zeros((n + 1, 6))
        self.pose[0, 3:5] = start
        self.turned = np.zeros((n + 1, 3))
        self.tracked = np.zeros((n + 1, 2))
        integrate(SUBSTEP_NS * 1e-9, wanted, tilt, slide, limits, self.pose, self.turned, self.tracked)

    def _stamps(self, index: NDArray[np.int64], latency_ms: tuple[float, float]) -> Iterator[Stamp]:
        least, most = (int(x * 1e6) for x in latency_ms)
        late = 0.5 * (1.0 + self.error(len(index)) * self.exceed.get("latency", 1.0))
        read = self.time_ns[index] + (least + late * (most - least)).astype(np.int64)
        return (Stamp(int(r) - most, int(r) - least) for r in np.maximum.accumulate(read))

    def _encoders(self) -> list[WheelTicks]:
        index = np.arange(0, self.n + 1, 20)
        phase = self.random.random(2)
        counts = np.floor(self.tracked[index] / 0.001 + phase).astype(int)
        self.start = self.pose[0].copy()
        return [
            WheelTicks(stamp, int(left), -int(right))
            for stamp, (left, right) in zip(self._stamps(index, ENCODERS.latency_ms), counts, strict=True)
            if stamp.earliest_ns < 10_000_000_000 or self.random.random() >= self.loss
        ]

    def _device_us(self, index: NDArray[np.int64], resolution: int) -> NDArray[np.int64]:
        rate = 1.0 + self.clock * IMU.clock_drift_ppm * 1e-6
        us = (self.time_ns[index] * 1e-3 * rate).astype(np.int64) - 3_000_000
        return us // resolution * resolution

    def _inertial(self) -> Iterator[InertialSample]:
        self.clock = float(self.error(1)[0])
        exceed = self.exceed.get("gyro", 1.0)
        index = np.arange(3, self.n + 1, 10)
        seconds = np.diff(self.time_ns[index], prepend=self.time_ns[index[0]] - 10 * SUBSTEP_NS) * 1e-9
        mean = np.diff(self.turned[index], axis=0, prepend=self.turned[index[:1]]) / seconds[:, None]
        m = len(index)
        for axis in range(3):
            drift = np.cumsum(self.error(m, hold=500.0) * IMU.gyro_bias_drift_dps2 * 0.005)
            bias = np.clip(self.random.uniform(-1, 1) * IMU.gyro_bias_bound_dps + drift, -0.3, 0.3)
            noise = self.error(m) * IMU.gyro_noise_bound_dps
            mean[:, axis] += np.radians(bias + noise) * exceed + self.error(m) * IMU.gyro_scale_bound * mean[:, axis]
            if not self.gyro_axes[axis]:
                mean[:, axis] = nan
        device = self._device_us(index, 1)
        for k, stamp in enumerate(self._stamps(index, IMU.latency_ms)):
            if self.random.random() >= self.loss:
                x, y, z = (float(r) for r in mean[k])
                yield InertialSample(stamp, "HIGHRES_IMU", 0, int(device[k]), gyro_rps=(x, y, z))
        index = np.arange(3, self.n + 1, 20)
        true = self.pose[index, 3:5]
        if self.tilt:
            bound = np.radians(IMU.tilt_bound_deg) * self.exceed.get("tilt", 1.0)
            device = self._device_us(index, 1000)
            roll, pitch = (true[:, k] + self.error(len(index)) * bound for k in range(2))
            for k, stamp in enumerate(self._stamps(index, IMU.latency_ms)):
                if self.random.random() >= self.loss:
                    yield InertialSample(
                        stamp, "ATTITUDE", 0, int(device[k]), tilt_rad=(float(roll[k]), float(pitch[k]))
                    )
        if self.accelerometers:
            bound = IMU.accel_bound_mps2 + ROBOT.max_acceleration_mps2
            device = self._device_us(index, 1)
            ahead = -9.81 * np.sin(true[:, 1]) + self.error(len(index)) * bound
            left = 9.81 * np.cos(true[:, 1]) * np.sin(true[:, 0]) + self.error(len(index)) * bound
            for k, stamp in enumerate(self._stamps(index, IMU.latency_ms)):
                accel = (float(ahead[k]), float(left[k]), nan)
                yield InertialSample(stamp, "HIGHRES_IMU", 1 + k % 2, int(device[k]), accel_mps2=accel)

    def _fixes(self) -> Iterator[Fix]:
        index = np.arange(37, self.n + 1, 200)
        self.place = np.append(self.random.uniform(-30, 30, 3), self.random.uniform(-pi, pi))
        bound = (0.05, 0.05, 0.1)
        error = np.stack([self.error(len(index)) * b for b in bound], axis=1) * self.exceed.get("gps", 1.0)
        arm = np.array([GPS.antenna_x_m, GPS.antenna_y_m, GPS.antenna_z_m])
        for k, stamp in enumerate(self._stamps(index, GPS.latency_ms)):
            pose = self.pose[index[k]]
            point = pose[:3] + rotation(pose[3], pose[4], pose[5]) @ arm
            enu = self.place[:3] + rotation(0.0, 0.0, self.place[3]) @ point + error[k]
            lat, lon, alt = (float(x) for x in pymap3d.enu2geodetic(*enu, *HOME))
            yield Fix(stamp, None, lat, lon, alt, 4, 0.8, bound)


def rotation(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    (sf, st, sp), (cf, ct, cp) = np.sin([roll, pitch, yaw]), np.cos([roll, pitch, yaw])
    rz = np.array([[cp, -sp, 0], [sp, cp, 0], [0, 0, 1]])
    ry = np.array([[ct, 0, st], [0, 1, 0], [-st, 0, ct]])
    rx = np.array([[1, 0, 0], [0, cf, -sf], [0, sf, cf]])
    return np.asarray(rz @ ry @ rx)


@dataclass
class Outcome:
    """What came of a drive."""

    filter: Filter
    checked: int
    violations: int
    width: NDArray[np.float64]
    """[6] half-widths at the end."""
    width_on_earth: NDArray[np.float64]
    """[6] largest half-widths of the last half."""


def follow(
    world: World,
    config: FilterConfig = CONFIG,
    *,
    modulo_turns: bool = False,
    robot: RobotConfig = ROBOT,
) -> Outcome:
    """Feed a drive to the filter; ask for its poses, as soon as they are to be had, at every instant of the truth."""
    pose = Filter(robot, config, ENCODERS, IMU, GPS if world.gps else None)
    checked = violations = 0
    next_index = 1
    width = np.full(6, np.inf)
    on_earth: list[NDArray[np.float64]] = []
    for count, sample in enumerate(world.samples):
        pose.accept(sample)
        if count % 40 or pose.horizon_ns is None or pose.oldest_ns is None:
            continue
        if next_index == 1:
            next_index = int(np.searchsorted(world.time_ns, pose.oldest_ns))
        last = int(np.searchsorted(world.time_ns, pose.horizon_ns, side="right"))
        if last <= next_index:
            continue
        times = world.time_ns[next_index:last]
        low, high = np.empty((len(times), 6)), np.empty((len(times), 6))
        assert pose.poses_over(times, times, low, high)
        assert np.isfinite(low).all()
        assert np.isfinite(high).all()
        true = world.pose[next_index:last].copy()
        if modulo_turns:
            true[:, 5] += 2 * pi * np.ceil((low[:, 5] - true[:, 5]) / (2 * pi))
        inside = (low - 1e-10 <= true) & (true <= high + 1e-10)
        checked += inside.size
        violations += int((~inside).sum())
        next_index = last
        width = 0.5 * (high[-1] - low[-1])
        earth = pose.pose_on_earth(int(times[-1]), int(times[-1]))
        if earth is not None:
            checked += 6
            violations += 6 - int(on_earth_holds(pose, world, last - 1, earth).sum())
            on_earth.append(0.5 * (earth.high - earth.low))
    widest = np.max(on_earth[len(on_earth) // 2 :], axis=0) if on_earth else np.full(6, np.inf)
    return Outcome(pose, checked, violations, width, widest)


def on_earth_holds(pose: Filter, world: World, index: int, earth: BoundedPose) -> NDArray[np.bool_]:
    """[6] is the true pose in the anchor's ENU frame inside? Yaw counts modulo whole turns."""
    anchor = pose.anchor
    assert anchor is not None
    true = world.pose[index]
    enu = world.place[:3] + rotation(0.0, 0.0, world.place[3]) @ true[:3]
    origin = anchor.origin_lat_deg, anchor.origin_lon_deg, anchor.origin_alt_m
    seen = np.array([*pymap3d.geodetic2enu(*pymap3d.enu2geodetic(*enu, *HOME), *origin), *true[3:]])
    seen[5] += world.place[3]
    seen[5] += 2 * pi * np.ceil((earth.low[5] - seen[5]) / (2 * pi))
    inside = (earth.low - 1e-6 <= seen) & (seen <= earth.high + 1e-6)
    return np.asarray(inside)


@both
@pytest.mark.parametrize("script", ["wander", "spin", "shake", "straight"])
@pytest.mark.parametrize("mode", MODES)
def test_the_true_pose_is_always_inside(script: str, mode: str, config: FilterConfig) -> None:
    """With every error inside its bound no coordinate leaves its interval, at no instant, and no fault is seen."""
    outcome = follow(World(hash_seed(script, mode), mode=mode, script=script, seconds=6.0), config)
    assert outcome.checked > 40_000
    assert outcome.violations == 0
    assert outcome.filter.guarantee.intact


def hash_seed(*words: str) -> int:
    """A seed that is the same in every run."""
    return sum(ord(letter) * (7 + i) for i, letter in enumerate("".join(words)))


EDGES: dict[str, dict[str, object]] = {
    "30 degrees steep": {"steep_deg": 30.0},
    "moving from the first instant": {"stand_s": 0.0},
    "z gyro alone": {"gyro_axes": (False, False, True)},
    "no pitch gyro": {"gyro_axes": (True, False, True)},
    "a third of all packets lost": {"loss": 0.33},
    "no GPS": {"gps": False},
    "no tilt sensor": {"tilt": False},
    "no accelerometers": {"accelerometers": False},
    "standing": {"script": "stand"},
    "spinning": {"script": "spin", "stand_s": 0.1},
}


@pytest.mark.parametrize("mode", ["corner", "constant"])
def test_the_ellipsoid_itself_holds_the_true_x_y_and_yaw(mode: str) -> None:
    """At the newest encoder reading, all along a drive; its box is about the pose's. Boxes know of none."""
    world = World(5, mode=mode, script="wander", seconds=8.0)
    pose, seen = Filter(ROBOT, ELLIPSOID, ENCODERS, IMU, GPS), 0
    for count, sample in enumerate(world.samples):
        pose.accept(sample)
        e = pose.ellipsoid()
        if count % 40 or e is None:
            continue
        during = (world.time_ns >= e.earliest_ns - 500_000) & (world.time_ns <= e.latest_ns + 500_000)
        away = world.pose[during][:, [0, 1, 5]] - e.centre
        least = np.min(np.einsum("ni,ij,nj->n", away, np.linalg.inv(e.shape), away))
        assert least <= 1.0 + 1e-6
        seen += 1
    assert seen > 50
    box, e = pose.latest(), pose.ellipsoid()
    assert box is not None
    assert e is not None
    np.testing.assert_allclose(0.5 * (box.high - box.low)[[0, 1, 5]], np.sqrt(np.diag(e.shape)), rtol=0.25)
    assert follow(world).filter.ellipsoid() is None


@both
@pytest.mark.parametrize("edge", EDGES)
def test_the_true_pose_is_inside_at_the_edges_too(edge: str, config: FilterConfig) -> None:
    """Steep, shaken, half blind or badly connected: the set grows, and holds."""
    for seed in range(2):
        world = World(seed + hash_seed(edge), mode="mixed", seconds=5.0, **EDGES[edge])  # type: ignore[arg-type]
        outcome = follow(world, config)
        assert outcome.checked > 20_000
        assert outcome.violations == 0
        assert outcome.filter.guarantee.intact


@pytest.mark.parametrize(
    ("what", "mode", "script"),
    [
        ("gyro", "constant", "wander"),
        ("slip", "constant", "straight"),
        ("tilt", "constant", "wander"),
        ("gps", "corner", "wander"),  # a constant error of all fixes is one of the anchor, and does no harm
        ("latency", "corner", "wander"),
    ],
)
def test_a_broken_bound_shows(what: str, mode: str, script: str) -> None:
    """Errors of four times their declared bounds lose the truth or are caught: the tests above can fail."""
    shown = 0
    for seed in range(3):
        outcome = follow(World(seed, mode=mode, script=script, seconds=6.0, exceed={what: 4.0}))
        shown += outcome.violations > 0 or not outcome.filter.guarantee.intact
    assert shown >= 2


@both
def test_a_contradiction_names_its_sensor_and_shrinks_nothing(config: FilterConfig) -> None:
    """One fix 5 m off voids the guarantee in the name of the GPS, is not used, and the pose still holds."""
    world = World(3, seconds=6.0)
    wrong = next(k for k, s in enumerate(world.samples) if isinstance(s, Fix) and s.stamp.mid_ns > 14_000_000_000)
    fix = world.samples[wrong]
    assert isinstance(fix, Fix)
    world.samples[wrong] = replace(fix, lat_deg=fix.lat_deg + 5.0 / 111_000.0)
    outcome = follow(world, config)
    assert outcome.filter.guarantee.sensor == "gps"
    assert outcome.filter.guarantee.contradicted_ns == fix.stamp.mid_ns
    assert outcome.filter.counts["contradiction_gps"] == 1
    assert outcome.violations == 0


@pytest.mark.parametrize("mode", ["corner", "constant", "slow"])
def test_the_anchor_holds_the_true_place(mode: str) -> None:
    """The map's place on Earth is inside the anchor, and centimetre GPS narrows it once the robot has driven."""
    world = World(5, mode=mode, script="straight", seconds=14.0)
    anchor = follow(world).filter.anchor
    assert anchor is not None
    lat, lon, alt = pymap3d.enu2geodetic(*world.place[:3], *HOME)
    enu = pymap3d.geodetic2enu(lat, lon, alt, anchor.origin_lat_deg, anchor.origin_lon_deg, anchor.origin_alt_m)
    assert np.all(anchor.low[:3] - 1e-5 <= enu)
    assert np.all(enu <= anchor.high[:3] + 1e-5)
    turns = np.round((anchor.low[3] - world.place[3]) / (2 * pi)) * 2 * pi
    yaw = world.place[3] + turns
    assert any(anchor.low[3] <= yaw + k * 2 * pi <= anchor.high[3] for k in (-1, 0, 1))
    assert np.max(anchor.high[:2] - anchor.low[:2]) < 0.3
    assert anchor.high[3] - anchor.low[3] < 0.2


def test_a_drive_with_centimetre_gps_stays_tight() -> None:
    """After 8 m: a few decimetres across, less along, tilt well under a degree, yaw a few degrees (half-widths)."""
    width = follow(World(5, mode="uniform", script="straight", seconds=13.0)).width
    assert width[0] < 0.2
    assert width[1] < 0.45
    assert width[2] < 0.15
    assert np.degrees(width[3:5]).max() < 0.5
    assert np.degrees(width[5]) < 3.0


def test_on_earth_yaw_and_place_stay_bounded_however_far_the_robot_drives() -> None:
    """With GPS of five centimetres they are no wider at the end of a long drive than soon after its beginning."""
    outcome = follow(World(11, mode="constant", seconds=150.0))
    assert outcome.violations == 0
    assert outcome.filter.guarantee.intact
    assert outcome.width_on_earth[:2].max() < 0.25
    assert np.degrees(outcome.width_on_earth[5]) < 20.0


def test_a_stretch_of_time_holds_the_whole_way() -> None:
    """The box of a stretch contains the pose at each of its instants, and a stretch within it never has a wider box."""
    world = World(8, seconds=5.0, mode="slow")
    pose = follow(world).filter
    assert pose.oldest_ns is not None
    assert pose.horizon_ns is not None
    random = np.random.default_rng(0)
    ends = np.sort(random.integers(pose.oldest_ns, pose.horizon_ns, (300, 2)), axis=1)
    low, high = np.empty((300, 6)), np.empty((300, 6))
    assert pose.poses_over(ends[:, 0].copy(), ends[:, 1].copy(), low, high)
    for k in range(300):
        during = world.pose[(world.time_ns >= ends[k, 0]) & (world.time_ns <= ends[k, 1])]
        assert np.all(low[k] - 1e-10 <= during)
        assert np.all(during <= high[k] + 1e-10)
        inner = pose.pose_over(int(ends[k].mean()), int(ends[k].mean()))
        assert inner is not None
        assert np.all(low[k] <= inner.low)
        assert np.all(inner.high <= high[k])


def test_what_is_too_old_or_not_yet_known_is_refused() -> None:
    """Outside of [oldest, horizon] there is no pose: False, NaN, counted."""
    short = FilterConfig(history_s=0.5, standstill_s=0.5, standstill_rate_dps=0.02)
    pose = follow(World(2, seconds=45.0, script="stand", gps=False, accelerometers=False), config=short).filter
    assert pose.oldest_ns is not None
    assert pose.horizon_ns is not None
    assert pose.horizon_ns - pose.oldest_ns < 30_000_000_000
    for begin, end in [(pose.oldest_ns - 1, pose.oldest_ns), (pose.horizon_ns, pose.horizon_ns + 1), (10, 20)]:
        assert pose.pose_over(begin, end) is None
    assert pose.counts["poses_refused"] == 3
    assert pose.pose_over(pose.oldest_ns, pose.horizon_ns) is not None
    newest = pose.latest()
    assert newest is not None
    assert newest.latest_ns == pose.horizon_ns


def test_nothing_is_claimed_before_the_tilt_is_known() -> None:
    """With ticks and a gyro alone there is no map frame yet."""
    world = World(2, seconds=1.0, tilt=False, accelerometers=False, gps=False)
    pose = Filter(ROBOT, CONFIG, ENCODERS, IMU, None)
    for sample in world.samples:
        pose.accept(sample)
    assert pose.horizon_ns is None
    assert pose.oldest_ns is None
    assert pose.latest() is None
    assert pose.anchor is None
    assert pose.pose_over(10_000_000_000, 10_000_000_000) is None


def test_samples_out_of_order_are_dropped_and_counted() -> None:
    """A stale sample of any kind changes nothing but a count."""
    world = World(4, seconds=4.0)
    late = [s for s in world.samples if s.stamp.mid_ns < 12_000_000_000]
    world.samples.extend(late)
    outcome = follow(world)
    assert outcome.violations == 0
    assert outcome.filter.counts["gyro_out_of_order"] > 100
    assert outcome.filter.counts["encoders_out_of_order"] > 100
    assert outcome.filter.guarantee.intact


@both
@pytest.mark.parametrize("silence_ms", [30, 150, 900])
def test_a_board_that_reboots_costs_width_and_nothing_else(silence_ms: int, config: FilterConfig) -> None:
    """Device times of another epoch are never subtracted; the silence is bridged by what the robot can do."""
    world = World(6, seconds=6.0, mode="mixed", script="wander")
    begin, end = 13_000_000_000, 13_000_000_000 + silence_ms * 1_000_000
    kept: list[WheelTicks | InertialSample | Fix] = []
    for sample in world.samples:
        if isinstance(sample, InertialSample) and sample.stamp.mid_ns > begin:
            if sample.stamp.mid_ns > end and sample.device_time_us is not None:
                kept.append(replace(sample, device_time_us=sample.device_time_us - 9_000_000, epoch=1))
        else:
            kept.append(sample)
    world.samples = kept
    outcome = follow(world, config, modulo_turns=silence_ms > 500)
    assert outcome.violations == 0
    assert outcome.filter.guarantee.intact
    assert np.isfinite(outcome.width).all()


@both
def test_counts_that_fail_for_longer_than_the_history_cost_width_and_nothing_else(config: FilterConfig) -> None:
    """When they come again the gyro nodes of the last ones are forgotten: nothing is said from where they stood."""
    world = World(4, mode="mixed", script="spin", seconds=26.0, gps=False)
    start_ns = world.samples[0].stamp.mid_ns
    pose, seen = Filter(ROBOT, replace(config, history_s=0.5), ENCODERS, IMU, None), 0
    for count, sample in enumerate(world.samples):
        after_ns = sample.stamp.mid_ns - start_ns
        if isinstance(sample, WheelTicks) and 15_000_000_000 < after_ns < 24_000_000_000:
            continue
        pose.accept(sample)
        box = pose.latest() if count % 40 == 0 else None
        if box is not None:
            true = world.pose[np.searchsorted(world.time_ns, box.latest_ns)]
            assert np.all((box.low - 1e-3 <= true) & (true <= box.high + 1e-3))  # the grid's step
            seen += after_ns > 24_500_000_000
    assert seen > 10
    assert pose.counts["attitude_history_missed"] > 0


@both
def test_a_counter_that_restarts_costs_width_and_nothing_else(config: FilterConfig) -> None:
    """Counts of another epoch are never subtracted."""
    world = World(7, seconds=5.0, mode="mixed")
    world.samples = [
        replace(s, left=s.left - 5000, right=s.right + 70, epoch=1)
        if isinstance(s, WheelTicks) and s.stamp.mid_ns > 13_000_000_000
        else s
        for s in world.samples
    ]
    outcome = follow(world, config)
    assert outcome.violations == 0
    assert outcome.filter.guarantee.intact


def test_a_robot_that_stands_learns_its_gyro_bias() -> None:
    """After standing, yaw grows by the noise alone, not by the bias bound."""
    standing = follow(World(9, script="stand", seconds=8.0, gps=False, mode="constant"))
    never = follow(World(9, script="stand", seconds=8.0, gps=False, mode="constant"), config=FilterConfig())
    assert standing.violations == never.violations == 0
    assert standing.width[5] < 0.6 * never.width[5]


@both
@pytest.mark.parametrize("share", [-1.0, 0.0, 1.0])
def test_a_robot_that_stands_keeps_its_yaw_but_for_what_a_standing_robot_may_turn(
    share: float, config: FilterConfig
) -> None:
    """Half a minute at the end of the declared rate: yaw holds it, and boxes are hardly wider than that."""
    still_dps = 0.2
    config = replace(config, standstill_rate_dps=still_dps)
    yaw_rate, seconds, tilt = share * np.radians(still_dps), 30.0, 0.3
    bias = np.radians(IMU.gyro_bias_bound_dps)
    poses = Filter(ROBOT, config, replace(ENCODERS, latency_ms=(0.0, 0.0)), IMU, None)
    for k in range(round(seconds / 0.02)):
        stamp = Stamp(k * 20_000_000, k * 20_000_000)
        gyro = (bias, bias + yaw_rate * np.sin(tilt), bias + yaw_rate * np.cos(tilt))
        poses.accept(InertialSample(stamp, "HIGHRES_IMU", 0, k * 20_000, (nan, nan, nan), gyro, (tilt, 0.0)))
        poses.accept(WheelTicks(stamp, 0, 0))
    pose = poses.latest()
    assert pose is not None
    assert poses.guarantee.intact
    turned = yaw_rate * pose.earliest_ns * 1e-9
    assert pose.low[5] <= turned <= pose.high[5]
    if config.set == "box":
        assert pose.high[5] - pose.low[5] < np.radians(3.0 * still_dps * seconds + 2.7)


@both
@pytest.mark.parametrize("sensor", ["gyro", "tilt", "encoders", "imu_clock"])
def test_a_reading_that_cannot_be_true_is_named_and_not_used(sensor: str, config: FilterConfig) -> None:
    """One impossible packet: the guarantee is void in its sensor's name, and the pose holds as if it had been lost."""

    def spoil(sample: WheelTicks | InertialSample | Fix) -> WheelTicks | InertialSample | Fix:
        if isinstance(sample, WheelTicks) and sensor == "encoders":
            return replace(sample, left=sample.left + 900)
        if isinstance(sample, InertialSample):
            if sensor == "gyro":
                return replace(sample, gyro_rps=(0.0, 0.0, 9.0))
            if sensor == "tilt":
                return replace(sample, tilt_rad=(0.5, 0.5))
            if sample.device_time_us is not None:
                return replace(sample, device_time_us=sample.device_time_us + 200_000)
        return sample

    world = World(3, seconds=5.0, script="straight")
    kinds = {"gyro": "HIGHRES_IMU", "tilt": "ATTITUDE", "imu_clock": "HIGHRES_IMU"}
    wrong = next(
        k
        for k, s in enumerate(world.samples)
        if s.stamp.mid_ns > 13_500_000_000
        and (isinstance(s, WheelTicks) if sensor == "encoders" else isinstance(s, InertialSample))
        and (not isinstance(s, InertialSample) or (s.message == kinds[sensor] and s.sensor_id == 0))
    )
    world.samples[wrong] = spoil(world.samples[wrong])
    outcome = follow(world, config)
    assert outcome.filter.guarantee.sensor == sensor
    assert outcome.filter.guarantee.contradicted_ns == world.samples[wrong].stamp.mid_ns
    assert outcome.violations == 0


@pytest.mark.parametrize("mode", ["corner", "constant", "slow"])
def test_the_tracks_bridge_a_gap_of_the_gyroscope(mode: str) -> None:
    """Without GPS, 0.3 s without inertial packets cost half the yaw where the tracks' turning centres are declared."""
    calm = replace(ROBOT, max_tilt_rate_dps=25.0)
    widths = []
    for robot in (calm, replace(calm, turning_gauge_m=(0.35, 0.35))):
        world = World(21, seconds=6.0, mode=mode, gps=False, script="straight", steep_deg=2.0)
        world.samples = [
            s
            for s in world.samples
            if not isinstance(s, InertialSample) or not 13_000_000_000 < s.stamp.mid_ns < 13_300_000_000
        ]
        outcome = follow(world, robot=robot)
        assert outcome.violations == 0
        assert outcome.filter.guarantee.intact
        widths.append(np.degrees(outcome.width[5]))
    assert widths[1] < 0.7 * widths[0]
