"""The whole service with less memory than its map needs: copy, store and saved file are the map of the whole drive."""

import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.clock import SystemClock
from drivers.samples import ABSENT3, Fix, InertialSample, Sample, Scan, Stamp, WheelTicks
from mapper.saved_map import assemble, load
from mapper.store_check import open_store
from mapper.tile import Tile, snap_outward
from service.client import RemoteMap
from service.config import LoadedConfig
from service.config import load as load_config
from service.loopback import free_locator
from service.messages import TileId
from service.onboard import Onboard
from service.pipeline import Pipeline
from service.sample_queue import Arrival
from service.shipped import shipped_config

MS = 1_000_000
BEGIN_NS = 10_000 * MS
STILL_MS, OUT_MS, SPEEDING_MS = 600, 9_000, 1_000
PATIENCE_S = 60.0


def ticks_at(ms: int) -> int:
    """Ahead at up to 0.7 m/s, then back to where it began; its pace changes by 0.7 m/s². A tick is 0.2 mm."""
    driven = max(ms - STILL_MS, 0)
    out = driven if driven < OUT_MS else 2 * OUT_MS - driven
    begun, left = min(out, SPEEDING_MS), min(OUT_MS - out, SPEEDING_MS)
    at_full_speed = out - begun - SPEEDING_MS + left
    return round(3.5 * (at_full_speed + 0.5 * begun**2 / SPEEDING_MS + 0.5 * (SPEEDING_MS - left**2 / SPEEDING_MS)))


