"""The slcan adapter: opened from any state, at the right rate or not at all; and as python-can knows it."""

import contextlib
import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.config import EncodersConfig
from drivers.samples import WheelTicks
from drivers.track_encoders.adapter import Step
from drivers.track_encoders.codec import CanFrame, parse_slcan, serialise_slcan
from drivers.track_encoders.protocol import TrackEncoderProtocol
from simulator.emulators.track_encoders import TrackEncodersEmulator
from simulator.ports import PseudoPort

TRACKS = (Path(__file__).resolve().parents[2] / "docs" / "config" / "tracks.dbc").read_text()
MS = 1_000_000


def protocol(bitrate: int = 500000) -> TrackEncoderProtocol:
    """The host's end."""
    config = EncodersConfig(
        port="can",
        dbc="tracks.dbc",
        bitrate=bitrate,  # type: ignore[arg-type]  # one of the four
        left="TRACKS.LEFT",
        right="TRACKS.RIGHT",
        left_metres_per_tick=1e-4,
        right_metres_per_tick=1e-4,
        latency_ms=(0.0, 4.0),
    )
    return TrackEncoderProtocol(config, TRACKS, 1.0)


def unit(**changes: object) -> TrackEncodersEmulator:
    """Tracks that run at 0.1 and -0.05 m/s."""
    return TrackEncodersEmulator(lambda t: (t / MS, -t / MS / 2), **changes)  # type: ignore[arg-type]


def converse(
    host: TrackEncoderProtocol, device: TrackEncodersEmulator, begin_ms: int, end_ms: int, deaf: bool = False
) -> list[WheelTicks]:
    """Mouth to mouth, a look every 5 ms. A deaf adapter sends nothing."""
    samples = []
    for t in range(begin_ms, end_ms, 5):
        if host.deadline_ns is not None and host.deadline_ns <= t * MS:
            host.advance(t * MS)
        device.receive_data(host.data_to_send(), t * MS)
        data = device.data_to_send(t * MS)
        samples += host.receive_data(b"" if deaf else data, t * MS)
    return samples


def test_the_rate_is_set_before_the_channel_is_opened() -> None:
    """And nothing is written but what the bus needs: no Z, which an adapter would store."""
    device, host, said = unit(), protocol(), b""
    host.connection_made(0)
    for t in range(0, 100, 5):
        command = host.data_to_send()
        said += command
        device.receive_data(command, t * MS)
        host.receive_data(device.data_to_send(t * MS), t * MS)
    assert said == b"\rC\rV\rN\rS6\rO\r"
    assert host.counts["opened"] == 1


@pytest.mark.parametrize(
    "before",
    [b"", b"O\r", b"S6\rO\r", b"S4\rO\r", b"S6\rO\rt18", b"S6\rO\rt1812AABB\r", b"Z1\rS6\rO\r", b"S8\rO\rS6\rC\rZ1\rS"],
)
def test_an_adapter_in_any_state_is_opened_at_the_right_rate(before: bytes) -> None:
    """Left open by a host that died, at another rate, in mid-command, stamping its frames."""
    device, host = unit(), protocol()
    device.receive_data(before, 0)
    device.data_to_send(0)
    host.connection_made(0)
    samples = converse(host, device, 5, 500)
    assert len(samples) > 40
    assert host.state == "open"
    assert host.counts["refused_commands"] == 0


def test_a_refused_bit_rate_does_not_go_unnoticed_and_disturbs_no_bus() -> None:
    """The bell leaves the channel shut; it is tried again after a second, and the state says what to do."""
    host = protocol()
    host.connection_made(0)
    said = host.data_to_send()
    host.receive_data(b"\rV1013\rNA123\r\a", MS)
    said += host.data_to_send()
    assert said == b"\rC\rV\rN\rS6\r" or said.startswith(b"\rC\rV\r")
    host.receive_data(b"\a", 2 * MS)
    assert b"O" not in said + host.data_to_send()
    assert host.counts["refused_commands"] == 1
    assert "refuses 500000 bit/s" in host.state
    assert host.deadline_ns is not None
    host.advance(host.deadline_ns)
    assert host.data_to_send() == b"\rC\rV\r"


def test_an_adapter_that_answers_nothing_is_opened_all_the_same() -> None:
    """Cheap ones do; each answer is waited for 0.2 s."""
    host = protocol()
    host.connection_made(0)
    said = host.data_to_send()
    for _ in range(4):
        assert host.deadline_ns is not None
        host.advance(host.deadline_ns)
        said += host.data_to_send()
    assert said == b"\rC\rV\rN\rS6\rO\r"
    assert (host.counts["unanswered_commands"], host.state) == (4, Step.OPEN.value)


