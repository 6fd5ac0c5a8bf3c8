"""`terrabound check` against the emulated robot, in real time."""

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
    config.write_text(text.replace("[38.0, 50.0]", "[0.0, 150.0]"))
    (tmp_path / "tracks.dbc").write_text(shipped_config("tracks.dbc").read_text())
    links = tmp_path / "ports"
    robot_options = ["--config", str(config), "--links", str(links), "--json-progress"]
    command = [sys.executable, "-m", "service.cli", "emulate", "robot", *robot_options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as robot:
        assert robot.stdout is not None
        robot.stdout.readline()  # its ports are there
        try:
            # Its progress must not fill the pipe: 8 s of it are a few kilobytes.
            code = run_command(["check", "--config", str(config), "--seconds", "8"])
            text = capfd.readouterr().out
            assert code == 0, text
            assert "all devices stream" in text
            assert "laser: LMS221" in text
            config.write_text(config.read_text().replace("ports/gps", "ports/none"))
            code = run_command(["check", "--config", str(config), "--seconds", "2"])
            assert code == 1
            assert "ports/none: no such port; plug the device in" in capfd.readouterr().out
        finally:
            robot.terminate()
            robot.communicate(timeout=30)
