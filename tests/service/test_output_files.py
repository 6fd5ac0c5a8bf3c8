"""What a command is to write is looked at first: nothing that it reads is overwritten, no work done in vain."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.capture import CaptureWriter
from estimator.bounded_pose import INTACT, BoundedPose
from service.cli import run_command
from service.output_files import OutputError, refuse_unwritable, write_text
from service.pipeline import Pipeline
from service.shipped import shipped_config


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A recording, short and whole."""
    path = tmp_path / "drive.mcap"
    texts = (shipped_config(name).read_text(encoding="utf-8") for name in ("demo.toml", "tracks.dbc"))
    capture = CaptureWriter(path, *texts)
    capture.write("gps", b"$GPGGA", 1_000_000, 2_000_000)
    capture.close()
    return path


@pytest.mark.parametrize(
    "arguments",
    ["replay drive.mcap --poses drive.mcap", "replay drive.mcap --map drive.mcap", "replay drive.mcap --map link.npz",
     "replay drive.mcap --config robot.toml --map robot.toml", "check --bounds drive.mcap --report drive.mcap",
     "export drive.mcap link.npz --layer slope"],
)  # fmt: skip
def test_no_command_overwrites_what_it_reads(
    arguments: str, drive: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A recording named as the output, by its own name or through a link, stays as it was."""
    monkeypatch.chdir(drive.parent)
    drive.with_name("link.npz").symlink_to("drive.mcap")
    for name, copy in (("demo.toml", "robot.toml"), ("tracks.dbc", "tracks.dbc")):
        shutil.copy(shipped_config(name), drive.with_name(copy))
    before = [path.read_bytes() for path in (drive, drive.with_name("robot.toml"))]
    assert run_command(arguments.split()) == 1
    assert "is read by this command and would be overwritten" in capfd.readouterr().err
    assert [path.read_bytes() for path in (drive, drive.with_name("robot.toml"))] == before


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("replay none.mcap --map none/map.npz", "there is no folder"),
        ("check --bounds none.mcap --report none/report.json", "there is no folder"),
        ("watch --connect tcp/127.0.0.1:1 --map none/map.npz", "there is no folder"),
        ("watch --connect tcp/127.0.0.1:1 --report .", "is a folder"),
        ("demo --report none/report.json", "there is no folder"),
        ("replay none.mcap --map one --poses ./one", "is to be written twice"),
        ("emulate robot --truth none/truth.npz", "there is no folder"),
        ("emulate robot --links file/ports", "file/ports: can't be made a folder: Not a directory"),
        ("demo --output file", "file: can't be made a folder: File exists"),
        ("reproduce table1 --output file", "file: can't be made a folder: File exists"),
    ],
)
def test_an_output_that_cannot_be_written_is_told_before_the_work(
    arguments: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Before the recording is even opened, or the robot looked for: an hour of watching is not thrown away."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert run_command(arguments.split()) == 1
    assert told in capfd.readouterr().err


def test_devices_and_new_names_are_no_obstacle(tmp_path: Path) -> None:
    """A pipe, a name that is new, a file to be replaced; and nothing asked for."""
    (tmp_path / "old.npz").write_bytes(b"old")
    refuse_unwritable([Path("/dev/stdout"), Path("/dev/null"), tmp_path / "new.npz", tmp_path / "old.npz", None])
    with pytest.raises(OutputError, match=r"old\.npz: is read by this command"):
        refuse_unwritable([tmp_path / "old.npz"], inputs=[None, tmp_path / "missing", tmp_path / "old.npz"])


def test_a_text_for_which_there_is_no_room_is_told_with_its_file() -> None:
    """Reports and pages, written whole."""
    with pytest.raises(OutputError, match="/dev/full: can't be written: No space left"):
        write_text(Path("/dev/full"), "a report")


def test_a_disk_that_fills_up_is_told_with_the_file(
    drive: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Of poses that are written all along: which file, and why."""
    pose = BoundedPose(10, 20, np.zeros(6), np.ones(6), INTACT)

    def replayed(*arguments: Any) -> Pipeline:
        on_pose = arguments[2]
        for _ in range(1000):
            on_pose(pose)
        raise AssertionError("a full disk takes no thousand poses")

    monkeypatch.setattr("service.commands.replay.replay_directly", replayed)
    assert run_command(["replay", str(drive), "--poses", "/dev/full"]) == 1
    assert "/dev/full: can't be written: No space left" in capfd.readouterr().err
