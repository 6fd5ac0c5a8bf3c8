"""What broken sensors read: only while they are broken, and only the one that is."""

from math import degrees, nan

import pytest

from drivers.samples import Fix, InertialSample, Stamp, WheelTicks
from simulator.faults import Fault, GpsJump, Reading, StuckGyro, TiltSpike, WrongTracks

STAMP = Stamp(0, 0)


def fix() -> Fix:
    return Fix(STAMP, None, 48.0, 11.0, 500.0, 4, 0.8, (0.05, 0.05, 0.1))


def inertial(rate: float = 0.0) -> InertialSample:
    return InertialSample(STAMP, "HIGHRES_IMU", 0, 0, (0.0, 0.0, nan), (0.0, 0.0, rate), (0.1, -0.1))


def ticks(count: int) -> WheelTicks:
    return WheelTicks(STAMP, count, count)


@pytest.mark.parametrize(
    ("fault", "own"),
    [(GpsJump(1.0, 2.0, 20.0), fix()), (StuckGyro(1.0, 2.0), inertial()), (TiltSpike(1.0, 2.0, 6.0), inertial())],
)
def test_a_fault_begins_and_ends_and_leaves_other_sensors_alone(fault: Fault, own: Reading) -> None:
    """Before and after it the sensor is good again; what others read is never touched."""
    others = [reading for reading in (fix(), inertial(), ticks(5)) if type(reading) is not type(own)]
    for t_s in (0.0, 0.99, 1.0, 1.5, 2.0, 9.0):
        assert [fault.changed(reading, t_s) for reading in others] == others
    assert repr(fault.changed(own, 0.5)) == repr(own)
    assert repr(fault.changed(own, 2.0)) == repr(own)


def test_a_receiver_jumps_by_metres() -> None:
    """North, by a degree of latitude's share."""
    moved = GpsJump(0.0, 1.0, 100.0).changed(fix(), 0.5)
    assert isinstance(moved, Fix)
    assert (moved.lat_deg - 48.0) * 111_320.0 == pytest.approx(100.0)


def test_a_stuck_gyroscope_repeats_its_first_packet() -> None:
    """Whatever it should read."""
    fault = StuckGyro(1.0, 2.0)
    read = [fault.changed(inertial(rate), 1.0 + rate) for rate in (0.1, 0.2, 0.3)]
    assert [reading.gyro_rps[2] for reading in read if isinstance(reading, InertialSample)] == [0.1, 0.1, 0.1]


def test_a_tilt_spike_adds_degrees_to_both_axes() -> None:
    """Six of them."""
    read = TiltSpike(0.0, 1.0, 6.0).changed(inertial(), 0.5)
    assert isinstance(read, InertialSample)
    assert degrees(read.tilt_rad[0] - 0.1) == pytest.approx(6.0)
    assert degrees(read.tilt_rad[1] + 0.1) == pytest.approx(6.0)


def test_what_wrong_tracks_counted_stays_counted() -> None:
    """Twice as much on the left from 1 s to 2 s, 100 ticks a second on the right: the difference goes on afterwards."""
    fault = WrongTracks(1.0, 2.0, (2.0, 1.0), (0.0, 100.0))
    read = [fault.changed(ticks(round(100 * t_s)), t_s) for t_s in (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)]
    left = [reading.left for reading in read if isinstance(reading, WheelTicks)]
    right = [reading.right for reading in read if isinstance(reading, WheelTicks)]
    assert left[:2] == [0, 50]
    assert left[-1] - left[-2] == 100
    assert left[-1] - 300 == pytest.approx(100, abs=51)
    assert right[-1] - 300 == pytest.approx(100, abs=51)
