"""GPS sentences: one bounded fix an epoch, promptly, and nothing from what is wrong, old or made up."""

from datetime import date
from itertools import pairwise
from math import inf, isnan

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.config import GpsConfig
from drivers.gps_nmea.codec import (
    checksum,
    serialise,
)
from drivers.gps_nmea.protocol import GpsProtocol
from drivers.samples import Fix, Stamp
from simulator.emulators.gps import GpsEmulator

MS = 1_000_000
GGA = "GNGGA,{time},4404.13387,N,12118.85628,W,{quality},{satellites},{hdop},1144.8,M,{separation},M,,"


def config(**changes: object) -> GpsConfig:
    """A receiver of known errors."""
    settings = {
        "port": "gps",
        "latency_ms": (40.0, 50.0),
        "gst_factor": 3.0,
        "range_error_m": 5.0,
        "floor_horizontal_m": 0.5,
        "floor_vertical_m": 1.0,
    }
    return GpsConfig(**(settings | changes))  # type: ignore[arg-type]


def protocol(**changes: object) -> GpsProtocol:
    """The host's end."""
    return GpsProtocol(config(**changes))


def gga(
    time: str = "120000.00", quality: int = 1, hdop: str = "0.8", separation: str = "-21.4", satellites: str = "12"
) -> bytes:
    """One GGA sentence."""
    return serialise(GGA.format(time=time, quality=quality, hdop=hdop, separation=separation, satellites=satellites))


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
        assert (fix.quality, fix.hdop) == (4, 0.7)
        assert fix.bound_m == pytest.approx((0.03, 0.03, 0.06), abs=2e-4)
        assert fix.bound_m > (0.03, 0.03, 0.06)
        read = (i * 100 + 40) * MS
        if i >= 5:  # by then it is known how an epoch begins
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
    """A slow line after it doesn't move the stamp."""
    host = protocol()
    for i in range(8):
        line = gga(f"12000{i}.00")
        host.receive_data(line[:9], (100 * i + 20) * MS)
        fixes = host.receive_data(line[9:], (100 * i + 30) * MS)
    (fix,) = fixes or host.finish()
    assert fix.stamp == Stamp(670 * MS, 680 * MS)


@pytest.mark.parametrize("dirt", [b"", b"$GNGGA,120008.00,44"])
@pytest.mark.parametrize("late_ms", [0, 120])
def test_an_epoch_whose_beginning_may_be_lost_is_stamped_back_to_the_epoch_before(dirt: bytes, late_ms: int) -> None:
    """GGA went missing without a trace, or in dirt: the epoch began between the last sentence and this one.

    Where the last sentence was itself read late, from when it may have come.
    """
    host = protocol()
    for i in range(8):
        host.receive_data(gga(f"12000{i}.00"), 1000 * i * MS)
        host.read_late(late_ms * MS)
        host.receive_data(serialise(f"GNRMC,12000{i}.00,A,4404.1,N,12118.8,W,,,010124,,,A"), (1000 * i + 300) * MS)
    host.receive_data(dirt + serialise("GNRMC,120008.00,A,4404.1,N,12118.8,W,,,010124,,,A"), 8300 * MS)
    (fix,) = host.finish()
    assert fix.stamp == Stamp((7250 - late_ms) * MS, 8260 * MS)


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
TWO_DIMENSIONAL = serialise("GLGSA,A,2,,,,,,,,,,,,,2.0,0.8,1.6")
RMC = serialise("GNRMC,120000.00,A,4404.13387,N,12118.85628,W,1.0,90.0,010124,,,A")


