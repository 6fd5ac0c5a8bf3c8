"""Pose and anchor as publisher and keeper are told of them: as often as poses are published, not with each tile."""

from estimator.bounded_pose import Anchor, BoundedPose
from estimator.filter import Filter


class OfferedPlace:
    """The pipeline thread's own."""

    def __init__(self, state: Filter, rate_hz: float) -> None:
        """`rate_hz`: so often, and no oftener, a pose can be published."""
        self.anchor: Anchor | None = None
        """As it was then: where the map frame stands never changes, so what was true of it is true."""
        self._pose: BoundedPose | None = None
        self._state = state
        self._period_ns = round(0.9e9 / rate_hz)  # there when it is due
        self._looked_ns = 0

    def look_up(self, now_ns: int, last: bool) -> None:
        """Look them up, if it is time; in any case where this is the `last` time."""
        if last or now_ns - self._looked_ns >= self._period_ns:
            self._looked_ns = now_ns
            self._pose, self.anchor = self._state.latest(), self._state.anchor

    def take_pose(self) -> BoundedPose | None:
        """The newest, once."""
        pose, self._pose = self._pose, None
        return pose