def drive() -> Iterator[list[Arrival]]:
    """What is heard in each tenth of a second, there and back."""
    for tenth in range((STILL_MS + 2 * OUT_MS) // 100):
        samples: list[tuple[str, Sample]] = []
        for ms in range(100 * tenth, 100 * tenth + 100, 10):
            stamp = Stamp(BEGIN_NS + ms * MS - MS, BEGIN_NS + ms * MS)
            gyro = InertialSample(stamp, "HIGHRES_IMU", 0, ms * 1000, gyro_rps=(0.0, 0.0, 0.0))
            tilt = InertialSample(stamp, "ATTITUDE", 0, ms * 1000, accel_mps2=ABSENT3, tilt_rad=(0.001, 0.001))
            samples += [("imu", gyro), ("imu", tilt), ("encoders", WheelTicks(stamp, ticks_at(ms), ticks_at(ms), 0))]
        ranges = np.random.default_rng(tenth).uniform(1.0, 7.9, 181)
        samples.append(("gps", Fix(stamp, None, 48.0, 11.0, 500.0, 1, 1.0, (50.0, 50.0, 50.0))))
        samples.append(("laser", Scan(stamp, np.zeros(181, np.int64), -np.pi / 2, np.radians(1.0), ranges, 16)))
        yield [Arrival(device, sample, 0) for device, sample in samples]


def listening_at(locator: str) -> socket.socket:
    """Another program at a `tcp/...` address."""
    host, port = locator.removeprefix("tcp/").split(":")
    other = socket.socket()
    other.bind((host, int(port)))
    other.listen()
    return other


@pytest.fixture
def small(tmp_path: Path) -> LoadedConfig:
    """The demo's robot with room for 64 tiles in memory, and a store."""
    demo = load_config(shipped_config("demo.toml"))
    config = replace(
        demo.config,
        map=replace(demo.config.map, max_tiles=64, resolution_m=0.03),
        publish=replace(demo.config.publish, listen=(free_locator(),), digest_period_s=0.2),
        store=replace(demo.config.store, path=str(tmp_path / "map.db"), interval_s=0.1),
    )
    return replace(demo, config=config)


def test_while_a_slow_link_is_full_nobody_looks_all_the_time_whether_it_is_free(
    small: LoadedConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A radio of 10 kB/s has work for many seconds: the mapping thread keeps the scans' rhythm meanwhile."""
    config = small.config
    narrow = replace(
        config,
        map=replace(config.map, max_tiles=4096),
        publish=replace(config.publish, max_bytes_per_s=10_000.0),
        store=replace(config.store, path=None),
    )
    onboard = Onboard(replace(small, config=narrow), SystemClock(), devices=())
    looks, take = 0, onboard.readers.take

    def counted(*arguments: Any) -> list[Arrival]:
        nonlocal looks
        looks += 1
        return take(*arguments)

    monkeypatch.setattr(onboard.readers, "take", counted)
    onboard.start()
    try:
        deadline = time.monotonic() + PATIENCE_S
        for arrivals in islice(drive(), 60):
            onboard.queue.put(arrivals)
            while not onboard.queue.empty:
                assert time.monotonic() < deadline
                time.sleep(0.005)
        while onboard.publisher.ready:
            assert time.monotonic() < deadline
            time.sleep(0.005)
        before, began = looks, time.monotonic()
        time.sleep(1.0)  # what passes meanwhile is counted
        assert looks - before < 150 * (time.monotonic() - began)
        assert not onboard.publisher.ready
    finally:
        onboard.publisher.close()
        onboard.stop()


@pytest.mark.parametrize("session", ["open", "late"])
def test_a_drive_beyond_memory_reaches_copy_store_and_file_whole(
    session: str, small: LoadedConfig, tmp_path: Path
) -> None:
    """Tiles leave memory and come back meanwhile; what everybody gets equals, bit for bit, the map of roomy memory.

    So it is where another program has the address for the whole drive; what waits for it takes no more memory.
    """
    config = small.config
    roomy = Pipeline(replace(config, map=replace(config.map, max_tiles=4096)))
    other = listening_at(config.publish.listen[0]) if session == "late" else None
    onboard = Onboard(small, SystemClock(), devices=())
    onboard.start()
    try:
        with RemoteMap(config.publish.listen[0]) as remote:
            most = most_waiting = 0
            for arrivals in drive():
                for arrival in arrivals:
                    roomy.step(arrival)
                onboard.queue.put(arrivals)
                deadline = time.monotonic() + PATIENCE_S
                # A robot is slower than its disk.
                while not onboard.queue.empty or onboard.keeper.state()["tiles_unsaved"] > 3:
                    assert onboard.failure is None
                    assert time.monotonic() < deadline, onboard.health.troubles
                    time.sleep(0.005)
                most = max(most, onboard.pipeline.map.tile_count)
                most_waiting = max(most_waiting, len(onboard._unsent))
            if other is not None:
                assert "in use" in str(onboard.publisher.failure)
                other.close()
                assert onboard.publisher.wait_until_ready(PATIENCE_S)
            roomy.finish()
            onboard.finish()
            assert onboard.failure is None
            onboard.save_map(tmp_path / "map.npz")
            assert onboard.publisher.flush(PATIENCE_S)
            assert remote.wait_in_sync(PATIENCE_S, final=True)
            copy = remote.tiles
    finally:
        onboard.stop()
    counts = onboard.pipeline.map.counts
    assert onboard.keeper.state()["tiles_out_of_memory"] > 10
    assert roomy.map.tile_count > 64
    assert most <= 64
    assert most_waiting <= 64
    assert counts["beyond_cap"] == 0

    whole = {TileId(0, tile.ix, tile.iy): snap_outward(tile) for tile in roomy.map.tiles()}
    assert copy == whole
    store, findings = open_store(tmp_path / "map.db")
    assert findings.clean
    kept: dict[TileId, Tile] = {TileId(tile.submap, tile.ix, tile.iy): tile for tile in store.tiles(0)}
    store.close()
    assert kept == whole
    saved, expected = load(tmp_path / "map.npz"), assemble(whole.values(), config.map.resolution_m, "map")
    assert saved.origin_m == expected.origin_m
    for ours, wholes in ((saved.low, expected.low), (saved.high, expected.high)):
        np.testing.assert_allclose(ours, wholes, rtol=0, atol=2.0**-9)
