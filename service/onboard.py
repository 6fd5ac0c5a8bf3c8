"""The service while it runs: readers, pipeline thread, publisher, and the saving of the map.

Used alike by `run`, `demo`, `replay --ports` and the tests; they differ in the clock and in where the ports lead.
"""

import gc
import threading
import time
from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

from drivers.clock import Clock
from estimator.bounded_pose import BoundedPose
from service.config import LoadedConfig
from service.devices import Device, wiring
from service.lifecycle import process_age_s
from service.map_file import save_map
from service.map_keeper import MapKeeper, Unkept
from service.map_update import MAP_FRAME, MapUpdate
from service.messages import fault_values
from service.offered_place import OfferedPlace
from service.passing_save import PassingSave
from service.pipeline import Pipeline
from service.published_map import Recall, nothing_kept
from service.publisher import Publisher
from service.readers import Readers
from service.rehearsal import rehearse
from service.rolling_window import RollingWindow
from service.scan_rhythm import take_in_rhythm
from service.session_ahead import SessionAhead
from service.unpublished import Unpublished
from service.unsent_tiles import UnsentTiles

IDLE_S = 0.02
"""The pipeline thread looks up this often when no sample comes."""
LEAST_OFFER_NS = 4_000_000
"""In lockstep updates are at least this far apart: a fast replay coalesces more instead of publishing more."""
COUNT_PERIOD_NS = 50_000_000
"""The pipeline's counts are brought together this often."""
GATHER_S = 0.004
"""In a lockstep that hurries: take more samples at a time, so that threads change places less often."""
HURRY = 1.5
"""Times real time."""
SOON_NS = 20_000_000
"""What the publisher has not taken so long after the last update waits for its link."""
TOLD_FAULTS = 16
"""Health tells of so many of the newest."""
OFFER_PERIOD_NS = 100_000_000
"""Pose and health are offered at least this often, also when no cell changed."""


