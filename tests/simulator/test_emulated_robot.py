"""The whole robot, mouth to mouth with the drivers over real pseudo-terminals, in lockstep."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.clock import LockstepClock, SystemClock
from drivers.config import DevicesConfig, EncodersConfig, GpsConfig, ImuConfig, LaserConfig
from drivers.errors import ConfigurationError, PortLost
from drivers.gps_nmea.protocol import GpsProtocol
from drivers.imu.protocol import ImuProtocol
from drivers.samples import Fix, InertialSample, Sample, Scan, WheelTicks
from drivers.sick_lms.protocol import SickLmsProtocol
from drivers.track_encoders.protocol import TrackEncoderProtocol
from drivers.transports import open_serial
from simulator.emulated_devices import DEVICES
from simulator.emulated_robot import Progress, run_emulated_robot
from simulator.emulators.sick_lms import SickLmsEmulator
from simulator.errors import ErrorLaw
from simulator.ports import PseudoPort
from simulator.robot import RobotModel
from simulator.terrain import build_terrain
from simulator.truth import Truth
from simulator.wire import Wire
from simulator.world import World

DBC = Path(__file__).parents[2] / "docs" / "config" / "tracks.dbc"
DURATION_S = 6.0

CONFIG = DevicesConfig(
    laser=LaserConfig(
        port="laser", latency_ms=(0, 11), range_bound_m=0.03, angle_bound_deg=0.1, range_max_m=8.0, mount_x_m=0.2,
        mount_y_m=0.0, mount_z_m=0.468, mount_pitch_deg=-10.0, mount_position_bound_m=0.002, mount_angle_bound_deg=0.1,
    ),
    encoders=EncodersConfig(
        port="encoders", dbc=str(DBC), left="TRACKS.LEFT", right="TRACKS.RIGHT", left_metres_per_tick=2e-4,
        right_metres_per_tick=2e-4, latency_ms=(0, 11),
    ),
    imu=ImuConfig(
        port="imu", baud=921600, latency_ms=(0, 11), clock_drift_ppm=50, gyro_bias_bound_dps=0.3,
        gyro_bias_drift_dps2=0.0005, gyro_noise_bound_dps=0.05, gyro_scale_bound=0.002, tilt_bound_deg=0.3,
        accel_bound_mps2=0.1,
    ),
    gps=GpsConfig(
        port="gps", latency_ms=(38, 50), gst_factor=5, range_error_m=5, floor_horizontal_m=0.02,
        floor_vertical_m=0.04, rtk_fixed_horizontal_m=0.05, rtk_fixed_vertical_m=0.08, antenna_z_m=0.6,
    ),
)  # fmt: skip


@dataclass
class Host:
    """The least that listens to all four devices: a thread each, every byte acknowledged."""

    folder: Path
    clock: LockstepClock
    samples: dict[str, list[Sample]] = field(default_factory=lambda: {name: [] for name in DEVICES})
    counts: dict[str, dict[str, int]] = field(default_factory=dict)

    def listen(self) -> list[threading.Thread]:
        assert CONFIG.gps is not None
        protocols: dict[str, Any] = {
            "laser": SickLmsProtocol(CONFIG.laser),
            "encoders": TrackEncoderProtocol(CONFIG.encoders, DBC.read_text()),
            "imu": ImuProtocol(CONFIG.imu),
            "gps": GpsProtocol(CONFIG.gps),
        }
        threads = [threading.Thread(target=self._converse, args=item) for item in protocols.items()]
        for thread in threads:
            thread.start()
        return threads

    def _converse(self, name: str, protocol: Any) -> None:
        transport = open_serial(str(self.folder / name), protocol.baud or 115200)
        total = 0
        protocol.connection_made(self.clock.now_ns())
        try:
            while True:  # until the robot unplugs its devices at the end
                if request := protocol.data_to_send():
                    transport.write(request)
                if protocol.baud is not None:
                    transport.set_baud(protocol.baud)
                data = transport.read(0.005)
                now_ns = self.clock.now_ns()
                if protocol.deadline_ns is not None and protocol.deadline_ns <= now_ns:
                    protocol.advance(now_ns)
                if data:
                    self.samples[name] += protocol.receive_data(data, now_ns)
                    total += len(data)
                    self.clock.acknowledge(name, total)
        except PortLost:
            self.counts[name] = dict(protocol.counts)
        finally:
            transport.close()


@dataclass
class Run:
    host: Host
    truth: Truth
    world: World
    reports: list[Progress]

    def of(self, name: str) -> list[Sample]:
        return self.host.samples[name]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    folder = tmp_path_factory.mktemp("robot")
    clock = LockstepClock.create(folder / "clock", DEVICES, now_ns=1_000_000_000)
    law = ErrorLaw("corners", 2)
    world = World(build_terrain("rough", 2), RobotModel(), CONFIG, law, clock.now_ns(), DURATION_S)
    reports: list[Progress] = []
    host = Host(folder, LockstepClock.attach(folder / "clock"))
    threads: list[threading.Thread] = []

    def on_progress(progress: Progress) -> None:
        if progress.state == "waiting":
            threads.extend(host.listen())
        reports.append(progress)

    truth_path = folder / "truth.npz"
    run_emulated_robot(world, CONFIG, folder, clock=clock, truth_path=truth_path, on_progress=on_progress)
    for thread in threads:
        thread.join(timeout=10)
    yield Run(host, Truth.load(folder / "truth.npz"), world, reports)
    host.clock.close()
    clock.close()


def test_every_device_is_heard_at_its_rate(run: Run) -> None:
    """75 scans, 100 counts, 350 inertial packets, 10 fixes a second: none lost, none false."""
    end_ns, begin_ns = run.truth.pose_time_ns[-1], run.truth.pose_time_ns[-1] - 5_000_000_000
    for name, rate in (("laser", 1 / 0.01332), ("encoders", 100), ("imu", 350), ("gps", 10)):
        within = [s for s in run.of(name) if begin_ns < s.stamp.mid_ns <= end_ns - 100_000_000]
        assert len(within) == pytest.approx(4.9 * rate, abs=2 + 0.01 * rate)
    for name, dirt in (("laser", "bad_crc"), ("imu", "bad_crc"), ("imu", "lost"), ("gps", "bad_checksum")):
        assert run.host.counts[name].get(dirt, 0) == 0


def test_the_drive_begins_when_the_hosts_listen_and_ends_on_time(run: Run) -> None:
    """States pass from waiting over starting and driving to done; the drive has its whole duration."""
    states = [report.state for report in run.reports]
    assert states == sorted(states, key=["waiting", "starting", "driving", "done"].index)
    assert run.reports[-1].driven_s == pytest.approx(DURATION_S, abs=0.011)
    assert run.reports[-1].scans > 75 * DURATION_S
    assert np.ptp(run.truth.pose[:, 0]) > 0.5


def test_stamps_of_beams_contain_the_true_time_of_their_shots(run: Run) -> None:
    """Each distance that arrived has a true hit inside its stamp, with its range to the wire's millimetre."""
    times, ranges = run.truth.hit_time_ns, run.truth.hit_range_m
    checked = 0
    for scan in run.of("laser")[-300:-5]:
        assert isinstance(scan, Scan)
        seen = np.isfinite(scan.ranges_m) & (scan.ranges_m < CONFIG.laser.range_max_m)
        first = np.searchsorted(times, scan.stamp.earliest_ns + scan.beam_offset_ns[seen])
        last = np.searchsorted(times, scan.stamp.latest_ns + scan.beam_offset_ns[seen], side="right")
        for a, b, distance in zip(first, last, scan.ranges_m[seen], strict=True):
            assert np.abs(ranges[a:b] - distance).min() <= 0.0005 + 1e-9
            checked += 1
    assert checked > 20_000


