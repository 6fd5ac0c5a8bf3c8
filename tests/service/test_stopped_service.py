"""A service that is stopped again and again, in real time, against the emulated robot: no promise breaks."""

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from drivers.capture import read_capture
from estimator.bounded_pose import BoundedPose
from service.config import load
from service.replay import replay
from service.shipped import shipped_config
from simulator.truth import Truth

PATIENCE_S = 90.0
STOPS_S = (0.15, 0.15, 1.5, 0.15, 0.15)


def command(*words: object) -> list[str]:
    """A command of ours as a process."""
    return [sys.executable, "-m", "service.cli", *map(str, words)]


def test_a_service_that_is_kept_from_running_breaks_no_promise(tmp_path: Path) -> None:
    """Stops of 150 ms and one of 1.5 s, which fills the ports' reserves, too: its recording replays to sets that hold
    every true pose, none voided."""
    text = shipped_config("demo.toml").read_text().replace("tcp/127.0.0.1:7447", "tcp/127.0.0.1:0")
    text = text.replace("latency_ms = [0.0, 11.0]", "latency_ms = [0.0, 60.0]").replace("[38.0, 50.0]", "[0.0, 100.0]")
    config, truth = tmp_path / "robot.toml", tmp_path / "truth.npz"
    config.write_text(text + '\n[record]\npath = "drive.mcap"\n')
    (tmp_path / "tracks.dbc").write_text(shipped_config("tracks.dbc").read_text())
    drive = (
        "--config",
        config,
        "--links",
        tmp_path / "ports",
        "--duration",
        6,
        "--truth",
        truth,
        "--errors",
        "corners",
    )
    with ExitStack() as stack:
        robot = subprocess.Popen(command("emulate", "robot", *drive, "--json-progress"), stdout=subprocess.PIPE)
        stack.callback(robot.kill)
        assert robot.stdout is not None
        assert b"waiting" in robot.stdout.readline()
        run = subprocess.Popen(command("run", "--config", config), stderr=subprocess.PIPE)
        stack.callback(run.kill)
        while b'"driving"' not in (line := robot.stdout.readline()):
            assert line
        for stopped_s in STOPS_S:
            time.sleep(0.5)  # the time that passes is what is tested
            os.kill(run.pid, signal.SIGSTOP)
            time.sleep(stopped_s)
            os.kill(run.pid, signal.SIGCONT)
        run.send_signal(signal.SIGTERM)
        _, said = run.communicate(timeout=PATIENCE_S)
        assert run.returncode == 0, said
        robot.send_signal(signal.SIGTERM)
        robot.communicate(timeout=PATIENCE_S)
    chunks = list(read_capture(tmp_path / "drive.mcap"))
    assert sum(chunk.late_ns > 100_000_000 for chunk in chunks) >= len(STOPS_S)
    poses: list[BoundedPose] = []
    pipeline = replay(load(config), chunks, poses.append)
    assert pipeline.filter.guarantee.intact
    assert pipeline.counts["scans"] > 100
    local = Truth.load(truth).in_map_frame()
    for pose in poses:
        times = (local.pose_time_ns >= pose.earliest_ns) & (local.pose_time_ns <= pose.latest_ns)
        inside = local.pose[times]
        assert ((pose.low <= inside) & (inside <= pose.high)).all()
