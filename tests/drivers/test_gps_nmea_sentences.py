"""NMEA sentences: what is written can be read, here and by others."""

import re
from datetime import date

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pynmeagps import VALCKSUM, NMEAMessage, NMEAReader

from drivers.gps_nmea.codec import (
    SENTENCE,
    Calendar,
    Dilution,
    ErrorEstimate,
    Minimum,
    Position,
    Sentence,
    Velocity,
    parse_content,
    serialise,
    serialise_gga,
    serialise_gsa,
    serialise_gst,
    serialise_rmc,
    serialise_vtg,
    serialise_zda,
)
from drivers.gps_nmea.fields import Angle, TimeOfDay
from drivers.gps_nmea.protocol import GpsProtocol
from service.passive import gps_config

times = st.builds(
    TimeOfDay,
    st.integers(0, 23),
    st.integers(0, 59),
    st.integers(0, 59),
    st.integers(0, 99).map(lambda hundredths: hundredths * 10_000_000),
)
metres = st.floats(0, 1e5)
dilutions = st.none() | st.floats(0, 999)


def read(data: bytes) -> Sentence:
    """Our own reading of a whole sentence."""
    match = SENTENCE.match(data)
    assert match is not None
    parsed = parse_content(match.group(1))
    assert parsed is not None
    assert parsed[1] is not None
    return parsed[1]


def theirs(data: bytes) -> NMEAMessage:
    """The oracle's."""
    message = NMEAReader.parse(data, validate=VALCKSUM)
    assert message is not None
    return message


@given(times, st.floats(-90, 90), st.floats(-180, 180), st.floats(-500, 9000), st.none() | st.floats(-110, 110))
@example(TimeOfDay(23, 59, 60, 990_000_000), 59.99999999999999, -179.99999999999997, 0.0, None)
def test_a_position_survives_writing(
    time: TimeOfDay, lat_deg: float, lon_deg: float, height_m: float, separation_m: float | None
) -> None:
    """GGA, to half a step of the last decimal written; pynmeagps reads the same numbers."""
    at = Position(time, Angle(lat_deg), Angle(lon_deg), 4, 0.7, height_m, separation_m, satellites=9)
    data = serialise_gga(at)
    got = read(data)
    assert isinstance(got, Position)
    assert got.lat is not None
    assert got.lon is not None
    assert got.altitude_m is not None
    assert abs(got.lat.deg - lat_deg) <= got.lat.half_step_deg
    assert abs(got.lon.deg - lon_deg) <= got.lon.half_step_deg
    error_m = got.altitude_m + (got.separation_m or 0.0) - height_m - (separation_m or 0.0)
    assert abs(error_m) <= got.height_half_step_m + 1e-9
    assert (got.time, got.quality, got.satellites, got.hdop) == (time, 4, 9, 0.7)
    if time.second < 60:
        message = theirs(data)
        assert abs(message.lat) == pytest.approx(abs(got.lat.deg), abs=1e-9)
        assert abs(message.lon) == pytest.approx(abs(got.lon.deg), abs=1e-9)
        assert message.alt == got.altitude_m


@given(times, st.dates(date(1980, 1, 1), date(2068, 12, 31)), st.none() | st.tuples(st.floats(-9, 9), st.floats(-9, 9)))
def test_date_and_velocity_survive_writing(
    time: TimeOfDay, day: date, velocity_mps: tuple[float, float] | None
) -> None:
    """RMC, VTG and ZDA; pynmeagps reads the same."""
    at = Position(time, Angle(1.0), Angle(2.0), 1)
    rmc, vtg, zda = (
        serialise_rmc(Minimum(at, day, velocity_mps)),
        serialise_vtg(velocity_mps),
        serialise_zda(Calendar(time, day)),
    )
    minimum, velocity, calendar = read(rmc), read(vtg), read(zda)
    assert isinstance(minimum, Minimum)
    assert isinstance(velocity, Velocity)
    assert calendar == Calendar(time, day)
    assert (minimum.time, minimum.date, minimum.position.quality) == (time, day, 1)
    expected = None if velocity_mps is None else pytest.approx(velocity_mps, abs=2e-3)
    assert minimum.velocity_mps == expected
    assert velocity.velocity_mps == expected
    message = theirs(rmc)
    assert (message.status, message.date) == ("A", day)
    assert theirs(zda).year == day.year
    if velocity_mps is not None:
        assert message.spd == theirs(vtg).sogn
        assert message.cog == theirs(vtg).cogt


