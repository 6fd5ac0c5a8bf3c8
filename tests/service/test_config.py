"""A configuration is read as a whole, and every mistake in it is named at once."""

from pathlib import Path

import pytest

from drivers.errors import ConfigurationError
from service.config import load, parse
from service.shipped import shipped_config

DEMO = shipped_config("demo.toml").read_text(encoding="utf-8")


def complaint(text: str) -> str:
    with pytest.raises(ConfigurationError) as caught:
        parse(text, Path(), "robot.toml")
    return str(caught.value)


@pytest.mark.parametrize("name", ["demo.toml", "paper-robot.toml"])
def test_the_shipped_configurations_are_valid(name: str) -> None:
    """What a newcomer copies works."""
    loaded = load(shipped_config(name))
    assert loaded.path(loaded.config.devices.encoders.dbc).exists()


def test_an_unknown_key_is_refused_with_its_path_and_the_likely_one() -> None:
    """A forgotten unit is the likeliest slip: the key with its unit is offered."""
    text = complaint(DEMO.replace("range_bound_m = 0.03", "range_bound = 0.03"))
    assert "devices.laser.range_bound: unknown key; did you mean range_bound_m?" in text
    assert "devices.laser.range_bound_m: missing" in text


def test_all_mistakes_come_at_once() -> None:
    """Nobody has to mend one line at a time."""
    broken = DEMO.replace("resolution_m = 0.05", "resolution_m = -1.0").replace("baud = 500000", "baud = 500001")
    text = complaint(broken.replace('name = "demo"', 'name = "de mo"'))
    assert "3 mistakes" in text
    for path in ("map.resolution_m", "devices.laser.baud", "robot.name"):
        assert path in text


@pytest.mark.parametrize(
    ("line", "wrong", "path"),
    [
        ("max_speed_mps = 0.8", 'max_speed_mps = "0.8"', "robot.max_speed_mps"),
        ("max_speed_mps = 0.8", "max_speed_mps = nan", "robot.max_speed_mps"),
        ("max_speed_mps = 0.8", "max_speed_mps = inf", "robot.max_speed_mps"),
        ("max_speed_mps = 0.8", "max_speed_mps = true", "robot.max_speed_mps"),
        ("latency_ms = [38.0, 50.0]", "latency_ms = [50.0, 38.0]", "devices.gps.latency_ms"),
        ("latency_ms = [38.0, 50.0]", "latency_ms = 38.0", "devices.gps.latency_ms"),
        ("resolution_deg = 1.0", "resolution_deg = 0.3", "devices.laser.resolution_deg"),
        ("[robot]", "[robbot]", "robbot"),
        ('set = "box"', 'set = "zonotope"', "filter.set"),
        ("[map]", "[map]\nmax_tile = 3", "map.max_tile"),
        ('interface = "slcan"', 'interface = "serial"', "devices.encoders.interface"),
    ],
)
def test_a_wrong_value_is_refused_and_named(line: str, wrong: str, path: str) -> None:
    """No wrong value is guessed around."""
    assert line in DEMO
    assert path in complaint(DEMO.replace(line, wrong, 1))


def test_every_bound_must_be_declared() -> None:
    """No bound has a default: leaving any one out is refused by its name."""
    bounds = [line for line in DEMO.splitlines() if "_bound" in line or "slip" in line or "latency" in line]
    assert len(bounds) > 12
    for line in bounds:
        key = line.split("=")[0].strip()
        assert f"{key}: missing" in complaint(DEMO.replace(line, "", 1))


def test_text_that_is_not_toml_is_refused_with_its_place() -> None:
    """The line is named."""
    assert "line 1" in complaint("this is no toml")


def test_a_missing_file_is_said_so(tmp_path: Path) -> None:
    """The file is named, and where to find examples."""
    with pytest.raises(ConfigurationError, match=r"nowhere\.toml: no such file"):
        load(tmp_path / "nowhere.toml")


def test_keys_that_contradict_each_other_are_named() -> None:
    """The LMS Fast's 90 degrees come at 0.5 degree alone: said in a line, not with the whole section."""
    text = complaint(DEMO.replace("scan_angle_deg = 180", "scan_angle_deg = 90"))

    assert "devices.laser: resolution_deg: at 90 degrees" in text
    assert "range_bound_m" not in text
