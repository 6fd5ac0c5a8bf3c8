"""A service that is kept from reading keeps its promise: late reads make stamps wider, and nothing else."""

import threading
import time
from pathlib import Path

from drivers.clock import SystemClock
from drivers.config import READ_ALLOWANCE_NS
from drivers.imu.codec import serialise
from drivers.imu.messages import highres_imu
from drivers.imu.protocol import ImuProtocol
from drivers.samples import InertialSample, Sample, Stamp, WheelTicks
from drivers.transports import open_serial
from service.devices import Device
from service.health import Health
from service.lateness import Lateness, lateness_ns
from service.passive import imu_config
from service.reader import Reader
from service.sample_queue import Arrival, SampleQueue
from simulator.ports import PseudoPort

MS = 1_000_000


def ticks(read_ms: int) -> WheelTicks:
    """A reading that was read then, with 2 to 5 ms of latency."""
    return WheelTicks(Stamp((read_ms - 5) * MS, (read_ms - 2) * MS), 0, 0)


def begin_ms(lateness: Lateness, sample: WheelTicks) -> float:
    """Where its stamp begins now."""
    (widened,) = lateness.widened([sample])
    assert widened.stamp.latest_ns == sample.stamp.latest_ns
    return widened.stamp.earliest_ns / MS


def test_punctual_reads_change_nothing() -> None:
    """The very samples come back; an ordinary wake-up is counted in the declared latency."""
    samples: list[Sample] = [ticks(10), ticks(20)]
    assert Lateness().widened(samples) is samples
    assert lateness_ns(READ_ALLOWANCE_NS) == 0
    assert lateness_ns(READ_ALLOWANCE_NS + 7) == 7


def test_what_may_have_begun_in_a_late_read_begins_as_much_earlier() -> None:
    """Also a frame whose end came later; a frame that began after it is as narrow as ever."""
    lateness = Lateness()
    lateness.read_late(100 * MS, 40 * MS)
    assert begin_ms(lateness, ticks(100)) == 55
    assert begin_ms(lateness, ticks(103)) == 98
    lateness.read_late(200 * MS, 10 * MS)
    assert begin_ms(lateness, ticks(100)) == 55
    assert begin_ms(lateness, ticks(200)) == 185
    lateness.read_late(300 * MS, 50 * MS)
    assert begin_ms(lateness, ticks(100)) == 45


def test_however_many_reads_are_late_the_stamps_stay_wide_enough() -> None:
    """What is remembered is bounded; what is merged stays on the safe side."""
    lateness = Lateness()
    for i in range(300):
        lateness.read_late((1000 + 10 * i) * MS, (400 - i) * MS)
    for i in range(300):
        assert begin_ms(lateness, ticks(1000 + 10 * i)) <= 1000 + 10 * i - 5 - (400 - i)


def test_bytes_that_lay_in_the_port_are_stamped_with_when_they_may_have_come(tmp_path: Path) -> None:
    """A reader that is held up for 200 ms between two reads: each packet's stamp contains when it was sent."""
    port = PseudoPort(tmp_path / "imu")
    held, reading = threading.Event(), threading.Event()

    class HeldUp(ImuProtocol):
        """Its thread stands still inside the first packet's parsing."""

        def receive_data(self, data: bytes, stamp_ns: int) -> list[InertialSample]:
            samples = super().receive_data(data, stamp_ns)
            reading.set()
            held.wait(10)
            return samples

    queue = SampleQueue(capacity=64)
    device = Device(
        "imu", port.path, lambda: open_serial(port.path, 115200), lambda: HeldUp(imu_config(latency_ms=(0.0, 8.0))), 1.0
    )
    reader = Reader(device, SystemClock(), queue, Health())
    reader.start()
    sent_ns: list[int] = []

    def send() -> None:
        i = len(sent_ns)
        data = serialise(highres_imu(i, 5000 * i + 1, 0, gyro_rps=(0.0, 0.0, 0.1)))
        sent_ns.append(time.monotonic_ns())
        port.write(data)

    try:
        while not reading.wait(0.02):  # until the port is open: what is sent before is lost
            sent_ns.clear()
            send()
        queue_before = len(sent_ns)
        for _ in range(20):
            send()
            time.sleep(0.01)  # the time that passes is what is tested
        held.set()
        arrivals: list[Arrival] = []
        while len(arrivals) < queue_before + 20:
            arrivals += queue.take(1.0)
    finally:
        held.set()
        reader.stop()
        port.close()
    stamps = [arrival.sample.stamp for arrival in arrivals]
    assert all(stamp.earliest_ns <= sent <= stamp.latest_ns for stamp, sent in zip(stamps, sent_ns, strict=True))
    assert max(stamp.latest_ns - stamp.earliest_ns for stamp in stamps) > 150 * MS
    assert reader.protocol.counts["late_reads"] >= 1
