"""A capture, replayed without ports: the recorded bytes through the same protocols into the same pipeline."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from drivers.capture import RawChunk
from estimator.bounded_pose import BoundedPose
from mapper.config import MOST_TILES
from service.config import LoadedConfig
from service.devices import wiring
from service.lateness import Lateness
from service.pipeline import Pipeline
from service.sample_queue import Arrival


def arrivals(loaded: LoadedConfig, chunks: Iterable[RawChunk], counts: Counter[str]) -> Iterator[Arrival]:
    """What the drivers make of recorded chunks, in their order and with their stamps.

    An empty chunk says that the port was opened then (docs/capture-format.md). Chunks of devices that the
    configuration doesn't know are counted.
    """
    protocols = {device.name: device.protocol() for device in wiring(loaded)}
    lateness = {name: Lateness(protocol) for name, protocol in protocols.items()}
    for chunk in chunks:
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


def replay(
    loaded: LoadedConfig, chunks: Iterable[RawChunk], on_pose: Callable[[BoundedPose], None] | None = None
) -> Pipeline:
    """Feed recorded chunks to the filter and the mapper; the pipeline that comes back has finished."""
    config = loaded.config
    if config.store.path is not None:
        # What left memory for the store then, stays in it now.
        config = replace(config, map=replace(config.map, max_tiles=MOST_TILES))
    pipeline = Pipeline(config, on_pose)
    for arrival in arrivals(loaded, chunks, pipeline.counts):
        pipeline.step(arrival)
    pipeline.finish()
    return pipeline
