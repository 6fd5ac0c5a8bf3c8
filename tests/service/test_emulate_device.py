"""One emulated device in a process of its own, and other people's programs in another: they understand each other."""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from service.cli import run_command
from service.shipped import shipped_config

MAVLINK_CLIENT = """
import sys
from pymavlink import mavutil
port = mavutil.mavlink_connection(sys.argv[1], baud=115200, dialect="ardupilotmega")
seen = {}
while sum(seen.values()) < 200:
    message = port.recv_match(blocking=True, timeout=30)
    seen[message.get_type()] = seen.get(message.get_type(), 0) + 1
print(sorted(seen))
"""
CAN_CLIENT = """
import sys
import can, cantools
tracks = cantools.database.load_file(sys.argv[2])
with can.Bus(interface="slcan", channel=sys.argv[1], bitrate=500000, sleep_after_open=0.0) as bus:
    for _ in range(50):
        message = bus.recv(30)
        counts = tracks.decode_message(message.arbitration_id, message.data)
    print(sorted(counts), message.dlc)
"""
NMEA_CLIENT = """
import sys
import serial
from pynmeagps import NMEAReader
with serial.Serial(sys.argv[1], 115200, timeout=30) as port:
    port.readline()  # opened amid a sentence
    kinds = {NMEAReader.parse(port.readline()).identity for _ in range(9)}
print(sorted(kinds))
"""
LMS_CLIENT = """
import sys
import serial
STATUS = bytes.fromhex("02000100311512")
with serial.Serial(sys.argv[1], 38400, timeout=0.3) as port:
    port.write(STATUS)
    garbled = port.read(500)
    port.baudrate = 9600
    while port.read(500):  # what it says when it is switched on
        pass
    port.write(STATUS)
    port.timeout = 5
    acknowledged, head = port.read(1), port.read(5)
    answer = port.read(int.from_bytes(head[2:4], "little") + 1)
print(garbled[:1] != b"\\x06" and acknowledged == b"\\x06", head[:2].hex(), hex(head[4]), answer[:6].decode())
"""


@contextmanager
def emulated(*words: object) -> Iterator[subprocess.Popen[str]]:
    """`terrabound emulate` as a process, once its port is there."""
    command = [sys.executable, "-m", "service.cli", "emulate", *map(str, words)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            assert "Ctrl-C ends it" in process.stderr.readline()
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(30)


def client(text: str, *words: object) -> str:
    """Somebody else's program as a process; what it prints."""
    command = [sys.executable, "-c", text, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=90)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_pymavlink_reads_the_inertial_board(tmp_path: Path) -> None:
    """Over its own serial connection."""
    with emulated("imu", "--link", tmp_path / "imu"):
        assert client(MAVLINK_CLIENT, tmp_path / "imu") == "['ATTITUDE', 'HIGHRES_IMU']"


def test_python_can_and_cantools_read_the_encoders(tmp_path: Path) -> None:
    """The adapter is opened by python-can's slcan, the frames are those of the shipped DBC file."""
    with emulated("encoders", "--link", tmp_path / "encoders"):
        said = client(CAN_CLIENT, tmp_path / "encoders", shipped_config("tracks.dbc"))
    assert said == "['LEFT', 'RIGHT'] 4"


def test_pynmeagps_reads_the_receiver(tmp_path: Path) -> None:
    """Every sentence passes its checks."""
    with emulated("gps", "--link", tmp_path / "gps", "--speed", 3):
        assert client(NMEA_CLIENT, tmp_path / "gps") == "['GNGGA', 'GNGST', 'GNRMC']"


def test_a_client_of_the_scanner_must_find_its_rate(tmp_path: Path) -> None:
    """The manual's status request: garbage at 38400 baud; at 9600 an acknowledgement and the status telegram."""
    with emulated("lms", "--link", tmp_path / "laser"):
        assert client(LMS_CLIENT, tmp_path / "laser").startswith("True 0280 0xb1 V")


@pytest.mark.parametrize(
    ("device", "kinds", "least"),
    [("imu", ("garbage:0.2", "bit-flip:0.2"), 200), ("gps", ("truncated:0.2", "false-header:0.2"), 6)],
)
def test_on_a_faulty_line_every_intact_frame_is_heard(
    device: str, kinds: tuple[str, ...], least: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Two processes and a pty between them; the emulator tells at its end how many frames it sent whole."""
    options = [word for kind in kinds for word in ("--fault", kind)]
    with emulated(device, "--link", tmp_path / device, "--seed", 4, *options) as process:
        assert run_command(["listen", device, str(tmp_path / device), "--seconds", "2"]) == 0
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
    output, counts = capfd.readouterr()
    lines = [json.loads(line) for line in output.splitlines()]
    assert len(lines) >= least
    told = re.search(r"frames: sent (\d+), whole at the other end (\d+)", said)
    assert told is not None
    assert 0.5 < int(told[2]) / int(told[1]) < 0.95
    assert "skipped_bytes=" in counts
    if device == "imu":  # at rest: what is wrong in a frame would show
        assert all(abs(value) < 0.1 for line in lines for value in line["gyro_rps"] if value is not None)


def test_what_is_no_fault_is_bad_usage(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Refused in words before anything is plugged in."""
    for words, said in ((["--fault", "hail"], "no such fault"), (["--fault", "wrong-length"], "no length field")):
        assert run_command(["emulate", "gps", "--link", str(tmp_path / "gps"), *words]) == 2
        assert said in capfd.readouterr().err
    assert not (tmp_path / "gps").exists()
