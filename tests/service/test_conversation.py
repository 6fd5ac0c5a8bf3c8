"""Where a protocol meets what its port gave."""

from drivers.clock import SystemClock
from drivers.gps_nmea.protocol import GpsProtocol
from drivers.record_pipe import LOST, NOT_STAMPED, OPENED, Record
from drivers.samples import Fix
from drivers.transports import open_serial
from service.config import load
from service.conversation import Conversation
from service.devices import Device
from service.health import Health
from service.reader import Request
from service.sample_queue import SampleQueue
from service.shipped import shipped_config

S = 1_000_000_000


def gga(second: int) -> bytes:
    """A whole sentence, all but its second the same."""
    words = f"GNGGA,1200{second:02d}.00,4800.0000,N,01100.0000,E,4,12,0.7,500.0,M,45.0,M,1.0,0000"
    checksum = 0
    for letter in words.encode():
        checksum ^= letter
    return f"${words}*{checksum:02X}\r\n".encode()


def test_where_the_pipe_was_full_nothing_on_both_sides_is_taken_for_one_frame() -> None:
    """Lost bytes are counted; two halves make no fix, the whole sentences before and after do."""
    asked: list[Request] = []
    queue, health = SampleQueue(), Health()
    config = load(shipped_config("demo.toml")).config.devices.gps
    assert config is not None
    device = Device("gps", "gps", lambda: open_serial("gps", 115200), lambda: GpsProtocol(config), 2.0)
    conversation = Conversation(device, SystemClock(), queue, health, asked.append)
    now_ns = SystemClock().now_ns() - 100 * S

    def happens(size: int, data: bytes = b"", lost: int = 0) -> None:
        nonlocal now_ns
        now_ns += S
        conversation.take(Record(0, 1, size, now_ns, now_ns - 1000, NOT_STAMPED, lost, data))

    happens(OPENED)
    for second in range(3):
        happens(len(gga(second)), gga(second))
    torn = gga(3)[:40], gga(3)[40:]  # as if of two sentences: what lay between them is lost
    happens(40, torn[0])
    happens(LOST, lost=77)
    happens(len(torn[1]), torn[1])
    for second in range(5, 8):
        happens(len(gga(second)), gga(second))
    fixes = [arrival.sample for arrival in queue.take(0)]
    assert all(isinstance(fix, Fix) for fix in fixes)
    assert len(fixes) == 6
    assert conversation.protocol.counts["lost_bytes"] == 77
