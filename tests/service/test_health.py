"""Device states, rates, flow."""

import json
import sys
import threading
from collections import Counter

from estimator.bounded_pose import Guarantee, Status
from service.health import DeviceState, Health

S = 1_000_000_000


def watched(counts: Counter[str] | None = None) -> Health:
    health = Health()
    health.watch("encoders", stale_after_s=0.1, counts=counts)
    return health


def test_a_device_is_connecting_until_its_port_has_been_open_and_lost_when_it_goes() -> None:
    """A port that never opened is being waited for; one that went away is lost, with the reason kept."""
    health = watched()
    assert health.state("encoders", 0) is DeviceState.CONNECTING
    health.port_failed("encoders", "no such port")
    assert health.state("encoders", 0) is DeviceState.CONNECTING
    health.port_opened("encoders")
    health.received("encoders", 8, 1, S)
    assert health.state("encoders", S) is DeviceState.STREAMING
    health.port_failed("encoders", "unplugged")
    assert health.state("encoders", S) is DeviceState.LOST
    assert health.snapshot(S)["devices"]["encoders"]["failure"] == "unplugged"
    health.port_opened("encoders")
    health.received("encoders", 8, 1, 2 * S)
    assert health.state("encoders", 2 * S) is DeviceState.STREAMING
    assert health.snapshot(2 * S)["devices"]["encoders"]["openings"] == 2


def test_silence_beyond_what_is_allowed_makes_a_device_stale() -> None:
    """Wheel odometry that is silent for more than 100 ms is stale; an open port that never spoke is as well."""
    health = watched()
    health.port_opened("encoders")
    assert health.state("encoders", 0) is DeviceState.STALE
    health.received("encoders", 8, 1, S)
    assert health.state("encoders", S + 100_000_000) is DeviceState.STREAMING
    assert health.state("encoders", S + 100_000_001) is DeviceState.STALE


def test_bytes_without_samples_are_degraded() -> None:
    """Garbage that never completes a sample isn't mistaken for a healthy stream."""
    health = watched()
    health.port_opened("encoders")
    for tick in range(20):
        health.received("encoders", 100, 0, S + tick * 10_000_000)
    assert health.state("encoders", S + 190_000_000) is DeviceState.DEGRADED


def test_dirt_among_good_samples_degrades_a_device_until_it_has_been_clean_for_a_while() -> None:
    """A rising count of bad frames shows at once, and is forgiven after the line was clean again."""
    counts: Counter[str] = Counter(ticks=5)
    health = watched(counts)
    health.port_opened("encoders")
    health.received("encoders", 8, 1, S)
    assert health.state("encoders", S) is DeviceState.STREAMING
    counts["bad_crc"] += 1
    assert health.state("encoders", S) is DeviceState.DEGRADED
    counts["ticks"] += 100
    health.received("encoders", 8, 1, 4 * S)
    assert health.state("encoders", 4 * S) is DeviceState.STREAMING


def test_rates_are_those_of_the_last_seconds() -> None:
    """100 samples a second read as 100, and a change of rate shows within seconds."""
    health = watched()
    health.port_opened("encoders")
    for tick in range(1000):
        health.received("encoders", 16, 1, tick * S // 100)
    row = health.snapshot(10 * S)["devices"]["encoders"]
    assert 95 <= row["samples_per_s"] <= 105
    assert 1520 <= row["bytes_per_s"] <= 1680
    for tick in range(400):
        health.received("encoders", 16, 1, 10 * S + tick * S // 50)
    assert 45 <= health.snapshot(18 * S)["devices"]["encoders"]["samples_per_s"] <= 55


def test_a_pipeline_that_leaves_samples_lying_does_not_flow() -> None:
    """Samples keep coming and none is taken: a hang, so the watchdog must not be fed."""
    health = watched()
    health.port_opened("encoders")
    for tick in range(31):
        health.received("encoders", 8, 1, tick * S // 10)
    assert health.flowing(2 * S)
    assert not health.flowing(3 * S)
    health.processed(3 * S, {"scans": 3})
    assert health.flowing(3 * S)


def test_a_robot_whose_sensors_are_gone_is_not_restarted() -> None:
    """Without samples the pipeline owes nothing: a restart would cost the map and bring no sensor back."""
    health = watched()
    assert health.flowing(S)
    health.port_opened("encoders")
    health.received("encoders", 8, 1, S)
    health.processed(S, {})
    health.port_failed("encoders", "unplugged")
    assert health.flowing(3600 * S)


def test_a_snapshot_is_json_and_tells_of_a_broken_guarantee() -> None:
    """Everything published survives JSON; a contradiction names its sensor and its time."""
    health = watched(Counter(bad_crc=2))
    void = Guarantee(12, "gps", 1.9, "m", Status.DEGRADED, contradicted_ns=15)
    health.processed(S, Counter(scans=7), void)
    health.dropped("encoders", 4)
    snapshot = json.loads(json.dumps(health.snapshot(S)))
    assert snapshot["guarantee"] == {
        "intact": False,
        "void_since_ns": 12,
        "sensor": "gps",
        "excess": 1.9,
        "unit": "m",
        "status": "DEGRADED",
        "restored_ns": None,
        "contradicted_ns": 15,
    }
    assert snapshot["pipeline"] == {"scans": 7}
    assert snapshot["devices"]["encoders"]["dropped"] == 4
    assert snapshot["devices"]["encoders"]["counts"] == {"bad_crc": 2}
    assert "gps" in health.status_line(S)


def test_threads_report_and_ask_at_once() -> None:
    """Four reporting threads and a watching one lose no count and raise nothing."""
    health = Health()
    names = ("laser", "encoders", "imu", "gps")
    for name in names:
        health.watch(name, 1.0, Counter())
        health.port_opened(name)

    def report(name: str) -> None:
        for number in range(2000):
            health.received(name, 3, 1, number)

    threads = [threading.Thread(target=report, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        health.snapshot(2000)
    for thread in threads:
        thread.join()
    rows = health.snapshot(2000)["devices"]
    assert [rows[name]["samples"] for name in names] == [2000] * 4
    assert [rows[name]["bytes"] for name in names] == [6000] * 4


def test_what_a_device_says_of_itself_is_in_the_snapshot() -> None:
    """Sentences for people, as they stand when somebody asks."""
    health, findings = Health(), list[str]()
    health.watch("laser", 0.5, findings=lambda: findings)

    assert health.snapshot(S)["devices"]["laser"]["findings"] == []
    findings.append("the scanner's window is dirty: clean it")
    assert health.snapshot(S)["devices"]["laser"]["findings"] == ["the scanner's window is dirty: clean it"]


def test_readers_may_start_while_others_ask() -> None:
    """On a busy machine a reader's thread begins late: whoever asks at that moment gets an answer all the same."""
    health, names = Health(), [f"device {number}" for number in range(20_000)]

    def begin() -> None:
        for name in names:
            health.alive(name, S)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        starter = threading.Thread(target=begin)
        starter.start()
        while starter.is_alive():
            assert health.flowing(S)
    finally:
        sys.setswitchinterval(interval)
        starter.join()
