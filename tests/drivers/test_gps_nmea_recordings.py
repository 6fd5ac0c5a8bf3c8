"""Twenty real receivers: what each of them said, as gpsd and pynmeagps understand it too."""

import json
from itertools import pairwise
from math import isfinite, isnan
from pathlib import Path
from typing import Any

import pytest
from pynmeagps import VALCKSUM, NMEAReader

from drivers.config import GpsConfig
from drivers.gps_nmea.codec import SENTENCE, checksum
from drivers.gps_nmea.protocol import GpsProtocol
from drivers.samples import Fix

FIXES = {
    "GPSmap-76S": 0,  # simulated, and void
    "ac12": 7,
    "cat-ms352": 40,
    "garmin15x": 7,
    "gp-320fw-2019-04-06-overflow": 20,
    "haicom-305N": 68,
    "magellan-ec10": 21,  # RMC alone
    "mtk-3301": 4,
    "neo-m8n": 23,
    "nmea-fuzzy-cases": 14,
    "pypilot": 0,  # a compass
    "rgm3800": 2,
    "rx210": 40,
    "sirfstarv-nmea": 59,  # two GGA an epoch
    "skytraq-dgps": 96,
    "tnt-revolution": 0,  # a compass
    "triton400": 4,
    "ublox-8": 72,
    "ublox-f9p-hpnmea": 9,
    "ublox-neo-m9n-nmea": 61,
}
UNMATCHED = {"GPSmap-76S": 1, "mtk-3301": 1, "triton400": 1}
"""gpsd's positions that are none of ours: simulated, void, GLL alone."""
COARSE_DEG = 1e-6
"""Half of 0.0001 minutes: gpsd may have taken the coarser of two sentences."""


def protocol() -> GpsProtocol:
    """The host's end."""
    return GpsProtocol(
        GpsConfig(
            port="",
            latency_ms=(0.0, 0.0),
            gst_factor=5.0,
            range_error_m=5.0,
            floor_horizontal_m=0.0,
            floor_vertical_m=0.0,
        )
    )


def fixes_of(data: bytes) -> list[Fix]:
    """All fixes of a whole stream."""
    host = protocol()
    return host.receive_data(data, 0) + host.finish()


def reports_of(check_file: Path) -> list[dict[str, Any]]:
    """The positions that gpsd expects from a log."""
    lines = check_file.read_text(errors="replace").splitlines()
    reports = [json.loads(line) for line in lines if line.startswith('{"class":"TPV"')]
    return [report for report in reports if "lat" in report]


def close(fix: Fix, report: dict[str, Any]) -> bool:
    """The same place, to the coarser one's digits?"""
    return bool(abs(fix.lat_deg - report["lat"]) < COARSE_DEG and abs(fix.lon_deg - report["lon"]) < COARSE_DEG)


@pytest.mark.parametrize("name", FIXES)
def test_positions_agree_with_gpsd(recordings: Path, name: str) -> None:
    """Each fix is where gpsd's report of the same second says, as high and as fast; none of its places is missing."""
    log = recordings / "nmea" / f"{name}.log"
    fixes, reports = fixes_of(log.read_bytes()), reports_of(log.with_suffix(".log.chk"))
    assert len(fixes) == FIXES[name]
    by_time = dict[str, list[dict[str, Any]]]()
    for report in reports:
        by_time.setdefault(report.get("time", "").partition("T")[2], []).append(report)
    unreported = 0  # gpsd tells no time of its first report, skips one, and tells nothing of an epoch cut off
    for fix in fixes:
        assert fix.utc is not None
        mine = [r for r in by_time.get(fix.utc.partition("T")[2], []) if close(fix, r)]
        unreported += not mine
        if heights := [r["altHAE"] for r in mine if "altHAE" in r]:
            assert any(abs(fix.alt_m - height) < 1e-3 for height in heights)
        if fix.ground_velocity_mps is not None and (speeds := [r["speed"] for r in mine if "speed" in r]):
            east, north = fix.ground_velocity_mps
            assert min(abs(east**2 + north**2 - speed**2) for speed in speeds) < 2.0  # gpsd also derives some itself
    assert unreported <= 1
    unmatched = {(r["lat"], r["lon"]) for r in reports if not any(close(fix, r) for fix in fixes)}
    assert len(unmatched) == UNMATCHED.get(name, 0)


@pytest.mark.parametrize("name", FIXES)
def test_every_recorded_stream_reads_the_same_in_any_pieces(recordings: Path, name: str) -> None:
    """Whole and in pieces of 7 bytes: the same fixes and the same counts; all numbers finite or plainly unknown."""
    data = (recordings / "nmea" / f"{name}.log").read_bytes()
    host, whole = protocol(), protocol()
    pieces = [fix for i in range(0, len(data), 7) for fix in host.receive_data(data[i : i + 7], 0)] + host.finish()
    fixes = whole.receive_data(data, 0) + whole.finish()
    assert repr(pieces) == repr(fixes)
    assert host.counts == whole.counts
    for fix in fixes:
        assert isfinite(fix.lat_deg + fix.lon_deg)
        assert isnan(fix.alt_m) <= (fix.bound_m[2] == float("inf"))
        assert min(fix.bound_m) > 0
    times = [fix.utc for fix in fixes if fix.utc]
    assert all(a < b for a, b in pairwise(times))
    places = {(round(fix.lat_deg, 9), round(fix.lon_deg, 9)) for fix in fixes}
    theirs = set()
    for match in SENTENCE.finditer(data):
        if match.group(1)[2:5] in (b"GGA", b"GNS", b"RMC") and checksum(match.group(1)) == int(match.group(2), 16):
            message = NMEAReader.parse(match.group(0) + b"\r\n", validate=VALCKSUM)
            if message is not None and message.lat != "":
                theirs.add((round(message.lat, 9), round(message.lon, 9)))
    assert places <= theirs


@pytest.mark.parametrize(
    ("name", "first", "last"),
    [
        ("ublox-8", (44.0688978, -121.3142713), (44.0690135, -121.3143157)),
        ("haicom-305N", (-27.2108667, 153.0523283), (-27.2106733, 153.0520000)),
    ],
)
def test_first_and_last_place_are_the_known_ones(
    recordings: Path, name: str, first: tuple[float, float], last: tuple[float, float]
) -> None:
    """In both hemispheres."""
    got = fixes_of((recordings / "nmea" / f"{name}.log").read_bytes())
    assert (round(got[0].lat_deg, 7), round(got[0].lon_deg, 7)) == first
    assert (round(got[-1].lat_deg, 7), round(got[-1].lon_deg, 7)) == last


def test_quality_and_date_of_known_receivers(recordings: Path) -> None:
    """cat-ms352 is differential throughout; gp-320fw keeps its date on the day of a week rollover."""
    folder = recordings / "nmea"
    assert {fix.quality for fix in fixes_of((folder / "cat-ms352.log").read_bytes())} == {2}
    overflow = fixes_of((folder / "gp-320fw-2019-04-06-overflow.log").read_bytes())
    assert {(fix.utc or "")[:10] for fix in overflow} == {"2019-04-06"}


def test_positions_whose_height_is_held_have_no_bound(recordings: Path) -> None:
    """mtk-3301 and rgm3800 saw three satellites; magellan tells no height: nothing there says how far off they are."""
    for name in ("mtk-3301", "rgm3800", "magellan-ec10"):
        fixes = fixes_of((recordings / "nmea" / f"{name}.log").read_bytes())
        assert all(max(fix.bound_m) == float("inf") for fix in fixes)
