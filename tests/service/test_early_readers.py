"""The sensors' side of the service, before machine code is there."""

import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.clock import SystemClock
from drivers.errors import ConfigurationError
from drivers.samples import Stamp, WheelTicks
from drivers.transports import Transport, open_serial
from service.config import load
from service.devices import wiring
from service.readers import Readers
from service.sample_queue import Arrival
from service.shipped import shipped_config
from simulator.ports import PseudoPort

PROGRAM = """
import sys
import service.commands.run
from drivers.clock import SystemClock
from service.config import load
from service.readers import Readers
from service.shipped import shipped_config
readers = Readers(load(shipped_config("demo.toml")), SystemClock())
readers.start()
assert len(list(readers)) == 4
readers.stop()
sys.exit("numba" in sys.modules)
"""


def test_readers_need_no_machine_code() -> None:
    """They converse with their devices while numba is not even imported; that takes most of a start."""
    subprocess.run([sys.executable, "-c", PROGRAM], timeout=100, check=True)


def test_what_is_not_read_punctually_is_not_used() -> None:
    """A sample read while the interpreter is busy loading is dropped and counted, not mapped with a late stamp."""
    readers = Readers(load(shipped_config("demo.toml")), SystemClock())
    readers.start()
    try:
        sample = Arrival("encoders", WheelTicks(Stamp(1, 2), 0, 0), 2)
        readers.queue.put([sample])
        readers.read_punctually()
        assert (readers.queue.take(0), readers.queue.dropped) == ([], {"encoders": 1})
        punctual = sample._replace(received_ns=time.monotonic_ns())
        readers.queue.put([sample, punctual])
        assert readers.queue.take(0) == [punctual]
        assert readers.queue.dropped == {"encoders": 2}
    finally:
        readers.stop()
        readers.close()


def test_a_port_that_opens_and_fails_at_once_is_not_tried_without_a_pause(tmp_path: Path) -> None:
    """As a CAN interface that is down, or an adapter that has lost its device: a busy loop would cost a core."""
    openings: list[float] = []

    def open_and_unplug() -> Transport:
        openings.append(time.monotonic())
        plug = PseudoPort(tmp_path / "port")
        transport = open_serial(str(tmp_path / "port"), 9600, at_once=True)
        plug.close()
        return transport

    loaded = load(shipped_config("demo.toml"))
    gps = next(device for device in wiring(loaded) if device.name == "gps")
    readers = Readers(loaded, SystemClock(), devices=(replace(gps, open=open_and_unplug),))
    readers.start()
    try:
        deadline = time.monotonic() + 60
        while len(openings) < 7:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert openings[6] - openings[0] >= 0.05 + 0.1 + 0.2 + 0.4 + 0.8 + 1.6
        assert "went away" in readers.health.failures["gps"]
    finally:
        readers.stop()
        readers.close()


def test_a_mistake_found_while_readers_start_leaves_none_behind() -> None:
    """The scanner's reader runs already when the DBC file turns out to be none: the error says so, and it can stop."""
    readers = Readers(replace(load(shipped_config("demo.toml")), dbc="no DBC file"), SystemClock())
    with pytest.raises(ConfigurationError, match=r"devices\.encoders: .*DBC"):
        readers.start()
    assert readers.started
    readers.stop()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith(("reader", "conversations"))]
