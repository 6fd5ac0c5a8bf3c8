"""One device on a live port: the real command against emulated devices on pseudo-terminals, in real time."""

import contextlib
import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from service.cli import run_command
from service.config import load
from service.shipped import shipped_config
from simulator.emulated_robot import run_emulated_robot
from simulator.errors import ErrorLaw
from simulator.robot import RobotModel
from simulator.terrain import build_terrain
from simulator.world import World

DEVICES = load(shipped_config("demo.toml")).config.devices
TRACKS = ("--dbc", str(shipped_config("tracks.dbc")), "--left", "TRACKS.LEFT", "--right", "TRACKS.RIGHT")

Listen = Callable[..., tuple[list[dict[str, Any]], str]]


@contextmanager
def emulated(**links: Path) -> Iterator[None]:
    """The devices whose links are named, in a thread of this process, standing still."""
    stopping, there = threading.Event(), threading.Event()
    world = World(build_terrain("rough"), RobotModel(), DEVICES, ErrorLaw(), time.monotonic_ns(), 5.0)
    robot = threading.Thread(
        target=lambda: run_emulated_robot(
            world, DEVICES, links, stopping=stopping, stay=True, punctual=False, on_progress=lambda _: there.set()
        )
    )
    robot.start()
    try:
        assert there.wait(60)
        yield
    finally:
        stopping.set()
        robot.join()


@pytest.fixture
def listen(capfd: pytest.CaptureFixture[str]) -> Listen:
    """Lines and counts of a run that must succeed; on a starved machine it is given more time."""

    def run(*arguments: object, seconds: int, enough: int) -> tuple[list[dict[str, Any]], str]:
        for patience in (seconds, 4 * seconds, 16 * seconds):
            code = run_command(["listen", *map(str, arguments), "--seconds", str(patience)])
            output, counts = capfd.readouterr()
            lines = output.splitlines()
            if code == 0 and len(lines) >= enough:
                return [json.loads(line) for line in lines], counts
        raise AssertionError(counts)

    return run


def test_the_scanner_is_found_and_streams(listen: Listen, tmp_path: Path) -> None:
    """From power-on at 9600 baud to scans of 181 beams, without writing its EEPROM, in the unit it is set to."""
    with emulated(laser=tmp_path / "laser"):
        scans, counts = listen("lms", tmp_path / "laser", seconds=4, enough=10)
    assert all(len(scan["ranges_m"]) == 181 and scan["kind"] == "scan" for scan in scans)
    stamps = [scan["stamp_ns"] for scan in scans]
    assert stamps == sorted(stamps)
    assert "configuration_writes" not in counts


def test_what_the_scanner_must_be_written_for_is_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A unit that the scanner isn't set to is refused without --configure, and taken with it."""
    with emulated(laser=tmp_path / "laser"):
        assert run_command(["listen", "lms", str(tmp_path / "laser"), "--unit", "cm", "--seconds", "20"]) == 1
        assert "halted: the scanner measures in mm" in capfd.readouterr().err
        arguments = ["listen", "lms", str(tmp_path / "laser"), "--unit", "cm", "--configure", "--seconds", "4"]
        assert run_command(arguments) == 0
    output, counts = capfd.readouterr()
    assert "configuration_writes=1" in counts
    assert json.loads(output.splitlines()[-1])["kind"] == "scan"


def test_the_other_devices_are_heard_side_by_side(listen: Listen, tmp_path: Path) -> None:
    """The adapter is opened and counters come; packets of all four inertial sensors; fixes with their bounds."""
    with emulated(**{name: tmp_path / name for name in ("encoders", "imu", "gps")}):
        ticks, _ = listen("encoders", tmp_path / "encoders", *TRACKS, seconds=1, enough=20)
        inertial, _ = listen("imu", tmp_path / "imu", seconds=1, enough=20)
        fixes, _ = listen("gps", tmp_path / "gps", seconds=2, enough=5)
    assert {(line["left"], line["right"]) for line in ticks} == {(0, 0)}
    sensors = {(line["message"], line["id"]) for line in inertial}
    assert sensors == {("HIGHRES_IMU", 0), ("HIGHRES_IMU", 1), ("HIGHRES_IMU", 2), ("ATTITUDE", 0)}
    assert all(fix["quality"] == 4 and min(fix["bound_m"]) > 0 for fix in fixes)


def test_the_wrong_rate_is_hinted_at(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Garbage makes no line; the hint names the rate; 1."""
    with emulated(gps=tmp_path / "gps"):
        assert run_command(["listen", "gps", str(tmp_path / "gps"), "--baud", "9600", "--seconds", "3"]) == 1
    fixes, told = capfd.readouterr()
    assert fixes == ""
    assert "check the rate (--baud)" in told


def test_a_device_alone_runs_until_ctrl_c_and_takes_its_port_along(listen: Listen, tmp_path: Path) -> None:
    """`emulate gps` in a process of its own: heard by `listen`, ended by one signal with exit code 0."""
    link = tmp_path / "ports" / "gps"
    command = [sys.executable, "-m", "service.cli", "emulate", "gps", "--link", str(link)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "Ctrl-C ends it" in process.stderr.readline()
        fixes, _ = listen("gps", link, seconds=2, enough=1)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert process.stderr.read() == ""
    assert fixes
    assert not link.is_symlink()


def test_an_unplugged_port_ends_with_a_line(tmp_path: Path) -> None:
    """What was heard stays printed, the counts come, and the port is named."""
    command = [sys.executable, "-m", "service.cli", "listen", "imu", str(tmp_path / "imu")]
    with emulated(imu=tmp_path / "imu"):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["kind"] == "inertial"
    _, told = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "imu: the port went away" in told
    assert told.startswith("counts: ")


def test_on_a_terminal_a_line_tells_how_far_it_is_and_ctrl_c_ends_it(tmp_path: Path) -> None:
    """The data goes to a file, the live line to the terminal; one Ctrl-C: counts, exit 0, every line whole."""
    terminal, terminal_of_process = pty.openpty()
    command = [sys.executable, "-m", "service.cli", "listen", "imu", str(tmp_path / "imu")]
    with emulated(imu=tmp_path / "imu"), (tmp_path / "lines").open("w+") as lines:
        process = subprocess.Popen(command, stdout=lines, stderr=terminal_of_process)
        os.close(terminal_of_process)
        told = b""
        while b"Ctrl-C ends it" not in told:
            told += os.read(terminal, 4096)
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(OSError):  # a terminal without a process ends with an error
            while more := os.read(terminal, 4096):
                told += more
        assert process.wait(30) == 0
        os.close(terminal)
        lines.seek(0)
        assert all(json.loads(line)["kind"] == "inertial" for line in lines)
    assert b"imu: " in told
    assert b"counts: bytes=" in told
    assert b"Traceback" not in told
