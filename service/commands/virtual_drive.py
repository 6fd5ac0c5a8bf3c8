"""A drive without ports: emulated devices, drivers, filter and mapper in one process, in virtual time.

The same parts as in a run, joined mouth to mouth in slices of 10 ms: many drives are held against their truth in little
time. For the proofs (`make prove`) and the tests.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.config import DevicesConfig, LaserConfig
from drivers.protocol import DeviceProtocol
from drivers.samples import Sample
from estimator.bounded_pose import BoundedPose
from mapper.saved_map import SavedMap, assemble
from service.commands.evaluation import PoseSets, check_bounds
from service.config import LoadedConfig
from service.devices import wiring
from service.map_update import MAP_FRAME
from service.pipeline import Pipeline
from service.robot_model import robot_model
from service.sample_queue import Arrival
from simulator.emulated_devices import emulate_devices
from simulator.emulated_robot import SLICE_NS
from simulator.emulators.emulator import Emulator
from simulator.errors import ErrorLaw
from simulator.terrain import build_terrain
from simulator.truth import Truth
from simulator.wire import as_heard
from simulator.world import World

START_NS = 1_000_000_000_000
LONGEST_START_NS = 60_000_000_000
"""The scanner's handshake has never taken longer in virtual time."""

DevicesMeddle = Callable[[Mapping[str, "VirtualWire"], float], None]


@dataclass(slots=True)
class VirtualWire:
    """One device joined to its driver, without a port between."""

    emulator: Emulator
    protocol: DeviceProtocol[Sample]
    plugged: bool = True

    def exchange(self, now_ns: int) -> list[Sample]:
        """Both directions, up to now; the samples that the driver makes of it."""
        protocol, emulator = self.protocol, self.emulator
        if protocol.deadline_ns is not None and protocol.deadline_ns <= now_ns:
            protocol.advance(now_ns)
        if request := protocol.data_to_send():
            self._receive(request, now_ns)
        samples: list[Sample] = []
        while True:
            rate = emulator.baud
            data = emulator.data_to_send(now_ns)
            if data and self.plugged:
                samples += protocol.receive_data(data if rate is None else as_heard(data, rate, protocol.baud), now_ns)
            if emulator.baud == rate:
                return samples

    def _receive(self, request: bytes, now_ns: int) -> None:
        rate = self.emulator.baud
        if self.plugged:
            self.emulator.receive_data(request if rate is None else as_heard(request, rate, self.protocol.baud), now_ns)

    def unplug(self) -> None:
        """From here on bytes go nowhere."""
        self.plugged = False

    def replug(self, now_ns: int) -> None:
        """Bytes come again, and the driver knows that it must begin afresh."""
        self.plugged = True
        self.protocol.connection_made(now_ns)


@dataclass(slots=True, eq=False)
class VirtualDrive:
    """A finished drive: what came out, and what was true."""

    laser: LaserConfig
    """As declared."""
    pipeline: Pipeline
    wires: dict[str, VirtualWire]
    truth: Truth
    """In the world frame."""
    poses: PoseSets
    saved: SavedMap
    scans_sent: int
    samples: dict[str, int]
    """How many each device gave."""

    @property
    def filter_steps(self) -> int:
        """Ticks, inertial packets and fixes that the filter was given."""
        return sum(count for name, count in self.samples.items() if name != "laser")

    def violations(self) -> tuple[int, int, int]:
        """(poses outside their set, hits outside their cell, hits checked)."""
        return check_bounds(self.truth, self.poses, self.saved, self.laser)


def drive_virtually(
    loaded: LoadedConfig,
    *,
    scene: str,
    law: str,
    seed: int,
    duration_s: float,
    true_devices: DevicesConfig | None = None,
    meddle: DevicesMeddle | None = None,
    on_arrival: Callable[[Arrival], None] = lambda arrival: None,
) -> VirtualDrive:
    """Start the scanner, stand still, drive for `duration_s` (standstill included), and finish the map.

    `true_devices` are what the emulated errors keep to, where that is not what `loaded` declares. `meddle` is called
    before each slice of the drive with the wires and the seconds driven; `on_arrival` gets every sample.
    """
    devices = loaded.config.devices if true_devices is None else true_devices
    world = World(
        build_terrain(scene, seed),
        robot_model(loaded.config.robot),
        devices,
        ErrorLaw(law, seed),
        START_NS,
        duration_s,
    )
    laser, encoders, emulators = emulate_devices(world, devices, SLICE_NS, START_NS)
    wires = {device.name: VirtualWire(emulators[device.name], device.protocol()) for device in wiring(loaded)}
    recorder = PoseRecorder()
    pipeline = Pipeline(loaded.config, recorder)
    samples = dict.fromkeys(wires, 0)
    now_ns = START_NS
    for wire in wires.values():
        wire.protocol.connection_made(now_ns)
    drive_start_ns: int | None = None
    while world.drive_end_ns is None or now_ns < world.drive_end_ns:
        if drive_start_ns is not None and meddle is not None:
            meddle(wires, (now_ns - drive_start_ns) * 1e-9)
        now_ns += SLICE_NS
        for name, wire in wires.items():
            arrived = wire.exchange(now_ns)
            samples[name] += len(arrived)
            for sample in arrived:
                arrival = Arrival(name, sample, now_ns)
                on_arrival(arrival)
                pipeline.step(arrival)
        if drive_start_ns is None and laser.streaming and laser.scans_sent > 0 and encoders.is_open:
            drive_start_ns = now_ns
            world.begin_drive(now_ns)
        if drive_start_ns is None and now_ns - START_NS > LONGEST_START_NS:
            raise RuntimeError("the emulated scanner was not brought to stream")
    pipeline.finish()
    saved = assemble(pipeline.map.tiles(), pipeline.map.config.resolution_m, MAP_FRAME)
    return VirtualDrive(
        loaded.config.devices.laser,
        pipeline,
        wires,
        world.truth(now_ns),
        recorder.sets(),
        saved,
        laser.scans_sent,
        samples,
    )


class PoseRecorder:
    """Keeps the pose sets that scans were mapped with."""

    def __init__(self) -> None:
        self._poses: list[BoundedPose] = []

    def __call__(self, pose: BoundedPose) -> None:
        self._poses.append(pose)

    def sets(self) -> PoseSets:
        """All of them, one a row."""
        poses = self._poses
        times = np.array([(pose.earliest_ns, pose.latest_ns) for pose in poses], np.int64).reshape(-1, 2)

        def rows(boxes: list[NDArray[np.float64]]) -> NDArray[np.float64]:
            return np.array(boxes, float).reshape(-1, 6)

        return PoseSets(
            times[:, 0].copy(),
            times[:, 1].copy(),
            rows([pose.low for pose in poses]),
            rows([pose.high for pose in poses]),
        )
