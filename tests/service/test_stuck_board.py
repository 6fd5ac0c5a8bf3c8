"""An inertial board whose sensors stick while the robot drives: where noise is declared, nothing of it is believed."""

from collections.abc import Mapping
from dataclasses import replace

from service.commands.virtual_drive import VirtualDrive, VirtualWire, drive_virtually
from service.config import load
from service.shipped import shipped_config
from simulator.emulators.imu import ImuEmulator


def drive_with_a_stuck_board(always_noisy: bool) -> VirtualDrive:
    """From 4.0 to 5.2 s of a drive over rough ground all sensors of the board repeat their last readings."""
    demo = load(shipped_config("demo.toml"))
    devices = demo.config.devices
    devices = replace(devices, imu=replace(devices.imu, always_noisy=always_noisy))

    def meddle(wires: Mapping[str, VirtualWire], driven_s: float) -> None:
        board = wires["imu"].emulator
        assert isinstance(board, ImuEmulator)
        board.stuck = 4.0 <= driven_s < 5.2

    loaded = replace(demo, config=replace(demo.config, devices=devices))
    return drive_virtually(loaded, scene="rough", law="corners", seed=5, duration_s=8.0, meddle=meddle)


def test_what_a_stuck_board_says_is_never_used() -> None:
    """Every true pose is inside its set, and every hit before in its cell; nothing is voided.

    In those seconds the heading is lost: from then on many beams are too uncertain for any cell.
    """
    drive = drive_with_a_stuck_board(always_noisy=True)
    truth = drive.truth.in_map_frame()
    poses = drive.poses
    assert truth.pose_violations(poses.earliest_ns, poses.latest_ns, poses.low, poses.high) == 0
    begin_ns = int(truth.pose_time_ns.max()) - 8_000_000_000
    into_drive_s = (truth.hit_time_ns - begin_ns) * 1e-9
    mapped = poses.cover(truth.hit_time_ns) & (into_drive_s < 3.8)
    mapped &= (truth.hit_range_m >= drive.laser.range_min_m) & (truth.hit_range_m <= drive.laser.range_max_m)
    saved = drive.saved
    assert truth.cell_violations(saved.low, saved.high, saved.resolution_m, saved.origin_m, mapped) == 0
    assert mapped.sum() > 15_000
    assert drive.pipeline.filter.guarantee.intact
    counts = drive.wires["imu"].protocol.counts
    assert counts["unchanged"] > 100
    assert counts["stuck"] > 100


def test_without_that_declaration_it_is_believed_and_comes_to_light() -> None:
    """The bounds do not hold then: something true is outside, or the guarantee is voided. It is told all the same."""
    drive = drive_with_a_stuck_board(always_noisy=False)
    pose_violations, cell_violations, _ = drive.violations()
    assert pose_violations + cell_violations > 0 or not drive.pipeline.filter.guarantee.intact
    assert drive.wires["imu"].protocol.counts["stuck"] > 100
