"""The commands as a robot's owner runs them: processes of their own, in real time, ended by signals."""

import json
import os
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.capture import read_capture
from mapper.saved_map import load as load_map
from mapper.store_check import open_store
from mapper.tile import join
from service.client import RemoteMap
from service.commands.replay import replay
from service.loopback import free_locator
from service.shipped import shipped_config

PATIENCE_S = 90.0
WATCHDOG_S = 3.0


@contextmanager
def terrabound(*arguments: object, environment: Mapping[str, str] | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """A command as a process, which is surely gone at the end."""
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", *map(str, arguments)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, **(environment or {})},
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def end(process: subprocess.Popen[bytes]) -> tuple[int, str]:
    """Ask it to end; its exit code, and what it said on standard error."""
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=PATIENCE_S)
    return process.returncode, said.decode()


def wait_until(happened: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    """Look until it is so; an error if it takes too long or the process has ended."""
    deadline = time.monotonic() + PATIENCE_S
    while not happened():
        assert process.poll() is None, f"ended early: {process.communicate()}"
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.02)


class Systemd:
    """The other end of NOTIFY_SOCKET."""

    def __init__(self, stack: ExitStack) -> None:
        self._socket = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        # In the abstract namespace: a folder of pytest's can be longer than a socket's name may be.
        name = f"terrabound-test-{os.getpid()}-{id(self)}"
        self._socket.bind(f"\0{name}")
        self.environment = {"NOTIFY_SOCKET": f"@{name}", "WATCHDOG_USEC": str(round(WATCHDOG_S * 1e6))}
        self.heard: list[str] = []

    def listen(self) -> list[str]:
        """Everything heard so far."""
        while select.select([self._socket], [], [], 0)[0]:
            self.heard.append(self._socket.recv(4096).decode())
        return self.heard


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An owner's folder: the demo's configuration, which saves its map and publishes at any free port.

    In real time a busy machine emulates late: latencies are declared wide enough that few bytes are lost by that.
    """
    folder = tmp_path_factory.mktemp("owner")
    shutil.copy(shipped_config("tracks.dbc"), folder)
    text = shipped_config("demo.toml").read_text().replace("tcp/127.0.0.1:7447", "tcp/127.0.0.1:0")
    text = text.replace("latency_ms = [0.0, 11.0]", "latency_ms = [0.0, 60.0]").replace("[38.0, 50.0]", "[0.0, 100.0]")
    (folder / "robot.toml").write_text(text + '\n[store]\nmap = "kept.npz"\n')
    return folder


@pytest.fixture(scope="module")
def robot(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The emulated robot on the system's clock; it stays after its drive."""
    ports = folder / "ports"
    drive = ("--links", ports, "--scene", "stairs", "--duration", 20)
    with terrabound("emulate", "robot", "--config", folder / "robot.toml", *drive) as process:
        wait_until(lambda: all((ports / name).is_symlink() for name in ("laser", "encoders", "imu", "gps")), process)
        yield process
        assert end(process)[0] == 0


def test_run_maps_in_real_time_and_ends_in_order(folder: Path, robot: subprocess.Popen[bytes]) -> None:
    """systemd hears READY, STATUS, WATCHDOG while samples flow, STOPPING; SIGTERM is exit 0 and the map is kept."""
    with ExitStack() as stack:
        systemd = Systemd(stack)
        run = stack.enter_context(terrabound("run", "--config", folder / "robot.toml", environment=systemd.environment))

        def maps() -> bool:
            texts = re.findall(r"STATUS=.*?(\d+) scans, (\d+) tiles", "\n".join(systemd.listen()))
            return (
                bool(texts)
                and int(texts[-1][0]) > 100
                and int(texts[-1][1]) > 2
                and systemd.heard.count("WATCHDOG=1") >= 2
            )

        wait_until(maps, run)
        code, said = end(run)
        assert code == 0, said
        assert "Traceback" not in said
        heard = systemd.listen()
        assert next(word for word in heard if not word.startswith("STATUS=still loading")) == "READY=1"
        assert heard.index("STOPPING=1") > heard.index("WATCHDOG=1")
        assert int(np.isfinite(load_map(folder / "kept.npz").low).sum()) > 500


