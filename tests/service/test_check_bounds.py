"""`terrabound check --bounds` on a capture of the emulated robot, whose errors are at the corners of their bounds."""

import json
from pathlib import Path

import pytest

from drivers.capture import read_capture
from service.cli import run_command
from service.commands.port_drive import PortDrive
from service.shipped import shipped_config


def test_a_capture_tells_what_its_own_bounds_are_worth(
    port_drive: PortDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Alone, with the configuration inside: nothing contradicted, tilt used up, the same in the report."""
    report = tmp_path / "bounds.json"
    assert run_command(["check", "--bounds", str(port_drive.capture), "--report", str(report)]) == 0
    text = capsys.readouterr().out
    assert "no bound is contradicted" in text
    assert "this drive says nothing of: " in text
    rows = {row["key"]: row for row in json.loads(report.read_text())["bounds"]}
    tilt = rows["devices.imu.tilt_bound_deg"]
    assert tilt["verdict"] == "fits"
    assert 0.99 < tilt["used"] <= 1.0 + 1e-6
    assert 0.0 < tilt["when_s"] < 20.0
    assert rows["robot.turning_centre_m"]["verdict"] == "not seen"


def test_another_configuration_is_held_against_the_same_bytes(
    port_drive: PortDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the tilt's bound at half: contradicted, when, by what, and what to declare; exit code 1."""
    text = read_capture(port_drive.capture).config_text
    assert text
    (tmp_path / "tracks.dbc").write_text(shipped_config("tracks.dbc").read_text())
    config = tmp_path / "half.toml"
    config.write_text(text.replace("tilt_bound_deg = 0.3", "tilt_bound_deg = 0.15"))
    assert run_command(["check", "--bounds", str(port_drive.capture), "--config", str(config)]) == 1
    said = capsys.readouterr().out
    assert "devices.imu.tilt_bound_deg = 0.15 is contradicted at " in said
    assert "declare at least 0.3" in said


def test_check_without_anything_to_check_is_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    """Neither a configuration nor a capture: 2, and what to give."""
    assert run_command(["check"]) == 2
    assert "--config" in capsys.readouterr().err


def test_what_is_no_capture_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line that names the file."""
    wrong = tmp_path / "drive.mcap"
    wrong.write_bytes(b"not a capture")
    assert run_command(["check", "--bounds", str(wrong)]) == 1
    assert "drive.mcap" in capsys.readouterr().err