@pytest.mark.parametrize(
    ("stream", "settings", "bound"),
    [
        (gga(), {}, (4.5, 4.5, 5.0)),
        (gga() + GSA, {}, (4.5, 4.5, 9.0)),
        (gga(hdop="") + GSA, {}, (4.5, 4.5, 9.0)),
        (gga() + GST, {}, (0.8, 1.1, 2.2)),
        (gga() + TWO_DIMENSIONAL, {}, (inf, inf, inf)),
        (gga() + GSA + TWO_DIMENSIONAL, {}, (inf, inf, inf)),
        (gga() + TWO_DIMENSIONAL + GST, {}, (0.8, 1.1, 2.2)),
        (gga(satellites="03"), {}, (inf, inf, inf)),
        (gga(quality=4) + GST, {"rtk_fixed_horizontal_m": 0.03}, (0.03, 0.03, 2.2)),
        (gga(quality=4), {"rtk_fixed_horizontal_m": 0.03, "rtk_fixed_vertical_m": 0.05}, (0.03, 0.03, 0.05)),
        (gga(quality=5), {"rtk_fixed_horizontal_m": 0.03, "rtk_fixed_vertical_m": 0.05}, (4.5, 4.5, 5.0)),
        (gga(separation=""), {}, (4.5, 4.5, 115.0)),
        (gga(hdop="") + GST, {}, (0.8, 1.1, 2.2)),
        (gga(hdop=""), {}, (inf, inf, inf)),
        (gga(quality=6) + GST, {}, (inf, inf, inf)),
        (gga(hdop="0.0") + serialise("GNGST,120000.00,,,,,0.0,0.0,0.0"), {}, (inf, inf, inf)),
        (RMC + GSA, {}, (4.5, 4.5, inf)),
        (RMC, {}, (inf, inf, inf)),
        (serialise("GNGGA,120000.00,4404.13387,N,12118.85628,W,1,12,0.8,,,,,,"), {}, (4.5, 4.5, inf)),
    ],
)
def test_the_bound_is_the_declared_one(
    stream: bytes, settings: dict[str, float], bound: tuple[float, float, float]
) -> None:
    """RTK fixed where vouched for, else GST, else HDOP, never from nothing; an unknown geoid widens the height.

    Half a step of the digits is added: 1e-5 minutes, and 0.1 m twice.
    """
    (fix,) = fixes_of(stream, **settings)
    assert fix.bound_m == pytest.approx(bound, abs=0.11)
    assert fix.bound_m[0] >= bound[0] + 0.5e-5 / 60 * 111_000 * 0.71 or bound[0] == inf
    assert fix.bound_m[1] >= bound[1] + 0.5e-5 / 60 * 111_000 or bound[1] == inf
    assert (fix.bound_m[0] == inf) == (bound[0] == inf)
    assert (fix.bound_m[2] == inf) == (bound[2] == inf)


@pytest.mark.parametrize(
    ("minutes", "step_m"), [("04.", None), ("04", 1855.0), ("04.1", 185.5), ("04.1234", 0.1855), ("04.1234567", 0.0002)]
)
def test_a_coarse_receiver_has_a_wide_bound(minutes: str, step_m: float | None) -> None:
    """0.0001 minutes are 0.185 m: the antenna is up to half of that from what was written, on each axis."""
    zero = "00" + minutes[2:].translate(dict.fromkeys(range(48, 58), "0"))
    sentence = serialise(f"GNGGA,120000.00,00{minutes},N,000{zero},E,1,12,1.0,100,M,0,M,,")
    fixes = fixes_of(sentence)
    if step_m is None:
        assert fixes == []
        return
    assert fixes[0].bound_m[1] - 5.5 == pytest.approx(step_m / 2, rel=0.01, abs=1e-4)
    assert fixes[0].bound_m[0] == pytest.approx(fixes[0].bound_m[1])
    assert fixes[0].bound_m[2] - 6.0 == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("stream", "count"),
    [
        (gga(quality=0), "no_fix"),
        (gga(quality=7), "not_measured"),
        (gga(quality=8), "not_measured"),
        (GST, "no_position"),
        (serialise("GNGGA,120000.00,,,,,1,12,0.8,100.0,M,,M,,"), "no_fix"),
        (gga() + serialise("GNRMC,120000.00,V,4404.1,N,12118.8,W,,,010124,,,A"), "no_fix"),
        (serialise("GNRMC,120000.00,V,4404.1,N,12118.8,W,,,010124,,,A"), "no_fix"),
        (gga(time=""), "untimed"),
        (gga().replace(b"*", b"\r\n$GP*"), "bad_unsummed"),
    ],
)
def test_what_is_no_position_is_no_fix(stream: bytes, count: str) -> None:
    """Counted, not delivered."""
    host = protocol()
    assert host.receive_data(stream, 0) + host.finish() == []
    assert host.counts[count] >= 1


def test_gns_serves_as_well_as_gga() -> None:
    """The weakest system's mode counts; a float solution is weaker than a fixed one."""
    for modes, quality in (("RRNA", 1), ("RF", 5), ("NR", 4), ("DRF", 2)):
        (fix,) = fixes_of(serialise(f"GNGNS,120000.00,4404.13387,N,12118.85628,W,{modes},12,0.8,1144.8,-21.4,,,V"))
        assert fix.quality == quality
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


