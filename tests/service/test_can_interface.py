"""A CAN interface under the reader: python-can's virtual bus, whose frames are stamped as the kernel's are."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from drivers.clock import SystemClock
from drivers.samples import WheelTicks
from drivers.socketcan import SocketCanTransport
from drivers.track_encoders.protocol import TrackEncoderProtocol
from service.config import load
from service.devices import Device
from service.health import DeviceState
from service.passive import encoders_config
from service.readers import Readers
from service.shipped import shipped_config
from simulator.emulators.track_encoders import tracks_frame

PATIENCE_S = 20.0


class Bench:
    """A reader on a bus that a test sends to; each opening of the port makes a new bus object."""

    def __init__(self, channel: str) -> None:
        self.channel = channel
        self.buses: list[can.BusABC] = []
        self.sender = can.Bus(interface="virtual", channel=channel)
        dbc = shipped_config("tracks.dbc").read_text()
        config = encoders_config("TRACKS.LEFT", "TRACKS.RIGHT", "socketcan")
        device = Device(
            "encoders",
            channel,
            self._open,
            lambda: TrackEncoderProtocol(config, dbc),
            stale_after_s=0.1,
            can_frames=True,
        )
        self._readers = Readers(load(shipped_config("demo.toml")), SystemClock(), devices=(device,))
        self.health = self._readers.health
        self._readers.start()
        self._readers.read_punctually()
        (conversation,) = self._readers
        self.protocol = conversation.protocol
        self.until(lambda: len(self.buses) == 1)

    def _open(self) -> SocketCanTransport:
        self.buses.append(can.Bus(interface="virtual", channel=self.channel))
        return SocketCanTransport(self.channel, self.buses[-1])

    def close(self) -> None:
        """Stop."""
        self._readers.stop()
        self._readers.close()
        self.sender.shutdown()

    def send(self, left: int, right: int) -> None:
        """One message of the counters."""
        frame = tracks_frame(left, right)
        self.sender.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False))

    def take(self) -> WheelTicks:
        """The next sample."""
        (arrival,) = self._readers.queue.take(PATIENCE_S)
        assert isinstance(arrival.sample, WheelTicks)
        return arrival.sample

    def until(self, condition: Callable[[], bool]) -> None:
        """Wait for something that must come."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.001)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """A reader and its bus."""
    bench = Bench(str(tmp_path))
    yield bench
    bench.close()


def test_a_frame_is_stamped_when_it_was_received(bench: Bench) -> None:
    """Between the moments before and after its sending, to the jitter of two clocks read one after the other."""
    for i in range(20):
        before_ns = time.monotonic_ns()
        bench.send(i, -i)
        after_ns = time.monotonic_ns()
        stamp = bench.take().stamp
        assert before_ns - 100_000 <= stamp.earliest_ns == stamp.latest_ns <= after_ns + 100_000


def test_error_frames_and_bus_off_are_told_and_the_counts_are_stale_at_once(bench: Bench) -> None:
    """STALE within 100 ms of the last frame, and the state says bus-off until the bus is heard again."""
    bench.send(1, 1)
    bench.take()
    last_ns = time.monotonic_ns()
    bench.sender.send(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, dlc=8, data=bytes(8)))
    counts = bench.protocol.counts
    bench.until(lambda: counts["bus_off"] == 1)
    assert "bus-off" in getattr(bench.protocol, "state", "")
    assert bench.health.state("encoders", last_ns + 300_000_000_000) == DeviceState.STALE
    bench.send(2, 2)
    bench.take()
    assert getattr(bench.protocol, "state", None) == ""


def test_an_interface_that_went_down_is_opened_anew(bench: Bench) -> None:
    """A new bus object, and a new epoch."""
    bench.send(1, 1)
    before = bench.take()
    bench.buses[0].shutdown()
    bench.until(lambda: len(bench.buses) > 1)
    bench.send(3, 3)
    after = bench.take()
    assert after.epoch == before.epoch + 1
