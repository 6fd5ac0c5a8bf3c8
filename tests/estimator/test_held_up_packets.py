"""Inertial packets that come later than declared: either the board's clock is wrong or they were held up."""

from dataclasses import replace
from functools import cache

import pytest

from bench.fault_drive import Reading, inside
from bench.pose_scenario import FILTER, GPS_CLASSES, ROBOT, devices, reference_world
from drivers.samples import InertialSample
from estimator.bounded_pose import Status
from estimator.filter import Filter
from simulator.sample_stream import Rates, sample_stream
from simulator.world import World

BEGIN_S, SECONDS = 14.0, 28.0
RTK = GPS_CLASSES[0]


@cache
def world() -> World:
    """A robot that turns then."""
    return reference_world(RTK, "constant", 2, 60.0)


def held_up(until_s: float, late_s: float | None) -> list[Reading]:
    """Readings in the order of their stamps, packets from BEGIN_S on held up by so much; None: all until the end."""
    readings: list[Reading] = []
    for now_ns, samples in sample_stream(world(), RTK.bound_m, Rates(steps_per_fix=10)):
        seconds = (now_ns - world().start_ns) * 1e-9
        if seconds > SECONDS:
            break
        for sample in samples:
            late_ns = round(1e9 * (until_s - seconds if late_s is None else late_s))
            if isinstance(sample, InertialSample) and BEGIN_S <= seconds < until_s:
                sample = replace(sample, stamp=sample.stamp.shifted(late_ns, late_ns))
            readings.append(sample)
    return sorted(readings, key=lambda reading: reading.stamp.latest_ns)


@pytest.mark.parametrize(("until_s", "late_s"), [(BEGIN_S + 1.5, 0.03), (BEGIN_S + 1.5, 0.2), (BEGIN_S + 0.5, None)])
def test_packets_that_are_held_up_make_no_pose_false_from_the_contradiction_on(
    until_s: float, late_s: float | None
) -> None:
    """On time by the board's clock, late by the host's: whichever is believed, the other one is not forgotten."""
    declared = devices(RTK)
    imu = replace(declared.imu, clock_drift_ppm=50.0)
    pose = Filter(ROBOT, replace(FILTER, fault_length_s=6.0), declared.encoders, imu, declared.gps)
    start, checks = world().pose(world().start_ns), 0
    for k, reading in enumerate(held_up(until_s, late_s)):
        pose.accept(reading)
        horizon_ns = pose.horizon_ns
        if k % 7 or pose.guarantee.intact or horizon_ns is None or pose.oldest_ns is None:
            continue
        at_ns = horizon_ns // 1_000_000 * 1_000_000
        box = pose.pose_over(at_ns, at_ns) if at_ns >= pose.oldest_ns else None
        if box is not None:
            checks += 1
            assert inside(world().pose(at_ns), start, box.low, box.high), (at_ns - world().start_ns) * 1e-9
    assert checks > 100
    assert pose.guarantee.sensor in ("imu_clock", "imu_latency")
    assert "imu_latency" in pose.faults[0].suspects
    assert pose.guarantee.status is Status.NOMINAL
