"""The robot's devices, emulated: switched on in the simulated world, and plugged into pseudo-terminals."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from drivers.config import READ_ALLOWANCE_NS, DevicesConfig, LatencyMs
from drivers.errors import ConfigurationError
from simulator.emulators.emulator import Emulator
from simulator.emulators.gps import GpsEmulator
from simulator.emulators.imu import ImuEmulator
from simulator.emulators.sick_lms import LMS_221, LMS_FAST, SickLmsEmulator
from simulator.emulators.track_encoders import TrackEncodersEmulator
from simulator.ports import PseudoPort
from simulator.wire import Wire
from simulator.world import World

DEVICES = ("laser", "encoders", "imu", "gps")
SLOW_SENSOR_PERIOD_NS = 20_000_000
"""Accelerometers and tilt sensor: 50 Hz, beside the gyroscope's 200."""


@dataclass(frozen=True, slots=True)
class PluggedDevices:
    """The robot's devices, plugged in."""

    laser: SickLmsEmulator
    encoders: TrackEncodersEmulator
    wires: list[Wire]

    @property
    def heard(self) -> bool:
        """Do the hosts get scans and counts?"""
        return self.laser.streaming and self.laser.scans_sent > 0 and self.encoders.is_open


def plug_in_all(
    world: World,
    devices: DevicesConfig,
    links: Mapping[str, Path] | Path,
    slice_ns: int,
    start_ns: int,
    punctual: bool,
) -> PluggedDevices:
    """Switch the devices on at `start_ns` and plug them in."""
    readers_ns = READ_ALLOWANCE_NS if punctual else 0
    laser, encoders, emulators = emulate_devices(world, devices, slice_ns + readers_ns, start_ns)
    paths = {name: links / name for name in DEVICES} if isinstance(links, Path) else links
    wires = []
    for name in [name for name in emulators if name in paths]:
        wire = Wire(name, emulators[name], plug_in(paths[name]))
        if punctual:
            # A host that is kept from reading measures how long the pty held bytes for it; ours must come in time.
            most_ns = round(1e6 * getattr(devices, name).latency_ms[1]) - READ_ALLOWANCE_NS
            wire.patience_ns = most_ns - getattr(emulators[name], "latency_ns", 0)
            wire.port.keeps_backlog = False
        wires.append(wire)
    return PluggedDevices(laser, encoders, wires)


def plug_in(link: Path) -> PseudoPort:
    """A pseudo-terminal under this link. Raises ConfigurationError where something else has that name."""
    if link.exists() and not link.is_symlink():
        raise ConfigurationError(f"{link}: exists and is no link; name another path for the emulated port")
    link.parent.mkdir(parents=True, exist_ok=True)
    return PseudoPort(link)


def emulate_devices(
    world: World, devices: DevicesConfig, slice_ns: int, start_ns: int, own_messages: bool = False
) -> tuple[SickLmsEmulator, TrackEncodersEmulator, dict[str, Emulator]]:
    """The robot's devices, switched on at `start_ns`: the laser, the encoders, and all of them by name.

    `own_messages`: the inertial board speaks those of drivers/imu/terrabound.xml.
    """
    imu, gps = devices.imu, devices.gps
    scanner = LMS_FAST if devices.laser.scan_angle_deg == 90 else LMS_221
    laser = SickLmsEmulator(world.measure, start_ns=start_ns, type_text=scanner)
    encoders = TrackEncodersEmulator(
        world.count,
        start_ns=start_ns,
        bitrate=devices.encoders.bitrate,
        latency_ns=_latency_ns("encoders", devices.encoders.latency_ms, slice_ns),
    )
    emulators: dict[str, Emulator] = {
        "laser": laser,
        "encoders": encoders,
        "imu": ImuEmulator(
            world.gyro,
            world.accel,
            world.tilt,
            start_ns=start_ns,
            accel_period_ns=SLOW_SENSOR_PERIOD_NS,
            tilt_period_ns=SLOW_SENSOR_PERIOD_NS,
            baud=imu.baud,
            latency_ns=_latency_ns("imu", imu.latency_ms, slice_ns),
            own_messages=own_messages,
            clock_ppm=imu.clock_drift_ppm * 0.99 * world.law.channel("imu.clock").level,
        ),
    }
    if gps is not None:
        emulators["gps"] = GpsEmulator(
            world.position,
            start_ns=start_ns,
            baud=gps.baud,
            latency_ns=_latency_ns("gps", gps.latency_ms, slice_ns),
            quality=4 if world.rtk else 2,
            sigma_m=world.gst_sigma_m,
            velocity=world.ground_velocity,
        )
    return laser, encoders, emulators


def _latency_ns(device: str, latency_ms: LatencyMs, slice_ns: int) -> int:
    """From acquisition to the wire, such that with a slice on top it stays in the middle of what is declared."""
    least, most = latency_ms
    room_ms = most - least - slice_ns * 1e-6
    if room_ms < 0:
        raise ConfigurationError(
            f"devices.{device}.latency_ms: [{least:g}, {most:g}] is narrower than the {slice_ns * 1e-6:g} ms slices of "
            "the emulated robot; declare a wider interval"
        )
    return round((least + 0.5 * room_ms) * 1e6)
