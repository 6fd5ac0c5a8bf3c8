"""Raw bytes of one device from a file, as JSON Lines: through the real command."""

import bz2
import gzip
import json
import lzma
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.gps_nmea.codec import serialise
from drivers.samples import Sample, WheelTicks
from drivers.sick_lms.telegrams import Command, request
from drivers.track_encoders.codec import parse_candump_line, serialise_slcan
from service.cli import run_command
from service.json_lines import sample_line
from service.passive import EncodersFile, GpsFile, ImuFile, LmsFile, encoders_config, gps_config, read_dbc
from service.shipped import shipped_config
from simulator.emulators.sick_lms import SickLmsEmulator
from simulator.emulators.track_encoders import tracks_frame

DBC = shipped_config("tracks.dbc")
TRACKS = ("--dbc", str(DBC), "--left", "TRACKS.LEFT", "--right", "TRACKS.RIGHT")
CAN_LOG = Path("can") / "css_canmod_drive_60FEB5A8.candump.log"
CAN_DBC = Path("can") / "css_canmod-gps.dbc"


Decode = Callable[..., tuple[list[dict[str, Any]], str]]


@pytest.fixture
def decode(capfd: pytest.CaptureFixture[str]) -> Decode:
    """Lines and counts of a run that must succeed."""

    def run(*arguments: object) -> tuple[list[dict[str, Any]], str]:
        assert run_command(["decode", *map(str, arguments)]) == 0
        output, counts = capfd.readouterr()
        return [json.loads(line) for line in output.splitlines()], counts

    return run


def count_of(name: str, counts: str) -> int:
    """A count in the line on stderr."""
    words = next(line for line in counts.splitlines() if line.startswith("counts: ")).split()[1:]
    return int(dict(word.split("=") for word in words).get(name, "0"))


def test_every_fix_of_a_recorded_receiver_comes_out(decode: Decode, recordings: Path) -> None:
    """ublox-8: 72 fixes, the first and last where the log's sentences say, stamped with their UTC."""
    fixes, counts = decode("gps", recordings / "nmea" / "ublox-8.log")
    assert len(fixes) == 72 == count_of("fixes", counts)
    assert (fixes[0]["lat_deg"], fixes[0]["lon_deg"]) == pytest.approx((44.0688978, -121.3142713), abs=5e-8)
    assert (fixes[-1]["lat_deg"], fixes[-1]["lon_deg"]) == pytest.approx((44.0690135, -121.3143157), abs=5e-8)
    assert fixes[0]["utc"] == "2017-01-10T00:09:41.000Z"
    assert fixes[0]["stamp_ns"] == 1_484_006_981_000_000_000
    assert set(fixes[0]) == {
        "kind", "stamp_ns", "utc", "lat_deg", "lon_deg", "alt_m", "quality", "hdop", "bound_m"
    }  # fmt: skip


def test_only_epochs_with_a_position_make_a_line(decode: Decode, recordings: Path) -> None:
    """haicom-305N has 68 fixes among 73 positions; all 40 of cat-ms352 are differential."""
    haicom, _ = decode("gps", recordings / "nmea" / "haicom-305N.log")
    assert len(haicom) == 68
    differential, _ = decode("gps", recordings / "nmea" / "cat-ms352.log")
    assert [fix["quality"] for fix in differential] == [2] * 40


def test_every_inertial_message_of_a_recorded_vehicle_comes_out(decode: Decode, recordings: Path) -> None:
    """5245 attitudes and 528 raw readings, at the board's own rising time, its axes turned into ours."""
    lines, counts = decode("imu", recordings / "mavlink" / "sub_small.serial.bin")
    assert Counter(line["message"] for line in lines) == {"ATTITUDE": 5245, "RAW_IMU": 528}
    assert count_of("frames", counts) == 35912
    assert count_of("reboots", counts) == 0
    raw = [line for line in lines if line["message"] == "RAW_IMU"]
    assert sum(line["accel_mps2"][2] for line in raw) == pytest.approx(527492 * 9.80665e-3)
    assert [line["stamp_ns"] for line in raw] == sorted(line["stamp_ns"] for line in raw)
    assert raw[0]["tilt_rad"] == [None, None]


def test_counters_come_out_of_a_candump_log_at_its_times(decode: Decode, recordings: Path) -> None:
    """The log's lines carry the time; both signals are read raw."""
    signals = ("--left", "gnss_odo.DistanceTrip", "--right", "gnss_odo.DistanceTotal")
    ticks, counts = decode("encoders", recordings / CAN_LOG, "--dbc", recordings / CAN_DBC, *signals)
    assert count_of("frames", counts) == 5477
    assert len(ticks) == 41
    assert ticks[0] == {"kind": "ticks", "stamp_ns": 1_627_276_800_472_100_000, "left": 40310, "right": 2118}
    assert ticks[-1]["left"] - ticks[0]["left"] == 269


