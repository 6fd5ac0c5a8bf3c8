"""Sensors that break their bounds: named soon, never believed again too early, and no pose is false unflagged."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi

import numpy as np
import pytest

from drivers.config import EncodersConfig, GpsConfig, ImuConfig
from drivers.samples import Fix, InertialSample, WheelTicks
from estimator.bounded_pose import Status
from estimator.config import FilterConfig, RobotConfig, SetName
from estimator.filter import Filter
from service.config import load
from service.robot_model import robot_model
from service.shipped import shipped_config
from simulator.errors import ErrorLaw
from simulator.open_ground import open_ground
from simulator.sample_stream import Rates, sample_stream
from simulator.world import World

Reading = InertialSample | WheelTicks | Fix
Meddle = Callable[[Reading, float], Reading]
"""What becomes of a reading, and the seconds driven."""

BEGIN_S, END_S = 20.0, 22.0
BOUND_M = (0.05, 0.05, 0.08)


@dataclass
class Outcome:
    """What came of a drive."""

    filter: Filter
    begin_ns: int
    """When the fault began."""
    unflagged: int
    """Poses that the truth had left while the guarantee was intact."""
    after: int
    """Poses that the truth had left after the contradiction."""
    false_ns: list[int]
    """When the truth was outside, told or not."""
    statuses: set[Status]
    way_m: float
    """From the fault's beginning to the first contradiction."""
    end_width_m: float


def drive(
    meddle: Meddle, *, seed: int = 1, law: str = "corners", seconds: float = 34.0, kept: SetName = "box"
) -> Outcome:
    """Over open ground, with the demo's robot and sensors at corners of their bounds, one of them meddled with."""
    config = load(shipped_config("demo.toml")).config
    robot: RobotConfig = config.robot
    encoders: EncodersConfig = replace(config.devices.encoders, latency_ms=(0.0, 0.0))
    imu: ImuConfig = replace(config.devices.imu, latency_ms=(0.0, 0.0))
    assert config.devices.gps is not None
    gps: GpsConfig = replace(config.devices.gps, latency_ms=(0.0, 0.0))
    devices = replace(config.devices, encoders=encoders, imu=imu, gps=gps)
    world = World(open_ground(seed, 3.0, seconds), robot_model(robot), devices, ErrorLaw(law, seed), 10**12, seconds)
    pose = Filter(
        robot,
        FilterConfig(fault_length_s=6.0, set=kept, standstill_s=0.5, standstill_rate_dps=0.02),
        encoders,
        imu,
        gps,
    )
    start = world.pose(world.start_ns)
    c, s = np.cos(start[5]), np.sin(start[5])
    outcome = Outcome(pose, world.start_ns + int(BEGIN_S * 1e9), 0, 0, [], set(), 0.0, np.inf)
    for k, (now_ns, readings) in enumerate(sample_stream(world, BOUND_M, Rates(steps_per_tilt=1, steps_per_fix=5))):
        for reading in readings:
            pose.accept(meddle(reading, (now_ns - world.start_ns) * 1e-9))
        box = pose.latest() if k % 5 == 0 else None
        if box is None:
            continue
        true = world.pose(box.latest_ns)
        x, y, z = true[:3] - start[:3]
        seen = np.array([c * x + s * y, c * y - s * x, z, true[3], true[4], true[5] - start[5]])
        seen[5] += 2 * pi * np.ceil((box.low[5] - seen[5]) / (2 * pi))
        out = not np.all((box.low - 1e-9 <= seen) & (seen <= box.high + 1e-9))
        if now_ns >= outcome.begin_ns and box.guarantee.intact:
            before = world.pose(box.latest_ns - 100_000_000)
            outcome.way_m += float(np.hypot(*(true[:2] - before[:2])))
        if out:
            outcome.false_ns.append(box.latest_ns)
        outcome.unflagged += out and box.guarantee.intact
        outcome.after += out and not box.guarantee.intact
        outcome.statuses.add(box.guarantee.status)
        outcome.end_width_m = float(np.max(box.high[:2] - box.low[:2]))
    return outcome


def during(change: Meddle) -> Meddle:
    """Only while the fault lasts."""
    return lambda reading, t: change(reading, t) if BEGIN_S <= t < END_S else reading


def gps_jump(metres: float) -> Meddle:
    """All fixes of the fault lie so far north of the truth."""
    return during(
        lambda reading, t: (
            replace(reading, lat_deg=reading.lat_deg + metres / 111_000.0) if isinstance(reading, Fix) else reading
        )
    )


def tilt_off(degrees: float) -> Meddle:
    """Roll reads too much."""
    return during(
        lambda reading, t: (
            replace(reading, tilt_rad=(reading.tilt_rad[0] + np.radians(degrees), reading.tilt_rad[1]))
            if isinstance(reading, InertialSample)
            else reading
        )
    )


