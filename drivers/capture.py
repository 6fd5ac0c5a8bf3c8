"""Record and replay a drive: the bytes exactly as each read gave them, in one MCAP file.

A channel per device, topic `/raw/<device>`. Each message is one read: `log_time` is the host's wall clock, for people
and viewers; `publish_time` its monotonic clock at receipt, the only time that replay uses. Empty messages of
`/deadline/<device>` say where a deadline of the driver passed: that changes what it makes of the bytes that follow.
Messages of `/late/<device>` say how late the next read of the device may have come (8 bytes, nanoseconds, little
endian). The configuration's text is the metadata record `terrabound.config`, and comes first, so that even the head of
a broken file replays alone.
"""

import contextlib
import os
import struct
import threading
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from drivers.errors import CaptureError

CONFIG_RECORD = "terrabound.config"
CONFIG_KEY = "toml"
DBC_KEY = "dbc"
RAW_TOPIC = "/raw/"
DEADLINE_TOPIC = "/deadline/"
LATE_TOPIC = "/late/"
BYTES_ENCODING = "application/octet-stream"
CAN_ENCODING = "application/x-can-frame"

_LATE = struct.Struct("<Q")
_MAGIC = b"\x89MCAP0\r\n"
_CHUNK_BYTES = 64 * 1024
_FLUSH_NS = 250_000_000
"""A crash loses no more than this much of the drive."""
_RECORD_LIMIT_BYTES = 64 * 1024 * 1024
"""No record of ours comes near; a length beyond it is damage."""
_DAMAGE = (
    McapError,
    struct.error,
    ValueError,
    KeyError,
    RuntimeError,
    MemoryError,
    AssertionError,
    zstandard.ZstdError,
)
"""What the reader raises where a file is cut or its bytes are wrong."""


@dataclass(frozen=True, slots=True)
class RawChunk:
    """What one read gave."""

    device: str
    data: bytes
    stamp_ns: int
    """Monotonic time of the read on the machine that recorded."""
    deadline: bool = False
    """No read at all (and no bytes): the driver was told that its deadline had passed."""
    late_ns: int = 0
    """So much longer than usual its bytes may have lain in the port before the read."""


class CaptureWriter:
    """Writes a capture; any number of threads may call `write`."""

    def __init__(
        self, path: Path | str, config_text: str, dbc_text: str = "", can_frames: Collection[str] = ()
    ) -> None:
        """Begin the file, which must not exist yet. Devices in `can_frames` give `struct can_frame` records.

        `dbc_text` is the encoders' DBC file, so that the recording replays alone.
        """
        self.path = Path(path)
        self._can_frames = frozenset(can_frames)
        self._lock = threading.Lock()
        self._channels: dict[str, int] = {}
        self._sequences: dict[str, int] = {}
        self._flushed_ns: int | None = None
        self._closed = False
        self._ended = f"{self.path}: this recording has ended; begin another file"
        """What is said of bytes that come after the end: of all threads that write, each is told why it came."""
        try:
            self._file: IO[bytes] = self.path.open("xb")
        except FileExistsError as error:
            raise CaptureError(
                f"{path}: exists already, and a recording is never overwritten; name another file"
            ) from error
        except OSError as error:
            raise CaptureError(
                f"{path}: can't record there ({error.strerror}); name a file in a writable folder"
            ) from error
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        try:
            self._writer.start(profile="", library="terrabound")
            self._writer.add_metadata(CONFIG_RECORD, {CONFIG_KEY: config_text, DBC_KEY: dbc_text})
            self._writer.flush()  # type: ignore[no-untyped-call]  # mcap leaves it so
        except OSError as error:
            raise self._failed(error) from error

    def write(self, device: str, data: bytes, monotonic_ns: int, wall_ns: int, late_ns: int = 0) -> None:
        """Record one read of `device`. CaptureError when the disk refuses; nothing more is recorded after that."""
        encoding = CAN_ENCODING if device in self._can_frames else BYTES_ENCODING
        if late_ns:
            self._write(LATE_TOPIC + device, BYTES_ENCODING, _LATE.pack(late_ns), monotonic_ns, wall_ns)
        self._write(RAW_TOPIC + device, encoding, data, monotonic_ns, wall_ns)

    def write_deadline(self, device: str, monotonic_ns: int, wall_ns: int) -> None:
        """Record that the driver of `device` was told that its deadline had passed. CaptureError as of `write`."""
        self._write(DEADLINE_TOPIC + device, BYTES_ENCODING, b"", monotonic_ns, wall_ns)

    def _write(self, topic: str, encoding: str, data: bytes, monotonic_ns: int, wall_ns: int) -> None:
        with self._lock:
            if self._closed:
                raise CaptureError(self._ended)
            channel = self._channels.get(topic)
            if channel is None:
                channel = self._channels[topic] = self._writer.register_channel(topic, encoding, schema_id=0)
            sequence = self._sequences.get(topic, 0)
            self._sequences[topic] = sequence + 1
            if self._flushed_ns is None:
                self._flushed_ns = monotonic_ns
            try:
                self._writer.add_message(
                    channel, log_time=wall_ns, data=data, publish_time=monotonic_ns, sequence=sequence & 0xFFFF_FFFF
                )
                if monotonic_ns - self._flushed_ns >= _FLUSH_NS:
                    self._writer.flush()  # type: ignore[no-untyped-call]  # mcap leaves it so
                    self._flushed_ns = monotonic_ns
            except OSError as error:
                raise self._failed(error) from error

    def close(self) -> None:
        """Write what is left and the index, and put it all on the disk; any number of times."""
        with self._lock:
            if self._closed:
                return
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]  # as above
                self._file.flush()
                os.fsync(self._file.fileno())
            except OSError as error:
                raise self._failed(error) from error
            self._closed = True
            self._file.close()

    def _failed(self, error: OSError) -> CaptureError:
        """Stop recording: after half a record, what follows could not be read."""
        self._closed = True
        with contextlib.suppress(OSError):  # the same trouble again
            self._file.close()
        self._ended = f"{self.path}: recording stopped ({error.strerror}); what came before it replays. Make room"
        return CaptureError(self._ended)


