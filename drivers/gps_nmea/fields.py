"""Fields of NMEA sentences: each has a pattern and a range of its own; an empty one: the receiver doesn't know.

`float` would take nan, 1e400 and 4_8.0. What is none of these is a BadField, which costs the whole sentence and never
leaves the codec. How many digits a field has tells how far the number behind it may be: half a step of the last one.
"""

import re
from dataclasses import dataclass
from datetime import date
from math import atan2, cos, degrees, floor, hypot, radians, sin

_TIME = re.compile(r"([01][0-9]|2[0-3])([0-5][0-9])([0-5][0-9]|60)(?:\.([0-9]{1,9}))?", re.ASCII)
_DATE = re.compile(r"([0-9]{2})([0-9]{2})([0-9]{2})", re.ASCII)
_LATITUDE = re.compile(r"([0-9]{2})([0-5][0-9](?:\.([0-9]{1,12}))?)", re.ASCII)
_LONGITUDE = re.compile(r"([01][0-9]{2})([0-5][0-9](?:\.([0-9]{1,12}))?)", re.ASCII)
_NUMBER = re.compile(r"-?[0-9]{1,8}(?:\.([0-9]{1,12}))?", re.ASCII)
_WHOLE = re.compile(r"[0-9]{1,4}", re.ASCII)

_KNOT_MPS = 1852 / 3600
_ROUNDING_DEG = 1e-13
"""Degrees and minutes become one binary number: a few units in the last place of 180."""
_MINUTE_STEPS = 10**7
"""Seven decimals of a minute: 0.2 mm."""


class BadField(ValueError):
    """A field that isn't what the standard says."""


_DAY_NS = 86_400_000_000_000


@dataclass(frozen=True, slots=True)
class TimeOfDay:
    """UTC; second 60 is a leap second."""

    hour: int
    minute: int
    second: int
    nanosecond: int

    def __str__(self) -> str:
        return f"{self.hour:02d}:{self.minute:02d}:{self.second:02d}.{self.nanosecond // 1_000_000:03d}"

    @property
    def seconds(self) -> int:
        """Whole seconds since midnight."""
        return 3600 * self.hour + 60 * self.minute + self.second

    def since_ns(self, earlier: "TimeOfDay") -> int:
        """Nanoseconds since an earlier time, less than a day before."""
        later_ns, earlier_ns = (1_000_000_000 * time.seconds + time.nanosecond for time in (self, earlier))
        return (later_ns - earlier_ns) % _DAY_NS


@dataclass(frozen=True, slots=True)
class Angle:
    """Latitude or longitude, north and east positive."""

    deg: float
    half_step_deg: float = 0.0
    """Half of the last digit that was written: the receiver's own number is no farther."""


def expect(condition: bool) -> None:
    """BadField unless `condition`."""
    if not condition:
        raise BadField


def time_of_day(field: str) -> TimeOfDay | None:
    """hhmmss.sss"""
    if not field:
        return None
    match = _TIME.fullmatch(field)
    if match is None:
        raise BadField
    hour, minute, second, fraction = match.groups()
    return TimeOfDay(int(hour), int(minute), int(second), int((fraction or "0").ljust(9, "0")))


def short_date(field: str) -> date | None:
    """ddmmyy, of the years 1980 to 2079."""
    if not field:
        return None
    match = _DATE.fullmatch(field)
    if match is None:
        raise BadField
    day, month, year = map(int, match.groups())
    return _real_date(year + (1900 if year >= 80 else 2000), month, day)


def long_date(day: str, month: str, year: str) -> date | None:
    """dd, mm, yyyy in three fields."""
    if not (day or month or year):
        return None
    expect(1980 <= (whole(year) or 0) < 2100)
    return _real_date(int(year), whole(month) or 0, whole(day) or 0)


def latitude(field: str, side: str) -> Angle | None:
    """ddmm.mmmm, N or S"""
    return _angle(_LATITUDE, field, side, "NS", 90)


def longitude(field: str, side: str) -> Angle | None:
    """dddmm.mmmm, E or W"""
    return _angle(_LONGITUDE, field, side, "EW", 180)


def number(field: str, low: float, high: float) -> float | None:
    """A decimal number in [low, high]."""
    if not field:
        return None
    expect(_NUMBER.fullmatch(field) is not None)
    value = float(field)
    expect(low <= value <= high)
    return value


def half_step(field: str) -> float:
    """Half of the last digit of a number that `number` has taken; 0 of an empty field."""
    return 0.5 * 10.0 ** -len(field.partition(".")[2]) if field else 0.0


def whole(field: str) -> int | None:
    """A whole number of up to four digits."""
    if not field:
        return None
    expect(_WHOLE.fullmatch(field) is not None)
    return int(field)


def velocity(speed_kn: str, course_deg: str) -> tuple[float, float] | None:
    """(east, north) in m/s from a speed and a true course; None where either is missing."""
    speed, course = number(speed_kn, 0, 10_000), number(course_deg, 0, 360)
    if speed is None or (course is None and speed > 0):
        return None
    angle = radians(course or 0.0)
    return speed * _KNOT_MPS * sin(angle), speed * _KNOT_MPS * cos(angle)


def time_text(time: TimeOfDay | None) -> str:
    """hhmmss.ss"""
    if time is None:
        return ""
    return f"{time.hour:02d}{time.minute:02d}{time.second:02d}.{time.nanosecond // 10_000_000:02d}"


def latitude_text(angle: Angle | None) -> str:
    """Both fields of a latitude, minutes with 7 decimals."""
    return _angle_text(angle, 2, "NS")


def longitude_text(angle: Angle | None) -> str:
    """Both fields of a longitude, minutes with 7 decimals."""
    return _angle_text(angle, 3, "EW")


def number_text(value: float | None, decimals: int) -> str:
    """A number with so many decimals."""
    return "" if value is None else f"{value:.{decimals}f}"


def velocity_text(velocity_mps: tuple[float, float] | None) -> tuple[str, str]:
    """Speed in knots and true course in degrees."""
    if velocity_mps is None:
        return "", ""
    east, north = velocity_mps
    return f"{hypot(east, north) / _KNOT_MPS:.3f}", f"{degrees(atan2(east, north)) % 360.0:.3f}"


def _real_date(year: int, month: int, day: int) -> date:
    try:
        return date(year, month, day)
    except ValueError as error:
        raise BadField from error


def _angle(pattern: re.Pattern[str], field: str, side: str, sides: str, limit_deg: int) -> Angle | None:
    if not field and not side:
        return None
    match = pattern.fullmatch(field)
    if match is None or len(side) != 1 or side not in sides:
        raise BadField
    whole_deg, minutes, decimals = match.groups()
    angle_deg = int(whole_deg) + float(minutes) / 60
    expect(angle_deg <= limit_deg)
    half_step_deg = 0.5 * 10.0 ** -len(decimals or "") / 60 + _ROUNDING_DEG
    return Angle(angle_deg if side == sides[0] else -angle_deg, half_step_deg)


def _angle_text(angle: Angle | None, degree_digits: int, sides: str) -> str:
    if angle is None:
        return ","
    steps = floor(abs(angle.deg) * 60 * _MINUTE_STEPS + 0.5)
    whole_deg, steps = divmod(steps, 60 * _MINUTE_STEPS)
    minutes, decimals = divmod(steps, _MINUTE_STEPS)
    return f"{whole_deg:0{degree_digits}d}{minutes:02d}.{decimals:07d},{sides[angle.deg < 0]}"
