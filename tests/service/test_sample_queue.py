"""The queue between readers and pipeline is bounded and honest."""

from drivers.samples import Stamp, WheelTicks
from service.sample_queue import Arrival, SampleQueue


def arrival(device: str, number: int) -> Arrival:
    return Arrival(device, WheelTicks(Stamp(number, number), number, number), number)


def test_a_full_queue_drops_the_oldest_and_counts_whose_they_were() -> None:
    """Memory stays bounded and nothing vanishes uncounted."""
    queue = SampleQueue(capacity=3)
    queue.put([arrival("imu", 0), arrival("gps", 1)])
    queue.put([arrival("imu", 2), arrival("imu", 3), arrival("imu", 4)])
    assert [a.received_ns for a in queue.take(0)] == [2, 3, 4]
    assert queue.dropped == {"imu": 1, "gps": 1}


def test_what_is_put_before_its_time_is_dropped_and_counted() -> None:
    """Samples that are not to be used yet leave nothing but their number; so do those that were read before."""
    queue = SampleQueue()
    queue.keeps_from_ns = None
    queue.put([arrival("imu", 0), arrival("gps", 1)])
    queue.keeps_from_ns = 3
    queue.put([arrival("imu", 2), arrival("imu", 3)])
    assert [a.received_ns for a in queue.take(0)] == [3]
    assert queue.dropped == {"imu": 2, "gps": 1}


def test_taking_from_an_empty_queue_gives_nothing() -> None:
    """The pipeline goes on with its other work."""
    assert SampleQueue().take(0) == []


def test_a_replay_can_wait_for_room() -> None:
    """A replay may be told to wait for the pipeline, so that nothing is ever dropped."""
    queue = SampleQueue(capacity=4)
    queue.put([arrival("imu", 0)])
    assert queue.wait_for_room(0)
    queue.put([arrival("imu", 1)])
    assert not queue.wait_for_room(0)
    queue.take(0)
    assert queue.wait_for_room(0)
