"""GPS sentences: one bounded fix an epoch, promptly, and nothing from what is wrong, old or made up."""

from datetime import UTC, datetime
from itertools import pairwise
from math import isfinite
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pynmeagps import VALCKSUM, NMEAReader

from drivers.config import GpsConfig
from drivers.gps_nmea.codec import (
    SENTENCE,
    Calendar,
    ErrorEstimate,
    Position,
    TimeOfDay,
    checksum,
    parse_content,
    serialise,
    serialise_gga,
    serialise_gst,
    serialise_rmc,
)
from drivers.gps_nmea.protocol import GpsProtocol
from drivers.samples import Fix, Stamp
from simulator.emulators.gps import GpsEmulator

MS = 1_000_000
GGA = "GNGGA,{time},4404.13387,N,12118.85628,W,{quality},12,{hdop},1144.8,M,{separation},M,,"


def protocol(**changes: object) -> GpsProtocol:
    """The host's end."""
    settings = {
        "port": "gps",
        "latency_ms": (40.0, 50.0),
        "gst_factor": 3.0,
        "range_error_m": 5.0,
        "floor_horizontal_m": 0.5,
        "floor_vertical_m": 1.0,
    }
    return GpsProtocol(GpsConfig(**(settings | changes)))  # type: ignore[arg-type]


def gga(time: str = "120000.00", quality: int = 1, hdop: str = "0.8", separation: str = "-21.4") -> bytes:
    """One GGA sentence."""
    return serialise(GGA.format(time=time, quality=quality, hdop=hdop, separation=separation))


def fixes_of(data: bytes, **changes: object) -> list[Fix]:
    """All fixes of a whole stream."""
    host = protocol(**changes)
    return host.receive_data(data, 0) + host.finish()


def emulated(epochs: int) -> bytes:
    """A stream of the emulator."""
    receiver = GpsEmulator(lambda t: (48.0 + t * 1e-15, -11.0, 500.0))
    return receiver.data_to_send(epochs * 100 * MS)


def test_the_antenna_arrives_mouth_to_mouth() -> None:
    """Where the world put it, to a tenth of a millimetre, with the stamp of its epoch."""
    receiver = GpsEmulator(lambda t: (-33.9 + t * 1e-16, 151.2, 77.1234))
    host = protocol(rtk_fixed_horizontal_m=0.03, rtk_fixed_vertical_m=0.06)
    fixes: list[Fix] = []
    for t in range(0, 1000, 5):
        fixes += host.receive_data(receiver.data_to_send(t * MS), t * MS)
    assert len(fixes) == 10
    for i, fix in enumerate(fixes):
        assert fix.lat_deg == pytest.approx(-33.9 + i * 1e8 * 1e-16, abs=1e-9)
        assert fix.lon_deg == pytest.approx(151.2, abs=1e-9)
        assert fix.alt_m == pytest.approx(77.1234, abs=1e-9)
        assert (fix.quality, fix.hdop, fix.bound_m) == (4, 0.7, (0.03, 0.03, 0.06))
        read = (i * 100 + 40) * MS
        assert fix.stamp == Stamp(read - 50 * MS, read - 40 * MS)
    assert fixes[3].utc == "2024-05-01T12:00:00.300Z"
    assert host.counts["skipped_bytes"] == host.counts["bad_checksum"] == 0


def test_the_fix_comes_with_the_epochs_last_sentence() -> None:
    """Once the protocol has seen how an epoch ends, it doesn't wait for the next one."""
    stream = emulated(5).split(b"\n")
    host = protocol()
    arrivals = [len(host.receive_data(line + b"\n", 0)) for line in stream if line]
    assert arrivals[:6] == [0, 0, 0, 1, 0, 1]
    assert arrivals[6:9] == [0, 0, 1]


def test_a_lost_sentence_does_not_teach_a_shorter_epoch() -> None:
    """After an epoch without GST the next fix still waits for its own."""
    lines = emulated(6).splitlines(keepends=True)
    del lines[3 * 3 + 2]
    host = protocol()
    bounds = [fix.bound_m for line in lines for fix in host.receive_data(line, 0)]
    assert [b[0] < 1 for b in bounds[:5]] == [True, True, True, False, True]