@given(times, metres, metres, metres, st.sampled_from([1, 2, 3]), dilutions, dilutions)
def test_errors_survive_writing(
    time: TimeOfDay, east_m: float, north_m: float, up_m: float, dimension: int, hdop: float | None, vdop: float | None
) -> None:
    """GST and GSA, to the decimals written; pynmeagps reads the same."""
    gst, gsa = serialise_gst(ErrorEstimate(time, east_m, north_m, up_m)), serialise_gsa(Dilution(dimension, hdop, vdop))
    errors, dilution = read(gst), read(gsa)
    assert isinstance(errors, ErrorEstimate)
    assert isinstance(dilution, Dilution)
    assert (errors.east_m, errors.north_m, errors.up_m) == pytest.approx((east_m, north_m, up_m), abs=1e-4)
    assert (theirs(gst).stdLat, theirs(gst).stdLong, theirs(gst).stdAlt) == (errors.north_m, errors.east_m, errors.up_m)
    assert dilution.dimension == dimension == theirs(gsa).navMode
    assert dilution.hdop == (None if hdop is None else pytest.approx(hdop, abs=0.01))
    assert dilution.vdop == (None if vdop is None else pytest.approx(vdop, abs=0.01))


EVERY_KIND = [
    "GNGGA,120000.00,4404.13387,N,12118.85628,W,1,12,0.8,1144.8,M,-21.4,M,,",
    "GNGNS,120000.00,4404.13387,N,12118.85628,W,AAN,12,0.8,1144.8,-21.4,,",
    "GNRMC,120000.00,A,4404.13387,N,12118.85628,W,1.0,90.0,010124,,,A,V",
    "GNGST,120000.00,1,2,3,4,0.2,0.1,0.4",
    "GNGSA,A,3,,,,,,,,,,,,,2.0,0.8,1.6,1",
    "GNVTG,90.0,T,,M,1.0,N,1.9,K,A",
    "GNZDA,120000.00,01,01,2024,00,00",
]


@pytest.mark.parametrize("content", EVERY_KIND)
@pytest.mark.parametrize("dirt", [b"", b"\x00\xff$GP*", b"$GNGGA,12*", b"\r\n$$$"])
def test_every_kind_is_read_cut_anywhere_with_dirt_around(content: str, dirt: bytes) -> None:
    """Whole, cut at every byte, behind dirt and before it: one sentence, understood."""
    sentence = serialise(content)
    assert read(sentence) is not None
    for cut in range(len(sentence) + 1):
        host = GpsProtocol(gps_config(5.0, 5.0))
        host.receive_data(dirt + sentence[:cut], 0)
        host.receive_data(sentence[cut:] + dirt, 0)
        assert (host.counts["sentences"], host.counts["bad_fields"], host.counts["bad_checksum"]) == (1, 0, 0)
        assert host.counts["skipped_bytes"] <= 2 * len(dirt)


@pytest.mark.parametrize("content", EVERY_KIND)
@given(st.data())
def test_no_field_makes_an_exception_or_an_odd_number(content: str, data: st.DataObject) -> None:
    """Any field replaced by anything: read as a number of its range, or refused."""
    fields = content.split(",")
    place = data.draw(st.integers(1, len(fields) - 1))
    odd = st.sampled_from(
        ["nan", "inf", "-inf", "1e3", "4_8.0", "+5", " 5", "\u0663", "--5", "1.", ".5", "99999999", "-0.0"]
    )
    fields[place] = data.draw(odd | st.text(max_size=12))
    parsed = parse_content(",".join(fields).encode("latin-1", "replace"))
    assert re.search(r"\b(nan|inf)\b", repr(parsed and parsed[1])) is None
