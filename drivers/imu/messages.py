"""What the inertial messages say, in our units and axes; and how our readings are put into them.

MAVLink's body frame is x ahead, y right, z down; ours is x ahead, y left, z up. So a vector (x, y, z) becomes
(x, -y, -z), both ways; roll stays as it is and pitch, positive nose up there, changes its sign.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import isnan, nan
from typing import Any

from drivers.imu.codec import MavlinkFrame, build
from drivers.samples import ABSENT3, Vector3

_MILLI_G_MPS2 = 9.80665e-3
_MILLI = 1e-3
_XACC, _XGYRO = 1 << 0, 1 << 3
"""Bits of HIGHRES_IMU.fields_updated; y and z follow."""
_BITS = tuple(first << axis for first in (_XACC, _XGYRO) for axis in range(3))
_ACCEL_AXES, _GYRO_AXES = ("xacc", "yacc", "zacc"), ("xgyro", "ygyro", "zgyro")


@dataclass(frozen=True, slots=True)
class Reading:
    """One message's readings in base_link; absent axes are NaN."""

    sensor_id: int
    device_time_us: int
    accel_mps2: Vector3 = ABSENT3
    gyro_rps: Vector3 = ABSENT3
    tilt_rad: tuple[float, float] = (nan, nan)
    present: tuple[float, ...] = ()
    """The values that the message claims to hold; none of them may be NaN."""


def turned(vector: Vector3) -> Vector3:
    """From MAVLink's body frame to ours, or back."""
    x, y, z = vector
    return x, -y, -z


def _highres(fields: dict[str, Any]) -> Reading:
    updated = fields["fields_updated"]
    accel, accel_present = _updated(fields, _ACCEL_AXES, updated // _XACC & 0b111)
    gyro, gyro_present = _updated(fields, _GYRO_AXES, updated // _XGYRO & 0b111)
    present = accel_present + gyro_present
    return Reading(fields["id"], fields["time_usec"], turned(accel), turned(gyro), present=present)


def _updated(fields: dict[str, Any], names: tuple[str, str, str], updated: int) -> tuple[Vector3, tuple[float, ...]]:
    """Three axes, NaN where their bit (x: 1, y: 2, z: 4) says that they are not new; and those that are."""
    if not updated:
        return ABSENT3, ()
    x, y, z = fields[names[0]], fields[names[1]], fields[names[2]]
    if updated == 0b111:
        return (x, y, z), (x, y, z)
    present = tuple(value for value, bit in ((x, 1), (y, 2), (z, 4)) if updated & bit)
    return (x if updated & 1 else nan, y if updated & 2 else nan, z if updated & 4 else nan), present


def _scaled(sensor_id: int, time_us: int, fields: dict[str, Any]) -> Reading:
    """Integers: milli-g and milliradians per second."""
    accel = (fields["xacc"] * _MILLI_G_MPS2, fields["yacc"] * _MILLI_G_MPS2, fields["zacc"] * _MILLI_G_MPS2)
    gyro = (fields["xgyro"] * _MILLI, fields["ygyro"] * _MILLI, fields["zgyro"] * _MILLI)
    return Reading(sensor_id, time_us, turned(accel), turned(gyro), present=accel + gyro)


def _attitude(fields: dict[str, Any]) -> Reading:
    """Only roll and pitch: the yaw may be NaN, and the rates are the board's filter's, not means between packets."""
    roll, pitch = fields["roll"], fields["pitch"]
    return Reading(0, fields["time_boot_ms"] * 1000, tilt_rad=(roll, -pitch), present=(roll, pitch))


READINGS: dict[str, Callable[[dict[str, Any]], Reading]] = {
    "HIGHRES_IMU": _highres,
    "SCALED_IMU": lambda fields: _scaled(0, fields["time_boot_ms"] * 1000, fields),
    "SCALED_IMU2": lambda fields: _scaled(1, fields["time_boot_ms"] * 1000, fields),
    "SCALED_IMU3": lambda fields: _scaled(2, fields["time_boot_ms"] * 1000, fields),
    "RAW_IMU": lambda fields: _scaled(fields["id"], fields["time_usec"], fields),
    "ATTITUDE": _attitude,
}
"""The messages that are read; all others are only counted."""


def highres_imu(
    sequence: int, time_us: int, sensor_id: int, accel_mps2: Vector3 = ABSENT3, gyro_rps: Vector3 = ABSENT3
) -> MavlinkFrame:
    """HIGHRES_IMU with base_link readings; NaN axes are sent as not updated."""
    updated, present = 0, dict[str, Any]()
    for bit, name, value in zip(_BITS, _ACCEL_AXES + _GYRO_AXES, turned(accel_mps2) + turned(gyro_rps), strict=True):
        if not isnan(value):
            updated |= bit
            present[name] = value
    return build("HIGHRES_IMU", sequence=sequence, time_usec=time_us, fields_updated=updated, id=sensor_id, **present)


def attitude(sequence: int, time_ms: int, roll_rad: float, pitch_rad: float) -> MavlinkFrame:
    """ATTITUDE of a tilt sensor: our roll and pitch, no yaw."""
    return build("ATTITUDE", sequence=sequence, time_boot_ms=time_ms, roll=roll_rad, pitch=-pitch_rad, yaw=nan)