def test_stamps_of_the_other_samples_contain_true_times(run: Run) -> None:
    """Counts, tilt and fixes at some instant of their stamp are what the world says, within the declared bounds."""
    ticks = [s for s in run.of("encoders") if isinstance(s, WheelTicks)]
    for before, after in zip(ticks[::50], ticks[50::50], strict=False):
        moved = np.array([after.left - before.left, after.right - before.right])
        least = np.array(run.world.count(after.stamp.earliest_ns)) - run.world.count(before.stamp.latest_ns)
        most = np.array(run.world.count(after.stamp.latest_ns)) - run.world.count(before.stamp.earliest_ns)
        assert (moved >= least - 1).all()
        assert (moved <= most + 1).all()
    assert ticks[-1].left > 1000
    tilts = [s for s in run.of("imu") if isinstance(s, InertialSample) and not np.isnan(s.tilt_rad[0])]
    for tilt in tilts:
        poses = np.array([run.world.pose(int(t)) for t in np.linspace(tilt.stamp.earliest_ns, tilt.stamp.latest_ns, 9)])
        error = np.abs(poses[:, 3:5] - np.array(tilt.tilt_rad)).min(axis=0)
        assert (error <= np.radians(CONFIG.imu.tilt_bound_deg)).all()
    for fix in run.of("gps"):
        assert isinstance(fix, Fix)
        assert fix.quality == 4
    assert len(run.of("gps")) >= 10 * DURATION_S - 2


