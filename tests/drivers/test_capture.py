"""A recorded drive comes back byte for byte, from a whole file and from the head of a broken one."""

import os
import threading
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from drivers.capture import CaptureWriter, RawChunk, read_capture
from drivers.errors import CaptureError

CONFIG = '[robot]\nname = "γ 1"\n'


def some_chunks(n: int) -> list[RawChunk]:
    """`n` reads of three devices, 3 ms apart, some of them empty, some of them late."""
    return [
        RawChunk(("laser", "imu", "gps")[i % 3], os.urandom(i % 97), 1_000 + 3_000_000 * i, late_ns=i % 7 * 1_000_000)
        for i in range(n)
    ]


def record(path: Path, chunks: list[RawChunk]) -> CaptureWriter:
    """A recording of `chunks`, not closed."""
    writer = CaptureWriter(path, CONFIG)
    for chunk in chunks:
        wall_ns = 1_700_000_000_000_000_000 + chunk.stamp_ns
        writer.write(chunk.device, chunk.data, chunk.stamp_ns, wall_ns, chunk.late_ns)
    return writer


def test_everything_comes_back_in_order(tmp_path: Path) -> None:
    """Device, bytes, stamp and configuration survive the file."""
    chunks = some_chunks(1000)
    record(tmp_path / "a.mcap", chunks).close()
    capture = read_capture(tmp_path / "a.mcap")
    assert list(capture) == chunks
    assert list(capture) == chunks
    assert capture.config_text == CONFIG
    assert not capture.truncated


