"""Every error law against the truth: emulated devices, drivers, filter and mapper in virtual time, without ports."""

from dataclasses import replace
from typing import Any

import pytest

from service.commands.virtual_drive import drive_virtually
from service.config import LoadedConfig, load
from service.shipped import shipped_config
from simulator.errors import LAWS

TRULY_ACROSS_DEG = 1.0


@pytest.fixture(scope="module")
def demo() -> LoadedConfig:
    """The demo's declared bounds."""
    return load(shipped_config("demo.toml"))


def lie(demo: LoadedConfig, device: str, **bounds: Any) -> LoadedConfig:
    """The demo's configuration with other declared bounds."""
    devices = demo.config.devices
    changed = replace(getattr(devices, device), **bounds)
    return replace(demo, config=replace(demo.config, devices=replace(devices, **{device: changed})))


@pytest.mark.parametrize("scene", ["stairs", "yard"])
@pytest.mark.parametrize("law", LAWS)
def test_no_truth_is_ever_outside(demo: LoadedConfig, law: str, scene: str) -> None:
    """However errors are drawn inside their declared bounds: every true pose and every true hit is in its set."""
    drive = drive_virtually(demo, scene=scene, law=law, seed=11, duration_s=8.0)
    pose_violations, cell_violations, hits = drive.violations()
    assert (pose_violations, cell_violations) == (0, 0)
    assert drive.pipeline.filter.guarantee.intact
    assert len(drive.poses.earliest_ns) >= 2 * 75 * 7
    assert hits > 50_000
    assert drive.pipeline.map.counts["too_wide"] == 0


@pytest.mark.parametrize("law", ["corners", "drift"])
def test_no_truth_is_ever_outside_the_papers_set_either(demo: LoadedConfig, law: str) -> None:
    """The same with `[filter] set = "ellipsoid"`, over rough ground."""
    config = replace(demo.config, filter=replace(demo.config.filter, set="ellipsoid"))
    drive = drive_virtually(replace(demo, config=config), scene="rough", law=law, seed=12, duration_s=5.0)
    pose_violations, cell_violations, hits = drive.violations()
    assert (pose_violations, cell_violations) == (0, 0)
    assert drive.pipeline.filter.guarantee.intact
    assert hits > 20_000


@pytest.mark.parametrize(
    ("device", "bounds", "scene", "law"),
    [
        ("laser", {"range_bound_m": 0.3 * 0.03}, "rough", "constant"),
        ("imu", {"tilt_bound_deg": 0.3 * 0.3}, "yard", "corners"),
        ("imu", {"gyro_bias_bound_dps": 0.3 * 0.3}, "yard", "corners"),
    ],
)
def test_a_lie_comes_to_light(demo: LoadedConfig, device: str, bounds: dict[str, float], scene: str, law: str) -> None:
    """A bound declared at 0.3 of the true error breaks a containment or voids the guarantee: these tests can fail."""
    drive = drive_virtually(
        lie(demo, device, **bounds),
        scene=scene,
        law=law,
        seed=11,
        duration_s=8.0,
        true_devices=demo.config.devices,
    )
    pose_violations, cell_violations, _ = drive.violations()
    assert pose_violations + cell_violations > 0 or not drive.pipeline.filter.guarantee.intact


@pytest.mark.parametrize(("declared_deg", "holds"), [(TRULY_ACROSS_DEG, True), (0.0, False)])
def test_beams_that_are_off_across_the_scan_are_mapped_within_their_own_bound(
    demo: LoadedConfig, declared_deg: float, holds: bool
) -> None:
    """Off by more than along the scan; a map that did not heed it would miss true hits."""
    truly = lie(demo, "laser", across_bound_deg=TRULY_ACROSS_DEG).config.devices
    drive = drive_virtually(
        lie(demo, "laser", across_bound_deg=declared_deg),
        scene="rough",
        law="corners",
        seed=11,
        duration_s=4.0,
        true_devices=truly,
    )
    pose_violations, cell_violations, hits = drive.violations()
    assert pose_violations == 0
    assert hits > 20_000
    assert (cell_violations == 0) is holds
    assert drive.pipeline.filter.guarantee.intact


def test_a_drive_repeats_bit_for_bit(demo: LoadedConfig) -> None:
    """The same seed gives the same map and the same pose sets."""
    one, two = (drive_virtually(demo, scene="rough", law="uniform", seed=5, duration_s=5.0) for _ in range(2))
    assert one.saved.low.tobytes() == two.saved.low.tobytes()
    assert one.saved.high.tobytes() == two.saved.high.tobytes()
    assert one.poses.low.tobytes() == two.poses.low.tobytes()
    assert one.poses.high.tobytes() == two.poses.high.tobytes()