STREAM = emulated(6)


@given(st.lists(st.integers(0, len(STREAM)), max_size=20))
@example(list(range(len(STREAM))))
def test_splits_do_not_matter(cuts: list[int]) -> None:
    """Whole, byte by byte or cut anywhere: the same fixes, the same counts."""
    edges = [0, *sorted(cuts), len(STREAM)]
    host, whole = protocol(), protocol()
    fixes = [fix for a, b in pairwise(edges) for fix in host.receive_data(STREAM[a:b], 0)]
    assert fixes == whole.receive_data(STREAM, 0)
    assert host.counts == whole.counts


def test_a_fix_is_stamped_by_the_read_of_its_epochs_first_byte() -> None:
    """Dirt before it and a slow line after it don't move the stamp."""
    host = protocol()
    host.receive_data(b"\xb5b$GPnoise", 10 * MS)
    line = gga()
    host.receive_data(line[:9], 20 * MS)
    host.receive_data(line[9:], 30 * MS)
    (fix,) = host.finish()
    assert fix.stamp == Stamp(-30 * MS, -20 * MS)


@given(st.binary(max_size=200))
def test_dirt_before_and_behind_costs_no_sentence(dirt: bytes) -> None:
    """Whatever stands between intact sentences, each is read."""
    host = protocol()
    fixes = host.receive_data(dirt + b"\r\n" + gga("120000.00") + dirt + gga("120001.00") + dirt, 0) + host.finish()
    assert [fix.quality for fix in fixes] == [1, 1]


@given(st.binary(max_size=300), st.text(alphabet="$GPNA,*0123456789.-eE+_nif\r\n", max_size=200))
def test_garbage_never_raises(data: bytes, text: str) -> None:
    """Neither bytes nor lookalikes, nor lookalikes with a right checksum."""
    host = protocol()
    assert host.receive_data(data + text.encode() + data, 0) == []
    content = text.replace("$", "").replace("*", "").replace("\r", "").replace("\n", "")
    host.receive_data(serialise("GPGGA," + content), 0)
    host.finish()


@given(st.integers(0, 8 * len(gga().rstrip()) - 1))
def test_a_flipped_bit_costs_the_sentence(bit: int) -> None:
    """The checksum sees every single error."""
    bad = bytearray(gga())
    bad[bit // 8] ^= 1 << bit % 8
    fixes = fixes_of(bytes(bad))
    # A digit of the checksum may turn from upper to lower case, which changes nothing.
    assert fixes == [] or bytes(bad).upper() == gga()


ODD = ["nan", "inf", "1e3", "4_8.0", "+5", " 5", "٣", "--5", "1.", "", "9999999999"]


@pytest.mark.parametrize("odd", ODD[:-2] + ODD[-1:])
@pytest.mark.parametrize("place", [2, 4, 8, 9, 11])
def test_odd_numbers_are_refused(odd: str, place: int) -> None:
    """In any field that is used: latitude, longitude, HDOP, altitude, separation."""
    fields = gga().decode().rstrip().split("*")[0][1:].split(",")
    fields[place] = odd
    content = ",".join(fields).encode("utf-8")
    host = protocol()
    sentence = b"$" + content + b"*%02X\r\n" % checksum(content)
    assert host.receive_data(sentence, 0) + host.finish() == []
    assert host.counts["bad_fields"] == 1


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (1, "246060.00"),
        (1, "12000"),
        (2, "9100.00000"),
        (2, "4460.00000"),
        (2, "9000.10000"),
        (3, "E"),
        (3, ""),
        (4, "18100.00000"),
        (4, "18000.00001"),
        (5, "N"),
        (6, "9"),
        (6, ""),
        (9, "200000.0"),
        (10, "F"),
    ],
)
def test_values_outside_their_range_are_refused(place: int, value: str) -> None:
    """Hours, degrees, minutes, sides, qualities, heights, units."""
    fields = gga().decode().rstrip().split("*")[0][1:].split(",")
    fields[place] = value
    host = protocol()
    assert host.receive_data(serialise(",".join(fields)), 0) + host.finish() == []
    assert host.counts["bad_fields"] == 1


