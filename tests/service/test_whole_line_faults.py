"""Plugs that are pulled and dirt on every line, during a drive: the service goes on, and every bound still holds."""

import random
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.capture import read_capture
from mapper.saved_map import SavedMap
from mapper.saved_map import load as load_map
from service.commands.evaluation import PoseSets, check_bounds
from service.commands.port_drive import PortDrive, drive_on_ports
from service.commands.replay import replay
from service.commands.virtual_drive import VirtualWire, drive_virtually
from service.config import load
from service.devices import wiring
from service.health import DeviceState
from service.onboard import Onboard
from service.shipped import shipped_config
from simulator.emulated_robot import SETTLE_S
from simulator.emulators.emulator import Emulator
from simulator.emulators.sick_lms import SickLmsEmulator
from simulator.truth import Truth
from simulator.wire import PluggedWires

WAIT_S = 30.0
GAP_NS = 5_000_000
"""Scans in a row leave less than this uncovered between them."""
EDGE_NS = 20_000_000

PLUGS = (
    # out, in again (seconds driven), device, does its power fail meanwhile?
    (2.2, 2.6, "laser", False),
    (3.0, 3.4, "encoders", False),
    (4.0, 4.5, "gps", False),
    (7.6, 7.8, "laser", True),
    (11.7, 12.0, "imu", False),
)
DURATION_S = 13.0


def wait_until(happened: Callable[[], bool]) -> None:
    """Look until it is so; an error if it takes too long."""
    deadline = time.monotonic() + WAIT_S
    while not happened():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.002)


class Plugs:
    """Pulls plugs by the table above, and keeps what health says of each device since."""

    def __init__(self) -> None:
        self.states: dict[str, list[DeviceState]] = {name: [] for _, _, name, _ in PLUGS}
        self._pulled, self._replugged = 0, 0

    def __call__(self, onboard: Onboard, wires: PluggedWires, driven_s: float) -> None:
        def state(name: str) -> DeviceState:
            return onboard.health.state(name, time.monotonic_ns())

        if self._pulled < len(PLUGS) and driven_s >= PLUGS[self._pulled][0]:
            name = PLUGS[self._pulled][2]
            self._pulled += 1
            wires[name].port.unplug()
            wait_until(lambda: state(name) is DeviceState.LOST)
        if self._replugged < self._pulled and driven_s >= PLUGS[self._replugged][1]:
            _, _, name, power_failed = PLUGS[self._replugged]
            self._replugged += 1
            if power_failed:
                cast(SickLmsEmulator, wires[name].emulator).switch_off_and_on(onboard.clock.now_ns())
            wires[name].port.replug()
            wait_until(lambda: wires[name].port.host_present)
            time.sleep(SETTLE_S)  # a host flushes a port that it has just opened, see simulator/emulated_robot.py
        for name, seen in self.states.items():
            if not seen or seen[-1] is not state(name):
                seen.append(state(name))


def without_lost_scans(truth: Truth, poses: PoseSets, end_ns: int) -> Truth:
    """The truth until `end_ns`, without the hits next to a gap: they may belong to a scan that nobody received."""
    order = np.argsort(poses.earliest_ns)
    begins, reach = poses.earliest_ns[order], np.maximum.accumulate(poses.latest_ns[order])
    keep: NDArray[np.bool_] = truth.hit_time_ns < end_ns
    for i in np.flatnonzero(begins[1:] - reach[:-1] > GAP_NS):
        for edge in (reach[i], begins[i + 1]):
            keep &= np.abs(truth.hit_time_ns - edge) > EDGE_NS
    return replace(truth, hit_time_ns=truth.hit_time_ns[keep], hit=truth.hit[keep], hit_range_m=truth.hit_range_m[keep])


@pytest.fixture(scope="module")
def plugs() -> Plugs:
    """Who pulls the plugs."""
    return Plugs()


@pytest.fixture(scope="module")
def unplugged(tmp_path_factory: pytest.TempPathFactory, plugs: Plugs) -> PortDrive:
    """A drive in which every plug is pulled once, and the scanner's power fails besides."""
    folder = tmp_path_factory.mktemp("unplugged")
    return drive_on_ports(
        folder, scene="stairs", law="switching", seed=7, duration_s=DURATION_S, speed=2.0, meddle=plugs
    )


