"""The shared clock keeps two processes in step, and outlives either of them."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from drivers.clock import LockstepClock, SystemClock
from drivers.errors import PortMissing

READER = """
import os, sys
from drivers.clock import LockstepClock
clock, total = LockstepClock.attach(sys.argv[1]), 0
while data := os.read(0, 65536):
    total += len(data)
    os.write(1, clock.now_ns().to_bytes(8, "little"))
    clock.acknowledge("imu", total)
"""


def test_system_clock_never_goes_back() -> None:
    """Two readings in a row are in order."""
    clock = SystemClock()
    first = clock.now_ns()
    clock.acknowledge("imu", 10)
    assert first <= clock.now_ns()


def test_another_process_reads_every_slice_at_exactly_its_time(tmp_path: Path) -> None:
    """3000 slices of bytes are each stamped with the slice's own time, in a second process."""
    clock = LockstepClock.create(tmp_path / "clock", ["imu"])
    with subprocess.Popen(
        [sys.executable, "-c", READER, str(tmp_path / "clock")], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as reader:
        assert reader.stdin is not None
        assert reader.stdout is not None
        for i in range(1, 3001):
            clock.set(i * 5_000_000)
            os.write(reader.stdin.fileno(), b"x")
            assert clock.wait_for({"imu": i}, timeout_s=20)
        reader.stdin.close()
        stamps = reader.stdout.read()
    clock.close()
    assert [int.from_bytes(stamps[i : i + 8], "little") for i in range(0, len(stamps), 8)] == [
        i * 5_000_000 for i in range(1, 3001)
    ]


def test_driver_gives_up_on_a_reader_that_died(tmp_path: Path) -> None:
    """Waiting for somebody who is gone ends with False, and the total tells how far they came."""
    clock = LockstepClock.create(tmp_path / "clock", ["imu", "gps"])
    reader = LockstepClock.attach(tmp_path / "clock")
    reader.acknowledge("imu", 7)
    reader.close()
    assert clock.wait_for({"imu": 7}, timeout_s=0)
    assert not clock.wait_for({"imu": 8}, timeout_s=0.02)
    assert (clock.acknowledged("imu"), clock.acknowledged("gps")) == (7, 0)
    clock.close()


def test_reader_goes_on_when_the_driver_died(tmp_path: Path) -> None:
    """Time stands still and acknowledgements fall on deaf ears, but nothing raises or blocks."""
    clock = LockstepClock.create(tmp_path / "clock", ["imu"], now_ns=42)
    reader = LockstepClock.attach(tmp_path / "clock")
    clock.close()
    for total in range(100_000):
        reader.acknowledge("imu", total)
    assert reader.now_ns() == 42
    reader.close()


def test_many_unheard_acknowledgements_do_not_block(tmp_path: Path) -> None:
    """A driver that never waits doesn't hold up its readers, though the FIFO is full."""
    clock = LockstepClock.create(tmp_path / "clock", ["imu"])
    reader = LockstepClock.attach(tmp_path / "clock")
    for total in range(1, 100_001):
        reader.acknowledge("imu", total)
    assert clock.wait_for({"imu": 100_000}, timeout_s=0)
    reader.close()
    clock.close()


def test_waiting_wakes_on_the_last_of_several_devices(tmp_path: Path) -> None:
    """All totals must have been reached, by whichever threads."""
    clock = LockstepClock.create(tmp_path / "clock", ["imu", "gps"])
    reader = LockstepClock.attach(tmp_path / "clock")
    threads = [threading.Thread(target=reader.acknowledge, args=(name, 5)) for name in ("imu", "gps")]
    for thread in threads:
        thread.start()
    assert clock.wait_for({"imu": 5, "gps": 5}, timeout_s=20)
    for thread in threads:
        thread.join()
    reader.close()
    clock.close()


def test_time_never_goes_back(tmp_path: Path) -> None:
    """Setting an earlier time is the programmer's mistake and raises."""
    clock = LockstepClock.create(tmp_path / "clock", [])
    clock.set(10)
    with pytest.raises(ValueError, match="go back"):
        clock.set(9)
    clock.close()


def test_missing_or_foreign_clock_is_named(tmp_path: Path) -> None:
    """The message holds the path and says what to start."""
    with pytest.raises(PortMissing, match="start the emulated robot"):
        LockstepClock.attach(tmp_path / "none")
    (tmp_path / "foreign").write_bytes(b"\0" * 256)
    os.mkfifo(tmp_path / "foreign.ack")
    with pytest.raises(PortMissing, match="foreign"):
        LockstepClock.attach(tmp_path / "foreign")


def test_unknown_device_is_ignored_by_readers(tmp_path: Path) -> None:
    """A service with more devices than the driver has doesn't stumble."""
    clock = LockstepClock.create(tmp_path / "clock", ["imu"])
    clock.acknowledge("laser", 3)
    assert clock.acknowledged("imu") == 0
    clock.close()
