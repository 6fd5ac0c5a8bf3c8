"""What the simulated devices are told, against the truth and the declared bounds."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray

from drivers.config import DevicesConfig, EncodersConfig, GpsConfig, ImuConfig, LaserConfig
from drivers.gps_nmea.protocol import GpsProtocol
from simulator.emulators.gps import GpsEmulator
from simulator.errors import LAWS, ErrorLaw
from simulator.robot import RobotModel, rotations
from simulator.terrain import build_terrain
from simulator.world import World

START_NS, DRIVE_NS = 5_000_000_000, 6_000_000_123
ANGLES = np.radians(np.arange(181) - 90.0)
OFFSETS = np.arange(181, dtype=np.int64) * 37_000
LEVER = np.array([-0.2, 0.05, 0.6])

LASER = LaserConfig(
    port="laser", latency_ms=(0, 6), range_bound_m=0.03, angle_bound_deg=0.25, across_bound_deg=0.15, mount_x_m=0.25,
    mount_y_m=0.01, mount_z_m=0.468, mount_pitch_deg=-10.0, mount_position_bound_m=0.004, mount_angle_bound_deg=0.2,
)  # fmt: skip
DEVICES = DevicesConfig(
    laser=LASER,
    encoders=EncodersConfig(
        port="can", dbc="tracks.dbc", left="T.L", right="T.R", left_metres_per_tick=1e-4,
        right_metres_per_tick=-1.1e-4, latency_ms=(0, 6),
    ),
    imu=ImuConfig(
        port="imu", latency_ms=(0, 6), clock_drift_ppm=20, gyro_bias_bound_dps=0.05, gyro_bias_drift_dps2=0.002,
        gyro_noise_bound_dps=0.02, gyro_scale_bound=0.005, tilt_bound_deg=0.3, accel_bound_mps2=0.2,
    ),
    gps=GpsConfig(
        port="gps", latency_ms=(0, 6), gst_factor=5, range_error_m=3, floor_horizontal_m=0.1, floor_vertical_m=0.2,
        rtk_fixed_horizontal_m=0.03, rtk_fixed_vertical_m=0.05, antenna_x_m=LEVER[0], antenna_y_m=LEVER[1],
        antenna_z_m=LEVER[2],
    ),
)  # fmt: skip


def world(law: str, scene: str = "rough", seed: int = 3, duration_s: float = 12.0) -> World:
    built = World(build_terrain(scene, seed), RobotModel(), DEVICES, ErrorLaw(law, seed), START_NS, duration_s)
    built.begin_drive(DRIVE_NS)
    return built


def shares(errors: NDArray[np.float64], bound: float, law: str) -> None:
    """The errors stay in the bound and, but for the uniform law, come within 5 % of it."""
    assert np.abs(errors).max() <= bound
    assert np.abs(errors).max() > (0.8 if law == "uniform" else 0.95) * bound


@pytest.mark.parametrize("law", LAWS)
def test_beams_stay_in_their_bounds_and_touch_them(law: str) -> None:
    """From the true laser at the true shot time, each hit is off by less than its bounds: range, along and across."""
    simulated = world(law)
    mount = simulated.true_mount
    nominal = np.array([0.25, 0.01, 0.468, 0.0, np.radians(10.0), 0.0])
    bounds = np.array([0.004] * 3 + [np.radians(0.2)] * 3)
    assert (np.abs(mount - nominal) <= bounds + 1e-15).all()
    if law != "uniform":
        np.testing.assert_allclose(np.abs(mount - nominal), bounds, rtol=1e-9)
    range_errors, angle_errors, across_errors = [], [], []
    for start_ns in range(DRIVE_NS, DRIVE_NS + 11_000_000_000, 250_000_000):
        times = start_ns + OFFSETS
        ranges = simulated.measure(times, ANGLES)
        seen = np.isfinite(ranges)
        hits = simulated.truth(start_ns).hit[-seen.sum() :]
        poses = np.array([simulated.pose(int(t)) for t in times[seen]])
        world_from_base = rotations(poses)
        base_from_laser = rotations(mount[None])[0]
        in_base = np.einsum("nji,nj->ni", world_from_base, hits - poses[:, :3])
        in_laser = (in_base - mount[:3]) @ base_from_laser
        across_errors.append(np.arctan2(in_laser[:, 2], np.hypot(in_laser[:, 0], in_laser[:, 1])))
        range_errors.append(ranges[seen] - np.linalg.norm(in_laser, axis=1))
        angle_errors.append(np.arctan2(in_laser[:, 1], in_laser[:, 0]) - ANGLES[seen])
    shares(np.concatenate(range_errors), 0.03 - 0.0005 + 1e-12, law)
    shares(np.concatenate(angle_errors), np.radians(0.25) + 1e-9, law)
    shares(np.concatenate(across_errors), np.radians(0.15) + 1e-9, law)


@pytest.mark.parametrize("law", LAWS)
def test_gyro_readings_stay_in_their_bounds(law: str) -> None:
    """|reading - true mean rate| <= bias + noise + scale * rate, whichever of the two rates the scale is taken of."""
    simulated = world(law)
    times = DRIVE_NS + np.arange(0, 11_000_000_000, 4_999_877)
    read = np.array([simulated.gyro(int(a), int(b)) for a, b in pairwise(times)])
    attitude = rotations(np.array([simulated.pose(int(t)) for t in times]))
    step = np.einsum("nji,njk->nik", attitude[:-1], attitude[1:])
    turned = 0.5 * np.column_stack(
        [step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]]
    )
    rate = turned / (np.diff(times)[:, None] * 1e-9)
    additive = np.radians(0.05 + 0.02)
    # The finite difference of interpolated attitudes is good to a few 1e-4 rad/s, the reading to much better.
    slack = 4e-4
    assert (np.abs(read - rate) <= additive + 0.005 * np.minimum(np.abs(rate), np.abs(read)) + slack).all()
    still = read[: int(1.9e9 / 4_999_877)]
    assert np.abs(still).max() <= additive
    if law == "corners":
        assert np.abs(still).max() > 0.99 * additive


@pytest.mark.parametrize("scene", ["stairs", "rough"])
def test_gyro_increments_telescope(scene: str) -> None:
    """Mean rates times their intervals add up over any partition, but for the declared errors."""
    simulated = world("constant", scene)
    quiet = np.array(simulated.gyro(DRIVE_NS, DRIVE_NS + 1_000_000))
    times = DRIVE_NS + np.arange(0, 10_000_000_001, 5_000_000)
    fine = sum(np.array(simulated.gyro(int(t), int(t) + 5_000_000)) - quiet for t in times[:-1]) * 0.005
    whole = (simulated.gyro(DRIVE_NS, int(times[-1])) - quiet) * 10.0
    np.testing.assert_allclose(fine, whole, atol=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_tilt_and_accelerometers_stay_in_their_bounds_and_touch_them(law: str) -> None:
    """Against the true attitude and the true specific force at the same instant."""
    simulated = world(law)
    tilt, force = [], []
    for t in range(DRIVE_NS, DRIVE_NS + 11_000_000_000, 10_000_000):
        pose = simulated.pose(t)
        tilt.append(np.array(simulated.tilt(t)) - pose[3:5])
        row = (t - DRIVE_NS) // 1_000_000
        force.append(np.array(simulated.accel(t, 1)) - simulated.drive.specific_force[row, :2])
    shares(np.array(tilt), np.radians(0.3), law)
    shares(np.array(force), 0.2, law)


@pytest.mark.parametrize("law", LAWS)
def test_fixes_stay_in_their_bounds_and_touch_them(law: str) -> None:
    """The antenna, not base_link, is where the fix says, within the declared half-widths."""
    simulated = world(law)
    errors = []
    for t in range(DRIVE_NS, DRIVE_NS + 11_000_000_000, 100_000_000):
        pose = simulated.pose(t)
        antenna = pose[:3] + rotations(pose[None])[0] @ LEVER
        errors.append(np.array(pymap3d.geodetic2enu(*simulated.position(t), *simulated.origin)) - antenna)
    for axis, bound in enumerate((0.03, 0.03, 0.05)):
        shares(np.array(errors)[:, axis], bound, law)


@pytest.mark.parametrize("law", LAWS)
def test_velocities_are_the_antennas_to_within_their_bound(law: str) -> None:
    """Lever arm and digits included; told only where a bound is declared."""
    simulated = world(law)
    assert simulated.ground_velocity(DRIVE_NS) is None
    assert DEVICES.gps is not None
    gps = replace(DEVICES.gps, velocity_bound_mps=0.05)
    simulated.devices = replace(DEVICES, gps=gps)
    receiver = GpsEmulator(
        simulated.position, start_ns=DRIVE_NS, period_ns=100_000_000, velocity=simulated.ground_velocity
    )
    errors = []
    for t in range(DRIVE_NS, DRIVE_NS + 11_000_000_000, 100_000_000):
        before, after = (
            pose[:3] + rotations(pose[None])[0] @ LEVER
            for pose in (simulated.pose(t - 1_000_000), simulated.pose(t + 1_000_000))
        )
        host, sent_ns = GpsProtocol(gps), t + receiver.latency_ns
        (fix,) = host.receive_data(receiver.data_to_send(sent_ns), sent_ns) + host.finish()
        assert fix.ground_velocity_mps is not None
        errors.append(np.array(fix.ground_velocity_mps) - (after - before)[:2] / 2e-3)
    assert np.abs(errors).max() < 0.05 + 2e-3
    assert np.abs(errors).max() > 0.035


def test_counters_follow_the_tracks() -> None:
    """Ticks times metres per tick are the encoder travel; the right counter falls."""
    simulated = world("constant")
    left, right = simulated.count(DRIVE_NS + 12_000_000_000)
    np.testing.assert_allclose((left * 1e-4, right * -1.1e-4), simulated.drive.tracks[-1], rtol=1e-12)
    assert left > 0 > right


def test_the_robot_stands_still_until_its_drive_begins() -> None:
    """However long the handshake takes, the pose is the first one, and the counters are at zero."""
    terrain = build_terrain("rough", 3)
    simulated = World(terrain, RobotModel(), DEVICES, ErrorLaw("corners", 3), START_NS, 8.0)
    assert simulated.drive_end_ns is None
    later = START_NS + 30_000_000_000
    np.testing.assert_array_equal(simulated.pose(later), simulated.drive.pose[0])
    assert np.isfinite(simulated.measure(later + OFFSETS, ANGLES)).sum() > 100
    simulated.begin_drive(later)
    assert simulated.drive_end_ns == later + 8_000_000_000
    assert simulated.count(later + 2_000_000_000) == (0.0, 0.0)
    assert simulated.count(later + 4_000_000_000)[0] > 0.0
    truth = simulated.truth(later + 8_000_000_000)
    assert truth.pose_time_ns[0] <= START_NS
    assert (truth.pose[: 30_000 + 2000] == truth.pose[0]).all()


@pytest.mark.parametrize("scene", ["ramp", "stairs", "rough"])
def test_hits_lie_on_the_terrain(scene: str) -> None:
    """No hit is above the top surface; many are on it, the others on vertical faces."""
    simulated = world("corners", scene)
    for start_ns in range(DRIVE_NS, DRIVE_NS + 11_000_000_000, 500_000_000):
        simulated.measure(start_ns + OFFSETS, ANGLES)
    hit = simulated.truth(DRIVE_NS).hit
    nudge = 1e-9  # a hit on a vertical face may be rounded to either side of it
    top = np.max([simulated.terrain.height(hit[:, 0] + dx, hit[:, 1] + dy)
                  for dx in (-nudge, nudge) for dy in (-nudge, nudge)], axis=0)  # fmt: skip
    assert (hit[:, 2] <= top + 1e-8).all()
    assert (np.abs(hit[:, 2] - top) < 1e-8).mean() > 0.3


def test_a_world_repeats_by_its_seed() -> None:
    """Same scene, law and seed: same readings; another seed: others."""
    one, two, other = (world("uniform", seed=s) for s in (3, 3, 4))
    t = DRIVE_NS + 7_000_000_000
    for name, arguments in (
        ("measure", (t + OFFSETS, ANGLES)),
        ("gyro", (t, t + 5_000_000)),
        ("tilt", (t,)),
        ("accel", (t, 2)),
        ("position", (t,)),
        ("count", (t,)),
    ):
        readings = [np.asarray(getattr(w, name)(*arguments)) for w in (one, two, other)]
        np.testing.assert_array_equal(readings[0], readings[1])
        assert (readings[0] != readings[2]).any()