def test_every_device_is_lost_and_found(unplugged: PortDrive, plugs: Plugs) -> None:
    """Health says STREAMING, LOST and STREAMING again; each port was opened anew."""
    openings = unplugged.onboard.health.snapshot(time.monotonic_ns())["devices"]
    for name, seen in plugs.states.items():
        lost = seen.index(DeviceState.LOST)
        assert DeviceState.STREAMING in seen[:lost]
        assert DeviceState.STREAMING in seen[lost:]
        assert openings[name]["openings"] == 1 + sum(plug[2] == name for plug in PLUGS)


def test_bounds_hold_over_every_gap(unplugged: PortDrive) -> None:
    """Sets may grow while a device is away; no true pose and no true hit leaves them, and nothing is contradicted."""
    poses, truth = unplugged.pose_sets(), unplugged.truth.in_map_frame()
    assert truth.pose_violations(poses.earliest_ns, poses.latest_ns, poses.low, poses.high) == 0
    assert unplugged.onboard.pipeline.filter.guarantee.intact
    # Without the inertial board the heading is soon too wide for the map, and beams are left out.
    end_ns = int(unplugged.truth.pose_time_ns[-1]) - round((DURATION_S - PLUGS[-1][0]) * 1e9) - EDGE_NS
    mapped = without_lost_scans(unplugged.truth, poses, end_ns)
    laser = unplugged.loaded.config.devices.laser
    _, cell_violations, hits = check_bounds(mapped, poses, load_map(unplugged.map), laser)
    assert cell_violations == 0
    assert hits > 70_000
    # Scans of the last tenths of a second before: the scanner has come back.
    assert ((poses.earliest_ns > end_ns - 300_000_000) & (poses.earliest_ns < end_ns)).sum() > 30


def test_samples_come_again_in_a_new_epoch(unplugged: PortDrive) -> None:
    """Nobody subtracts counts or device times across a gap; and scans come again after the scanner's power failed."""
    protocols = {device.name: device.protocol() for device in wiring(unplugged.loaded)}
    samples: dict[str, list[Any]] = {name: [] for name in protocols}
    for chunk in read_capture(unplugged.capture):
        protocol = protocols[chunk.device]
        if chunk.deadline:
            protocol.advance(chunk.stamp_ns)
        elif not chunk.data:
            protocol.connection_made(chunk.stamp_ns)
        else:
            samples[chunk.device] += protocol.receive_data(chunk.data, chunk.stamp_ns)
    end_ns = unplugged.truth.pose_time_ns[-1]
    for name in ("encoders", "imu"):
        epochs = [sample.epoch for sample in samples[name]]
        assert epochs == sorted(epochs)
        assert epochs[-1] == epochs[0] + 1
    for name in samples:
        assert samples[name][-1].stamp.latest_ns > end_ns - 300_000_000


@pytest.mark.parametrize("ports", [False, True], ids=["directly", "through ports"])
def test_a_drive_with_pulled_plugs_replays_bit_for_bit(unplugged: PortDrive, tmp_path: Path, ports: bool) -> None:
    """The driver's timeouts are part of the recording: a scanner found anew is found at the same byte."""
    replay(unplugged.capture, map=tmp_path / "map.npz", poses=tmp_path / "poses.jsonl", ports=ports)
    assert (tmp_path / "map.npz").read_bytes() == unplugged.map.read_bytes()
    assert (tmp_path / "poses.jsonl").read_bytes() == unplugged.poses.read_bytes()