def test_every_form_of_a_candump_log_is_read(decode: Decode, tmp_path: Path) -> None:
    """`candump -l` and `-L`, with and without direction; CAN FD lines are skipped and counted, dirt as well."""
    lines = [
        "(1627276800.100000) can0 181#01000200",
        "(1627276800.110000) can0 181#02000300 R",
        "(1627276800.120000) vcan0 181#03000400 T",
        "(1627276800.130000000) can0 181#04000500",
        "(1627276800.135000) can0 181##1AABBCCDD",
        "(1627276800.136000) can0 20000040#0000000000000000",
        "(1627276800.137000) can0 181#R4",
        "(1627276800.138000) can0 181#0102",
        "(1627276800.139000) can0 181#010",
        "garbage",
        "(1627276800.140000) can0 00000181#FFFFFFFF",
        "(1627276800.150000)  can0  181#05000600",
    ]
    for end in ("\n", "\r\n"):
        (tmp_path / "log").write_text(end.join(lines), newline="")
        ticks, counts = decode("encoders", tmp_path / "log", *TRACKS)
        assert [(line["left"], line["right"]) for line in ticks] == [(i, i + 1) for i in range(1, 6)]
        assert ticks[3]["stamp_ns"] == 1_627_276_800_130_000_000
        told = ("fd_frames", "error_frames", "remote_frames", "bad_length", "bad_lines", "other_frames")
        assert [count_of(name, counts) for name in told] == [1, 1, 1, 1, 2, 1]


@pytest.mark.parametrize(("mark", "end"), [(b"\xef\xbb\xbf", b"\r\n"), (b"", b"\r"), (b"", b"\r\r\n")])
def test_a_log_that_went_through_an_editor_loses_no_line(
    mark: bytes, end: bytes, decode: Decode, tmp_path: Path
) -> None:
    """Notepad's mark stands before the first line; other programs end lines in other ways."""
    lines = [b"(1627276800.1%d0000) can0 181#0%d000200" % (n, n) for n in range(5)]
    (tmp_path / "log").write_bytes(mark + end.join(lines))
    (tmp_path / "dbc").write_bytes(b"\xef\xbb\xbf" + DBC.read_bytes())
    ticks, counts = decode("encoders", tmp_path / "log", "--dbc", tmp_path / "dbc", *TRACKS[2:])
    assert ([tick["left"] for tick in ticks], count_of("bad_lines", counts)) == ([0, 1, 2, 3, 4], 0)


def test_a_log_through_a_pipe_is_recognised_by_its_first_line_not_by_its_first_bytes() -> None:
    """A read may give any part of a line; slcan text is told apart as well."""
    shown = b"\xef\xbb\xbf" + b"".join(b"  can0  181   [4]  0%d 00 02 00\n" % n for n in range(5))
    slcan = b"\r" + b"".join(serialise_slcan(tracks_frame(n, 2)) for n in range(5))
    for data in (shown, slcan, shown[:-1], slcan[:-1]):
        file = EncodersFile(encoders_config("TRACKS.LEFT", "TRACKS.RIGHT"), read_dbc(DBC))
        got = [ticks for n in range(len(data)) for _, ticks in file.receive_data(data[n : n + 1])]
        got += [ticks for _, ticks in file.finish()]
        expected = 4 if data == slcan[:-1] else 5
        assert [ticks.left for ticks in got if isinstance(ticks, WheelTicks)] == list(range(expected))