def test_a_position_without_a_height_is_told_as_such() -> None:
    """RMC alone: latitude, longitude, velocity; no height."""
    (fix,) = fixes_of(RMC)
    assert (fix.lat_deg, fix.lon_deg) == pytest.approx((44.0688978, -121.3142713), abs=5e-8)
    assert isnan(fix.alt_m)
    assert fix.ground_velocity_mps == pytest.approx((1852 / 3600, 0.0))
    assert fix.utc == "2024-01-01T12:00:00.000Z"


def test_course_and_speed_come_from_rmc_or_else_from_vtg() -> None:
    """East and north; a course that isn't told is none, unless the speed is zero."""
    bare = serialise("GNRMC,120000.00,A,4404.1,N,12118.8,W,,,010124,,,A")
    vtg = "GNVTG,{course},T,,M,{speed},N,,K,A"
    for course, speed, velocity in (
        ("180.0", "36.0", (0.0, -18.52)),
        ("", "36.0", None),
        ("", "0.0", (0.0, 0.0)),
        ("", "", None),
    ):
        epochs = [bare.replace(b"120000", b"12000%d" % second) for second in range(3)]
        epochs = [serialise(epoch[1:].split(b"*")[0].decode()) for epoch in epochs]
        *_, fix = fixes_of(b"".join(epoch + serialise(vtg.format(course=course, speed=speed)) for epoch in epochs))
        assert fix.ground_velocity_mps == (None if velocity is None else pytest.approx(velocity, abs=1e-9))


VTG_AND_GSA = """GNVTG,90.0,T,,M,{knots:.4f},N,,K,A
GNGSA,A,{dimension},,,,,,,,,,,,,2.0,0.8,1.6"""


@pytest.mark.parametrize("period_ms", [50, 100, 200, 1000])
@pytest.mark.parametrize("order", ["GVD", "VGD", "DVG", "VDG"])
def test_a_velocity_is_never_that_of_another_epoch(order: str, period_ms: int) -> None:
    """A receiver that speeds up and loses its height now and then, its sentences in any order, read in any pieces.

    A fix has the velocity of its epoch or none, and a finite bound only where its own epoch was measured in height.
    Where VTG and GSA come behind their position, and in time, every fix has them once the rate is known.
    """
    rng = np.random.default_rng(period_ms)
    host, fixes, waiting = protocol(), [], b""
    for epoch in range(40):
        now_ms = period_ms * epoch
        time = f"12{now_ms // 60000:02d}{now_ms % 60000 / 1000:06.3f}"
        knots, dimension = epoch * 3600 / 1852, 2 if epoch % 5 == 3 else 3
        vtg, gsa = VTG_AND_GSA.format(knots=knots, dimension=dimension).split("\n")
        sentences = {"G": gga(time), "V": serialise(vtg), "D": serialise(gsa)}
        for number, letter in enumerate(order):
            waiting += sentences[letter]
            read_ns = (now_ms + 40 + number) * MS
            if rng.random() < 0.7:
                cut = int(rng.integers(len(waiting) + 1))
                fixes += host.receive_data(waiting[:cut], read_ns)
                waiting = waiting[cut:]
        fixes += host.receive_data(waiting, (now_ms + 44) * MS)
        waiting = b""
    fixes += host.finish()
    assert len(fixes) == 40
    known = [fix.ground_velocity_mps for fix in fixes]
    for epoch, (fix, velocity) in enumerate(zip(fixes, known, strict=True)):
        assert velocity is None or velocity == pytest.approx((epoch, 0.0), abs=1e-3)
        assert fix.bound_m[2] == inf or epoch % 5 != 3
    if order == "GVD" and period_ms > 50:
        assert None not in known[8:]
        assert [fix.bound_m[2] < inf for fix in fixes[8:]] == [epoch % 5 != 3 for epoch in range(8, 40)]


def test_the_emulated_receivers_velocity_arrives() -> None:
    """What the world gave it, to the digits of RMC."""
    receiver = GpsEmulator(lambda t: (48.0, 11.0, 500.0), velocity=lambda t: (-0.3, 0.4))
    fixes = fixes_of(receiver.data_to_send(1000 * MS))
    assert len(fixes) == 10
    assert all(fix.ground_velocity_mps == pytest.approx((-0.3, 0.4), abs=1e-3) for fix in fixes)


