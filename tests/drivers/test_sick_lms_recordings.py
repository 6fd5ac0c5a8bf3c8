"""Real scanners' measurements, put into telegrams again and taken out of a bad line."""

import bz2
import gzip
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.sick_lms.measurements import CM, MM
from drivers.sick_lms.range_telegrams import RangeTelegram
from drivers.sick_lms.stream import LmsStreamDecoder
from drivers.sick_lms.telegrams import Variant, answer
from simulator.line_faults import LINES, Fault, damage

SPECIAL = 8183
"""13 bits: the first code that is no distance."""


@cache
def outdoor_vehicle(folder: Path) -> NDArray[np.uint16]:
    """[scans, 361] centimetres of a SICK LMS on a vehicle; 81.91, 81.87 and 81.83 are the scanner's special codes."""
    with gzip.open(folder / "laser" / "ual_first_half_sick_front_obs.txt.gz", "rt") as lines:
        rows = [line.split()[1:362] for line in lines if not line.startswith("%")]
    return np.rint(np.array(rows, np.float64) * 100).astype(np.uint16)


@cache
def indoor_robot(folder: Path) -> NDArray[np.uint16]:
    """[scans, 180] centimetres of a SICK LMS in a building, as CARMEN logged them."""
    with bz2.open(folder / "laser" / "aces.clf.bz2", "rt") as lines:
        rows = [line.split()[2:182] for line in lines if line.startswith("FLASER")]
    return np.rint(np.array(rows, np.float64) * 100).astype(np.uint16)


@pytest.mark.parametrize(("drive", "partial", "count"), [(outdoor_vehicle, False, 1659), (indoor_robot, True, 7374)])
@pytest.mark.parametrize("bad_line", [False, True])
def test_real_scans_come_back_exactly(recordings: Path, drive, partial: bool, count: int, bad_line: bool) -> None:  # type: ignore[no-untyped-def]  # one of the two above
    """Every distance to the centimetre, every special code as none, from clean bytes and from a bad line."""
    faults = [Fault("dropped", 0.1), Fault("false-header", 0.1), Fault("truncated", 0.1)] if bad_line else []
    codes = drive(recordings)
    telegrams = [RangeTelegram(scan, CM, partial=partial, quarter=2 * partial, indices=None) for scan in codes]
    frames = [answer(telegram.serialise()) for telegram in telegrams]
    damaged = damage(frames, LINES["lms"], faults)
    row_of = dict(zip(frames, codes, strict=True))
    expected = [row_of[frame] for frame in damaged.intact(frames)]
    decoder = LmsStreamDecoder(measuring_mode=0x00)

    scans = [scan for chunk in damaged.chunks for scan in decoder.receive_data(chunk)] + decoder.finish()

    assert len(codes) == count
    assert len(scans) == len(expected)
    rows, got = np.array(expected), np.array([scan.ranges_m for scan in scans])
    assert np.array_equal(got[rows < SPECIAL], rows[rows < SPECIAL] / 100.0)
    assert not np.isfinite(got[rows >= SPECIAL]).any()


@pytest.mark.parametrize("drive", [outdoor_vehicle, indoor_robot])
@pytest.mark.parametrize("bits", [13, 14, 15])
@pytest.mark.parametrize("flagged", [0.0, 0.1])
def test_no_inferred_width_makes_up_a_distance(recordings: Path, drive, bits: int, flagged: float) -> None:  # type: ignore[no-untyped-def]  # one of the two above
    """Real scenes in millimetres, in every width, with and without flags: what comes out is true, and nearly all is."""
    rng = np.random.default_rng(14)
    top = (1 << bits) - 1
    millimetres = np.minimum(drive(recordings)[:200].astype(np.int64) * 10, top)
    millimetres[millimetres >= top - 8] = top
    flags = (rng.random(millimetres.shape) < flagged) * rng.integers(0, 1 << 16 - bits, millimetres.shape) << bits
    codes = (millimetres | np.where(millimetres == top, 0, flags)).astype(np.uint16)
    decoder = LmsStreamDecoder(variant=Variant(180, 50))
    partial = codes.shape[1] == 180

    frames = [answer(RangeTelegram(scan, MM, partial=partial, quarter=2 * partial).serialise()) for scan in codes]
    scans = decoder.receive_data(b"".join(frames)) + decoder.finish()

    got, measured = np.array([scan.ranges_m for scan in scans]), millimetres < top
    told = np.isfinite(got)
    assert np.array_equal(got[told], millimetres[told] / 1000)
    assert told.sum() > 0.99 * measured.sum()


def test_the_width_of_real_scans_is_inferred(recordings: Path) -> None:
    """Without a word about the measuring mode, a real drive's distances are what they were."""
    codes = outdoor_vehicle(recordings)[:300]
    decoder = LmsStreamDecoder(variant=Variant(180, 50))

    scans = decoder.receive_data(b"".join(answer(RangeTelegram(scan, CM).serialise()) for scan in codes))
    scans += decoder.finish()

    assert len(scans) == 300
    for scan, row in zip(scans, codes, strict=True):
        assert np.array_equal(scan.ranges_m, np.where(row < SPECIAL, row / 100.0, np.nan), equal_nan=True)