def test_the_true_end_is_where_the_drive_ends(run: Run) -> None:
    """The saved poses are those of the planned drive, and the robot rests at its end."""
    np.testing.assert_allclose(run.truth.pose[-1], run.world.drive.pose[-1], atol=1e-12)
    np.testing.assert_array_equal(run.truth.pose[0], run.world.drive.pose[0])


def test_a_latency_narrower_than_a_slice_is_refused(tmp_path: Path) -> None:
    """Bytes leave at slice ends: an honest stamp needs that much room, and the message says which key to mend."""
    narrow = replace(CONFIG, imu=replace(CONFIG.imu, latency_ms=(0.0, 3.0)))
    world = World(build_terrain("flat"), RobotModel(), narrow, ErrorLaw(), 0, 4.0)
    with pytest.raises(ConfigurationError, match=r"devices\.imu\.latency_ms"):
        run_emulated_robot(world, narrow, tmp_path)


def test_in_real_time_nobody_is_waited_for(tmp_path: Path) -> None:
    """Without a lockstep clock the devices run on the system's clock, host or none, and the truth outlives the stop."""
    world = World(build_terrain("flat"), RobotModel(), CONFIG, ErrorLaw(), SystemClock().now_ns(), 4.0)
    stopping = threading.Event()
    reports: list[Progress] = []

    def on_progress(progress: Progress) -> None:
        reports.append(progress)
        if progress.state == "waiting":
            assert sorted(path.name for path in tmp_path.iterdir()) == sorted(DEVICES)
        if len(reports) == 4:
            stopping.set()

    run_emulated_robot(
        world, CONFIG, tmp_path, truth_path=tmp_path / "truth.npz", on_progress=on_progress, stopping=stopping
    )
    assert [report.state for report in reports] == ["waiting", "starting", "starting", "starting", "done"]
    assert reports[-1].now_ns - reports[0].now_ns >= 400_000_000
    truth = Truth.load(tmp_path / "truth.npz")
    assert (truth.pose == truth.pose[0]).all()
    assert [path.name for path in tmp_path.iterdir()] == ["truth.npz"]


def test_a_host_at_another_rate_gets_garbage(tmp_path: Path) -> None:
    """The scanner's power-on telegram is whole at its own 9600 baud, and of one length but wrong at another."""
    telegrams = []
    for rate in (9600, 38400):
        port = PseudoPort(tmp_path / f"laser-{rate}")
        host = open_serial(port.path, rate)
        wire = Wire("laser", SickLmsEmulator(lambda times, _: np.full(times.size, 3.0)), port)
        for now_ns in range(0, 1_000_000_000, 5_000_000):
            wire.exchange(now_ns)
        data = bytearray()
        while len(data) < wire.due:
            data += host.read(1.0)
        telegrams.append(bytes(data))
        host.close()
        port.close()
    assert telegrams[0].startswith(b"\x02\x80")
    assert len(telegrams[1]) == len(telegrams[0])
    assert b"\x02" not in telegrams[1]


class SlowPort(PseudoPort):
    """A port at which this process is interrupted between its look at the clock and its write."""

    def write(self, data: bytes = b"") -> None:
        if data:
            time.sleep(0.05)  # the time that passes is what is tested
        super().write(data)


def test_bytes_that_an_interruption_made_late_are_told(tmp_path: Path) -> None:
    """Whoever finds a clock contradicted on a busy machine sees whether the emulated robot kept its own word."""
    for kind, overdue in ((PseudoPort, False), (SlowPort, True)):
        port = kind(tmp_path / kind.__name__)
        host = open_serial(port.path, 9600)
        wire = Wire("laser", SickLmsEmulator(lambda times, _: np.full(times.size, 3.0)), port)
        wire.patience_ns = 50_000_000 if overdue else 60_000_000_000
        now_ns = SystemClock().now_ns()
        wire.prepare(now_ns)
        while not wire.due:
            now_ns = SystemClock().now_ns()
            wire.exchange(now_ns)
        assert (wire.overdue_bytes > 0) is overdue
        host.close()
        port.close()
