"""Declared bounds against drives whose true errors are known: proofs are right, and name the right bound."""

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.samples import Fix, InertialSample, Sample, Stamp
from estimator.bound_usage.at_rest import largest_change
from estimator.bound_usage.ledger import Ledger, Usage, Verdict, rounded_up
from estimator.bound_usage.usage import bound_usage
from service.commands.virtual_drive import drive_virtually
from service.config import Config, load
from service.shipped import shipped_config
from simulator.errors import LAWS

GPS_HORIZONTAL = "devices.gps.rtk_fixed_horizontal_m"
AT_THE_CORNERS = {
    "devices.imu.gyro_bias_bound_dps": 0.9,
    "devices.imu.gyro_noise_bound_dps": 0.75,  # what a standing robot may still turn is taken off
    "devices.imu.tilt_bound_deg": 0.99,
    "devices.imu.accel_bound_mps2": 0.99,
    GPS_HORIZONTAL: 0.85,  # the antenna may have swung a little on its mast
    "devices.gps.rtk_fixed_vertical_m": 0.9,
}
"""Bounds whose errors show where they change their sign, and the share that is proved at least."""


@functools.cache
def samples(law: str) -> tuple[Sample, ...]:
    """What the drivers gave in a drive of 12 s, standstill at both ends."""
    kept: list[Sample] = []
    drive_virtually(
        declared(), scene="rough", law=law, seed=3, duration_s=12.0, on_arrival=lambda a: kept.append(a.sample)
    )
    return tuple(kept)


@functools.cache
def declared() -> Any:
    return load(shipped_config("demo.toml"))


def weighed(law: str, key: str = "", factor: float = 1.0) -> dict[str, Usage]:
    """The drive's usage by key, with one bound declared `factor` times as wide."""
    config = declared().config
    given = list(samples(law))
    if key:
        *path, name = key.split(".")
        section = path[-1]
        holder = config.robot if section == "robot" else getattr(config.devices, section)
        changed = replace(holder, **{name: getattr(holder, name) * factor})
        if section == "robot":
            config = replace(config, robot=changed)
        else:
            config = replace(config, devices=replace(config.devices, **{section: changed}))
        if section == "gps":  # the driver makes bounds of it
            axes = np.array([factor, factor, 1.0] if key == GPS_HORIZONTAL else [1.0, 1.0, factor])
            given = [replace(s, bound_m=tuple((axes * s.bound_m).tolist())) if isinstance(s, Fix) else s for s in given]
    return {usage.key: usage for usage in bound_usage(config.robot, config.filter, config.devices, given)}


@pytest.mark.parametrize("law", LAWS)
def test_honest_bounds_are_never_contradicted(law: str) -> None:
    """Errors up to their bounds, by every law: no proof against any of them."""
    assert {key: usage.used for key, usage in weighed(law).items() if usage.used > 1.0 + 1e-6} == {}


@pytest.mark.parametrize("law", ["corners", "uniform"])
def test_a_scanner_within_its_bounds_that_looks_down_at_the_ground_is_not_suspected(law: str) -> None:
    """Beams graze the ground, and wander by what a tilting beam does to their length, beside the range's own error."""
    usage = weighed(law)["devices.laser.range_bound_m"]
    assert usage.readings > 1000
    assert usage.verdict is Verdict.USED


@pytest.mark.parametrize("key", AT_THE_CORNERS)
def test_errors_at_the_corners_use_up_their_bound(key: str) -> None:
    """Nearly all of it is proved to be needed, and all of it is seen."""
    usage = weighed("corners")[key]
    assert AT_THE_CORNERS[key] <= usage.used <= 1.0 + 1e-6
    assert usage.seen_share > 0.97
    assert usage.readings > 100
    assert usage.worst


@pytest.mark.parametrize("key", AT_THE_CORNERS)
def test_a_bound_at_half_of_the_truth_is_contradicted_and_no_other(key: str) -> None:
    """It alone is named, with a proposal between what it was and what is true."""
    usages = weighed("corners", key, 0.5)
    assert [k for k, usage in usages.items() if usage.verdict is Verdict.CONTRADICTED] == [key]
    proposal = usages[key].proposal
    assert proposal is not None
    assert usages[key].declared < usages[key].needed <= proposal <= 2.0 * usages[key].declared * 1.01
    assert usages[key].when_ns is not None


def test_slip_beyond_its_bound_is_proved_from_turns() -> None:
    """Each track slips at its bound all the time: half of it is contradicted, given gauge and gyroscope."""
    usage = weighed("constant", "robot.slip_ratio", 0.5)["robot.slip_ratio"]
    assert usage.verdict is Verdict.CONTRADICTED
    assert "robot.track_gauge_m" in usage.given
    assert usage.needed <= 0.02 * (1.0 + 1e-6)