def test_record_keeps_what_replays(folder: Path, tmp_path: Path) -> None:
    """A few seconds of raw bytes, SIGTERM, exit 0: a whole recording that makes a map.

    The robot stands for most of it: a busy machine reads late, and what is read late of a drive has wide stamps.
    """
    capture, config = tmp_path / "drive.mcap", tmp_path / "robot.toml"
    shutil.copy(shipped_config("tracks.dbc"), tmp_path)
    config.write_text((folder / "robot.toml").read_text())
    with (
        terrabound("emulate", "robot", "--config", config, "--links", tmp_path / "ports", "--duration", 5) as robot,
        terrabound("record", "--config", config, "--output", capture) as record,
    ):
        wait_until(lambda: capture.exists() and capture.stat().st_size > 150_000, record)
        code, said = end(record)
        assert end(robot)[0] == 0
    assert code == 0, said
    recording = read_capture(capture)
    assert {chunk.device for chunk in recording} == {"laser", "encoders", "imu", "gps"}
    assert not recording.truncated
    assert replay(capture, map=tmp_path / "map.npz") == 0
    assert int(np.isfinite(load_map(tmp_path / "map.npz").low).sum()) > 500


@pytest.mark.parametrize("kept", ["box", "ellipsoid"])
def test_the_demo_holds_all_its_promises(tmp_path: Path, kept: str) -> None:
    """Exit 0; the report has every field; nothing true was outside its bounds; the remote copy is the robot's map."""
    report = tmp_path / "report.json"
    arguments = ("--duration", 8, "--set", kept, "--output", tmp_path / "out", "--report", report)
    with terrabound("demo", *arguments) as demo:
        _, said = demo.communicate(timeout=2 * PATIENCE_S)
        assert demo.returncode == 0, said.decode()
    result = json.loads(report.read_text())
    assert result.keys() >= {
        "scans", "beams", "cells", "tiles", "pose_violations", "cell_violations", "mean_width_m", "remote_equal",
        "latency_ms", "realtime_factor",
    }  # fmt: skip
    assert result["pose_violations"] == result["cell_violations"] == 0
    assert result["remote_equal"] is True
    assert set(result["latency_ms"]) == {"p50", "p99"}
    assert result["scans"] > 500
    assert result["hits_checked"] > 50_000
    assert 0 < result["mean_width_m"] < 0.5
    assert {"map.npz", "map.png", "poses.jsonl", "drive.mcap"} <= {path.name for path in (tmp_path / "out").iterdir()}


def test_kill_9_loses_nothing_that_was_saved_and_mapping_resumes(
    folder: Path, robot: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    """What health had acknowledged is there after SIGKILL, as an earlier submap with its anchor; a new one begins."""
    address = free_locator()
    text = (folder / "robot.toml").read_text().replace("tcp/127.0.0.1:0", address)
    config = folder / "stored.toml"
    config.write_text(f'{text}path = "{tmp_path / "map.db"}"\n')

    with terrabound("run", "--config", config) as run, RemoteMap(address) as remote:

        def saved_up_to_ns() -> int:
            return int(remote.health.get("store", {}).get("saved_up_to_ns") or 0)

        wait_until(lambda: len(remote.tiles) > 0 and saved_up_to_ns() > 0, run)
        tiles, seen_ns = remote.tiles, time.monotonic_ns()
        wait_until(lambda: saved_up_to_ns() > seen_ns, run)
        run.kill()
        run.wait()
    assert {place.submap for place in tiles} == {0}

    started_s = time.monotonic() - 0.01  # the kernel tells in hundredths
    with terrabound("run", "--config", config) as run, RemoteMap(address) as remote:
        wait_until(lambda: {place.submap for place in remote.tiles} == {0, 1}, run)
        wait_until(lambda: all(place in remote.tiles for place in tiles), run)
        for place, tile in tiles.items():
            assert join(remote.tiles[place], tile) == remote.tiles[place]
        wait_until(lambda: 0 in remote.anchors, run)
        wait_until(lambda: "store" in remote.health and "submap" in remote.info, run)
        assert remote.info["submap"] == 1
        assert remote.health["store"]["found_clean"] is True
        wait_until(lambda: remote.health.get("first_scan_s") is not None, run)
        assert 0.0 < remote.health["first_scan_s"] < time.monotonic() - started_s
        code, said = end(run)
    assert code == 0, said
    store, findings = open_store(tmp_path / "map.db")
    assert findings.clean
    assert set(store.submaps) == {0, 1}
    assert '"origin_lat_deg"' in store.submaps[0].anchor
    for place, tile in tiles.items():
        kept = store.read(place)
        assert kept is not None
        assert join(kept, tile) == kept
    store.close()
