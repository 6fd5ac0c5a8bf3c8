"""Recorded bytes, replayed directly and through ports, give what the live run gave."""

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.capture import CaptureWriter, RawChunk, read_capture
from drivers.sick_lms.protocol import SickLmsProtocol
from drivers.sick_lms.telegrams import Command
from mapper.saved_map import SavedMap
from mapper.saved_map import load as load_map
from service.commands.evaluation import PoseSets, check_bounds
from service.commands.port_drive import PortDrive
from service.commands.replay import replay
from service.messages import guarantee_message, guarantee_of, read_pose
from service.replay import replay as replay_directly
from simulator.emulators.sick_lms import SickLmsEmulator
from simulator.wire import as_heard

SaidOnStderr = Callable[[], str]


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> SaidOnStderr:
    """What was written on standard error since it was last asked."""
    return lambda: capsys.readouterr().err


def inside(part: SavedMap, whole: SavedMap) -> bool:
    """Is every cell of `part` a cell of `whole`, and its interval inside that one's?"""
    shift = (np.array(part.origin_m) - np.array(whole.origin_m)) / whole.resolution_m
    ix, iy = (round(float(cells)) for cells in shift)
    rows, columns = slice(iy, iy + part.low.shape[0]), slice(ix, ix + part.low.shape[1])
    low, high = whole.low[rows, columns], whole.high[rows, columns]
    seen = np.isfinite(part.low)
    assert low.shape == part.low.shape
    return bool((low[seen] <= part.low[seen]).all() and (part.high[seen] <= high[seen]).all())


def test_the_drive_was_bounded(port_drive: PortDrive) -> None:
    """Through real ports, drivers, filter and mapper: no true pose and no true hit outside, and enough of both."""
    poses, laser = port_drive.pose_sets(), port_drive.loaded.config.devices.laser
    pose_violations, cell_violations, hits = check_bounds(port_drive.truth, poses, load_map(port_drive.map), laser)
    assert (pose_violations, cell_violations) == (0, 0)
    assert hits > 50_000
    assert port_drive.onboard.pipeline.filter.guarantee.intact


@pytest.mark.parametrize("ports", [False, True], ids=["directly", "through ports"])
def test_a_replay_is_the_live_run_bit_for_bit(port_drive: PortDrive, tmp_path: Path, ports: bool) -> None:
    """The same bytes with the same stamps: the same map file and the same pose sets."""
    replay(port_drive.capture, map=tmp_path / "map.npz", poses=tmp_path / "poses.jsonl", ports=ports)
    assert (tmp_path / "map.npz").read_bytes() == port_drive.map.read_bytes()
    assert (tmp_path / "poses.jsonl").read_bytes() == port_drive.poses.read_bytes()


def test_poses_that_a_later_measurement_takes_back_are_told_so_by_the_last_line(
    port_drive: PortDrive, tmp_path: Path
) -> None:
    """Wheels whose scale is wrong contradict after the last scan: the file's last word is the map's, not `intact`."""
    recording = read_capture(port_drive.capture)
    (tmp_path / "tracks.dbc").write_text(recording.dbc_text)
    config = tmp_path / "wrong.toml"
    config.write_text(recording.config_text.replace("metres_per_tick = 0.0002", "metres_per_tick = 0.0004"))
    replay(port_drive.capture, config=config, map=tmp_path / "whole.npz")
    contradicted_ns = guarantee_of(load_map(tmp_path / "whole.npz").guarantee).contradicted_ns
    assert contradicted_ns is not None
    writer = CaptureWriter(tmp_path / "drive.mcap", recording.config_text, recording.dbc_text)
    for chunk in recording:
        if chunk.device != "laser" or chunk.stamp_ns < contradicted_ns - 200_000_000:
            writer.write(chunk.device, chunk.data, chunk.stamp_ns, chunk.stamp_ns, chunk.late_ns)
    writer.close()
    replay(tmp_path / "drive.mcap", config=config, map=tmp_path / "map.npz", poses=tmp_path / "poses.jsonl")
    poses = [read_pose(line.encode()) for line in (tmp_path / "poses.jsonl").read_text().splitlines()]
    assert poses[0].guarantee.intact
    assert not poses[-1].guarantee.intact
    assert guarantee_message(poses[-1].guarantee) == guarantee_of(load_map(tmp_path / "map.npz").guarantee)