@pytest.mark.parametrize(
    ("line", "stamp_ns"),
    [
        ("  can0  181   [4]  {bytes}", 0),  # as candump shows it
        (" (1700000000.000001)  can0  181   [4]  {bytes}", 1_700_000_000_000_001_000),  # -t a
        (" (000.020000)  vcan10  181   [4]  {bytes}   '........'", 20_000_000),  # -t z -a
        (" (2026-11-26 07:00:00.000000)  can0  181   [4]  {bytes}", 0),  # -t A: no time is made of a date
        (" (1700000000.000001)  can0  RX - -  181   [4]  {bytes}", 1_700_000_000_000_001_000),  # -t a -x
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_what_candump_shows_is_read_like_its_log(
    line: str, stamp_ns: int, end: str, decode: Decode, tmp_path: Path
) -> None:
    """What somebody copied from a terminal: the counters of every frame, and its time where there is one."""
    frames = [tracks_frame(count, -count) for count in range(3)]
    text = [line.format(bytes=frame.data.hex(" ").upper()) + end for frame in frames]
    (tmp_path / "log").write_text("".join(text), newline="")
    ticks, counts = decode("encoders", tmp_path / "log", *TRACKS)
    assert [(tick["left"], tick["right"]) for tick in ticks] == [(0, 0), (1, -1), (2, -2)]
    assert {tick["stamp_ns"] for tick in ticks} == {stamp_ns}
    assert count_of("frames", counts) == 3


@pytest.mark.parametrize(
    "line",
    [
        "  can0  123   [8]  01 02",  # cut off
        "  can0  123  [12]  00 11 22 33 44 55 66 77 88 99 AA BB",  # CAN FD
        "  can0  123   [9]  01 02 03 04 05 06 07 08 09",
        "  can0   [8]  01 02 03 04 05 06 07 08",
    ],
)
def test_of_a_line_that_holds_no_whole_frame_nothing_is_made(line: str) -> None:
    """Neither of one that was cut off while it was copied."""
    assert parse_candump_line(line) is None


def test_sentences_without_a_checksum_are_told_as_such(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """They are not believed, and the words say why."""
    text = serialise("GPGGA,235960.00,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,").split(b"*")[0]
    (tmp_path / "log").write_bytes(10 * (text + b"\r\n"))
    assert run_command(["decode", "gps", str(tmp_path / "log")]) == 1
    assert "have no checksum" in capfd.readouterr().err


def test_slcan_bytes_are_recognised_and_unwrapped(decode: Decode, tmp_path: Path) -> None:
    """Counters of 16 bits go on beyond 65535; a file of slcan text has no times."""
    bytes_ = b"".join(serialise_slcan(tracks_frame(65530 + 4 * i, 2 * i)) for i in range(10))
    (tmp_path / "tracks.slcan").write_bytes(b"\r\r" + bytes_)
    ticks, _ = decode("encoders", tmp_path / "tracks.slcan", *TRACKS)
    assert [(line["left"], line["right"]) for line in ticks] == [(65530 + 4 * i, 2 * i) for i in range(10)]
    assert {line["stamp_ns"] for line in ticks} == {0}


def test_scans_come_out_of_the_scanners_bytes(decode: Decode, tmp_path: Path) -> None:
    """A beam without distance is null; a file has no times."""
    (tmp_path / "scans").write_bytes(scanner_bytes())
    lines, counts = decode("lms", tmp_path / "scans")
    assert count_of("scans", counts) == len(lines) == 3
    for line in lines:
        assert set(line) == {"kind", "stamp_ns", "angle_min_rad", "angle_increment_rad", "ranges_m", "status"}
        assert line["ranges_m"] == [None if beam % 10 == 0 else 2.5 for beam in range(361)]
        assert (line["kind"], line["stamp_ns"], line["status"]) == ("scan", 0, 16)


def test_the_cut_of_the_chunks_changes_nothing(recordings: Path) -> None:
    """Byte by byte or whole, every decoder gives the same lines."""
    nmea = (recordings / "nmea" / "ublox-8.log").read_bytes()[:12000]
    mavlink = (recordings / "mavlink" / "sub_small.serial.bin").read_bytes()[:60000]
    log = (recordings / CAN_LOG).read_bytes()[:30000].rstrip(b"\n")  # the last line's end is missing
    odometer = encoders_config("gnss_imu.AccelerationX", "gnss_imu.AccelerationY")
    for make, data in (
        (lambda: GpsFile(gps_config(5.0, 5.0)), nmea),
        (ImuFile, mavlink),
        (lambda: EncodersFile(odometer, read_dbc(recordings / CAN_DBC)), log),
        (LmsFile, scanner_bytes()),
    ):
        whole, pieces = make(), make()
        expected = told([*whole.receive_data(data), *whole.finish()])
        step = 17
        got = [timed for i in range(0, len(data), step) for timed in pieces.receive_data(data[i : i + step])]
        assert told([*got, *pieces.finish()]) == expected != []
        assert pieces.counts == whole.counts


def test_the_last_epoch_of_a_file_is_not_forgotten(decode: Decode, tmp_path: Path) -> None:
    """A single sentence is an epoch; a leap second is the next minute's first."""
    sentence = serialise("GPGGA,235960.00,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,")
    date = serialise("GPRMC,235960.00,A,4807.038,N,01131.000,E,0.0,0.0,311216,,,A")
    (tmp_path / "dated").write_bytes(date + sentence)
    (tmp_path / "undated").write_bytes(sentence)
    (fix,), _ = decode("gps", tmp_path / "dated")
    assert fix["stamp_ns"] == 1_483_228_800_000_000_000
    (undated,), _ = decode("gps", tmp_path / "undated")
    assert (undated["utc"], undated["stamp_ns"]) == (None, 0)


def test_dirt_from_standard_input_is_counted_and_hinted_at() -> None:
    """Bytes of something else make no line: the count, a hint, and 1."""
    command = [sys.executable, "-m", "service.cli", "decode", "gps", "-"]
    done = subprocess.run(command, input=bytes(range(256)) * 100, capture_output=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (1, b"")
    assert count_of("bytes", done.stderr.decode()) == 25600
    assert b"are they of this device?" in done.stderr


def test_a_reader_that_leaves_ends_it_quietly(tmp_path: Path) -> None:
    """`| head -1` is no error."""
    (tmp_path / "long").write_bytes(b"".join(serialise_slcan(tracks_frame(i, i)) for i in range(200_000)))
    read_end, write_end = os.pipe()
    command = [sys.executable, "-m", "service.cli", "decode", "encoders", str(tmp_path / "long"), *TRACKS]
    with subprocess.Popen(command, stdout=write_end, stderr=subprocess.PIPE) as process:
        os.close(write_end)
        assert os.read(read_end, 10)
        os.close(read_end)
        _, complaint = process.communicate(timeout=60)
    assert process.returncode == 0
    assert b"Traceback" not in complaint
    assert b"Exception" not in complaint


def told(samples: list[tuple[int, Sample]]) -> list[str]:
    """Their lines."""
    return [sample_line(sample, stamp_ns) for stamp_ns, sample in samples]


def scanner_bytes() -> bytes:
    """Three scans as an emulated scanner answers single requests; each tenth beam hits nothing."""
    emulator = SickLmsEmulator(lambda times, angles: np.where(np.arange(len(angles)) % 10 == 0, np.inf, 2.5))
    data, now_ns = b"", 0
    for step in range(60):
        now_ns += 100_000_000
        if step in (10, 20, 30):
            emulator.receive_data(request(bytes((Command.SCAN, 1))), now_ns)
        sent = emulator.data_to_send(now_ns)
        data += sent if step > 9 else b""
    return data


@pytest.mark.parametrize(
    ("written", "told"),
    [
        pytest.param(gzip.compress(bytes(1000), mtime=0), "gzip -dc FILE", id="gzip"),
        pytest.param(bz2.compress(bytes(1000)), "bzip2 -dc FILE", id="bzip2"),
        pytest.param(lzma.compress(bytes(1000)), "xz -dc FILE", id="xz"),
        pytest.param(b"PK\x03\x04" + bytes(100), "unzip -p FILE", id="zip"),
        pytest.param(b"\x89MCAP0\r\n" + bytes(3), "replay", id="mcap"),
        pytest.param(b"LOGG" + bytes(140), "can.logconvert", id="blf"),
        pytest.param(
            b"date Thu Nov 26 06:39:47.000 am 2026\nbase hex  timestamps absolute\n", "can.logconvert", id="asc"
        ),
        pytest.param(bytes.fromhex("d4c3b2a1020004000000000000000000ffff000001000000"), "packet capture", id="pcap"),
        pytest.param(b"", "is empty", id="empty"),
    ],
)
def test_files_that_are_no_raw_bytes_are_told_from_dirt(
    written: bytes, told: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A compressed log, a capture, other people's logs, nothing at all: what to do with it, and 1."""
    (tmp_path / "log").write_bytes(written)
    assert run_command(["decode", "gps", str(tmp_path / "log")]) == 1
    output, said = capfd.readouterr()
    assert (output, told in said) == ("", True), said


def test_a_receiver_without_satellites_is_not_taken_for_dirt(decode: Decode, tmp_path: Path) -> None:
    """Its sentences are intact, none makes a line, and that is what is said."""
    (tmp_path / "indoors").write_bytes(b"".join(serialise(f"GPGGA,12000{s}.00,,,,,0,00,99.99,,,,,,") for s in range(9)))
    lines, said = decode("gps", tmp_path / "indoors")
    assert (lines, count_of("no_fix", said)) == ([], 9)
    assert "understood, but nothing in it makes a line" in said


def test_a_sentence_that_noise_made_by_chance_is_no_receiver(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """One in 256 of them has its checksum: that is not "understood", and ends with 1."""
    noise = b"".join(b"$GP%03d,*%02X\r\n" % (n, n) for n in range(256))
    (tmp_path / "noise").write_bytes(noise)
    assert run_command(["decode", "gps", str(tmp_path / "noise")]) == 1
    said = capfd.readouterr().err
    assert count_of("sentences", said) < 5 < count_of("bad_checksum", said)


def test_standard_input_that_is_closed_is_told() -> None:
    """As of a service without one."""
    command = f"{sys.executable} -m service.cli decode gps - <&-"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, "standard input is closed" in done.stderr) == (1, True), done.stderr
