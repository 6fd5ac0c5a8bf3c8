"""Which devices there are: how each port is opened, who speaks its protocol, how its bytes are recorded.

A protocol is imported when it is made: the scanner can be set up before the others' libraries are loaded.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from math import radians
from typing import TYPE_CHECKING

from drivers.config import EncodersConfig, GpsConfig, ImuConfig, LaserConfig
from drivers.errors import ConfigurationError
from drivers.protocol import DeviceProtocol
from drivers.samples import Sample
from drivers.transports import Transport, open_serial
from estimator.config import RobotConfig
from service.config import LoadedConfig

if TYPE_CHECKING:
    from drivers.gps_nmea.protocol import GpsProtocol
    from drivers.imu.protocol import ImuProtocol
    from drivers.sick_lms.protocol import SickLmsProtocol
    from drivers.track_encoders.protocol import TrackEncoderProtocol

NOW_OR_LATER = date(2024, 1, 1)
"""A receiver that tells an earlier day lives in another GPS week epoch."""


@dataclass(frozen=True, slots=True)
class Device:
    """One device of the robot, as the reader needs it."""

    name: str
    port: str
    open: Callable[[], Transport]
    """At once: see `drivers.port_read` for punctual reading."""
    protocol: Callable[[], DeviceProtocol[Sample]]
    stale_after_s: float
    """Silence longer than this is a fault."""
    can_frames: bool = False
    """Does the port give struct can_frame records rather than bytes?"""


def wiring(loaded: LoadedConfig) -> tuple[Device, ...]:
    """The table of devices. Raises ConfigurationError where the encoders' DBC file can't be used."""
    table = unchecked_wiring(loaded)
    for device in table:
        device.protocol()
    return table


def unchecked_wiring(loaded: LoadedConfig) -> tuple[Device, ...]:
    """The same; what the configuration names is looked up when the protocols are made, which then raise."""
    devices = loaded.config.devices
    laser, encoders, imu, gps = devices.laser, devices.encoders, devices.imu, devices.gps
    dbc_text = loaded.dbc_text()
    max_track_mps = _max_track_mps(loaded.config.robot)
    framed = encoders.interface == "socketcan"
    encoder_port = encoders.port if framed else _port(loaded, encoders.port)
    table = [
        Device(
            "encoders",
            encoder_port,
            (lambda: _open_socketcan(encoders, dbc_text, max_track_mps))
            if framed
            else (lambda: open_serial(encoder_port, 115200, at_once=True)),
            lambda: _track_encoders(encoders, dbc_text, max_track_mps),
            stale_after_s=0.1,
            can_frames=framed,
        ),
        _serial(loaded, "imu", imu.port, imu.baud, lambda: _imu(imu), stale_after_s=0.1),
        _serial(loaded, "laser", laser.port, laser.baud, lambda: _laser(laser), stale_after_s=0.5),
    ]
    if gps is not None:
        table.append(_serial(loaded, "gps", gps.port, gps.baud, lambda: _gps(gps), stale_after_s=2.0))
    return tuple(table)


def _laser(config: LaserConfig) -> "SickLmsProtocol":
    from drivers.sick_lms.protocol import SickLmsProtocol

    return SickLmsProtocol(config)


def _imu(config: ImuConfig) -> "ImuProtocol":
    from drivers.imu.protocol import ImuProtocol

    return ImuProtocol(config)


def _gps(config: GpsConfig) -> "GpsProtocol":
    from drivers.gps_nmea.protocol import GpsProtocol

    return GpsProtocol(config, NOW_OR_LATER)


def _track_encoders(config: EncodersConfig, dbc_text: str, max_track_mps: float | None) -> "TrackEncoderProtocol":
    from drivers.track_encoders.protocol import TrackEncoderProtocol

    try:
        return TrackEncoderProtocol(config, dbc_text, max_track_mps)
    except ConfigurationError as error:
        raise ConfigurationError(f"devices.encoders: {error}") from None


def _open_socketcan(config: EncodersConfig, dbc_text: str, max_track_mps: float | None) -> Transport:
    from drivers.socketcan import open_socketcan

    return open_socketcan(config.port, config.bitrate, _track_encoders(config, dbc_text, max_track_mps).messages)


def can_frames(devices: tuple[Device, ...]) -> tuple[str, ...]:
    """Names of the devices whose captures hold CAN frames."""
    return tuple(device.name for device in devices if device.can_frames)


def _max_track_mps(robot: RobotConfig) -> float | None:
    """No track is faster over the ground than the robot moves and turns, nor much faster than that by its slip."""
    if robot.slip_ratio >= 1.0:
        return None
    turning_mps = radians(robot.max_turn_rate_dps) * robot.track_gauge_m / 2
    return (robot.max_speed_mps + turning_mps) / (1.0 - robot.slip_ratio)


def _serial(
    loaded: LoadedConfig,
    name: str,
    port: str,
    baud: int,
    protocol: Callable[[], DeviceProtocol[Sample]],
    stale_after_s: float,
) -> Device:
    """A device on a serial port."""
    path = _port(loaded, port)
    return Device(name, path, lambda: open_serial(path, baud, at_once=True), protocol, stale_after_s)


def _port(loaded: LoadedConfig, port: str) -> str:
    """Ports are absolute, or as seen from the configuration's folder."""
    return str(loaded.path(port))