def test_a_silent_bus_is_opened_again_within_a_second() -> None:
    """The controller switched itself off: its flags are asked for and counted, the channel is opened anew."""
    device, host = unit(), protocol()
    host.connection_made(0)
    before = converse(host, device, 0, 500)
    device.bus_off(500 * MS)
    before += converse(host, device, 500, 505)
    lost = converse(host, device, 505, 1400)
    after = converse(host, device, 1400, 2100)
    assert (len(before) > 40, lost, len(after) > 40) == (True, [], True)
    assert (host.counts["reopened"], host.counts["bus_errors"]) == (1, 1)
    assert after[0].epoch == before[-1].epoch + 1
    assert after[0].stamp.earliest_ns < 1600 * MS


def test_a_restarted_unit_begins_a_new_epoch() -> None:
    """Behind an adapter that stays open: its counts begin at zero."""
    device, host = unit(), protocol()
    host.connection_made(0)
    before = converse(host, device, 0, 500)
    device.restart_unit(500 * MS, 120 * MS)
    before += converse(host, device, 500, 505)
    after = converse(host, device, 505, 800)
    assert {s.epoch for s in before} == {0}
    assert {s.epoch for s in after} == {1}
    assert after[0].left == 0


def test_an_adapter_refuses_what_it_cannot_do() -> None:
    """The emulator answers as the manual of LAWICEL's adapter says."""
    device = unit(period_ns=10**15)
    asked = [
        b"O",
        b"C",
        b"S9",
        b"Z1",
        b"S6",
        b"O",
        b"O",
        b"S4",
        b"Z0",
        b"V",
        b"N",
        b"F",
        b"t1230",
        b"t1234",
        b"X",
        b"C",
    ]
    answers = []
    for command in asked:
        device.receive_data(command + b"\r", 1)
        answers.append(device.data_to_send(1))
    expected = [b"\a", b"\a", b"\a", b"\r", b"\r", b"\r", b"\a", b"\a", b"\a", b"V1013\r", b"NA123\r", b"F00\r", b"z\r"]
    assert answers == [*expected, b"\a", b"\a", b"\r"]


@pytest.fixture
def live(tmp_path: Path) -> Iterator[tuple[PseudoPort, TrackEncodersEmulator]]:
    """The emulated adapter on a pseudo-terminal, at work until the test is over."""
    port, device, over = PseudoPort(tmp_path / "can"), unit(), threading.Event()

    def run() -> None:
        t = 0
        while not over.wait(0.002):
            device.receive_data(port.read(), t)
            port.write(device.data_to_send(t))
            t += 10 * MS  # faster than real time

    thread = threading.Thread(target=run)
    thread.start()
    yield port, device
    over.set()
    thread.join()
    port.close()


def test_python_can_opens_the_emulated_adapter_and_reads_its_frames(
    live: tuple[PseudoPort, TrackEncodersEmulator],
) -> None:
    """Somebody else's client: the same counts, the version, the serial number, and thanks for what it sends."""
    port, _ = live
    with can.Bus(interface="slcan", channel=port.path, bitrate=500000, sleep_after_open=0.0) as bus:
        messages = [message for _ in range(30) if (message := bus.recv(2.0)) is not None]
        assert len(messages) > 20
        assert {(m.arbitration_id, m.dlc) for m in messages} == {(0x181, 4)}
        lefts = [int.from_bytes(m.data[:2], "little") for m in messages]
        assert {b - a for a, b in pairwise(lefts)} == {10}
        assert bus.get_version(2.0) == (10, 13)  # type: ignore[attr-defined]  # slcan's own
        assert bus.get_serial_number(2.0) == "A123"  # type: ignore[attr-defined]  # as above


frames = st.builds(
    lambda extended, can_id, remote, data: CanFrame(
        can_id if extended else can_id & 0x7FF, b"" if remote else data, len(data), extended, remote
    ),
    st.booleans(),
    st.integers(0, 0x1FFF_FFFF),
    st.booleans(),
    st.binary(max_size=8),
)


def test_python_can_and_we_write_and_read_the_same_lines(tmp_path: Path) -> None:
    """Both ways over a pseudo-terminal: what python-can sends we parse, what we serialise it receives."""
    port = PseudoPort(tmp_path / "can")
    with can.Bus(interface="slcan", channel=port.path, bitrate=500000, sleep_after_open=0.0) as bus:
        bus.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
        opening = b""
        while not opening.endswith(b"t7FF0\r"):
            opening += port.read()

        @given(frames)
        def same(frame: CanFrame) -> None:
            message = can.Message(
                arbitration_id=frame.can_id,
                is_extended_id=frame.extended,
                is_remote_frame=frame.remote,
                data=None if frame.remote else frame.data,
                dlc=frame.dlc,
            )
            bus.send(message)
            sent = b""
            while not sent.endswith(b"\r"):
                sent += port.read()
            assert parse_slcan(sent[:-1]) == frame
            port.write(serialise_slcan(frame))
            got = bus.recv(2.0)
            assert got is not None
            assert got.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)

        same()
    with contextlib.suppress(OSError):
        port.close()
