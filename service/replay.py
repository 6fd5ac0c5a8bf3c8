"""A capture, replayed without ports: the recorded bytes through the same protocols into the same pipeline."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from drivers.capture import RawChunk
from drivers.sick_lms.overheard import OverheardScanner
from estimator.bounded_pose import BoundedPose
from mapper.config import MOST_TILES
from service.config import LoadedConfig
from service.devices import Device, wiring
from service.lateness import Lateness
from service.pipeline import Pipeline
from service.sample_queue import Arrival

UNSURE = ("scans_of_inferred_width", "undecoded_unit", "undecoded_scans")
"""Of a scanner that is only listened to: what a person should know."""


def recorded_devices(loaded: LoadedConfig, recording: Iterable[RawChunk]) -> tuple[Device, ...]:
    """The devices of a recording, which is read once for it as far as the laser's first scan.

    Where our driver's own conversation leads to no scan (another program's or an earlier version's was recorded, or the
    scanner streamed already), the scanner is listened to only.
    """
    devices = wiring(loaded)
    of_laser = (chunk for chunk in recording if chunk.device == "laser")
    if next(arrivals(devices, of_laser, Counter()), None) is not None:
        return devices
    laser = loaded.config.devices.laser
    return tuple(
        replace(device, protocol=lambda: OverheardScanner(laser)) if device.name == "laser" else device
        for device in devices
    )


def arrivals(devices: Iterable[Device], chunks: Iterable[RawChunk], counts: Counter[str]) -> Iterator[Arrival]:
    """What the drivers make of recorded chunks, in their order and with their stamps.

    An empty chunk says that the port was opened then (docs/capture-format.md). Chunks of devices that the
    configuration doesn't know are counted.
    """
    protocols = {device.name: device.protocol() for device in devices}
    stamp_ns = 0
    lateness = {name: Lateness(protocol) for name, protocol in protocols.items()}
    for chunk in chunks:
        stamp_ns = chunk.stamp_ns
        protocol = protocols.get(chunk.device)
        if protocol is None:
            counts["chunks_of_unknown_devices"] += 1
            continue
        if chunk.deadline:
            protocol.advance(chunk.stamp_ns)
            continue
        if not chunk.data:
            protocol.connection_made(chunk.stamp_ns)
            continue
        # Our own recordings hold every deadline; those of others may not.
        if protocol.deadline_ns is not None and protocol.deadline_ns <= chunk.stamp_ns:
            protocol.advance(chunk.stamp_ns)
        if chunk.late_ns:
            lateness[chunk.device].read_late(chunk.stamp_ns, chunk.late_ns)
        for sample in lateness[chunk.device].widened(protocol.receive_data(chunk.data, chunk.stamp_ns)):
            yield Arrival(chunk.device, sample, chunk.stamp_ns)
        protocol.data_to_send()  # questions to a device that isn't there
    for name, protocol in protocols.items():
        if isinstance(protocol, OverheardScanner):
            counts |= {f"laser_{what}": protocol.counts[what] for what in UNSURE if protocol.counts[what]}
            for scan in lateness[name].widened(protocol.finish()):
                yield Arrival(name, scan, stamp_ns)


def replay(
    loaded: LoadedConfig,
    chunks: Iterable[RawChunk],
    on_pose: Callable[[BoundedPose], None] | None = None,
    devices: Iterable[Device] | None = None,
) -> Pipeline:
    """Feed recorded chunks to the filter and the mapper; the pipeline that comes back has finished.

    `devices` as `recorded_devices` tells them; None: our own recordings' devices.
    """
    config = loaded.config
    if config.store.path is not None:
        # What left memory for the store then, stays in it now.
        config = replace(config, map=replace(config.map, max_tiles=MOST_TILES))
    pipeline = Pipeline(config, on_pose)
    for arrival in arrivals(wiring(loaded) if devices is None else devices, chunks, pipeline.counts):
        pipeline.step(arrival)
    pipeline.finish()
    return pipeline
