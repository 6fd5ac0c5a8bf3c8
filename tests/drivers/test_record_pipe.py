"""Ports fill a pipe, in machine code or in the interpreter; whoever takes from it gets whole records, in order."""

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers import port_read
from drivers.errors import PortLost
from drivers.port_read import read_in_machine_code
from drivers.record_pipe import BELL_FD, LOST, NOT_STAMPED, OPENED, READ_BYTES, Record, RecordPipe
from drivers.transports import SerialTransport, open_serial
from simulator.ports import PseudoPort

PATIENCE_S = 20.0


@pytest.fixture
def pipe() -> Iterator[RecordPipe]:
    """A pipe."""
    pipe = RecordPipe()
    yield pipe
    pipe.close()


@pytest.fixture
def port(tmp_path: Path) -> Iterator[PseudoPort]:
    """The device's end of a port."""
    port = PseudoPort(tmp_path / "port")
    yield port
    port.close()


class Pumping:
    """A thread that pumps the host's end of a port until it is woken."""

    def __init__(self, port: PseudoPort, pipe: RecordPipe) -> None:
        self.transport: SerialTransport = open_serial(port.path, 115200)
        self.lost: PortLost | None = None
        self._pipe = pipe
        self._woken = False
        self._wake_fd = os.eventfd(0)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._woken:
                self.transport.pump(self._pipe, 3, 7, self._wake_fd, 30.0)
        except PortLost as error:
            self.lost = error

    def end(self) -> None:
        """Wake it; it comes back at once."""
        self._woken = True
        os.eventfd_write(self._wake_fd, 1)
        self.join()
        os.close(self._wake_fd)
        self.transport.close()

    def join(self) -> None:
        """Wait for its end."""
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()


@pytest.fixture(params=["machine code", "interpreter"])
def pumping(
    port: PseudoPort, pipe: RecordPipe, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Pumping]:
    """The same either way."""
    read_in_machine_code()
    if request.param == "interpreter":
        monkeypatch.setattr(port_read, "pump_port", port_read.pump_interpreted)
    pumping = Pumping(port, pipe)
    yield pumping
    pumping.end()


def take(pipe: RecordPipe, size: int) -> list[Record]:
    """Records until they hold so many bytes."""
    records: list[Record] = []
    while sum(record.size for record in records) < size:
        more = pipe.take(PATIENCE_S)
        assert more
        records += more
    return records


def test_all_bytes_come_out_in_order_with_the_times_of_their_reads(
    port: PseudoPort, pipe: RecordPipe, pumping: Pumping
) -> None:
    """Every byte once, whose port it was and which opening; no bytes came after the read that gave them."""
    sent = os.urandom(50_000)
    port.write(sent)
    records: list[Record] = []
    while sum(record.size for record in records) < len(sent):
        records += pipe.take(0.05)
        port.write()  # what didn't fit into the terminal's buffer
    assert b"".join(record.data for record in records) == sent
    assert {(record.port, record.opening, record.received_ns) for record in records} == {(3, 7, NOT_STAMPED)}
    assert all(record.empty_ns <= record.read_ns for record in records)
    assert [record.read_ns for record in records] == sorted(record.read_ns for record in records)
    assert max(record.size for record in records) <= READ_BYTES


def test_a_port_that_goes_away_is_told_as_by_a_read(port: PseudoPort, pipe: RecordPipe, pumping: Pumping) -> None:
    """What came before is in the pipe."""
    port.write(b"last words")
    assert take(pipe, 10)[0].data == b"last words"
    port.unplug()
    pumping.join()
    assert pumping.lost is not None


def test_bytes_that_find_no_room_are_counted_and_told_in_their_place(
    port: PseudoPort, pipe: RecordPipe, pumping: Pumping
) -> None:
    """A pipe that nobody takes from fills up. What is lost then is told before the first bytes that find room again."""
    while pipe.put(0, 1, 4000, data=bytes(4000)):
        pass
    port.write(b"lost")
    while not pumping.transport.lost_bytes:
        time.sleep(0.001)
    while pipe.take(0):
        pass
    port.write(b"kept")
    lost, kept = take_all(pipe, 2)
    assert (lost.size, lost.lost_bytes) == (LOST, 4)
    assert (kept.size, kept.data, kept.lost_bytes) == (4, b"kept", 0)


def take_all(pipe: RecordPipe, count: int) -> list[Record]:
    """So many records."""
    records: list[Record] = []
    while len(records) < count:
        records += pipe.take(PATIENCE_S)
    return records


def test_a_full_pipe_refuses_a_record_whole(pipe: RecordPipe) -> None:
    """Never half of one: what is taken later is what was put before."""
    count = 0
    while pipe.put(1, 1, 1000, data=bytes(1000), read_ns=count):
        count += 1
    taken = take_all(pipe, count)
    assert [record.read_ns for record in taken] == list(range(count))
    assert pipe.put(1, 2, OPENED, read_ns=5)
    assert pipe.take(0) == [Record(1, 2, OPENED, 5, 0, 0, 0, b"")]


def test_who_waits_for_a_port_sleeps_over_what_others_give(
    port: PseudoPort, pipe: RecordPipe, pumping: Pumping
) -> None:
    """Neither other ports end that wait nor what was read too early; what they gave is there when it ends."""
    taken: list[Record] = []
    since_ns = time.monotonic_ns() + 1

    def wait() -> None:
        taken.extend(pipe.take(3 * PATIENCE_S, [3], since_ns))

    waiting = threading.Thread(target=wait)
    waiting.start()
    assert pipe.put(0, 1, 5, data=b"other", read_ns=since_ns)
    assert pipe.put(3, 1, 5, data=b"early", read_ns=since_ns - 1)
    waiting.join(0.05)
    assert waiting.is_alive()
    port.write(b"awaited")
    waiting.join(PATIENCE_S)
    assert not waiting.is_alive()
    assert [record.data for record in taken] == [b"other", b"early", b"awaited"]


def test_a_wait_that_nothing_ends_is_over_in_time_and_gives_what_came(pipe: RecordPipe) -> None:
    """Late bells change nothing: one that was rung for an earlier wait is no reason to come back."""
    assert pipe.put(1, 1, 1, data=b"1")
    assert len(pipe.take(PATIENCE_S, [1])) == 1
    os.eventfd_write(int(pipe.alarm[BELL_FD]), 1)
    assert pipe.put(0, 1, 1, data=b"0")
    begun_s = time.monotonic()
    assert [record.port for record in pipe.take(0.05, [1])] == [0]
    assert time.monotonic() - begun_s >= 0.05