class Onboard:
    """Everything that runs on the robot, between `start` and `stop`."""

    def __init__(
        self,
        loaded: LoadedConfig,
        clock: Clock,
        *,
        readers: Readers | None = None,
        devices: tuple[Device, ...] | None = None,
        capture: Path | None = None,
        on_pose: Callable[[BoundedPose], None] | None = None,
        lockstep: bool = False,
        publish: bool = True,
        ahead: SessionAhead | None = None,
        keep: bool = True,
    ) -> None:
        """`readers` None: its own, of `devices` and with `capture`; others may have been started already.

        `ahead`: the publisher's session, where it is being opened already.

        `lockstep`: readers acknowledge their bytes to `clock` once the pipeline has room for more samples.

        `publish` False: nothing leaves the process (a replay's map is wanted, not its stream). `keep` False: nothing
        is saved where the configuration says, neither in a store nor as a file.
        """
        config = loaded.config
        self.clock = clock
        self.pipeline = Pipeline(config, on_pose)
        self.laser = config.devices.laser
        if readers is None:
            readers = Readers(loaded, clock, devices=wiring(loaded) if devices is None else devices, capture=capture)
        self.readers = readers
        self.queue, self.health = self.readers.queue, self.readers.health
        self.keeper = self._keeper(loaded) if keep and config.store.path is not None else Unkept()
        about = {"resolution_m": config.map.resolution_m}
        recalled: tuple[Recall, int | None] = nothing_kept, None
        if isinstance(self.keeper, MapKeeper):
            recalled = self.keeper.recall, config.map.max_tiles
        robot = config.robot.name
        self.publisher = Publisher(config.publish, robot, about, *recalled, ahead=ahead) if publish else Unpublished()
        self._window = RollingWindow(config.map, self.keeper)
        self._unsent = UnsentTiles(recalled[1])
        self._keep = keep
        self._failure: BaseException | None = None
        self._loaded = loaded
        self._lockstep = lockstep
        self._least_offer_ns = LEAST_OFFER_NS if lockstep else 0
        self._owing = False
        """Did a scan change the map that the publisher had no room for?"""
        self._stopping = threading.Event()
        self._offered_ns = self._told_ns = 0
        self._place = OfferedPlace(self.pipeline.filter, config.publish.pose_rate_hz)
        self._told: Mapping[str, Any] = {}
        """Health as it was then."""
        self._pace = 0, clock.now_ns(), False
        """The system's time and the clock's when they were last compared, and whether the latter hurried until then."""
        self._counted_ns = 0
        self._uncounted = False
        self._first_scan_s: float | None = None
        """Of the process's life, when its first scan was in the map."""
        self._save_wanted = threading.Event()
        self._passing_save = PassingSave(config.map.resolution_m, self.health)
        self._thread = threading.Thread(target=self._map, name="pipeline", daemon=True)

    @property
    def failure(self) -> BaseException | None:
        """What ended one of the threads early, if anything did: the service is no longer whole."""
        return self.readers.failure or self._failure

    def start(self) -> None:
        """Open what must be there at once (the capture file), then begin to read and map.

        Raises CaptureError, or NotAnAddress; ports and network may come and go later.
        """
        if not self.readers.started:
            self.readers.open_recording()
        rehearse(self._loaded.config)
        # What the start has made stays: the cycle collector need not go through it again and again.
        gc.freeze()
        self.pipeline.map.submap = self.publisher.submap = self.keeper.start()
        self.publisher.start()
        self.readers.read_punctually()
        if not self.readers.started:
            self.readers.start(self._acknowledge if self._lockstep else None)
        if not self._lockstep:
            self.readers.leave_to_taker()
        self._thread.start()

    def stop(self, flush_s: float = 2.0) -> None:
        """End in order: ports, pipeline, saved map, last tiles, capture."""
        self.readers.stop()
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self._passing_save.wait()
        try:
            if self._keep:
                self.save_map()
        finally:
            self.publisher.flush(flush_s)
            self.publisher.close()
            self.keeper.close()
            self.readers.close()

    def finish(self) -> None:
        """The stream has ended, but the publisher lives on: readers stop, the pipeline uses what it still holds."""
        self.readers.stop()
        self._stopping.set()
        self._thread.join()

    def status_line(self) -> str:
        """Devices, scans, tiles, pose width: for systemctl and terminals; costs the same however large the map is."""
        failure = self.publisher.failure
        told = self.publisher.rival if failure is None else f"{failure}; it is tried again, mapping goes on"
        self.health.trouble("publishing", told)
        pose, terrain = self.pipeline.filter.latest(), self.pipeline.map
        width = "no pose yet" if pose is None else f"pose +-{50 * float((pose.high[:3] - pose.low[:3]).max()):.0f} cm"
        mapped = f"{self.pipeline.counts['scans']} scans, {terrain.tile_count} tiles"
        return f"{self.health.status_line(time.monotonic_ns())} | {mapped} | {width}"

    def save_map(self, path: Path | None = None) -> None:
        """Write the map to `path`, or to where the configuration wants it. Call it once the pipeline has ended."""
        path = self._map_path if path is None else path
        if path is not None:
            save_map(self.pipeline, path, self.keeper.kept())

    @property
    def _map_path(self) -> Path | None:
        """Where the configuration wants the map's file; nowhere while an empty one would take its place."""
        wanted = self._loaded.config.store.map
        path = None if wanted is None else self._loaded.path(wanted)
        return None if path is None or (self.pipeline.map.tile_count == 0 and path.exists()) else path

    def _save_in_passing(self) -> None:
        """Copy the map, and have it written: nothing else waits for the disk."""
        if (path := self._map_path) is not None and not self._passing_save.busy:
            # What memory lacks is settled now, by the thread that brings tiles back; the disk is read by who writes.
            whole, state = chain(self.pipeline.map.tiles(), self.keeper.kept()), self.pipeline.filter
            self._passing_save.begin(whole, state.anchor, state.guarantee, path)

    def request_save(self) -> None:
        """Have the pipeline thread save the map when it next has a moment."""
        self._save_wanted.set()

    def _acknowledge(self, device: str, total_bytes: int) -> None:
        """Tell the lockstep clock that these bytes are dealt with, once the pipeline has room for more."""
        self.queue.wait_for_room(1.0)
        self.clock.acknowledge(device, total_bytes)

    def _map(self) -> None:
        """The pipeline thread: take, step, offer."""
        try:
            ending = False
            while not ending:
                ending = self._stopping.is_set()  # before the last look at what is left
                # In lockstep another thread parses and acknowledges meanwhile.
                arrivals = (
                    self.queue.take(IDLE_S)
                    if self._lockstep
                    else take_in_rhythm(self.readers, self.pipeline, self.clock, self._owing)
                )
                if arrivals and self._hurries():
                    time.sleep(GATHER_S)
                    arrivals += self.queue.take(0)
                for arrival in arrivals:
                    self.pipeline.step(arrival)
                if self._first_scan_s is None and self.pipeline.counts["scans"]:
                    self._first_scan_s = round(process_age_s(), 2)
                if arrivals or self._uncounted:
                    self._report()
                self._offer()
                self._roll()
                if self._save_wanted.is_set():
                    self._save_wanted.clear()
                    self._save_in_passing()
            self.pipeline.finish()
            self._offer(last=True)
        except BaseException as error:
            self._failure = error

    def _hurries(self) -> bool:
        """Does the lockstep clock run faster than real time? It is looked at every now and then."""
        if not self._lockstep:
            return False
        wall_ns, now_ns = time.monotonic_ns(), self.clock.now_ns()
        wall_before_ns, before_ns, hurries = self._pace
        if wall_ns - wall_before_ns > OFFER_PERIOD_NS:
            hurries = now_ns - before_ns > HURRY * (wall_ns - wall_before_ns)
            self._pace = wall_ns, now_ns, hurries
        return hurries

    def _report(self) -> None:
        """Tell health that the pipeline has taken what there was, and now and then how much that has been."""
        now_ns, pipeline = time.monotonic_ns(), self.pipeline
        self._uncounted = now_ns - self._counted_ns < COUNT_PERIOD_NS
        if self._uncounted:
            self.health.processed(now_ns, guarantee=pipeline.filter.guarantee)
            return
        self._counted_ns = now_ns
        counts = pipeline.counts | {f"filter_{name}": count for name, count in pipeline.filter.counts.items()}
        counts |= {f"late_{name}": count for name, count in pipeline.late.items()}
        counts |= {f"map_{name}": count for name, count in (pipeline.map.counts + self._window.counts).items()}
        counts["scans_waiting"] = pipeline.waiting_scans
        faults = [fault_values(fault) for fault in list(pipeline.filter.faults)[-TOLD_FAULTS:]]
        self.health.processed(now_ns, counts, pipeline.filter.guarantee, faults)
        for name, total in self.queue.dropped.items():
            self.health.dropped(name, total)

    def _offer(self, last: bool = False) -> None:
        """Fill the publisher's mailbox if it is empty: changes coalesce by themselves, nothing queues, nobody waits."""
        if last:
            self.publisher.wait_until_ready(2.0)
        now_ns = time.monotonic_ns()
        publisher_ready = self.publisher.ready
        wanted = publisher_ready or self.keeper.due(now_ns)
        if not last and (now_ns - self._offered_ns < self._least_offer_ns or not wanted):
            self._owing = self._is_soon_taken and self.pipeline.map.has_changed
            return
        self._place.look_up(now_ns, last)
        self._keep_changes()
        self._owing = self._is_soon_taken and bool(self._unsent) and not publisher_ready
        if not publisher_ready:
            return
        if not (last or self._unsent or now_ns - self._offered_ns > OFFER_PERIOD_NS):
            return
        self._offered_ns = now_ns
        unsent = self._unsent.take()
        self.publisher.offer(
            MapUpdate(
                tiles=unsent.tiles,
                stored=unsent.stored,
                pose=self._place.take_pose(),
                anchor=self._place.anchor,
                health=self._health_now(now_ns, last),
                guarantee=self.pipeline.filter.guarantee,
                released_ns=self.pipeline.released_ns,
                forgotten=unsent.forgotten,
                beams_until_ns=self.pipeline.beams_until_ns,
            )
        )

    @property
    def _is_soon_taken(self) -> bool:
        """Will the publisher take an update in a moment? Not without a session, nor while a slow link is full.

        Nobody need look a thousand times a second then.
        """
        soon = time.monotonic_ns() - self._offered_ns < SOON_NS
        return soon and self.publisher.takes_updates and self.publisher.failure is None

    def _health_now(self, now_ns: int, last: bool) -> Mapping[str, Any]:
        """Health as it is published. It goes out far less often than tiles: put together ten times a second."""
        if last or now_ns - self._told_ns > OFFER_PERIOD_NS:
            self._told_ns = now_ns
            own = {"store": self.keeper.state(), "first_scan_s": self._first_scan_s}
            self._told = self.health.snapshot(now_ns) | own
        return self._told

    def _keep_changes(self) -> None:
        """Hand over to the keeper what changed, and note it for the publisher, which is never ahead of the keeper."""
        terrain, state = self.pipeline.map, self.pipeline.filter
        tiles = terrain.take_dirty()
        if self.keeper.wants_all:
            self.keeper.wants_all = False
            tiles = terrain.tiles()
        if tiles or self.keeper.due(time.monotonic_ns()):
            self.keeper.offer(tiles, self._place.anchor, state.guarantee, self.pipeline.released_ns)
        if self.publisher.takes_updates:
            self._unsent.add(tiles)

    def _roll(self) -> None:
        """Let far tiles leave memory where it is short; join what has come back."""
        if self._window.is_full(self.pipeline.map):
            forgotten = self._window.roll(self.pipeline.map, self.pipeline.filter.latest())
            if self.publisher.takes_updates:
                self._unsent.forget(forgotten)
        for tile in self.keeper.returned():
            self.pipeline.map.join(tile)

    def _keeper(self, loaded: LoadedConfig) -> MapKeeper:
        """The keeper of the configured store; what earlier runs left in it is published, too."""
        config = loaded.config
        path = loaded.path(config.store.path or "")
        return MapKeeper(
            path,
            config.store.interval_s,
            config.map.resolution_m,
            MAP_FRAME,
            self.health,
            lambda earlier: self.publisher.offer_earlier(earlier),
            config.store.earlier_submaps,
        )