def spinning_tracks(mps: float, right: bool = True) -> Meddle:
    """Both tracks (or the left one alone) run on the spot, beside the way they really go."""
    return lambda reading, t: (
        replace(
            reading,
            left=reading.left + round(mps * min(max(t - BEGIN_S, 0.0), END_S - BEGIN_S) / 0.0002),
            right=reading.right + right * round(mps * min(max(t - BEGIN_S, 0.0), END_S - BEGIN_S) / 0.0002),
        )
        if isinstance(reading, WheelTicks)
        else reading
    )


def clock_stuck() -> Meddle:
    """The board's clock stands still."""
    held: list[int | None] = []

    def change(reading: Reading, t: float) -> Reading:
        if isinstance(reading, InertialSample):
            held.append(reading.device_time_us)
            return replace(reading, device_time_us=held[0])
        return reading

    return during(change)


def clock_step(microseconds: int) -> Meddle:
    """The board's clock is set, and goes on from there."""
    return lambda reading, t: (
        replace(reading, device_time_us=(reading.device_time_us or 0) + microseconds)
        if isinstance(reading, InertialSample) and t >= BEGIN_S
        else reading
    )


FAULTS: dict[str, tuple[Meddle, str]] = {
    "GPS jumps 2 m": (gps_jump(2.0), "gps"),
    "GPS jumps 20 m": (gps_jump(20.0), "gps"),
    "GPS jumps 100 m": (gps_jump(100.0), "gps"),
    "the tilt sensor reads 10 degrees too much": (tilt_off(10.0), "tilt"),
    "the tracks slip": (spinning_tracks(0.4), "encoders"),
    "one track slips": (spinning_tracks(0.4, right=False), "encoders"),
    "the board's clock is stuck": (clock_stuck(), "imu_clock"),
    "the board's clock steps forward": (clock_step(700_000), "imu_clock"),
    "the board's clock steps back": (clock_step(-700_000), "imu_clock"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_sensor_is_named_within_a_second_or_a_metre_and_no_pose_is_false_unflagged(fault: str) -> None:
    """... nor false at all from the contradiction on; and the pose is restored, and tight again, when it is over."""
    meddle, sensor = FAULTS[fault]
    check_recovery(drive(meddle), sensor)


def test_the_papers_set_recovers_as_well() -> None:
    """The same with ellipsoids, which begin anew from the hull of what had been thought possible."""
    meddle, sensor = FAULTS["GPS jumps 20 m"]
    outcome = drive(meddle, kept="ellipsoid")
    check_recovery(outcome, sensor)
    assert outcome.filter.ellipsoid() is not None


def check_recovery(outcome: Outcome, sensor: str) -> None:
    """Named in time, flagged, never false from then on, restored."""
    guarantee = outcome.filter.guarantee
    assert guarantee.sensor == sensor
    assert guarantee.contradicted_ns is not None
    assert guarantee.contradicted_ns >= outcome.begin_ns
    assert guarantee.contradicted_ns - outcome.begin_ns < 1_000_000_000 or outcome.way_m < 1.0
    assert guarantee.void_since_ns is not None
    assert guarantee.void_since_ns <= outcome.begin_ns, "the doubt reaches back to before the fault"
    assert not any(guarantee.covers(time_ns, time_ns) for time_ns in outcome.false_ns)
    assert guarantee.excess is not None
    assert guarantee.excess > 0.0
    assert outcome.unflagged == 0
    assert outcome.after == 0
    assert outcome.statuses == {Status.NOMINAL, Status.DEGRADED}
    assert guarantee.status is Status.NOMINAL
    assert guarantee.restored_ns is not None
    assert outcome.end_width_m < 5.0


def test_two_sensors_that_break_at_once_leave_the_limits_of_motion_alone() -> None:
    """LOST is said, the set holds all the same, and what was measured later makes it smaller again."""
    one, two = gps_jump(30.0), tilt_off(20.0)
    outcome = drive(lambda reading, t: two(one(reading, t), t))
    assert Status.LOST in outcome.statuses
    assert outcome.unflagged == 0
    assert outcome.after == 0
    assert outcome.filter.guarantee.status is Status.NOMINAL


def test_without_a_fault_nothing_is_reported() -> None:
    """The same drive unmeddled: intact, nominal, and no checkpoint shows."""
    outcome = drive(lambda reading, t: reading, seconds=14.0)
    assert outcome.filter.guarantee.intact
    assert outcome.statuses == {Status.NOMINAL}
    assert not outcome.filter.faults
    assert outcome.unflagged == 0