@pytest.mark.parametrize("told", [True, False], ids=["all but one answer is heard", "it streams already"])
def test_a_scanner_that_somebody_else_has_set_up_is_listened_to(
    port_drive: PortDrive, tmp_path: Path, said: SaidOnStderr, told: bool
) -> None:
    """Without a conversation that our driver can follow, the telegrams tell: the scans come, and nothing is outside."""
    chunks, loaded = list(read_capture(port_drive.capture)), port_drive.loaded
    talk = [chunk for chunk in chunks if chunk.device == "laser" and chunk.data]
    of_errors = next(i for i, chunk in enumerate(talk) if Command.ERRORS.answer in chunk.data[:8])
    left_out = talk[of_errors : of_errors + 1] if told else talk[: len(talk) // 4]
    heard = CaptureWriter(tmp_path / "heard.mcap", loaded.text, loaded.dbc_text())
    for chunk in chunks:
        if not chunk.deadline and not any(chunk is unheard for unheard in left_out):
            heard.write(chunk.device, chunk.data, chunk.stamp_ns, chunk.stamp_ns)
    heard.close()
    assert replay(tmp_path / "heard.mcap", map=tmp_path / "map.npz", poses=tmp_path / "poses.jsonl") == 0
    assert ("laser_scans_of_inferred_width" in said()) is not told
    poses = PoseSets.read(tmp_path / "poses.jsonl")
    pose_violations, cell_violations, hits = check_bounds(
        port_drive.truth, poses, load_map(tmp_path / "map.npz"), loaded.config.devices.laser
    )
    assert (pose_violations, cell_violations) == (0, 0)
    assert hits > 20_000


def test_a_cut_recording_replays_up_to_the_cut(port_drive: PortDrive, tmp_path: Path, said: SaidOnStderr) -> None:
    """Wherever a crash cut it: it replays, says so, and claims nothing that the whole drive does not claim."""
    whole, full = port_drive.capture.read_bytes(), load_map(port_drive.map)
    cells = []
    for share in (0.34, 0.5, 0.77, 0.9):
        cut = tmp_path / f"cut-{share}.mcap"
        cut.write_bytes(whole[: round(share * len(whole))])
        assert replay(cut, map=tmp_path / "cut.npz") == 0
        assert "cut short" in said()
        part = load_map(tmp_path / "cut.npz")
        cells.append(int(np.isfinite(part.low).sum()))
        assert inside(part, full)
    assert cells == sorted(cells)
    assert 0 < cells[-1] <= int(np.isfinite(full.low).sum())


def test_a_recording_cut_inside_any_record_replays(port_drive: PortDrive, tmp_path: Path, said: SaidOnStderr) -> None:
    """Byte by byte across the boundary of a record: never an error, always what was whole before."""
    whole = port_drive.capture.read_bytes()
    chunks = len(list(read_capture(port_drive.capture)))
    middle = len(whole) // 3
    counts = []
    for length in (10, 100, *range(middle, middle + 60_000, 2357)):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(whole[:length])
        capture = read_capture(cut)
        counts.append(len(list(capture)))
        assert capture.truncated
    assert counts == sorted(counts)
    assert 0 < counts[-1] < chunks


@pytest.mark.parametrize("seed", range(12))
def test_a_recording_replays_however_the_scanner_was_found(port_drive: PortDrive, seed: int) -> None:
    """Whatever rates the driver tried before, and however late it was told of its deadlines: the same scans."""
    chance = random.Random(seed)
    scanner = SickLmsEmulator(lambda times, _: np.full(times.size, 3.0))
    driver = SickLmsProtocol(port_drive.loaded.config.devices.laser)
    now_ns = chance.randrange(4000) * 1_000_000
    scanner.data_to_send(now_ns)
    driver.connection_made(now_ns)
    recorded, scans = [RawChunk("laser", b"", now_ns)], 0
    for _ in range(700):
        now_ns += chance.randrange(1, 8) * 5_000_000
        if driver.deadline_ns <= now_ns:
            recorded.append(RawChunk("laser", b"", now_ns, deadline=True))
            driver.advance(now_ns)
        scanner.receive_data(as_heard(driver.data_to_send(), scanner.baud, driver.baud), now_ns)
        rate = scanner.baud
        while data := scanner.data_to_send(now_ns):
            recorded.append(RawChunk("laser", as_heard(data, rate, driver.baud), now_ns))
            scans += len(driver.receive_data(recorded[-1].data, now_ns))
            rate = scanner.baud
    counts = replay_directly(port_drive.loaded, recorded).counts
    assert counts["scans_without_pose"] + counts["scans_dropped_waiting"] == scans
    assert scans > 100