def test_other_tools_read_it(tmp_path: Path) -> None:
    """The file is plain MCAP, with the topics, encodings and times promised."""
    writer = CaptureWriter(tmp_path / "a.mcap", CONFIG, can_frames={"encoders"})
    writer.write("encoders", bytes(16), 5, 1_700_000_000_000_000_000)
    writer.write("imu", b"\xfd", 6, 1_700_000_000_000_000_001)
    writer.close()
    with (tmp_path / "a.mcap").open("rb") as file:
        seen = [
            (channel.topic, channel.message_encoding, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(file).iter_messages()
        ]
    assert seen == [
        ("/raw/encoders", "application/x-can-frame", 1_700_000_000_000_000_000, 5, bytes(16)),
        ("/raw/imu", "application/octet-stream", 1_700_000_000_000_000_001, 6, b"\xfd"),
    ]


def test_file_cut_anywhere_replays_what_is_whole_before_the_cut(tmp_path: Path) -> None:
    """At every cut: no exception, a beginning of the truth, and never less than an earlier cut gave."""
    chunks = some_chunks(400)
    record(tmp_path / "a.mcap", chunks).close()
    whole = (tmp_path / "a.mcap").read_bytes()
    longest = 0
    for cut in range(8, len(whole), 37):
        (tmp_path / "cut.mcap").write_bytes(whole[:cut])
        capture = read_capture(tmp_path / "cut.mcap")
        got = list(capture)
        assert capture.truncated
        assert got == chunks[: len(got)]
        assert len(got) >= longest
        assert capture.config_text in (CONFIG, "")
        longest = len(got)
    assert longest == len(chunks)


def test_process_that_dies_loses_only_its_last_moments(tmp_path: Path) -> None:
    """Without `close`, all but the last quarter of a second is in the file, and the configuration too."""
    chunks = some_chunks(1000)
    writer = record(tmp_path / "a.mcap", chunks)
    capture = read_capture(tmp_path / "a.mcap")
    got = list(capture)
    assert capture.truncated
    assert capture.config_text == CONFIG
    assert got == chunks[: len(got)]
    assert chunks[-1].stamp_ns - got[-1].stamp_ns < 250_000_000
    writer.close()


def test_damage_inside_stops_the_replay_there(tmp_path: Path) -> None:
    """A flipped bit never changes what is replayed: it ends it, and says so."""
    chunks = some_chunks(400)
    record(tmp_path / "a.mcap", chunks).close()
    content = bytearray((tmp_path / "a.mcap").read_bytes())
    content[len(content) // 2] ^= 0x10
    (tmp_path / "bad.mcap").write_bytes(content)
    capture = read_capture(tmp_path / "bad.mcap")
    got = list(capture)
    assert got == chunks[: len(got)]
    assert 0 < len(got) < len(chunks)
    assert capture.truncated


def test_a_chunk_that_would_fill_the_memory_is_damage(tmp_path: Path) -> None:
    """A small file that unpacks to 100 MB is not unpacked; what stands before it is replayed."""
    with (tmp_path / "bomb.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/raw/imu", "application/octet-stream", 0)
        writer.add_message(channel, 1, b"good", 1)
        writer.flush()  # type: ignore[no-untyped-call]
        writer.add_message(channel, 2, bytes(100_000_000), 2)
        writer.finish()  # type: ignore[no-untyped-call]
    assert (tmp_path / "bomb.mcap").stat().st_size < 100_000
    capture = read_capture(tmp_path / "bomb.mcap")
    assert [chunk.data for chunk in capture] == [b"good"]
    assert capture.truncated


def test_threads_may_write_at_once(tmp_path: Path) -> None:
    """Each device's reads keep their order and none is lost."""
    writer = CaptureWriter(tmp_path / "a.mcap", CONFIG)

    def write(device: str) -> None:
        for i in range(500):
            writer.write(device, i.to_bytes(2, "big"), i, i)

    threads = [threading.Thread(target=write, args=(name,)) for name in ("laser", "imu", "gps")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    writer.close()
    got = list(read_capture(tmp_path / "a.mcap"))
    for name in ("laser", "imu", "gps"):
        assert [c.stamp_ns for c in got if c.device == name] == list(range(500))


def test_recording_is_never_overwritten(tmp_path: Path) -> None:
    """A drive can't be repeated: an existing file is left alone."""
    record(tmp_path / "a.mcap", some_chunks(3)).close()
    with pytest.raises(CaptureError, match="name another file"):
        CaptureWriter(tmp_path / "a.mcap", CONFIG)
    assert len(list(read_capture(tmp_path / "a.mcap"))) == 3


def test_writing_after_the_end_is_refused(tmp_path: Path) -> None:
    """A closed recording says that it has ended; closing twice is fine."""
    writer = record(tmp_path / "a.mcap", [])
    writer.close()
    writer.close()
    with pytest.raises(CaptureError, match="ended"):
        writer.write("imu", b"x", 1, 1)


def test_every_thread_is_told_why_the_recording_stopped(tmp_path: Path) -> None:
    """On a full disk the laser's thread and the GPS's get the same words: whichever is told last names the disk."""
    writer = CaptureWriter(tmp_path / "a.mcap", CONFIG)
    with Path("/dev/full").open("wb") as full:
        os.dup2(full.fileno(), writer._file.fileno())  # the disk has no more room from now on
    told = []
    for device in ("laser", "gps", "laser"):
        with pytest.raises(CaptureError, match="No space left") as refused:
            writer.write(device, os.urandom(200_000), 1, 1)
        told.append(str(refused.value))
    assert len(set(told)) == 1
    assert told[0].endswith("Make room")


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    """Missing, empty and foreign files are each told apart in the text."""
    with pytest.raises(CaptureError, match="No such file"):
        read_capture(tmp_path / "none.mcap")
    (tmp_path / "empty.mcap").write_bytes(b"")
    with pytest.raises(CaptureError, match="is empty"):
        read_capture(tmp_path / "empty.mcap")
    (tmp_path / "text.mcap").write_text("$GPGGA,hello")
    with pytest.raises(CaptureError, match="not an MCAP recording"):
        read_capture(tmp_path / "text.mcap")
    with pytest.raises(CaptureError, match="can't record there"):
        CaptureWriter(tmp_path / "no" / "such" / "folder.mcap", CONFIG)
