"""Four real drives: what the recordings hold, and that no set loses the truth where there is one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import TerraboundError
from drivers.samples import InertialSample, WheelTicks
from examples.matlab_file import read_arrays
from examples.real_poses import configuration, contradicted, follow
from examples.recorded_drives import TICK_M, RecordedDrive, husky, plaza, victoria_park


@pytest.fixture(scope="module")
def folder(recordings: Path) -> Path:
    """The recordings of localisation."""
    found = recordings / "localisation"
    if not found.is_dir():
        pytest.skip(f"no {found}: set TERRABOUND_DATA to the folder that holds the recordings")
    return found


def cut(drive: RecordedDrive, seconds: float) -> RecordedDrive:
    """The beginning of a drive."""
    end_ns = drive.samples[0].stamp.mid_ns + round(seconds * 1e9)
    return replace(drive, samples=[sample for sample in drive.samples if sample.stamp.mid_ns <= end_ns])


def test_the_recordings_hold_what_their_page_says(folder: Path) -> None:
    """Plaza's dead reckoning ends 4.449 m off; Victoria Park's speed integrates to 4030.034 m, with 4466 fixes."""
    arrays = read_arrays(folder / "Plaza1_.mat")
    reckoned, truth = arrays["DRp"][:, 1:3], arrays["GT"][:, 1:3]
    off = np.linalg.norm(_reckoned(truth[0], arrays["GT"][0, 3], arrays["DR"][:, 1:3]) - truth, axis=1)
    assert reckoned.shape == truth.shape
    assert off[-1] == pytest.approx(4.449, abs=0.02)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1.935, abs=0.02)
    car = read_arrays(folder / "aa3_dr.mat")
    assert np.sum(car["speed"][:, 0]) * 0.025 == pytest.approx(4030.034, abs=0.01)
    assert len(read_arrays(folder / "aa3_gpsx.mat")["timeGps"]) == 4466


def _reckoned(start: np.ndarray, heading: float, steps: np.ndarray) -> np.ndarray:
    """[n + 1, 2] places by way and turn of each step."""
    along = heading + np.cumsum(steps[:, 1]) - 0.5 * steps[:, 1]
    moves = steps[:, :1] * np.column_stack([np.cos(along), np.sin(along)])
    return np.vstack([start, start + np.cumsum(moves, axis=0)])


def test_what_is_no_matlab_file_is_refused(tmp_path: Path) -> None:
    """One error that names the file."""
    wrong = tmp_path / "drive.mat"
    wrong.write_bytes(b"MATLAB 7.3 MAT-file" + bytes(200))
    with pytest.raises(TerraboundError, match=r"drive\.mat"):
        read_arrays(wrong)


def test_the_mowers_place_is_always_in_its_set(folder: Path) -> None:
    """Plaza 1, the first seven minutes: centimetre truth inside at every instant, and the sets say something."""
    followed = follow(cut(plaza(folder), 420.0), configuration("plaza"))
    assert followed.outside == 0
    assert len(followed.time_ns) > 2000
    assert followed.filter.guarantee.intact
    assert followed.half_widths[:2].max() < 3.0


def test_the_mowers_place_is_always_in_its_ellipsoid_too(folder: Path) -> None:
    """The paper's set, the first minutes: wider, but as true."""
    followed = follow(cut(plaza(folder), 120.0), configuration("plaza", "ellipsoid"))
    assert followed.outside == 0
    assert len(followed.time_ns) > 500
    assert followed.filter.guarantee.intact
    assert followed.half_widths[:2].max() < 10.0


def test_a_skidding_mower_contradicts_a_slip_of_five_percent(folder: Path) -> None:
    """At 706 s a step of 0.83 m by the wheels is one of 0.68 m in truth: told within two seconds."""
    config = configuration("plaza")
    config = replace(config, robot=replace(config.robot, slip_ratio=0.05))
    drive = cut(plaza(folder), 715.0)
    late = [sample for sample in drive.samples if sample.stamp.mid_ns > 571 * 10**9]
    since = follow(replace(drive, samples=late), config).filter.guarantee.contradicted_ns
    assert since is not None
    assert 705.5 < since * 1e-9 - 1.0 < 708.5


@pytest.mark.parametrize(("ground", "yaw_rad", "wheels_m"), [("SNOW", 0.0628, 0.3137), ("ASPHALT", None, None)])
def test_slipping_wheels_contradict_their_bound(
    folder: Path, ground: str, yaw_rad: float | None, wheels_m: float | None
) -> None:
    """Gyroscope and wheels disagree on the turn by more than 5 % of slip allow: named, with what is needed at least."""
    drive = husky(folder, ground)
    if yaw_rad is not None:
        rates = [s.gyro_rps[2] for s in drive.samples if isinstance(s, InertialSample) and s.message == "HIGHRES_IMU"]
        assert np.sum(rates) * 0.01 == pytest.approx(yaw_rad, abs=2e-3)
        assert drive.tracks[-1, 2] - drive.tracks[-1, 1] == pytest.approx(wheels_m, abs=5e-3)
    found = {usage.key: usage for usage in contradicted(drive, configuration("husky"))}
    assert list(found) == ["robot.slip_ratio"]
    assert 0.05 < found["robot.slip_ratio"].needed < 0.5
    assert "tracks and gyroscope differ" in found["robot.slip_ratio"].worst


def test_sets_outlive_a_gap_of_the_gps_and_a_false_fix_is_told(folder: Path) -> None:
    """Victoria Park around its jump: a fix 130 m away is named as the receiver's, and the sets go on without it."""
    drive = victoria_park(folder)
    begin_ns, end_ns = 1_100 * 10**9, 1_240 * 10**9
    part = replace(drive, samples=[s for s in drive.samples if begin_ns <= s.stamp.mid_ns <= end_ns])
    assert sum(isinstance(sample, WheelTicks) for sample in part.samples) > 5000
    followed = follow(part, configuration("victoria_park"))
    guarantee = followed.filter.guarantee
    assert guarantee.sensor == "gps"
    assert guarantee.contradicted_ns is not None
    assert guarantee.contradicted_ns * 1e-9 - 1.0 == pytest.approx(1222.3, abs=0.5)
    half = 0.5 * (followed.high - followed.low)[:, :2].max(axis=1)
    assert half.max() > 100.0  # in the gap
    assert np.median(half) < 60.0
    assert np.isfinite(half).all()


def test_ticks_follow_the_odometer(folder: Path) -> None:
    """Both tracks of the mower ran the odometer's 1861 m, but for what it turned."""
    ticks = [sample for sample in plaza(folder).samples if isinstance(sample, WheelTicks)]
    assert 0.5 * (ticks[-1].left + ticks[-1].right) * TICK_M == pytest.approx(1861.28, abs=0.01)
