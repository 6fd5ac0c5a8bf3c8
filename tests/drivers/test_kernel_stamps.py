"""Frames of a CAN interface are stamped when the kernel received them, whoever sets the clock meanwhile."""

import socket
import time
from collections.abc import Iterator
from typing import Any

import can
import pytest
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.socketcan.constants import SO_TIMESTAMPNS
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import PortLost
from drivers.kernel_stamps import KernelStamps
from drivers.socketcan import SocketCanTransport
from drivers.track_encoders.codec import CanFrame, pack_can_frame

MS = 1_000_000


class Clocks:
    """A monotonic clock and a wall clock that people set."""

    def __init__(self) -> None:
        self.now_ns, self.ahead_ns = 5_000_000_000, 1_700_000_000_000_000_000

    def stamps(self) -> KernelStamps:
        """What is under test, on these clocks."""
        return KernelStamps(lambda: self.now_ns + self.ahead_ns, lambda: self.now_ns)


steps = st.sampled_from([0, 0, 0, 1, -1, 30, -30, 3_600_000, -3_600_000]).map(lambda ms: ms * MS)


@given(st.lists(st.tuples(st.integers(0, 8), st.integers(1, 3), steps, st.integers(0, 30)), max_size=40))
def test_a_clock_that_is_set_moves_no_stamp(events: list[tuple[int, int, int, int]]) -> None:
    """Frames come 1 ms apart and are read late; the clock is set in between, forth and back, by an hour or by a little.

    Each frame comes out at its true receipt, or, where the clocks leave that open, without one.
    """
    clocks = Clocks()
    stamps = clocks.stamps()
    last_ns = clocks.now_ns
    for burst, gap, step_ns, late in events:
        queue = []
        for i in range(burst):
            clocks.now_ns += gap * MS
            if i == burst // 2:
                clocks.ahead_ns += step_ns
            queue.append((clocks.now_ns, clocks.now_ns + clocks.ahead_ns))
        clocks.now_ns += late * MS
        for true_ns, wall_ns in queue:
            assert stamps.not_before_ns <= true_ns
            got_ns = stamps.received_ns(wall_ns)
            assert got_ns in (true_ns, None)
            if got_ns is not None:
                assert got_ns >= last_ns
                last_ns = got_ns
        stamps.empty_at(clocks.now_ns)


def test_without_steps_every_stamp_is_the_kernels() -> None:
    """However late the read; a clock that is slewed is none that is set."""
    clocks = Clocks()
    stamps = clocks.stamps()
    for _ in range(200):
        clocks.now_ns += 10 * MS
        true_ns, wall_ns = clocks.now_ns, clocks.now_ns + clocks.ahead_ns
        clocks.ahead_ns += 4_000  # 400 ppm
        clocks.now_ns += 7 * MS
        assert abs((stamps.received_ns(wall_ns) or 0) - true_ns) <= 7_000
    assert (stamps.clock_steps, stamps.unstamped) == (0, 0)


def test_an_hours_step_is_seen_and_harmless() -> None:
    """Stamps of before and after the step both come out true."""
    clocks = Clocks()
    stamps = clocks.stamps()
    walls = []
    for i in range(6):
        clocks.now_ns += 10 * MS
        clocks.ahead_ns += 3600 * 1000 * MS if i == 3 else 0
        walls.append((clocks.now_ns, clocks.now_ns + clocks.ahead_ns))
    clocks.now_ns += MS
    assert all(stamps.received_ns(wall_ns) == true_ns for true_ns, wall_ns in walls)
    assert (stamps.clock_steps, stamps.unstamped) == (1, 0)


@pytest.fixture
def wire() -> Iterator[tuple[socket.socket, SocketCanTransport]]:
    """python-can's SocketCAN bus on a datagram socket, which this kernel stamps as it would a CAN socket."""
    device, host = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    host.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    bus: Any = SocketcanBus.__new__(SocketcanBus)
    bus.socket, bus.channel, bus._is_filtered, bus._filters = host, "can0", True, None
    transport = SocketCanTransport("can0", bus)
    yield device, transport
    device.close()
    host.close()
    bus._is_shutdown = True


def test_frames_read_late_have_their_own_times(wire: tuple[socket.socket, SocketCanTransport]) -> None:
    """Real kernel stamps: frames sent 20 ms apart and read together lie 20 ms apart, byte for byte as they came."""
    device, transport = wire
    frames = [CanFrame(0x181, bytes([i, 2, 3])) for i in range(3)] + [CanFrame(0x40, bytes(8), error=True)]
    windows = []
    for frame in frames:
        begin_ns = time.monotonic_ns()
        device.send(pack_can_frame(frame))
        windows.append((begin_ns, time.monotonic_ns()))
        time.sleep(0.02)
    for frame, (begin_ns, end_ns) in zip(frames, windows, strict=True):
        assert transport.read(1.0) == pack_can_frame(frame)
        assert transport.received_ns is not None
        assert begin_ns - 100_000 <= transport.received_ns <= end_ns + 100_000
    assert transport.read(0.0) == b""
    assert transport.stamps.unstamped == 0


def test_an_interface_that_goes_down_is_a_lost_port(wire: tuple[socket.socket, SocketCanTransport]) -> None:
    """The next read says so."""
    device, transport = wire
    device.close()
    transport._bus.socket.close()  # type: ignore[attr-defined]  # as the kernel would
    with pytest.raises(PortLost, match="ip -details link show can0"):
        transport.read(0.1)


def test_a_virtual_bus_passes_every_kind_of_frame() -> None:
    """python-can at the other end: standard, extended, remote, error."""
    with can.Bus(interface="virtual", channel="wires") as sender, can.Bus(interface="virtual", channel="wires") as host:
        transport = SocketCanTransport("wires", host)
        frames = [
            CanFrame(0x181, b"1234"),
            CanFrame(0x1ABCDEF0, b"12345678", extended=True),
            CanFrame(0x7FF, b"", 4, remote=True),
            CanFrame(0x44, bytes(8), error=True),
        ]
        for frame in frames:
            sender.send(
                can.Message(
                    arbitration_id=frame.can_id,
                    is_extended_id=frame.extended,
                    is_remote_frame=frame.remote,
                    is_error_frame=frame.error,
                    data=None if frame.remote else frame.data,
                    dlc=frame.dlc,
                )
            )
        assert [transport.read(1.0) for _ in frames] == [pack_can_frame(frame) for frame in frames]
        transport.write(pack_can_frame(frames[1]))
        answer = sender.recv(1.0)
        assert answer is not None
        assert answer.arbitration_id == 0x1ABCDEF0
