"""What is sent at set intervals, whether or not a tile changed: pose, health, anchor, info and digest."""

from collections.abc import Callable
from math import inf

from estimator.bounded_pose import BoundedPose
from service.messages import write, write_pose
from service.publish_config import PublishConfig
from service.published_state import PublishedState
from service.topics import ANCHOR, ANCHOR_OF, DIGEST, HEALTH, INFO, POSE, Topic, anchor_key

Put = Callable[[Topic, bytes, str | None], None]
"""Send a payload of a topic, under its own key (None) or this one."""


class Periodic:
    """When each is due, and the sending of it; the publisher thread's own."""

    def __init__(self, config: PublishConfig, robot: str, state: PublishedState) -> None:
        """Everything is due at once."""
        self.pose: BoundedPose | None = None
        """The newest, until it is sent."""
        self._config, self._robot, self._state = config, robot, state
        self._pose_due_s = self._health_due_s = self._digest_due_s = -inf
        self._listed_root: int | None = None

    def list_anew(self) -> None:
        """A new session: nobody in it has seen a listing."""
        self._listed_root = None

    def due_s(self) -> float:
        """When the next of them is due, by the monotonic clock."""
        due_s = self._digest_due_s
        if self.pose is not None:
            due_s = min(due_s, self._pose_due_s)
        if self._state.health is not None:
            due_s = min(due_s, self._health_due_s)
        return due_s

    def send(self, put: Put, now_s: float, ending: bool) -> bool:
        """Send each that is due, and all at the `ending`; was a digest among them?"""
        state = self._state
        if self.pose is not None and (ending or now_s >= self._pose_due_s):
            self._pose_due_s = now_s + 1 / self._config.pose_rate_hz
            pose, self.pose = self.pose, None
            put(POSE, write_pose(pose, state.epoch), None)
            state.write_anchor()
        if state.health is not None and (ending or now_s >= self._health_due_s):
            self._health_due_s = now_s + self._config.health_period_s
            put(HEALTH, state.plain(HEALTH), None)
        if state.unsent_anchor and state.anchor is not None:
            state.unsent_anchor = False
            put(ANCHOR, state.anchor, None)
        state.final = state.final or ending
        if not ending and now_s < self._digest_due_s:
            return False
        self._digest_due_s = now_s + self._config.digest_period_s
        self._send_digest(put)
        return True

    def _send_digest(self, put: Put) -> None:
        """Info, anchor and digest; the tiles are listed only when something changed since the last listing."""
        state = self._state
        put(INFO, state.plain(INFO), None)
        state.write_anchor()
        if state.anchor is not None:
            put(ANCHOR, state.anchor, None)
        parts = list(state.digest(summary_if_root=self._listed_root))
        for number, submap in state.earlier.items() if parts[0].parts else ():
            if submap.anchor is not None:
                put(ANCHOR_OF, submap.anchor, anchor_key(self._robot, number))
        for part in parts:
            put(DIGEST, write(part), None)
            self._listed_root = part.root