@pytest.mark.parametrize(
    "key",
    [
        "devices.imu.gyro_bias_bound_dps", "devices.imu.gyro_noise_bound_dps", "devices.imu.tilt_bound_deg",
        "devices.imu.accel_bound_mps2", "robot.slip_ratio",
    ],
)  # fmt: skip
def test_a_bound_ten_times_too_wide_is_named(key: str) -> None:
    """Needlessly wide, with a proposal that would have held."""
    usage = weighed("corners", key, 10.0)[key]
    assert usage.verdict is Verdict.WIDE
    assert usage.proposal is not None
    assert 0.1 * usage.declared * 0.99 <= usage.proposal < 0.5 * usage.declared


@pytest.mark.parametrize("key", [GPS_HORIZONTAL, "robot.max_speed_mps", "devices.laser.range_bound_m"])
def test_where_an_error_can_hide_little_use_is_told_but_nothing_is_proposed(key: str) -> None:
    """A receiver's error may stay the same, and the next drive may be faster: it only looks wide."""
    usage = weighed("corners", key, 10.0)[key]
    assert usage.verdict is Verdict.LOOKS_WIDE
    assert usage.proposal is None
    assert usage.blind_to


def test_what_can_not_be_seen_is_called_unseen() -> None:
    """Side slip, turning centre, the counters' latency: no share is made up."""
    usages = weighed("corners")
    for key in ("robot.lateral_slip_ratio", "robot.turning_centre_m", "devices.encoders.latency_ms"):
        assert usages[key].verdict is Verdict.UNSEEN
        assert usages[key].blind_to


def test_nothing_is_said_of_a_drive_without_readings() -> None:
    """An empty recording: every bound is unseen."""
    config: Config = declared().config
    usages = bound_usage(config.robot, config.filter, config.devices, [])
    assert {usage.verdict for usage in usages} == {Verdict.UNSEEN}


def test_the_largest_change_is_the_one_between_any_two_values() -> None:
    """Against all pairs: how far each value is from an earlier one, less what a drift explains."""
    random = np.random.default_rng(5)
    values, times = random.normal(size=60), np.cumsum(random.uniform(0.0, 1.0, 60))
    for rate in (0.0, 0.3):
        expected = [
            max(abs(values[j] - values[i]) - rate * (times[j] - times[i]) for i in range(j + 1)) for j in range(60)
        ]
        np.testing.assert_allclose(largest_change(values, times, rate), expected, atol=1e-12)


def inertial(k: int, latency_ms: float, opened_ms: float = 0.0, drift_ppm: float = 0.0) -> InertialSample:
    """Packet k of a board that reads every 100 ms, declared latency 0 to 11 ms."""
    read_ns = 10**9 + round((100.0 * k * (1.0 + drift_ppm * 1e-6) + latency_ms) * 1e6)
    stamp = Stamp(read_ns - 11_000_000 - round(opened_ms * 1e6), read_ns)
    return InertialSample(stamp, "HIGHRES_IMU", 0, 100_000 * k, gyro_rps=(0.0, 0.0, 0.0))


def test_a_latency_that_varies_more_than_declared_is_contradicted() -> None:
    """By 14 ms where 11 are declared; a read that the host itself was late for, and said so, proves nothing."""
    config = declared().config
    for opened_ms, verdict in ((0.0, Verdict.CONTRADICTED), (5.0, Verdict.USED)):
        packets = [inertial(k, 14.0 if k == 20 else 0.0, opened_ms if k == 20 else 0.0) for k in range(50)]
        usages = {usage.key: usage for usage in bound_usage(config.robot, config.filter, config.devices, packets)}
        assert usages["devices.imu.latency_ms"].verdict is verdict


def test_a_clock_that_drifts_more_than_declared_is_contradicted() -> None:
    """200 ppm over two minutes, where 50 are declared; the latency is not blamed."""
    config = declared().config
    packets = [inertial(k, 5.0 + 5.0 * (-1) ** k, drift_ppm=200.0) for k in range(1200)]
    usages = {usage.key: usage for usage in bound_usage(config.robot, config.filter, config.devices, packets)}
    drift = usages["devices.imu.clock_drift_ppm"]
    assert drift.verdict is Verdict.CONTRADICTED
    assert 50.0 < drift.needed <= 201.0
    assert usages["devices.imu.latency_ms"].verdict is Verdict.USED


def test_a_contradicted_bound_is_not_held_against_the_others() -> None:
    """From then on what was seen of it counts."""
    ledger = Ledger()
    ledger.declare("a", 1.0)
    assert ledger.trusted("a") == 1.0
    ledger.charge("a", needed=np.array([0.5]), seen=np.array([3.0]), when_ns=np.array([7]), worst="")
    assert ledger.trusted("a") == 1.0
    ledger.charge("a", needed=np.array([2.0]), when_ns=np.array([8]), worst="")
    assert ledger.trusted("a") == 3.0


@pytest.mark.parametrize(("value", "wanted"), [(0.0394, 0.04), (0.030, 0.03), (123.0, 130.0), (0.0, 0.0), (1.01, 1.1)])
def test_proposals_are_rounded_up_to_two_digits(value: float, wanted: float) -> None:
    """Never down."""
    assert rounded_up(value) == pytest.approx(wanted)