class Noisy:
    """An emulated device on a bad line: dirt between its frames, never inside."""

    FALSE_BEGINNINGS: Mapping[str, tuple[bytes, ...]] = {
        "laser": (b"\x02", b"\x02\x80", b"\x02\x80\x6e\x01", b"\x02\x80\x6e\x01\xb0\xb5\x40", b"\x06", b"\x15"),
        "encoders": (b"t", b"t1814", b"T000", b"t18140000\r", b"\r", b"\x07"),
        "imu": (b"\xfd", b"\xfd\x3f\x00\x00", b"\xfe\x1c\x00\x01\x01\x1e", b"\xfd\xff\x00\x00\x00\x01\x01\x69\x00\x00"),
        "gps": (b"$", b"$GN", b"$GNGGA,120000.00,4812.0", b"$GNGGA,,,,,,0,,,,,,,,*00\r\n", b"*\r\n"),
    }

    def __init__(self, emulator: Emulator, name: str, seed: int) -> None:
        self._emulator, self._name = emulator, name
        self._random = random.Random(f"{name}{seed}")
        self._frame = b""
        self._last = b"?"
        self._synchronised = name != "laser"  # which may be in the middle of a telegram
        self.insertions = 0

    @property
    def baud(self) -> int | None:
        return self._emulator.baud

    def receive_data(self, data: bytes, now_ns: int) -> None:
        self._emulator.receive_data(data, now_ns)

    def data_to_send(self, now_ns: int) -> bytes:
        out = bytearray()
        data = self._emulator.data_to_send(now_ns)
        if not self._synchronised:
            begin = data.find(b"\x02\x80\x6e\x01\xb0")
            if begin < 0:
                return data
            self._synchronised = True
            out += data[:begin]
            data = data[begin:]
        for byte in data:
            if not self._frame and self._random.random() < 0.5:
                out += self._dirt()
            self._frame += bytes((byte,))
            out.append(byte)
            if self._complete():
                self._last, self._frame = self._frame, b""
        return bytes(out)

    def _complete(self) -> bool:
        frame = self._frame
        match self._name:
            case "laser":
                if frame[0] != 0x02:
                    return True
                return len(frame) >= 4 and len(frame) == 6 + int.from_bytes(frame[2:4], "little")
            case "imu":
                return len(frame) >= 2 and len(frame) == 12 + frame[1]
            case "encoders":
                return frame[-1] in b"\r\x07"
            case _:
                return frame.endswith(b"\n")

    def _dirt(self) -> bytes:
        self.insertions += 1
        draw = self._random
        match draw.randrange(3):
            case 0:
                return draw.randbytes(draw.randrange(1, 60))
            case 1:
                return draw.choice(self.FALSE_BEGINNINGS[self._name])
            case _:
                return self._last[: draw.randrange(1, max(len(self._last), 2))]


DIRT = {
    "laser": ("skipped_bytes",),
    "encoders": ("bad_frames", "skipped_bytes"),
    "imu": ("skipped_bytes", "bad_crc"),
    "gps": ("skipped_bytes", "bad_checksum"),
}


def check_dirty(counts: Mapping[str, Mapping[str, int]], noises: Mapping[str, Noisy], seconds: float) -> None:
    """Much dirt went in, all of it was counted, and every intact frame came through."""
    for name, noise in noises.items():
        assert noise.insertions > 2 * seconds
        assert sum(counts[name][kind] for kind in DIRT[name]) > noise.insertions / 2
    assert counts["imu"].get("lost", 0) == 0
    assert counts["laser"].get("restarts", 0) == counts["laser"].get("silences", 0) == 0
    assert counts["encoders"].get("gaps", 0) == counts["encoders"].get("jumps", 0) == 0


def violations(truth: Truth, poses: PoseSets, saved: SavedMap, drive: PortDrive) -> tuple[int, int]:
    """(poses outside, hits outside)."""
    return check_bounds(truth, poses, saved, drive.loaded.config.devices.laser)[:2]


def test_dirt_between_frames_breaks_nothing(tmp_path: Path) -> None:
    """Random bytes, false headers and pieces of frames on every port: all scans come, every bound holds."""
    noises: dict[str, Noisy] = {}

    def disturb(onboard: Onboard, wires: PluggedWires, driven_s: float) -> None:
        if not noises:
            for name, wire in wires.items():
                wire.emulator = noises[name] = Noisy(wire.emulator, name, seed=1)

    drive = drive_on_ports(tmp_path, scene="rough", law="drift", seed=4, duration_s=6.0, meddle=disturb)
    devices = drive.onboard.health.snapshot(time.monotonic_ns())["devices"]
    check_dirty({name: device["counts"] for name, device in devices.items()}, noises, 6.0)
    poses = drive.pose_sets()
    assert violations(drive.truth, poses, load_map(drive.map), drive) == (0, 0)
    assert drive.onboard.pipeline.filter.guarantee.intact
    begins = np.sort(poses.earliest_ns)
    assert np.diff(begins).max() < 20_000_000  # no scan is missing


@pytest.mark.parametrize("seed", [2, 3])
def test_dirt_breaks_nothing_with_other_seeds(seed: int) -> None:
    """The same in virtual time."""
    noises: dict[str, Noisy] = {}

    def disturb(wires: Mapping[str, VirtualWire], driven_s: float) -> None:
        if not noises:
            for name, wire in wires.items():
                wire.emulator = noises[name] = Noisy(wire.emulator, name, seed)

    demo = load(shipped_config("demo.toml"))
    drive = drive_virtually(demo, scene="stairs", law="corners", seed=seed, duration_s=6.0, meddle=disturb)
    check_dirty({name: wire.protocol.counts for name, wire in drive.wires.items()}, noises, 6.0)
    assert drive.violations()[:2] == (0, 0)
    assert drive.pipeline.filter.guarantee.intact
    assert drive.scans_sent - drive.samples["laser"] <= 2