GST = serialise("GNGST,120000.00,,,,,0.2,0.1,0.4")
GSA = serialise("GNGSA,A,3,,,,,,,,,,,,,2.0,0.8,1.6")


@pytest.mark.parametrize(
    ("stream", "settings", "bound"),
    [
        (gga(), {}, (4.5, 4.5, 5.0)),
        (gga() + GSA, {}, (4.5, 4.5, 9.0)),
        (gga() + GST, {}, (0.8, 1.1, 2.2)),
        (gga(quality=4) + GST, {"rtk_fixed_horizontal_m": 0.03}, (0.03, 0.03, 2.2)),
        (gga(quality=4), {"rtk_fixed_horizontal_m": 0.03, "rtk_fixed_vertical_m": 0.05}, (0.03, 0.03, 0.05)),
        (gga(quality=5), {"rtk_fixed_horizontal_m": 0.03, "rtk_fixed_vertical_m": 0.05}, (4.5, 4.5, 5.0)),
        (gga(separation=""), {}, (4.5, 4.5, 115.0)),
        (gga(hdop="") + GST, {}, (0.8, 1.1, 2.2)),
    ],
)
def test_the_bound_is_the_declared_one(
    stream: bytes, settings: dict[str, float], bound: tuple[float, float, float]
) -> None:
    """RTK fixed where vouched for, else GST, else HDOP; an unknown geoid widens the height."""
    (fix,) = fixes_of(stream, **settings)
    assert fix.bound_m == pytest.approx(bound)


@pytest.mark.parametrize(
    ("stream", "count"),
    [
        (gga(hdop=""), "no_bound"),
        (gga(hdop="0.0") + serialise("GNGST,120000.00,,,,,0.0,0.0,0.0"), "no_bound"),
        (gga(quality=0), "no_fix"),
        (gga(quality=6), "estimated"),
        (gga(quality=8), "estimated"),
        (GST, "no_position"),
        (serialise("GNGGA,120000.00,4404.1,N,12118.8,W,1,12,0.8,,,,,,"), "no_altitude"),
    ],
)
def test_what_has_no_bound_is_no_fix(stream: bytes, count: str) -> None:
    """Counted, not delivered."""
    host = protocol()
    assert host.receive_data(stream, 0) + host.finish() == []
    assert host.counts[count] >= 1


def test_gns_serves_as_well_as_gga() -> None:
    """The weakest system's mode counts."""
    (fix,) = fixes_of(serialise("GNGNS,120000.00,4404.13387,N,12118.85628,W,RRNA,12,0.8,1144.8,-21.4,,,V"))
    assert fix.quality == 1
    assert fix.alt_m == pytest.approx(1123.4)


def test_epochs_run_over_midnight_and_a_leap_second() -> None:
    """Second 60 is a second; the next day begins a new epoch; the date is RMC's."""
    stream = b""
    for time, day in (("235959.00", "311216"), ("235960.00", "311216"), ("000000.00", "010117")):
        stream += gga(time) + serialise(f"GNRMC,{time},A,,,,,,,{day},,,A")
    assert [fix.utc for fix in fixes_of(stream)] == [
        "2016-12-31T23:59:59.000Z",
        "2016-12-31T23:59:60.000Z",
        "2017-01-01T00:00:00.000Z",
    ]


def test_the_receiver_loses_its_fix_and_finds_it_again() -> None:
    """Epochs without a fix give nothing; delivery goes on after them."""
    receiver = GpsEmulator(lambda t: (48.0, 11.0, 500.0))
    host = protocol()
    before = host.receive_data(receiver.data_to_send(1000 * MS), 1000 * MS)
    receiver.quality = 0
    without = host.receive_data(receiver.data_to_send(2000 * MS), 2000 * MS)
    receiver.quality = 4
    after = host.receive_data(receiver.data_to_send(3000 * MS), 3000 * MS)
    assert (len(before), len(without), len(after)) == (10, 0, 10)
    assert host.counts["no_fix"] == 10


def test_reopening_forgets_the_epoch_that_was_cut_off() -> None:
    """Half an epoch from before the loss gives no fix afterwards."""
    host = protocol()
    host.receive_data(gga() + b"$GNRMC,12", 0)
    host.connection_made(5)
    assert host.finish() == []
    assert (host.baud, host.deadline_ns, host.data_to_send()) == (115200, None, b"")


