"""Start, watchdog, signals."""

import fcntl
import os
import signal
import socket
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.lifecycle import ServiceNotifier, interrupted_later, stop_on_signals, terminated_like_interrupted


class FakeSystemd:
    """The other end of NOTIFY_SOCKET."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.socket.settimeout(5)

    def heard(self) -> str:
        return self.socket.recv(4096).decode()

    def silent(self) -> bool:
        self.socket.setblocking(False)
        try:
            self.socket.recv(4096)
        except BlockingIOError:
            return True
        finally:
            self.socket.settimeout(5)
        return False


@pytest.fixture(params=["file", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[FakeSystemd]:
    address = str(tmp_path / "notify") if request.param == "file" else f"@terrabound-test-{os.getpid()}"
    fake = FakeSystemd(address)
    yield fake
    fake.socket.close()


def test_systemd_hears_ready_status_and_stopping(systemd: FakeSystemd) -> None:
    """Words arrive over file and abstract sockets, in their order; an unchanged status is said once."""
    notifier = ServiceNotifier({"NOTIFY_SOCKET": systemd.address})
    notifier.ready()
    notifier.status("mapping,\n75 scans/s")
    notifier.status("mapping, 75 scans/s")
    notifier.stopping()
    assert [systemd.heard() for _ in range(3)] == ["READY=1", "STATUS=mapping, 75 scans/s", "STOPPING=1"]
    assert systemd.silent()
    notifier.close()


def test_the_watchdog_is_fed_at_half_its_time_and_only_while_samples_flow(systemd: FakeSystemd) -> None:
    """A pipeline that stands still isn't fed, so systemd restarts a service that hangs."""
    notifier = ServiceNotifier({"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "10000000"})
    assert notifier.watchdog_period_ns == 5_000_000_000
    fed = [notifier.feed(int(second * 1e9), flowing) for second, flowing in
           [(0, False), (1, True), (2, True), (5.9, True), (6, True), (20, False), (21, True)]]  # fmt: skip
    assert fed == [False, True, False, False, True, False, True]
    assert [systemd.heard() for _ in range(3)] == ["WATCHDOG=1"] * 3
    assert systemd.silent()
    notifier.close()


@pytest.mark.parametrize("usec", ["", "0", "-5", "abc", "1.5", "²"])
def test_without_a_proper_watchdog_nothing_is_fed(usec: str) -> None:
    """A missing, zero or garbled WATCHDOG_USEC means: no watchdog."""
    notifier = ServiceNotifier({"WATCHDOG_USEC": usec})
    assert notifier.watchdog_period_ns is None
    assert not notifier.feed(0, True)


def test_a_watchdog_meant_for_another_process_is_not_ours() -> None:
    """WATCHDOG_PID names the process that systemd expects to hear from."""
    environment = {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "77"}
    assert ServiceNotifier(environment, pid=77).watchdog_period_ns == 500_000_000
    assert ServiceNotifier(environment, pid=78).watchdog_period_ns is None


def test_a_missing_or_deaf_systemd_never_stops_the_service(tmp_path: Path) -> None:
    """No socket, a vanished one, and one that nobody reads: all are survived without blocking."""
    ServiceNotifier({}).ready()
    ServiceNotifier({"NOTIFY_SOCKET": str(tmp_path / "gone")}).ready()
    deaf = FakeSystemd(str(tmp_path / "deaf"))
    notifier = ServiceNotifier({"NOTIFY_SOCKET": deaf.address})
    for number in range(2000):
        notifier.status(f"status {number}")
    notifier.close()
    deaf.socket.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_the_process_in_order_with_code_zero(number: signal.Signals) -> None:
    """SIGTERM, SIGINT and SIGHUP set the event; the process ends by itself and says 0."""
    program = (
        "from service.lifecycle import stop_on_signals\n"
        "with stop_on_signals() as stop:\n"
        "    print('running', flush=True)\n"
        "    assert stop.wait(20)\n"
        "print('ended in order', flush=True)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "running\n"
    process.send_signal(number)
    rest, _ = process.communicate(timeout=20)
    assert (rest, process.returncode) == ("ended in order\n", 0)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_without_an_end_of_its_own_is_interrupted(number: signal.Signals) -> None:
    """As by Ctrl-C: what it has begun is cleared away. After the block the signal does what it did."""
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), terminated_like_interrupted():
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_what_must_not_be_interrupted_is_finished_first(number: signal.Signals) -> None:
    """A process that has just begun is known to whoever must end it, before the interrupt is heard."""
    begun = []
    with pytest.raises(KeyboardInterrupt), terminated_like_interrupted(), interrupted_later():  # noqa: PT012
        os.kill(os.getpid(), number)
        begun.append("a process")
    assert begun == ["a process"]


def on_its_terminal(program: str, *arguments: str) -> tuple[subprocess.Popen[bytes], int]:
    """A process on a terminal of its own, and that terminal's other end."""
    ours, theirs = os.openpty()

    def take_terminal() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    process = subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True, preexec_fn=take_terminal,
    )  # fmt: skip
    os.close(theirs)
    return process, ours


def test_a_terminal_that_goes_away_is_no_reason_to_lose_anything(tmp_path: Path) -> None:
    """A robot's ssh connection breaks: the end is orderly, also where the shell sends a signal of its own after it."""
    program = (
        "import os, pathlib, signal, sys\n"
        "from service.lifecycle import stop_on_signals\n"
        "with stop_on_signals() as stop:\n"
        "    print('running', flush=True)\n"
        "    assert stop.wait(60)\n"
        "    os.kill(os.getpid(), signal.SIGHUP)\n"
        "    pathlib.Path(sys.argv[1]).write_text('saved')\n"
    )
    process, terminal = on_its_terminal(program, str(tmp_path / "map"))
    with os.fdopen(terminal, "rb", buffering=0) as other_end:
        assert other_end.readline() == b"running\r\n"
    assert process.wait(60) == 0
    assert (tmp_path / "map").read_text() == "saved"


def test_whoever_ignores_the_terminals_end_is_left_running() -> None:
    """`nohup terrabound run`: it stays ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signals() as stop:
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            assert not stop.is_set()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_second_signal_interrupts_an_end_that_hangs() -> None:
    """After the first signal the usual behaviour is back, and leaving the block restores it as well."""
    before = signal.getsignal(signal.SIGINT)
    told: list[str] = []
    with stop_on_signals(tell=told.append) as stop:
        assert signal.getsignal(signal.SIGINT) is not before
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(5)
        assert signal.getsignal(signal.SIGINT) is before
    assert told == ["SIGINT"]
    assert signal.getsignal(signal.SIGINT) is before
