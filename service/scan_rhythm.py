"""When the pipeline thread wakes up: once or twice a scan, instead of at every byte.

Each time that a thread wakes up it finds its memory in no cache: much at a time costs half of the same in small
portions (docs/decisions/0037). Stamps don't depend on it, as readers stamp what comes meanwhile. So the thread rests
until the poses of the next scan can be complete, does what has come until then, and waits for the motion that completes
them; nobody's scan waits any longer for that.
"""

from drivers.clock import Clock
from service.pipeline import MOTION, Pipeline
from service.readers import Awaited, Readers
from service.sample_queue import Arrival

REST_S = 0.01
"""So long where no scan is known to come, or where a sensor is silent and nothing completes it."""
LONGEST_REST_S = 0.02
"""The thread looks up at least this often."""
AHEAD_S = 0.003
"""So long before a scan can be complete, all that has come is done: what completes it is then done at once."""
EARLY_NS = 1_500_000
"""What completes a scan may come so much earlier than was foreseen."""
OWING_REST_S = 0.001
"""While the publisher has no room for what was mapped."""


def take_in_rhythm(readers: Readers, pipeline: Pipeline, clock: Clock, owing: bool = False) -> list[Arrival]:
    """What the sensors have given, once it is time to look; `owing`: tiles wait for the publisher."""
    if owing:
        return readers.take(0.0, OWING_REST_S)
    next_ns = pipeline.next_scan_ns()
    if next_ns is None:
        return readers.take(LONGEST_REST_S, REST_S)
    left_s = (next_ns - clock.now_ns()) * 1e-9
    if left_s > AHEAD_S:
        return readers.take(LONGEST_REST_S, min(left_s - AHEAD_S, LONGEST_REST_S))
    if left_s > -LONGEST_REST_S:
        completing = Awaited(MOTION, next_ns - EARLY_NS)
        return readers.take(LONGEST_REST_S, max(left_s - EARLY_NS * 1e-9, 0.0), completing)
    return readers.take(LONGEST_REST_S, REST_S)
