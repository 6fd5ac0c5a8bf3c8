"""When a fault is over: the pose is called good again, and is; it is tight; what was false meanwhile is taken back."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from bench.fault_drive import Meddle, Reading, drive, settings, world_of
from drivers.samples import ABSENT3, InertialSample
from estimator.bounded_pose import Status
from estimator.config import FilterConfig, SetName
from simulator.faults import Fault, FaultMaker, GpsJump, StuckGyro, TiltSpike, WrongTracks
from simulator.world import World

SECONDS, LENGTH_S = 54.0, 6.0
SPIN_TICKS = 0.3 / 0.0002
BEGINS_S = 26.0

FAULTS: dict[str, tuple[FaultMaker, str]] = {
    "the receiver is off by 20 m for 4 s": (lambda t: GpsJump(t, t + 4.0, 20.0), "gps"),
    "the gyroscope is stuck for 4 s": (lambda t: StuckGyro(t, t + 4.0), "gyro"),
    "the wheels' scale is wrong by a fifth for 4 s": (lambda t: WrongTracks(t, t + 4.0, (1.2, 1.2)), "encoders"),
    "both tracks spin for 4 s": (lambda t: WrongTracks(t, t + 4.0, ticks_per_s=(SPIN_TICKS, SPIN_TICKS)), "encoders"),
    "the tilt sensor is off by 6 degrees for 2 s": (lambda t: TiltSpike(t, t + 2.0, 6.0), "tilt"),
}


def world() -> World:
    """One drive for all."""
    return world_of("constant", 2, SECONDS)


@pytest.mark.parametrize("kept", ["box", "ellipsoid"])
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_that_is_over_is_forgotten_in_time(name: str, kept: SetName) -> None:
    """Restored once, `fault_length_s` after it was told; true and tight from then on; nothing false stays promised."""
    make, sensor = FAULTS[name]
    fault: Fault = make(BEGINS_S)
    outcome = drive(
        fault.changed,
        FilterConfig(set=kept, fault_length_s=LENGTH_S, standstill_s=0.5, standstill_rate_dps=0.02),
        world(),
    )
    guarantee = outcome.filter.guarantee
    assert guarantee.sensor == sensor
    assert guarantee.status is Status.NOMINAL
    assert len(outcome.filter.faults) == 1
    assert guarantee.contradicted_ns is not None
    assert guarantee.restored_ns is not None
    assert guarantee.restored_ns - guarantee.contradicted_ns < (LENGTH_S + 0.3) * 1e9
    assert outcome.told == 0
    assert outcome.not_taken_back == 0
    assert outcome.on_earth is not None
    width = outcome.on_earth.high - outcome.on_earth.low
    assert width[:2].max() < (0.4 if kept == "box" else 1.6)
    if kept == "ellipsoid":
        assert outcome.filter.ellipsoid() is not None


@pytest.mark.parametrize("kept", ["box", "ellipsoid"])
def test_a_fault_that_outlasts_the_time_it_is_given_is_told_again(kept: SetName) -> None:
    """A receiver that stays off by 20 m: DEGRADED again and again, each time on its own account, never false untold."""
    outcome = drive(
        GpsJump(BEGINS_S, 1e9, 20.0).changed,
        FilterConfig(set=kept, fault_length_s=LENGTH_S, standstill_s=0.5, standstill_rate_dps=0.02),
        world(),
    )
    faults = outcome.filter.faults
    assert len(faults) >= 3
    assert {fault.sensor for fault in faults} == {"gps"}
    for before, after in zip(list(faults)[:-1], list(faults)[1:], strict=True):
        assert before.restored_ns is not None
        assert after.void_since_ns >= before.void_since_ns
        assert after.contradiction.time_ns >= before.restored_ns
    assert outcome.told == outcome.untold == 0


@pytest.mark.parametrize("kept", ["box", "ellipsoid"])
def test_a_second_fault_takes_back_what_was_restored_after_the_first(kept: SetName) -> None:
    """Two faults, the receiver's and the tracks': each has its own time of doubt, and the last word judges all."""
    first, second = GpsJump(BEGINS_S, BEGINS_S + 2.0, 5.0), WrongTracks(
        BEGINS_S + 14.0, BEGINS_S + 18.0, ticks_per_s=(SPIN_TICKS, SPIN_TICKS)
    )  # fmt: skip
    outcome = drive(
        lambda reading, t_s: second.changed(first.changed(reading, t_s), t_s),
        FilterConfig(set=kept, fault_length_s=LENGTH_S, standstill_s=0.5, standstill_rate_dps=0.02),
        world(),
    )
    one, two = outcome.filter.faults
    assert (one.sensor, two.sensor) == ("gps", "encoders")
    assert one.restored_ns is not None
    assert one.restored_ns <= two.void_since_ns <= two.contradiction.time_ns
    guarantee = outcome.filter.guarantee
    assert guarantee.void_since_ns == one.void_since_ns
    assert guarantee.restored_ns == two.restored_ns
    assert outcome.not_taken_back == 0
    assert not guarantee.covers(two.void_since_ns, two.void_since_ns)


def test_the_doubt_ends_where_no_later_reading_reaches() -> None:
    """A pose that ended before `void_since_ns` is the same with the fault as without it, bit for bit."""
    fault = GpsJump(BEGINS_S, BEGINS_S + 2.0, 5.0)
    config = FilterConfig(fault_length_s=LENGTH_S, history_s=60.0, standstill_s=0.5, standstill_rate_dps=0.02)
    with_it = drive(fault.changed, config, world()).filter
    without = drive(lambda reading, t_s: reading, config, world()).filter
    since_ns = with_it.guarantee.void_since_ns
    assert since_ns is not None
    same = [with_it.pose_over(since_ns - 1 - back, since_ns - 1 - back) for back in range(0, 10**9, 37_000_000)]
    true = [without.pose_over(since_ns - 1 - back, since_ns - 1 - back) for back in range(0, 10**9, 37_000_000)]
    for mine, its in zip(same, true, strict=True):
        assert mine is not None
        assert its is not None
        assert np.array_equal(mine.low, its.low)
        assert np.array_equal(mine.high, its.high)


def tilt_alone_and_off(reading: Reading, t_s: float) -> Reading:
    """No accelerometer, and a tilt sensor that is off by 8 degrees until 7.5 s."""
    if not isinstance(reading, InertialSample):
        return reading
    roll, pitch = reading.tilt_rad
    return replace(reading, accel_mps2=ABSENT3, tilt_rad=(roll, pitch - radians(8.0) * (t_s < 7.5)))


def two_at_once() -> Meddle:
    """Receiver and tracks break in the fourth second; the first gyro packet comes after the first count."""
    faults = GpsJump(3.2, 5.5, 3.0), WrongTracks(3.0, 5.5, (1.0, 1.6))

    def changed(reading: Reading, t_s: float) -> Reading:
        for fault in faults:
            reading = fault.changed(reading, t_s)
        if isinstance(reading, InertialSample) and t_s < 0.01:
            return replace(reading, gyro_rps=ABSENT3)
        return reading

    return changed


@pytest.mark.parametrize("meddle", [tilt_alone_and_off, two_at_once()], ids=["tilt alone", "two sensors at once"])
def test_a_fault_in_the_first_seconds_leaves_poses_in_the_frame_that_the_map_began_in(meddle: Meddle) -> None:
    """Also on the word of sensors that alone would not have begun one then: it is driven from before the beginning."""
    outcome = drive(meddle, settings(), world_of("uniform", 2, 30.0), until_s=16.0)
    guarantee = outcome.filter.guarantee
    assert guarantee.restored_ns is not None
    assert outcome.checks > 150
    assert outcome.told == 0
    assert outcome.not_taken_back == 0