class Capture:
    """A recording; iterate over it as often as you like. Whatever is whole before a cut is given."""

    def __init__(self, path: Path, config_text: str, dbc_text: str, truncated: bool) -> None:
        """Use `read_capture`."""
        self.path = path
        self.config_text = config_text
        """The configuration it was recorded with; empty where the file holds none."""
        self.dbc_text = dbc_text
        """The encoders' DBC file, likewise."""
        self.truncated = truncated
        """Is the end missing? Damage further in is known once the iteration has come to it."""

    def __iter__(self) -> Iterator[RawChunk]:
        """Every read and every deadline of every device, in the order recorded."""
        devices: dict[int, tuple[str, str]] = {}
        late_ns: dict[str, int] = {}
        with self.path.open("rb") as file:
            records = self._whole_records(file)
            for record in records:
                if isinstance(record, Channel):
                    for prefix in (RAW_TOPIC, DEADLINE_TOPIC, LATE_TOPIC):
                        if record.topic.startswith(prefix):
                            devices[record.id] = prefix, record.topic.removeprefix(prefix)
                elif isinstance(record, Message) and (source := devices.get(record.channel_id)) is not None:
                    topic, device = source
                    if topic == LATE_TOPIC:
                        late_ns[device] = int.from_bytes(record.data[: _LATE.size], "little")
                    elif topic == DEADLINE_TOPIC:
                        yield RawChunk(device, b"", record.publish_time, deadline=True)
                    else:
                        yield RawChunk(device, record.data, record.publish_time, late_ns=late_ns.pop(device, 0))

    def _whole_records(self, file: IO[bytes]) -> Iterator[McapRecord]:
        reader = StreamReader(file, emit_chunks=True, record_size_limit=_RECORD_LIMIT_BYTES)
        try:
            for record in reader.records:
                if isinstance(record, Chunk):
                    _refuse_bomb(record)
                    yield from breakup_chunk(record, validate_crc=True)
                else:
                    yield record
        except _DAMAGE:
            self.truncated = True


def read_capture(path: Path | str) -> Capture:
    """Open a recording, whole or cut short. CaptureError where it is none."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(len(_MAGIC))
            file.seek(0, os.SEEK_END)
            size = file.tell()
            file.seek(max(0, size - len(_MAGIC)))
            whole = size > len(_MAGIC) and file.read() == _MAGIC
            if head != _MAGIC:
                found = "is empty" if not head else f"begins with {head!r}"
                raise CaptureError(
                    f"{path}: not an MCAP recording (it {found}); give a file that `terrabound record` wrote"
                )
            file.seek(0)
            config = _config(file)
    except OSError as error:
        raise CaptureError(
            f"{path}: can't be read ({error.strerror}); check the file's name and permissions"
        ) from error
    return Capture(path, config.get(CONFIG_KEY, ""), config.get(DBC_KEY, ""), truncated=not whole)


def _refuse_bomb(chunk: Chunk) -> None:
    """A few kilobytes can unpack to gigabytes: what a compressed chunk says of its own size decides, not the record."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        size = max(size, zstandard.frame_content_size(chunk.data))
    elif chunk.compression:
        raise ValueError(f"compression {chunk.compression!r} is not ours")
    if size > _RECORD_LIMIT_BYTES:
        raise ValueError(f"a chunk of {size} bytes")


def _config(file: IO[bytes]) -> dict[str, str]:
    """The configuration's record; found at once in our own files, and wherever it is in others'."""
    try:
        for record in StreamReader(file, emit_chunks=True, record_size_limit=_RECORD_LIMIT_BYTES).records:
            if isinstance(record, Metadata) and record.name == CONFIG_RECORD:
                return record.metadata
    except _DAMAGE:
        pass  # cut before it was written
    return {}
