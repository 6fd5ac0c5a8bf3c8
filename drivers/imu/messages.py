"""What the inertial messages say, in our units and axes; and how our readings are put into them.

MAVLink's body frame is x ahead, y right, z down; ours is x ahead, y left, z up. So a vector (x, y, z) becomes
(x, -y, -z), both ways; roll stays as it is and pitch, positive nose up there, changes its sign.
"""

from collections.abc import Callable
from inspect import signature
from math import isnan, nan
from operator import itemgetter
from typing import Any, NamedTuple, TypeAlias

from drivers.imu.codec import MavlinkFrame, build, field_names
from drivers.imu.dialect import UNKNOWN_TEMPERATURE_CDEGC
from drivers.samples import ABSENT3, Vector3

_MILLI_G_MPS2 = 9.80665e-3
_MILLI = 1e-3
_XACC, _XGYRO = 1 << 0, 1 << 3
"""Bits of HIGHRES_IMU.fields_updated; y and z follow."""
_TEMPERATURE = 1 << 12
_CENTI = 1e-2
_BITS = tuple(first << axis for first in (_XACC, _XGYRO) for axis in range(3))
_ACCEL_AXES, _GYRO_AXES = ("xacc", "yacc", "zacc"), ("xgyro", "ygyro", "zgyro")

Counts: TypeAlias = tuple[int, int, int]


class Reading(NamedTuple):
    """One message's readings in base_link; absent axes are NaN."""

    sensor_id: int
    device_time_us: int
    accel_mps2: Vector3 = ABSENT3
    gyro_rps: Vector3 = ABSENT3
    tilt_rad: tuple[float, float] = (nan, nan)
    present: tuple[float, ...] = ()
    """The values that the message claims to hold; none of them may be NaN."""
    resolution_us: int = 1
    """Step of the device time."""
    wraps: bool = False
    """Does the device time count 32 bits of milliseconds?"""
    temperature_degc: float = nan
    """Of the sensor; NaN where the message doesn't tell."""
    told_bound: float = 0.0
    """Half-width that the board vouches for, m/s^2 or rad; 0 where it doesn't."""


def turned(vector: Vector3) -> Vector3:
    """From MAVLink's body frame to ours, or back."""
    x, y, z = vector
    return x, -y, -z