@given(
    st.floats(-90, 90),
    st.floats(-180, 180),
    st.floats(-500, 9000),
    st.sampled_from([TimeOfDay(0, 0, 0, 0), TimeOfDay(23, 59, 60, 990_000_000)]),
)
@example(59.99999999999999, -179.99999999999997, 0.0, TimeOfDay(1, 2, 3, 0))
def test_sentences_survive_writing(lat_deg: float, lon_deg: float, height_m: float, time: TimeOfDay) -> None:
    """Parse undoes serialise to the last decimal written; pynmeagps reads the same numbers."""
    at = Position(time, lat_deg, lon_deg, 4, 0.7, height_m, -20.0)
    day = datetime(2024, 2, 29, tzinfo=UTC).date()
    for data in (
        serialise_gga(at),
        serialise_rmc(Calendar(time, day), at),
        serialise_gst(ErrorEstimate(time, 0.01, 0.02, 0.03)),
    ):
        match = SENTENCE.match(data)
        assert match is not None
        parsed = parse_content(match.group(1))
        assert parsed is not None
        if isinstance(parsed[1], Position):
            assert parsed[1].lat_deg == pytest.approx(lat_deg, abs=1e-9)
            assert parsed[1].lon_deg == pytest.approx(lon_deg, abs=1e-9)
            assert parsed[1].altitude_m == pytest.approx(height_m, abs=1e-4)
            theirs = NMEAReader.parse(data, validate=VALCKSUM)
            assert theirs is not None
            assert abs(theirs.lat) == pytest.approx(abs(parsed[1].lat_deg or 0.0), abs=1e-9)
        elif isinstance(parsed[1], Calendar):
            assert parsed[1].date == day
        else:
            assert parsed[1] == ErrorEstimate(time, 0.01, 0.02, 0.03)


@pytest.mark.parametrize(
    ("name", "fixes", "first", "last"),
    [
        ("ublox-8", 72, (44.0688978, -121.3142713), (44.0690135, -121.3143157)),
        ("haicom-305N", 68, (-27.2108667, 153.0523283), (-27.2106733, 153.0520000)),
        ("cat-ms352", 40, None, None),
    ],
)
def test_real_receivers_give_their_fixes(
    recordings: Path, name: str, fixes: int, first: tuple[float, float] | None, last: tuple[float, float] | None
) -> None:
    """One fix an epoch, in both hemispheres, from logs with dirt in them."""
    data = (recordings / "nmea" / f"{name}.log").read_bytes()
    got = fixes_of(data)
    assert len(got) == fixes
    if first and last:
        assert (round(got[0].lat_deg, 7), round(got[0].lon_deg, 7)) == first
        assert (round(got[-1].lat_deg, 7), round(got[-1].lon_deg, 7)) == last
    else:
        assert {fix.quality for fix in got} == {2}


def test_every_recorded_stream_reads_the_same_in_any_pieces(recordings: Path) -> None:
    """20 receivers, whole and in pieces of 7 bytes; all numbers finite; positions as pynmeagps reads them."""
    logs = sorted((recordings / "nmea").glob("*.log"))
    assert len(logs) == 20
    for log in logs:
        data = log.read_bytes()
        host = protocol()
        pieces = [fix for i in range(0, len(data), 7) for fix in host.receive_data(data[i : i + 7], 0)] + host.finish()
        whole = fixes_of(data)
        assert pieces == whole
        assert all(isfinite(v) for f in whole for v in (f.lat_deg, f.lon_deg, f.alt_m, *f.bound_m))
        places = {(round(f.lat_deg, 9), round(f.lon_deg, 9)) for f in whole}
        theirs = set()
        for match in SENTENCE.finditer(data):
            if match.group(1)[2:5] in (b"GGA", b"GNS") and checksum(match.group(1)) == int(match.group(2), 16):
                message = NMEAReader.parse(match.group(0) + b"\r\n", validate=VALCKSUM)
                if message is not None and message.lat != "":
                    theirs.add((round(message.lat, 9), round(message.lon, 9)))
        assert places <= theirs
