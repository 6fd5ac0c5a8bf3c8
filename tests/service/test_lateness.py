"""A service that is kept from reading keeps its promise: late reads make stamps wider, and nothing else."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

from drivers.clock import SystemClock
from drivers.config import READ_ALLOWANCE_NS
from drivers.imu.codec import serialise
from drivers.imu.messages import highres_imu
from drivers.imu.protocol import ImuProtocol
from drivers.record_pipe import RecordPipe
from drivers.samples import InertialSample, Sample, Stamp, WheelTicks
from drivers.transports import Transport, open_serial
from service.config import load
from service.devices import Device
from service.lateness import Lateness, lateness_ns
from service.passive import imu_config
from service.readers import Readers
from service.shipped import shipped_config
from simulator.ports import PseudoPort

MS = 1_000_000


def opened(path: str) -> Transport:
    """A port that nothing holds up."""
    return open_serial(path, 115200)


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


class Board:
    """An inertial board that a test speaks for, and the readers that listen to it."""

    def __init__(
        self, port: PseudoPort, protocol: type[ImuProtocol] = ImuProtocol, opened: Callable[[str], Transport] = opened
    ) -> None:
        self.port = port
        self.sent_ns: dict[int, int] = {}
        """When each packet was sent, by its device time."""
        device = Device(
            "imu", port.path, lambda: opened(port.path), lambda: protocol(imu_config(latency_ms=(0.0, 8.0))), 1.0
        )
        self.readers = Readers(load(shipped_config("demo.toml")), SystemClock(), devices=(device,))
        self.readers.start()
        self.readers.read_punctually()

    def send(self) -> None:
        """The next packet."""
        i, now_ns = len(self.sent_ns), time.monotonic_ns()
        self.sent_ns[now_ns // 1000] = now_ns
        self.port.write(serialise(highres_imu(i % 256, now_ns // 1000, 0, gyro_rps=(0.0, 0.0, 0.1))))

    def send_until(self, reading: threading.Event) -> None:
        """Until the port is open: what is sent before is lost."""
        while not reading.wait(0.02):
            self.send()

    def stamps(self) -> list[Stamp]:
        """Of all that came, up to the last that was sent: each holds the time when it was."""
        samples: list[InertialSample] = []
        while not samples or samples[-1].device_time_us != max(self.sent_ns):
            for arrival in self.readers.queue.take(1.0):
                assert isinstance(arrival.sample, InertialSample)
                samples.append(arrival.sample)
        for sample in samples:
            assert sample.device_time_us is not None
            assert sample.stamp.earliest_ns <= self.sent_ns[sample.device_time_us] <= sample.stamp.latest_ns
        return [sample.stamp for sample in samples]

    def close(self) -> None:
        """End."""
        self.readers.stop()
        self.readers.close()
        self.port.close()


def test_bytes_that_lay_in_the_port_are_stamped_with_when_they_may_have_come(tmp_path: Path) -> None:
    """A reader that is held up for 200 ms between two reads: each packet's stamp contains when it was sent."""
    held, reading, waiting = threading.Event(), threading.Event(), threading.Event()

    class HeldUp(ImuProtocol):
        """Tells that the first packet has come."""

        def receive_data(self, data: bytes, stamp_ns: int) -> list[InertialSample]:
            reading.set()
            return super().receive_data(data, stamp_ns)

    def open_held_up(path: str) -> Transport:
        """A port whose reader stands still once its first packet has come."""
        transport = open_serial(path, 115200)
        pump = transport.pump

        def held_up(pipe: RecordPipe, port: int, opening: int, wake_fd: int, lasting_s: float) -> None:
            pump(pipe, port, opening, wake_fd, 0.01)
            if reading.is_set():
                waiting.set()
                held.wait(10)

        transport.pump = held_up  # type: ignore[method-assign]
        return transport

    board = Board(PseudoPort(tmp_path / "imu"), HeldUp, open_held_up)
    try:
        board.send_until(reading)
        waiting.wait(10)
        for _ in range(20):
            board.send()
            time.sleep(0.01)  # the time that passes is what is tested
        held.set()
        stamps = board.stamps()
        (conversation,) = board.readers
        assert max(stamp.latest_ns - stamp.earliest_ns for stamp in stamps) > 150 * MS
        assert conversation.protocol.counts["late_reads"] >= 1
    finally:
        held.set()
        board.close()


def test_who_parses_may_be_late_without_any_stamp_being_late(tmp_path: Path) -> None:
    """The thread that parses stands still for 200 ms: each packet is stamped as it came all the same."""
    held, reading = threading.Event(), threading.Event()

    class HeldUp(ImuProtocol):
        """Its thread stands still inside the first packet's parsing."""

        def receive_data(self, data: bytes, stamp_ns: int) -> list[InertialSample]:
            samples = super().receive_data(data, stamp_ns)
            reading.set()
            held.wait(10)
            return samples

    board = Board(PseudoPort(tmp_path / "imu"), HeldUp)
    try:
        board.send_until(reading)
        for _ in range(20):
            board.send()
            time.sleep(0.01)  # the time that passes is what is tested
        held.set()
        widths = sorted(stamp.latest_ns - stamp.earliest_ns for stamp in board.stamps())
        assert widths[len(widths) // 2] < 20 * MS  # of most; a starved machine may read some late
    finally:
        held.set()
        board.close()
