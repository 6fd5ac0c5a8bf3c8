"""When the gyroscope says nothing: then other readings are the steps of the attitude, and nothing tells of its turning.

So roll and pitch are what tilt sensor and accelerometers say, yaw is what the tracks and the fixes do, each widened by
the declared greatest rates in between. Decided by the stamps as they came, so that all hypotheses decide alike.
"""

from drivers.samples import Stamp

SILENT_NS = 1_000_000_000
SILENT_INTERVALS = 3
"""It is silent after so many times the last interval between its packets, where that is longer than a second."""
SILENT_AT_THE_START_NS = 10_000_000_000
"""A board that starts is given time: a map that begins without its gyroscope knows little of yaw."""


class GyroSilence:
    """Who spoke last, and when."""

    def __init__(self) -> None:
        self._gyro_ns: int | None = None
        self._board_ns = 0
        self._allowed_ns = SILENT_AT_THE_START_NS
        self._spoke = self._lasts = False

    def ends(self, stamp: Stamp) -> bool:
        """A gyro packet: is it the first one after a silence? Its mean may be of all that time."""
        ended, self._lasts = self._lasts, False
        if self._spoke and self._gyro_ns is not None and not ended:
            self._allowed_ns = max(SILENT_NS, SILENT_INTERVALS * (stamp.latest_ns - self._gyro_ns))
        self._gyro_ns = self._board_ns = stamp.latest_ns
        self._spoke = True
        return ended

    def was_not_used(self) -> None:
        """The packet that ended it came out of order: the next one's mean reaches back before the last step, too."""
        self._lasts = True

    def step_by_board(self, stamp: Stamp) -> bool:
        """Another packet of the inertial board: is it a step in the gyroscope's place?"""
        self._board_ns = stamp.latest_ns
        if self._gyro_ns is None:
            self._gyro_ns = stamp.latest_ns
        self._lasts = self._lasts or stamp.earliest_ns - self._gyro_ns > self._allowed_ns
        return self._lasts

    def step_by_count(self, stamp: Stamp) -> bool:
        """An encoder reading: is it a step, as the whole board is silent?"""
        if self._gyro_ns is None or stamp.earliest_ns - self._board_ns <= SILENT_NS:
            return False
        self._lasts = self._lasts or stamp.earliest_ns - self._gyro_ns > self._allowed_ns
        return self._lasts
