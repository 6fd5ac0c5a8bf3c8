"""The encoders' wire for the benches: slcan lines of a busy bus, and the driver that reads them."""

import re
from collections.abc import Callable, Hashable, Mapping
from random import Random

from drivers.config import EncodersConfig
from drivers.samples import WheelTicks
from drivers.track_encoders.codec import CanFrame, serialise_slcan
from drivers.track_encoders.protocol import TrackEncoderProtocol
from service.shipped import shipped_config
from simulator.emulators.track_encoders import TRACKS_ID, tracks_frame

MS = 1_000_000
_TRACKS_LINE = re.compile(rb"t%03X4([0-9A-Fa-f]{8})(?:[0-9A-Fa-f]{4}){0,2}[\r\a]" % TRACKS_ID)
"""As an adapter may write it that stamps its frames."""
FOREIGN_FRAMES = 9
"""Between two messages of the counters: a bus of 1000 frames a second."""
MOST_TICKS = 6
"""Between two messages."""


def lines(seed: int, count: int) -> list[tuple[bytes, Hashable]]:
    """TRACKS messages, each with its counts; they run over the wrap, and never stand still."""
    random = Random(seed)
    left, right = 0xFFFF - 100, 100
    frames: list[tuple[bytes, Hashable]] = []
    for _ in range(count):
        left, right = left + random.randint(1, MOST_TICKS), right - random.randint(1, MOST_TICKS)
        frames.append((serialise_slcan(tracks_frame(left, right)), (left & 0xFFFF, right & 0xFFFF)))
    return frames


def busy_lines(seed: int, count: int) -> bytes:
    """`count` TRACKS messages among those of others."""
    random = Random(seed)
    stream = b""
    for line, _ in lines(seed, count):
        others = [CanFrame(random.randint(0x200, 0x7FF), random.randbytes(8)) for _ in range(FOREIGN_FRAMES)]
        stream += line + b"".join(map(serialise_slcan, others))
    return stream


def protocol(interface: str = "slcan") -> TrackEncoderProtocol:
    """A driver that knows the robot's speed."""
    config = EncodersConfig(
        port="",
        interface=interface,  # type: ignore[arg-type]  # one of the two
        dbc="",
        left="TRACKS.LEFT",
        right="TRACKS.RIGHT",
        left_metres_per_tick=0.0002,
        right_metres_per_tick=0.0002,
        latency_ms=(0.0, 10.0),
    )
    return TrackEncoderProtocol(config, shipped_config("tracks.dbc").read_text(), max_track_mps=1.5)


def driver() -> Callable[[bytes], list[Hashable]]:
    """A new one: bytes of a read in, the counts that they complete out. A read comes every 10 ms."""
    host, now_ns = protocol(), 0

    def receive(data: bytes) -> list[Hashable]:
        nonlocal now_ns
        now_ns += 10 * MS
        return [counts(ticks) for ticks in host.receive_data(data, now_ns)]

    return receive


def counts(ticks: WheelTicks) -> Hashable:
    """As the message had them."""
    return ticks.left & 0xFFFF, ticks.right & 0xFFFF


def unseen(stream: bytes, sent: Mapping[bytes, Hashable]) -> set[Hashable]:
    """Counts that were never sent, in lines that look like a message of the counters: slcan has no checksum."""
    pairs = (bytes.fromhex(digits.decode()) for digits in _TRACKS_LINE.findall(stream))
    found: set[Hashable] = {(int.from_bytes(p[:2], "little"), int.from_bytes(p[2:], "little")) for p in pairs}
    return found - set(sent.values())
