"""From samples to map: order, filter, scans that wait for their poses, cells, and what is offered to the publisher.

One thread owns a Pipeline. `step` is deterministic: the same samples give the same map, bit for bit.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.samples import Scan
from estimator.bounded_pose import BoundedPose
from estimator.filter import Filter
from mapper.elevation_map import ElevationMap
from service.beam_times import BeamTimes, beam_times
from service.config import Config
from service.reordering import ReorderingWindow
from service.sample_queue import Arrival

DEVICES = ("encoders", "imu", "gps", "laser")
"""Names of the devices; their order decides between equal stamps: motion first, scans last."""

MOTION, SCANNER = ("encoders", "imu"), "laser"

MAX_WAITING_SCANS = 750
"""Ten seconds of scans may wait for poses; then the oldest goes, and is counted."""


@dataclass(frozen=True, slots=True)
class WaitingScan:
    """A scan whose poses are not there yet."""

    scan: Scan
    times: BeamTimes
    end_ns: int
    """When its poses are complete, if the horizon is there."""
    received_ns: int


class Pipeline:
    """The way of the data between the queue and the publisher."""

    def __init__(self, config: Config, on_pose: Callable[[BoundedPose], None] | None = None) -> None:
        self.filter = Filter(
            config.robot, config.filter, config.devices.encoders, config.devices.imu, config.devices.gps
        )
        self.map = ElevationMap(config.map, config.devices.laser, robot=config.robot)
        self.counts: Counter[str] = Counter()
        """scans, beams, and what was dropped, by reason."""
        self.released_ns = 0
        """When the sample that completed the newest inserted scan's poses was read (system monotonic)."""
        self.beams_until_ns: int | None = None
        """No beam in the map is newer; its host time."""
        self._window = ReorderingWindow(round(config.filter.reordering_window_ms * 1e6), DEVICES)
        self._waiting: deque[WaitingScan] = deque()
        self._foreseen: tuple[int, int] | None = None
        """The end of the oldest scan, and when its poses should be there."""
        self._on_pose = on_pose

    @property
    def late(self) -> Counter[str]:
        """Samples that came too late to be used, by device."""
        return self._window.late

    @property
    def waiting_scans(self) -> int:
        """Scans that wait for their poses."""
        return len(self._waiting)

    def next_scan_ns(self) -> int | None:
        """Host time at which the oldest scan's poses should be there, and not before; None: none is known to come.

        A guess from what the window holds: motion whose stamps begin after the scan must leave it.
        """
        end_ns = self._waiting[0].end_ns if self._waiting else self._window.oldest_ns(SCANNER)
        if end_ns is None:
            return None
        if self._foreseen is None or self._foreseen[0] != end_ns:
            released_ns = [self._window.released_at_ns(device, end_ns) for device in MOTION]
            if None in released_ns:
                return None
            self._foreseen = end_ns, max(time for time in released_ns if time is not None)
        return self._foreseen[1]

    def step(self, arrival: Arrival) -> None:
        """Take one arrival; filter and map whatever it releases."""
        self._window.add(arrival)
        for ready in self._window.release():
            self._process(ready, arrival.received_ns)

    def finish(self) -> None:
        """The stream has ended: use what the window still holds. Scans whose poses never came are dropped."""
        for ready in self._window.release_all():
            self._process(ready, ready.received_ns)
        self.counts["scans_without_pose"] += len(self._waiting)
        self._waiting.clear()

    def _process(self, arrival: Arrival, received_ns: int) -> None:
        """Give the filter a measurement, or let a scan wait; then insert the scans that the poses have reached."""
        sample = arrival.sample
        if isinstance(sample, Scan):
            times = beam_times(sample)
            self._waiting.append(WaitingScan(sample, times, int(times.latest_ns.max()), arrival.received_ns))
            if len(self._waiting) > MAX_WAITING_SCANS:
                self._waiting.popleft()
                self.counts["scans_dropped_waiting"] += 1
        else:
            self.filter.accept(sample)
        horizon_ns = self.filter.horizon_ns if self._waiting else None
        while self._waiting and horizon_ns is not None and self._waiting[0].end_ns <= horizon_ns:
            self._insert(self._waiting.popleft(), received_ns)

    def _insert(self, waiting: WaitingScan, received_ns: int) -> None:
        """Put one scan into the map, each beam with the pose set of its own time."""
        times = waiting.times
        count = len(times.earliest_ns)
        low, high = np.empty((count, 6)), np.empty((count, 6))
        if not self.filter.poses_over(times.earliest_ns, times.latest_ns, low, high):
            self.counts["scans_without_pose"] += 1
            return
        result = self.map.insert(waiting.scan, low, high, times.pose_index)
        self.map.insert_contact(times.earliest_ns[0], low[0], high[0])
        self.beams_until_ns = max(self.beams_until_ns or 0, waiting.end_ns)
        self.counts["scans"] += 1
        self.counts["beams"] += result.beams
        self.released_ns = max(received_ns, waiting.received_ns)
        if self._on_pose is not None:
            told = self.filter.guarantee, self.filter.ellipsoid()
            for i in range(count):
                self._on_pose(BoundedPose(int(times.earliest_ns[i]), int(times.latest_ns[i]), low[i], high[i], *told))
