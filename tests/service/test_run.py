"""`terrabound run` where not all is as it should be: what it can do without does not end it. Processes of their own."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.capture import read_capture
from service.commands.run import unused_path
from service.shipped import shipped_config

PATIENCE_S = 90.0
DEMO = shipped_config("demo.toml").read_text(encoding="utf-8")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where the robot's configuration is; its devices are not there."""
    (tmp_path / "tracks.dbc").write_text(shipped_config("tracks.dbc").read_text())
    return tmp_path


def configured(folder: Path, address: str = "tcp/127.0.0.1:0", more: str = "") -> Path:
    """The demo's robot with another address, and what else it is to have."""
    path = folder / "robot.toml"
    path.write_text(DEMO.replace("tcp/127.0.0.1:7447", address) + more)
    return path


def command(*words: object) -> list[str]:
    """A command of ours as a process."""
    return [sys.executable, "-m", "service.cli", *map(str, words)]


@contextlib.contextmanager
def running(config: Path) -> Iterator[subprocess.Popen[str]]:
    """The service as a process, ended in order if it still runs."""
    with subprocess.Popen(command("run", "--config", config), stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def heard(process: subprocess.Popen[str], words: str) -> str:
    """The first line on standard error that has these words."""
    assert process.stderr is not None
    lines = []
    for line in process.stderr:
        if words in line:
            return line
        lines.append(line)
    raise AssertionError("".join(lines))


def end(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code, and what it said at last, of a service that is told to stop."""
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=PATIENCE_S)
    return process.returncode, said


def test_an_address_in_use_is_told_and_taken_once_it_is_free(folder: Path) -> None:
    """Mapping goes on: the line names address, key and what to do; when the other program has ended, a copy comes."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        address = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        with running(configured(folder, address)) as service:
            line = heard(service, "the address is in use")
            assert address in line
            assert "publish.listen" in line
            other.close()
            heard(service, "publishing: works again")
            report = folder / "report.json"
            watch = command("watch", "--connect", address, "--once", "--report", report)
            done = subprocess.run(watch, capture_output=True, text=True, timeout=PATIENCE_S)
            assert done.returncode == 0, done.stderr
            assert json.loads(report.read_text())["in_sync"]
            code, said = end(service)
    assert code == 0, said
    assert "Traceback" not in said


@pytest.mark.parametrize("path", ["none/drive.mcap", "tracks.dbc/drive.mcap"])
def test_where_nothing_can_be_recorded_the_service_says_so_and_maps_on(path: str, folder: Path) -> None:
    """The line names the key, the file and the reason; the end is orderly."""
    with running(configured(folder, more=f'\n[record]\npath = "{path}"\n')) as service:
        line = heard(service, "recording")
        assert "record.path: " in line
        assert path in line
        assert "until the next start" in line
        code, said = end(service)
    assert code == 0, said


@pytest.mark.parametrize(
    ("old", "new"), [("TRACKS.LEFT", "TRACKS.LEFTY"), ("tcp/127.0.0.1:7447", "udp/127.0.0.1:7447#iface=;=,")]
)
def test_a_start_that_fails_leaves_no_recording(old: str, new: str, folder: Path) -> None:
    """A wrong configuration is 78, however late it is found out, and no empty recordings pile up."""
    (folder / "robot.toml").write_text(DEMO.replace(old, new) + '\n[record]\npath = "rec-%Y.mcap"\n')
    (folder / "recordings").mkdir()
    done = subprocess.run(
        command("run", "--config", folder / "robot.toml"), capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert (done.returncode, list(folder.glob("rec-*"))) == (78, []), done.stderr


def test_a_console_that_takes_nothing_does_not_end_the_drive(folder: Path) -> None:
    """A log on a full disk: the service runs on, records, and ends in order when told to."""
    config = configured(folder, more='\n[record]\npath = "drive.mcap"\n')
    with Path("/dev/full").open("w") as full:
        service = subprocess.Popen(command("run", "--config", config), stderr=full)
        try:
            with pytest.raises(subprocess.TimeoutExpired):
                service.wait(6)  # the missing ports are told by then
            service.send_signal(signal.SIGTERM)
            assert service.wait(PATIENCE_S) == 0
        finally:
            service.kill()
    assert list(read_capture(folder / "drive.mcap")) == []


def test_a_run_that_maps_nothing_leaves_an_earlier_map_as_it_is(folder: Path) -> None:
    """A service that starts again after a crash, its sensors not there: an empty map does not replace the drive's."""
    config, kept = configured(folder, more='\n[store]\nmap = "kept.npz"\n'), folder / "kept.npz"
    for expected in (None, b"a map"):
        if expected is not None:
            kept.write_bytes(expected)
        with running(config) as service:
            heard(service, "no such port")
            heard(service, "no such port")
            code, said = end(service)
        assert code == 0, said
        assert expected is None or kept.read_bytes() == expected


def test_a_first_start_can_be_ended(folder: Path) -> None:
    """Nobody waits until all machine code is made: exit 0, and the recording is whole."""
    code, recording = folder / "code", folder / "drive.mcap"
    config = configured(folder, more='\n[record]\npath = "drive.mcap"\n')
    environment = os.environ | {"NUMBA_CACHE_DIR": str(code)}
    service = subprocess.Popen(command("run", "--config", config), stderr=subprocess.PIPE, text=True, env=environment)
    try:
        deadline = time.monotonic() + PATIENCE_S
        while not list(code.rglob("*.nbc")):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        exit_code, said = end(service)
    finally:
        service.kill()
    assert (exit_code, "Traceback" in said) == (0, False), said
    assert len(list(code.rglob("*.nbc"))) < 30  # of some 150
    assert not read_capture(recording).truncated


def test_a_recording_never_takes_the_place_of_another(tmp_path: Path) -> None:
    """Names have the time in them; a number is added where the file exists."""
    from datetime import UTC, datetime

    now = datetime(2026, 11, 26, 7, 0, tzinfo=UTC)
    first = unused_path(tmp_path / "rec-%H%M.mcap", now)
    first.touch()
    (tmp_path / "rec-0700-2.mcap").symlink_to("nowhere")
    assert (first.name, unused_path(tmp_path / "rec-%H%M.mcap", now).name) == ("rec-0700.mcap", "rec-0700-3.mcap")
