"""Serial ports as the service meets them, over real pseudo-terminals."""

import errno
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers import port_read
from drivers.errors import PortBusy, PortError, PortLost, PortMissing
from drivers.socketcan import open_socketcan
from drivers.socketcan import refusal as can_refusal
from drivers.transports import SerialTransport, open_serial, refusal
from simulator.ports import PseudoPort

EVERY_BYTE = bytes(range(256))


@pytest.fixture
def port(tmp_path: Path) -> Iterator[PseudoPort]:
    """A port with a stable name."""
    pseudo = PseudoPort(tmp_path / "gps")
    yield pseudo
    pseudo.close()


@pytest.fixture
def host(port: PseudoPort) -> Iterator[SerialTransport]:
    """The host's end of it."""
    transport = open_serial(port.path, 115200)
    yield transport
    transport.close()


@pytest.fixture(params=["machine code", "interpreter"])
def either_way(
    host: SerialTransport, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> SerialTransport:
    """The same, read in machine code, and as it is read until that is loaded."""
    if request.param == "interpreter":
        monkeypatch.setattr(port_read, "read_when_ready", port_read.read_interpreted)
    return host


def read_exactly(transport: SerialTransport, n: int) -> bytes:
    """Read until `n` bytes have come."""
    data = b""
    while len(data) < n:
        chunk = transport.read(10)
        assert chunk
        data += chunk
    return data


def write_until_read(port: PseudoPort, n: int) -> bytes:
    """What the host wrote, `n` bytes of it."""
    data = b""
    while len(data) < n:
        data += port.read()
    return data


def test_every_byte_value_passes_unchanged_both_ways(port: PseudoPort, either_way: SerialTransport) -> None:
    """XON, XOFF, carriage return, interrupt: all are plain data."""
    port.write(EVERY_BYTE)
    assert read_exactly(either_way, 256) == EVERY_BYTE
    either_way.write(EVERY_BYTE)
    assert write_until_read(port, 256) == EVERY_BYTE


def test_a_port_knows_when_it_was_last_empty(port: PseudoPort, either_way: SerialTransport) -> None:
    """No byte of a read came before that; and while a port is waited at, that is never long ago."""
    for patience_ms in (0, 50):
        waiting_ns = time.monotonic_ns()
        assert either_way.read(patience_ms / 1000) == b""
        sent_ns = time.monotonic_ns()
        port.write(b"first")
        time.sleep(0.03)  # the time that passes is what is tested
        assert either_way.read(10) == b"first"
        assert waiting_ns + min(patience_ms, 4) * 1_000_000 <= either_way.empty_ns <= sent_ns


def test_what_lay_in_a_port_was_there_since_it_was_empty(port: PseudoPort, either_way: SerialTransport) -> None:
    """However a busy kernel hands it over, full reads and little ones between: no read claims to be of later bytes."""
    for _ in range(5):
        either_way.read(0.0)
        left = os.write(port.fileno(), bytes(20_000))
        sent_ns = time.monotonic_ns()
        while left > 0:
            chunk = either_way.read(10)
            assert chunk
            assert either_way.empty_ns <= sent_ns
            left -= len(chunk)


def test_silence_is_an_empty_read(either_way: SerialTransport) -> None:
    """Waiting out the timeout gives no bytes and no exception."""
    assert either_way.read(0.0) == b""
    assert either_way.read(0.01) == b""


def test_a_signal_during_a_read_is_no_lost_port(port: PseudoPort, host: SerialTransport) -> None:
    """Ctrl-C and the like: the read comes back early with nothing, and the port goes on."""
    heard: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, frame: heard.append(number))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        while not heard:
            assert host.read(10) == b""
    finally:
        signal.signal(signal.SIGALRM, before)
    port.write(b"still here")
    assert read_exactly(host, 10) == b"still here"


def test_more_than_the_kernel_holds_arrives_whole(port: PseudoPort, either_way: SerialTransport) -> None:
    """What the pty can't take waits in the backlog and follows in order."""
    sent = os.urandom(200_000)
    port.write(sent)
    got = b""
    while len(got) < len(sent):
        got += either_way.read(10)
        port.write()
    assert got == sent
    assert port.dropped_bytes == 0


def test_backlog_is_bounded(port: PseudoPort, host: SerialTransport) -> None:
    """A host that never reads costs dropped bytes, counted, not memory."""
    for _ in range(6):
        port.write(bytes(500_000))
    assert port.dropped_bytes > 1_500_000
    assert host.read(0)


def test_bytes_sent_to_nobody_are_gone(port: PseudoPort) -> None:
    """A host that opens late gets nothing old."""
    port.write(b"old")
    host = open_serial(port.path, 9600)
    port.write(b"new")
    assert read_exactly(host, 3) == b"new"
    host.close()
    assert port.dropped_bytes == 3


