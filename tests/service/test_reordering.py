"""Samples are put into the order in which they were acquired."""

import random

from drivers.samples import Stamp, WheelTicks
from service.reordering import ReorderingWindow
from service.sample_queue import Arrival

DEVICES = ("encoders", "imu")
MS = 1_000_000


def ticks(device: str, at_ms: int) -> Arrival:
    return Arrival(device, WheelTicks(Stamp(at_ms * MS, at_ms * MS), at_ms, at_ms), at_ms * MS)


def run(arrivals: list[Arrival], window_ms: int) -> tuple[list[Arrival], ReorderingWindow]:
    window = ReorderingWindow(window_ms * MS, DEVICES)
    out: list[Arrival] = []
    for arrival in arrivals:
        window.add(arrival)
        out.extend(window.release())
    out.extend(window.release_all())
    return out, window


def test_any_interleaving_inside_the_window_gives_the_same_order() -> None:
    """Which thread was quicker does not show in the order."""
    arrivals = [ticks(device, t) for t in range(0, 200, 5) for device in DEVICES]
    expected, _ = run(arrivals, 50)
    for seed in range(20):
        jitter = random.Random(seed)
        shuffled = sorted(arrivals, key=lambda a: a.received_ns + jitter.uniform(0, 40) * MS)
        for device in DEVICES:  # one device's bytes never overtake each other
            own = iter([a for a in arrivals if a.device == device])
            shuffled = [next(own) if a.device == device else a for a in shuffled]
        out, window = run(shuffled, 50)
        assert out == expected
        assert not window.late


def test_a_sample_beyond_the_window_is_dropped_and_counted() -> None:
    """What comes too late is refused and shows in the count of its device."""
    out, window = run([ticks("imu", 0), ticks("imu", 100), ticks("imu", 200), ticks("encoders", 20)], 50)
    assert [a.device for a in out] == ["imu", "imu", "imu"]
    assert window.late == {"encoders": 1}


def test_a_sample_waits_until_the_window_has_passed() -> None:
    """Nothing is handed on while an older sample may still come."""
    window = ReorderingWindow(50 * MS, DEVICES)
    window.add(ticks("imu", 0))
    window.add(ticks("imu", 49))
    assert list(window.release()) == []
    window.add(ticks("imu", 50))
    assert [a.sample.stamp.mid_ns for a in window.release()] == [0]


def test_samples_of_one_device_never_overtake_each_other() -> None:
    """Where a late read left some stamps with later ends than those behind them, the order stays that of arrival."""
    arrivals = [ticks("imu", t) for t in (100, 400, 350, 360, 401)]
    out, window = run([*arrivals[:3], ticks("encoders", 380), *arrivals[3:]], 200)
    assert [a for a in out if a.device == "imu"] == arrivals
    assert not window.late


def test_when_a_sample_will_be_released_is_known_beforehand() -> None:
    """With the newest stamp at that time it is released; a nanosecond before, it is not."""
    window = ReorderingWindow(50 * MS, DEVICES)
    for at_ms in (10, 20, 30):
        window.add(ticks("encoders", at_ms))
    assert window.oldest_ns("encoders") == 10 * MS
    assert window.oldest_ns("imu") is None
    assert window.released_at_ns("imu", 0) is None
    assert window.released_at_ns("encoders", 31 * MS) is None
    released_ns = window.released_at_ns("encoders", 15 * MS)
    assert released_ns == 70 * MS
    for newest_ns, count in ((released_ns - 1, 1), (released_ns, 1)):
        window.add(Arrival("imu", WheelTicks(Stamp(newest_ns, newest_ns), 0, 0), newest_ns))
        assert len(list(window.release())) == count