@pytest.mark.parametrize("order", ["GRD", "RGD", "DRG", "GDR", "RDG", "DGR"])
def test_the_order_of_the_sentences_does_not_matter(order: str) -> None:
    """GGA, RMC and GSA in any order, others between them: one fix an epoch, dated, with its height."""
    stream = b""
    for i in range(6):
        time = f"12000{i}.00"
        sentences = {"G": gga(time), "R": serialise(f"GPRMC,{time},A,4404.1,N,12118.8,W,,,010124,,,A"), "D": GSA}
        stream += serialise("GPGSV,1,1,00").join(sentences[letter] for letter in order)
    fixes = fixes_of(stream)
    assert [fix.utc for fix in fixes] == [f"2024-01-01T12:00:0{i}.000Z" for i in range(6)]
    assert all(fix.bound_m == pytest.approx((4.5, 4.5, 9.0), abs=0.11) for fix in fixes[1:])


@pytest.mark.parametrize("talker", ["GN", "GP", "GL", "GA", "GB", "BD", "GQ", "QZ", "GI", "II", "IN"])
def test_every_talker_is_read(talker: str) -> None:
    """Only proprietary addresses are not."""
    assert len(fixes_of(b"$" + talker.encode() + gga()[3:-5] + b"*%02X" % checksum(talker.encode() + gga()[3:-5]))) == 1
    assert fixes_of(b"$PU" + gga()[3:-5] + b"*%02X" % checksum(b"PU" + gga()[3:-5])) == []


@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r", b"", b"   \r\n"])
def test_every_line_end_is_taken(end: bytes) -> None:
    """CR and LF, one of them, or none."""
    stream = b"".join(gga(f"12000{i}.00").rstrip() + end for i in range(5))
    assert len(fixes_of(stream)) == 5


def test_a_long_sentence_is_read_and_costs_nobody_else() -> None:
    """Over 82 characters, proprietary or not: nothing of it is dirt."""
    host = protocol()
    host.receive_data(serialise("PUBX,00," + "1234567.8," * 30) + gga() + serialise("PGRMT," + "x" * 90), 0)
    assert len(host.finish()) == 1
    assert host.counts["skipped_bytes"] == 0
    assert host.counts["other_sentences"] == 2


def test_an_epoch_that_is_sent_again_is_no_second_one() -> None:
    """A receiver that repeats itself, two systems' positions, a sentence that comes late: one fix an epoch."""
    late = serialise("GNGST,120000.00,,,,,0.2,0.1,0.4")
    stream = gga("120000.00") * 2 + gga("120001.00") + late + gga("120001.00") + gga("120002.00")
    host = protocol()
    fixes = host.receive_data(stream, 0) + host.finish()
    assert len(fixes) == 3
    assert host.counts["late"] == 1


def test_a_date_lost_is_carried_on_over_midnight() -> None:
    """RMC tells the date once; GGA goes on alone; ZDA may tell that of the next second."""
    stream = serialise("GNRMC,235958.00,A,4404.1,N,12118.8,W,,,311299,,,A")
    stream += b"".join(gga(time) for time in ("235958.00", "235959.00", "000000.00", "000001.00"))
    assert [fix.utc for fix in fixes_of(stream)] == [
        "1999-12-31T23:59:58.000Z",
        "1999-12-31T23:59:59.000Z",
        "2000-01-01T00:00:00.000Z",
        "2000-01-01T00:00:01.000Z",
    ]
    ahead = gga("235959.00") + serialise("GPZDA,000000.00,01,01,2000,00,00") + gga("000000.00")
    assert [fix.utc for fix in fixes_of(ahead)] == ["1999-12-31T23:59:59.000Z", "2000-01-01T00:00:00.000Z"]


def test_a_date_that_falls_back_by_1024_weeks_is_mended() -> None:
    """The receiver's week counter runs over at midnight, and it may have done so long ago."""
    before = serialise("GNRMC,235959.00,A,4404.1,N,12118.8,W,,,060419,,,A") + gga("235959.00")
    after = serialise("GNRMC,000000.00,A,4404.1,N,12118.8,W,,,220899,,,A") + gga("000000.00")
    host = protocol()
    fixes = host.receive_data(before + after, 0) + host.finish()
    assert [fix.utc for fix in fixes] == ["2019-04-06T23:59:59.000Z", "2019-04-07T00:00:00.000Z"]
    assert host.counts["week_rollovers"] == 1
    live = GpsProtocol(config(), not_before=date(2024, 1, 1))
    (fix,) = live.receive_data(serialise("GNRMC,000000.00,A,4404.1,N,12118.8,W,,,110405,,,A"), 0) + live.finish()
    assert fix.utc == "2024-11-25T00:00:00.000Z"
    (old,) = fixes_of(serialise("GNRMC,000000.00,A,4404.1,N,12118.8,W,,,110405,,,A"))
    assert old.utc == "2005-04-11T00:00:00.000Z"