def test_unplugging_is_seen_at_once(port: PseudoPort, either_way: SerialTransport) -> None:
    """The next read says that the port went away, and names it."""
    port.unplug()
    with pytest.raises(PortLost, match=port.path):
        either_way.read(10)
    with pytest.raises(PortLost, match="went away"):
        either_way.write(b"hello")
    with pytest.raises(PortLost):
        either_way.set_baud(9600)
    either_way.close()
    either_way.close()


def test_last_words_before_unplugging_may_be_read_but_nothing_is_invented(
    port: PseudoPort, either_way: SerialTransport
) -> None:
    """Bytes sent just before the plug was pulled come out right or not at all."""
    port.write(b"goodbye")
    port.unplug()
    got: list[bytes] = []
    with pytest.raises(PortLost):
        got.extend(iter(lambda: either_way.read(10), None))
    assert b"goodbye".startswith(b"".join(got))


def test_port_that_is_gone_is_missing_until_replugged(port: PseudoPort, host: SerialTransport) -> None:
    """The same name works again after a replug, though another pty stands behind it."""
    port.unplug()
    host.close()
    with pytest.raises(PortMissing, match=port.path):
        open_serial(port.path, 9600)
    port.replug()
    again = open_serial(port.path, 9600)
    port.write(b"back")
    assert read_exactly(again, 4) == b"back"
    again.close()


def test_host_may_close_and_open_again(port: PseudoPort, host: SerialTransport) -> None:
    """Closing the host's end doesn't hurt the device's."""
    assert port.host_present
    host.close()
    assert not port.host_present
    assert port.read() == b""
    again = open_serial(port.path, 9600)
    again.write(b"hello")
    assert write_until_read(port, 5) == b"hello"
    again.close()


def test_second_open_is_refused(port: PseudoPort, host: SerialTransport) -> None:
    """One port, one owner; the message says what to do."""
    with pytest.raises(PortBusy, match="another process"):
        open_serial(port.path, 9600)
    host.close()
    open_serial(port.path, 9600).close()


def test_device_sees_the_hosts_rate(port: PseudoPort, host: SerialTransport) -> None:
    """A change of rate is visible at the device's end, so that it can garble what doesn't match."""
    assert port.host_baud == 115200
    for baud in (9600, 19200, 38400, 500000):
        host.set_baud(baud)
        assert port.host_baud == baud


def test_no_port_and_no_tty_are_told_apart(tmp_path: Path) -> None:
    """Each message names the path and what to do."""
    with pytest.raises(PortMissing, match="plug the device in"):
        open_serial(str(tmp_path / "none"), 9600)
    (tmp_path / "file").write_text("")
    with pytest.raises(PortError, match="name the device's own port"):
        open_serial(str(tmp_path / "file"), 9600)


def test_impossible_rate_is_refused(port: PseudoPort) -> None:
    """A rate below zero is an error a person can read."""
    with pytest.raises(PortError, match="set another rate"):
        open_serial(port.path, -1)


def test_a_missing_can_interface_is_told_with_what_to_do() -> None:
    """Whether this system knows CAN or not: what it lacks stands in the message, and a command for that."""
    with pytest.raises(PortMissing) as told:
        open_socketcan("nocan0", 500000)
    assert str(told.value).startswith("nocan0: ")
    lacks_can = getattr(told.value.__cause__, "errno", None) == errno.EAFNOSUPPORT
    assert ("modprobe can_raw" if lacks_can else "no such CAN interface") in str(told.value)


@pytest.mark.parametrize(
    ("number", "advice"),
    [
        (errno.EAFNOSUPPORT, "modprobe can_raw"),
        (errno.EPROTONOSUPPORT, "modprobe can_raw"),
        (errno.ENODEV, "plug the adapter in"),
        (errno.ENETDOWN, "ip link set can7 up type can bitrate 125000"),
    ],
)
def test_why_a_can_interface_is_refused_decides_what_is_advised(number: int, advice: str) -> None:
    """A kernel without CAN, no such interface, one that is down: to bring it up helps in the last case alone."""
    told = str(can_refusal("can7", 125000, OSError(number, os.strerror(number))))
    assert advice in told
    assert os.strerror(number) in told or number == errno.ENODEV
    assert ("ip link set" in told) is (number == errno.ENETDOWN)


def test_a_port_that_the_system_forbids_is_not_blamed_on_its_group() -> None:
    """EPERM is a unit's DevicePolicy, EACCES the file's permissions."""
    forbidden, closed = (
        str(refusal("/dev/ttyX0", 9600, OSError(number, os.strerror(number)))) for number in (errno.EPERM, errno.EACCES)
    )
    assert "DeviceAllow=" in forbidden
    assert "dialout" not in forbidden
    assert "dialout" in closed
