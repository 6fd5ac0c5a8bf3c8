"""Which day it is: told now and then, needed at every epoch, and wrong by 1024 weeks where a receiver has grown old.

A day is a label for people; no bound hangs on it.
"""

from datetime import date, timedelta

from drivers.gps_nmea.fields import TimeOfDay

_HALF_DAY_S = 43_200
_ROLLOVER = timedelta(weeks=1024)
"""GPS counts its weeks in ten bits."""

_LAST_DAY = date(2200, 1, 1)


class DayTeller:
    """The day of the present epoch."""

    def __init__(self, not_before: date | None = None) -> None:
        """`not_before`: no day can be earlier (as of a live receiver); None: any day may be."""
        self.day: date | None = None
        """Of the newest epoch."""
        self.rollovers = 0
        """Days told that were wrong by weeks."""
        self._not_before = not_before
        self._time: TimeOfDay | None = None

    def advance(self, time: TimeOfDay) -> None:
        """An epoch begins; where its time has fallen by more than half a day it is the next day."""
        if self.day is not None and self._time is not None:
            self.day = _next_to(self.day, self._time, time)
            if self.day > _LAST_DAY:  # nobody has told a date for long
                self.day = None
        self._time = time

    def told(self, time: TimeOfDay | None, day: date | None) -> None:
        """The receiver tells the day of a time, be it that of the present epoch or of one beside it."""
        if day is None:
            return
        if self._time is not None and time is not None:
            day = _next_to(day, time, self._time)
        self.day = self._mended(day)

    def _mended(self, day: date) -> date:
        """`day`, with the weeks that it has lost against the last one or against the earliest possible."""
        weeks_lost = 0
        if self.day is not None and abs((self.day - day) % _ROLLOVER - _ROLLOVER / 2) >= _ROLLOVER / 2 - timedelta(1):
            weeks_lost = max(0, round((self.day - day) / _ROLLOVER))
        while self._not_before is not None and _later(day, weeks_lost) < self._not_before:
            weeks_lost += 1
        self.rollovers += weeks_lost > 0
        return _later(day, weeks_lost)


def _later(day: date, rollovers: int) -> date:
    return day + rollovers * _ROLLOVER


def _next_to(day: date, time: TimeOfDay, other: TimeOfDay) -> date:
    """The day of `other`, which is less than half a day from `time` on `day`."""
    ahead_s = other.seconds - time.seconds
    if ahead_s < -_HALF_DAY_S:
        return day + timedelta(1)
    return day - timedelta(1) if ahead_s > _HALF_DAY_S else day