def _highres(
    id_: int,
    time_usec: int,
    xacc: float,
    yacc: float,
    zacc: float,
    xgyro: float,
    ygyro: float,
    zgyro: float,
    temperature: float,
    fields_updated: int,
) -> Reading:
    accel, accel_present = _updated(xacc, yacc, zacc, fields_updated // _XACC & 0b111)
    gyro, gyro_present = _updated(xgyro, ygyro, zgyro, fields_updated // _XGYRO & 0b111)
    warmth = temperature if fields_updated & _TEMPERATURE else nan
    present = accel_present + gyro_present
    return Reading(id_, time_usec, accel, gyro, present=present, temperature_degc=warmth)


def _updated(x: float, y: float, z: float, updated: int) -> tuple[Vector3, tuple[float, ...]]:
    """Three axes in our frame, NaN where their bit (x: 1, y: 2, z: 4) says that they are not new; those that are."""
    if not updated:
        return ABSENT3, ()
    if updated == 0b111:
        return (x, -y, -z), (x, y, z)
    present = tuple(value for value, bit in ((x, 1), (y, 2), (z, 4)) if updated & bit)
    return (x if updated & 1 else nan, -y if updated & 2 else nan, -z if updated & 4 else nan), present


def _raw(
    id_: int,
    time_usec: int,
    xacc: int,
    yacc: int,
    zacc: int,
    xgyro: int,
    ygyro: int,
    zgyro: int,
    temperature: int,
) -> Reading:
    return _scaled(id_, time_usec, (xacc, yacc, zacc), (xgyro, ygyro, zgyro), temperature)


def _boot_ms(sensor_id: int) -> Callable[..., Reading]:
    """SCALED_IMU and its likes."""

    def read(
        time_boot_ms: int, xacc: int, yacc: int, zacc: int, xgyro: int, ygyro: int, zgyro: int, temperature: int
    ) -> Reading:
        axes = (xacc, yacc, zacc), (xgyro, ygyro, zgyro)
        return _scaled(sensor_id, time_boot_ms * 1000, *axes, temperature, resolution_us=1000, wraps=True)

    return read


def _scaled(
    sensor_id: int,
    time_us: int,
    milli_g: Counts,
    milli_rps: Counts,
    temperature: int,
    resolution_us: int = 1,
    wraps: bool = False,
) -> Reading:
    """Integers: milli-g and milliradians per second; a temperature of 0 is none."""
    x, y, z = milli_g
    accel = (x * _MILLI_G_MPS2, y * _MILLI_G_MPS2, z * _MILLI_G_MPS2)
    x, y, z = milli_rps
    gyro = (x * _MILLI, y * _MILLI, z * _MILLI)
    return Reading(
        sensor_id,
        time_us,
        turned(accel),
        turned(gyro),
        present=accel + gyro,
        resolution_us=resolution_us,
        wraps=wraps,
        temperature_degc=temperature * _CENTI or nan,
    )


def _attitude(time_boot_ms: int, roll: float, pitch: float) -> Reading:
    """Only roll and pitch: the yaw may be NaN, and the rates are the board's filter's, not means between packets."""
    return Reading(
        0, time_boot_ms * 1000, tilt_rad=(roll, -pitch), present=(roll, pitch), resolution_us=1000, wraps=True
    )


def _dual_acceleration(id_: int, time_usec: int, xacc: float, yacc: float, bound: float, temperature: int) -> Reading:
    warmth = _own_temperature(temperature)
    axes, present = (xacc, -yacc, nan), (xacc, yacc)
    return Reading(id_, time_usec, accel_mps2=axes, present=present, temperature_degc=warmth, told_bound=bound)


def _dual_tilt(id_: int, time_usec: int, roll: float, pitch: float, bound: float, temperature: int) -> Reading:
    warmth = _own_temperature(temperature)
    axes, present = (roll, -pitch), (roll, pitch)
    return Reading(id_, time_usec, tilt_rad=axes, present=present, temperature_degc=warmth, told_bound=bound)


def _own_temperature(told: int) -> float:
    return nan if told == UNKNOWN_TEMPERATURE_CDEGC else told * _CENTI


READINGS: dict[str, Callable[..., Reading]] = {
    "HIGHRES_IMU": _highres,
    "SCALED_IMU": _boot_ms(0),
    "SCALED_IMU2": _boot_ms(1),
    "SCALED_IMU3": _boot_ms(2),
    "RAW_IMU": _raw,
    "ATTITUDE": _attitude,
    "DUAL_AXIS_ACCELERATION": _dual_acceleration,
    "DUAL_AXIS_TILT": _dual_tilt,
}
"""The messages that are read, each by a function of the fields that it wants; all others are only counted."""


def _wanted(message: str, reader: Callable[..., Reading]) -> "itemgetter[tuple[Any, ...]]":
    """Takes the fields that a reader wants, in its order, out of all values of a message."""
    names = field_names(message)
    return itemgetter(*(names.index(name.rstrip("_")) for name in signature(reader).parameters))


_WANTED = {message: (reader, _wanted(message, reader)) for message, reader in READINGS.items()}


def read(frame: MavlinkFrame) -> Reading | None:
    """What an inertial message says; None of any other."""
    known = _WANTED.get(frame.message)
    if known is None:
        return None
    reader, wanted = known
    return reader(*wanted(frame.values()))


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


def dual_axis_acceleration(
    sequence: int,
    time_us: int,
    sensor_id: int,
    accel_mps2: tuple[float, float],
    bound_mps2: float = 0.0,
    temperature_cdegc: int = UNKNOWN_TEMPERATURE_CDEGC,
) -> MavlinkFrame:
    """DUAL_AXIS_ACCELERATION of base_link readings ahead and left."""
    ahead, left = accel_mps2
    axes: dict[str, Any] = {"xacc": ahead, "yacc": -left, "bound": bound_mps2, "temperature": temperature_cdegc}
    return build("DUAL_AXIS_ACCELERATION", sequence=sequence, time_usec=time_us, id=sensor_id, **axes)


def dual_axis_tilt(
    sequence: int,
    time_us: int,
    sensor_id: int,
    tilt_rad: tuple[float, float],
    bound_rad: float = 0.0,
    temperature_cdegc: int = UNKNOWN_TEMPERATURE_CDEGC,
) -> MavlinkFrame:
    """DUAL_AXIS_TILT of our roll and pitch."""
    roll, pitch = tilt_rad
    axes: dict[str, Any] = {"roll": roll, "pitch": -pitch, "bound": bound_rad, "temperature": temperature_cdegc}
    return build("DUAL_AXIS_TILT", sequence=sequence, time_usec=time_us, id=sensor_id, **axes)
