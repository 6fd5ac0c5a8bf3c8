"""One thread parses for all devices: a parser of ours that raises or hangs can't silently stop the others."""

import os
import pty
import subprocess
import sys
import threading
import time
import tty
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from drivers.clock import SystemClock
from drivers.samples import Sample
from drivers.transports import open_serial
from service.commands.demo import demo_configuration
from service.config import load
from service.devices import Device
from service.health import LIFE_TIMEOUT_NS
from service.readers import Readers
from service.shipped import shipped_config

PATIENCE_S = 120.0


class Parser:
    """A protocol that only counts what it is given."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.baud, self.deadline_ns = None, None

    def connection_made(self, now_ns: int) -> None:
        """The port is open."""

    def advance(self, now_ns: int) -> None:
        """Nothing is due."""

    def data_to_send(self) -> bytes:
        """Nothing."""
        return b""

    def receive_data(self, data: bytes, stamp_ns: int) -> list[Sample]:
        """Count."""
        self.counts["bytes"] += len(data)
        return []


class Hanging(Parser):
    """It never comes back, until it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.let_go = threading.Event()
        self.hung_ns: int | None = None

    def receive_data(self, data: bytes, stamp_ns: int) -> list[Sample]:
        """Hang."""
        self.hung_ns = time.monotonic_ns()
        self.let_go.wait(PATIENCE_S)
        return super().receive_data(data, stamp_ns)


@contextmanager
def wires(*names: str) -> Iterator[dict[str, tuple[int, str]]]:
    """Pseudo-terminals: our end of each, and the path of the other."""
    ends = {name: pty.openpty() for name in names}
    for ours, theirs in ends.values():
        tty.setraw(theirs)
        os.set_blocking(ours, False)
    try:
        yield {name: (ours, os.ttyname(theirs)) for name, (ours, theirs) in ends.items()}
    finally:
        for pair in ends.values():
            for end in pair:
                os.close(end)


@contextmanager
def stopping(readers: Readers, hanging: Hanging) -> Iterator[None]:
    """However it goes, no thread stays on ports that another test may be given."""
    try:
        yield
    finally:
        hanging.let_go.set()
        readers.stop()


def send(ours: int) -> None:
    """Something comes at the port, unless it is full already."""
    with suppress(BlockingIOError):
        os.write(ours, b"anything")


def test_a_parser_that_hangs_starves_the_watchdog_by_name() -> None:
    """All readers are at work, and yet nothing flows: the status says who hangs. Once it goes on, all of it does."""
    hanging, other = Hanging(), Parser()
    with wires("imu", "gps") as ports:
        devices = tuple(
            Device(name, path, lambda path=path: open_serial(path, 115200), lambda parser=parser: parser, 2.0)  # type: ignore[misc]
            for (name, (_, path)), parser in zip(ports.items(), (hanging, other), strict=True)
        )
        readers = Readers(load(shipped_config("demo.toml")), SystemClock(), devices=devices)
        readers.start()
        with closing(readers), stopping(readers, hanging):
            readers.read_punctually()
            health, deadline_s = readers.health, time.monotonic() + PATIENCE_S
            while hanging.hung_ns is None:  # what comes before a port is open is thrown away
                assert time.monotonic() < deadline_s
                send(ports["imu"][0])
                time.sleep(0.01)
            os.write(ports["gps"][0], b"good")
            then_ns = hanging.hung_ns + LIFE_TIMEOUT_NS
            while health.hung(then_ns) != ["conversations"]:  # each reader has looked up since
                assert time.monotonic() < deadline_s, health.hung(then_ns)
                time.sleep(0.01)
            assert not health.flowing(then_ns)
            assert health.status_line(then_ns).startswith("conversations hangs; ")
            assert other.counts["bytes"] == 0
            hanging.let_go.set()
            while other.counts["bytes"] != 4:  # it waited in the pipe
                assert time.monotonic() < deadline_s
                time.sleep(0.01)
            assert health.flowing(time.monotonic_ns())


PROGRAM = """
import sys
from drivers.imu.protocol import ImuProtocol
from service.cli import main

def fails(self, data, stamp_ns):
    raise ArithmeticError("a fault of ours")

ImuProtocol.receive_data = fails
sys.argv = ["terrabound", "run", "--config", sys.argv[1]]
main()
"""


def test_a_parser_that_raises_ends_the_service_which_says_why(tmp_path: Path) -> None:
    """Exit code 1, on which systemd starts it again; never a service that lives and has gone deaf."""
    demo_configuration(tmp_path)
    with wires("imu") as ports:
        ours, path = ports["imu"]
        (tmp_path / "ports" / "imu").symlink_to(path)
        service = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(tmp_path / "demo.toml")], stderr=subprocess.PIPE, text=True
        )
        try:
            deadline_s = time.monotonic() + 4 * PATIENCE_S
            while service.poll() is None and time.monotonic() < deadline_s:
                send(ours)
                time.sleep(0.05)
            _, said = service.communicate(timeout=1)
        finally:
            service.kill()
    assert "a fault of ours" in said
    assert service.returncode == 1
