"""`terrabound check` against the emulated robot, in real time."""

import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from service.cli import run_command
from service.shipped import shipped_config


def test_a_robot_that_works_passes_and_a_missing_device_is_told(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """All four devices stream at their rates, the scanner says who it is; a port that is not there fails."""
    config = tmp_path / "robot.toml"
    # A busy machine emulates late, and what is too late is lost on the line: declared latencies leave room for it.
    text = shipped_config("demo.toml").read_text().replace("latency_ms = [0.0, 11.0]", "latency_ms = [0.0, 80.0]")
    text = text.replace("tcp/127.0.0.1:7447", "tcp/127.0.0.1:0")
    config.write_text(text.replace("[38.0, 50.0]", "[0.0, 150.0]"))
    (tmp_path / "tracks.dbc").write_text(shipped_config("tracks.dbc").read_text())
    links = tmp_path / "ports"
    robot_options = ["--config", str(config), "--links", str(links), "--json-progress"]
    command = [sys.executable, "-m", "service.cli", "emulate", "robot", *robot_options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as robot:
        assert robot.stdout is not None
        robot.stdout.readline()  # its ports are there
        try:
            # Its progress must not fill the pipe: a minute of it is 40 kilobytes.
            code = run_command(["check", "--config", str(config), "--seconds", "60"])
            text = capfd.readouterr().out
            assert code == 0, text
            assert "all devices stream" in text
            assert "laser: LMS221" in text
            assert re.search(r"imu: system 1 component 1: HIGHRES_IMU \d+", text)  # 0 lost where nothing else runs
            config.write_text(config.read_text().replace("ports/gps", "ports/none"))
            code = run_command(["check", "--config", str(config), "--seconds", "2"])
            assert code == 1
            assert "ports/none: no such port; plug the device in" in capfd.readouterr().out
        finally:
            robot.terminate()
            robot.communicate(timeout=30)


def test_what_the_service_could_not_write_is_told_before_the_drive(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Folders that are not there and an address in use, each by its key; nothing is created."""
    (tmp_path / "tracks.dbc").write_text(shipped_config("tracks.dbc").read_text())
    config = tmp_path / "robot.toml"
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        address = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        keep = '[record]\npath = "none/rec-%H.mcap"\n[store]\npath = "gone/map.db"\nmap = "map.npz"\n'
        config.write_text(shipped_config("demo.toml").read_text().replace("tcp/127.0.0.1:7447", address) + keep)
        assert run_command(["check", "--config", str(config), "--seconds", "0.1"]) == 1
    said = capfd.readouterr().out
    assert re.search(r"record\.path: .*/none/rec-\d\d\.mcap: can't be written: there is no folder", said)
    assert "store.path: " in said
    assert "store.map: " not in said
    assert f"publish.listen: {address}: the address is in use" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["robot.toml", "tracks.dbc"]


def test_a_wrong_rate_is_found_and_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The device's own rate is named for the configuration; other devices that are missing are told beside it."""
    config = tmp_path / "robot.toml"
    text = shipped_config("demo.toml").read_text().replace('port = "ports/imu"', 'port = "ports/imu"\nbaud = 57600')
    config.write_text(text)
    (tmp_path / "tracks.dbc").write_text(shipped_config("tracks.dbc").read_text())
    command = [sys.executable, "-m", "service.cli", "emulate", "imu", "--link", str(tmp_path / "ports" / "imu")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as board:
        assert board.stderr is not None
        board.stderr.readline()  # its port is there
        try:
            assert run_command(["check", "--config", str(config), "--seconds", "1"]) == 1
            said = capfd.readouterr().out
            assert "the device speaks at 115200 baud: set devices.imu.baud = 115200" in said
            assert "ports/gps: no such port" in said
        finally:
            board.terminate()
            board.communicate(timeout=30)
