"""When the pipeline thread wakes up."""

from drivers.clock import SystemClock
from service.pipeline import MOTION, Pipeline
from service.readers import Awaited, Readers
from service.sample_queue import Arrival
from service.scan_rhythm import AHEAD_S, EARLY_NS, LONGEST_REST_S, OWING_REST_S, REST_S, take_in_rhythm

NOW_NS = 5_000_000_000
MS = 1_000_000


class Asked(Readers):
    """Readers that note what they are asked for."""

    def __init__(self) -> None:
        self.rest_s = self.timeout_s = -1.0
        self.awaited: Awaited | None = None

    def take(self, timeout_s: float, rest_s: float = 0.0, awaited: Awaited | None = None) -> list[Arrival]:
        """Nothing has come."""
        self.timeout_s, self.rest_s, self.awaited = timeout_s, rest_s, awaited
        return []


class Foreseen(Pipeline):
    """A pipeline whose next scan can be complete at a given time."""

    def __init__(self, next_ns: int | None) -> None:
        self._next_ns = next_ns

    def next_scan_ns(self) -> int | None:
        """When its poses should be there."""
        return self._next_ns


class Stopped(SystemClock):
    """It is always NOW_NS."""

    def now_ns(self) -> int:
        """Now."""
        return NOW_NS


def asked(next_ns: int | None) -> Asked:
    """What the readers are asked for while the next scan can be complete then."""
    readers = Asked()
    take_in_rhythm(readers, Foreseen(next_ns), Stopped())
    return readers


def test_without_a_scan_to_come_it_looks_a_hundred_times_a_second() -> None:
    """What has come is taken then, whatever it is: a robot without a scanner still keeps its pose."""
    readers = asked(None)
    assert (readers.rest_s, readers.awaited) == (REST_S, None)


def test_it_rests_until_a_little_before_a_scan_can_be_complete() -> None:
    """Then everything that has come is done; it never rests longer than it may."""
    readers = asked(NOW_NS + 10 * MS)
    assert abs(readers.rest_s - (0.01 - AHEAD_S)) < 1e-9
    assert readers.awaited is None
    assert asked(NOW_NS + 3600 * 1000 * MS).rest_s == LONGEST_REST_S


def test_then_it_waits_for_the_motion_that_completes_the_scan() -> None:
    """Nothing else ends that wait: not the scanner's next bytes, not motion that came before; and it ends by itself."""
    for left_ms in (2.9, 1.6, 0.5, 0.0, -5.0, -19.0):
        next_ns = NOW_NS + round(left_ms * MS)
        readers = asked(next_ns)
        assert readers.awaited == Awaited(MOTION, next_ns - EARLY_NS)
        assert 0.0 <= readers.rest_s <= AHEAD_S
        assert readers.timeout_s == LONGEST_REST_S


def test_motion_that_never_comes_is_not_waited_for_again_and_again() -> None:
    """A silent sensor: the others are taken as if no scan were to come."""
    readers = asked(NOW_NS - 25 * MS)
    assert (readers.rest_s, readers.awaited) == (REST_S, None)


def test_while_tiles_wait_for_the_publisher_it_looks_again_soon() -> None:
    """They are offered once there is room, not with the next scan."""
    readers = Asked()
    take_in_rhythm(readers, Foreseen(NOW_NS + 10 * MS), Stopped(), owing=True)
    assert (readers.rest_s, readers.timeout_s, readers.awaited) == (OWING_REST_S, 0.0, None)
