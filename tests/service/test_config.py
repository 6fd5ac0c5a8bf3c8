"""A configuration is read as a whole, and every mistake in it is named at once."""

from pathlib import Path

import pytest

from drivers.errors import ConfigurationError
from service.config import load, load_for_ports, parse
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
        ("[map]", "[map]\nmax_footprint_m = 1e6", "map: max_footprint_m = 1e+06 is more than 2000 cells"),
        ('interface = "slcan"', 'interface = "serial"', "devices.encoders.interface"),
        ("range_min_m = 0.3", "range_min_m = 8.5", "range_min_m = 8.5 should be less than range_max_m = 8"),
        ("left_metres_per_tick = 0.0002", "left_metres_per_tick = 0.0", "devices.encoders.left_metres_per_tick"),
        ("latency_ms = [38.0, 50.0]", "latency_ms = [38.0, 1e15]", "devices.gps.latency_ms: 1e+15 should be at most"),
        ("mirror_phase_ms = [0.0, 0.0]", "mirror_phase_ms = [0.0, 1e15]", "devices.laser.mirror_phase_ms.1"),
        ("standstill_s = 0.5 ", "standstill_s = 1e9 ", "filter.standstill_s"),
        ("[publish]", "[publish]\ndigest_period_s = 1e300", "publish.digest_period_s"),
        ("gyro_scale_bound = 0.002", "gyro_scale_bound = 2.0", "devices.imu.gyro_scale_bound"),  # meant in percent
        ("clock_drift_ppm = 50.0", "clock_drift_ppm = 1e6", "devices.imu.clock_drift_ppm"),
        ("\nslip_ratio = 0.02", "\nslip_ratio = 2.0", "robot.slip_ratio"),
        ("turning_gauge_m = [0.35, 0.35]", "turning_gauge_m = [0.6, 0.35]", "robot.turning_gauge_m"),
        ("mount_pitch_deg = -10.0", "mount_pitch_deg = 1000.0", "devices.laser.mount_pitch_deg"),
        ("tcp/127.0.0.1:7447", "http://127.0.0.1:7447", "publish.listen.0"),
        ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:74470", "publish.listen.0"),
        ("tcp/127.0.0.1:7447", "tcp/127.0.0.1", "publish.listen.0"),
        ("reordering_window_ms = 100.0", "reordering_window_ms = 1e9", "filter.reordering_window_ms"),
        ("[filter]", "[filter]\nwrong_fixes = 6", "wrong_fixes = 6 needs wrong_fixes_of >= 28"),
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


def test_every_kind_of_address_is_taken() -> None:
    """Names, IPv6, other links and their settings: what Zenoh opens is not refused here."""
    for address in ("tcp/robot:7447", "tcp/[::]:0", "tls/robot:443#so_sndbuf=65536", "unixsock-stream//run/t.sock"):
        loaded = parse(DEMO.replace("tcp/127.0.0.1:7447", address), Path(), "robot.toml")
        assert loaded.config.publish.listen == [address]


def test_a_file_from_notepad_is_read(tmp_path: Path) -> None:
    """A byte order mark and the other line ends are no mistake."""
    (tmp_path / "robot.toml").write_text(DEMO.replace("\n", "\r\n"), encoding="utf-8-sig", newline="")
    assert load(tmp_path / "robot.toml").config == parse(DEMO, Path(), "robot.toml").config


def test_a_file_in_another_encoding_is_refused_with_its_place(tmp_path: Path) -> None:
    """An umlaut of Latin-1, or UTF-16: the line, and what to do, not a codec's words."""
    path = tmp_path / "robot.toml"
    for text, line in (
        (DEMO.encode() + "# Straße".encode("latin-1"), DEMO.count("\n") + 1),
        (DEMO.encode("utf-16"), 1),
    ):
        path.write_bytes(text)
        with pytest.raises(
            ConfigurationError, match=rf"is not UTF-8 text \(at line {line}\); save it in that encoding"
        ):
            load(path)


def test_a_long_wrong_value_is_not_repeated_whole() -> None:
    """[[devices.gps]] for [devices.gps]: the line stays a line."""
    assert max(map(len, complaint(DEMO.replace("[devices.gps]", "[[devices.gps]]")).splitlines())) < 140


@pytest.mark.parametrize("text", ["a = " + 5000 * "[" + 5000 * "]", ".".join(3000 * ["a"]) + " = 1"])
def test_what_stands_in_itself_too_deeply_is_refused(text: str) -> None:
    """A file of another program, or of nobody: one line."""
    assert "too deeply" in complaint(text)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ('[store]\npath = "map.db"\nmap = "./map.db"\n', "store.map: './map.db' is store.path, too"),
        ('[store]\nmap = "tracks.dbc"\n', "store.map: 'tracks.dbc' is devices.encoders.dbc, too"),
        ('[store]\npath = "robot.toml"\n', "store.path: 'robot.toml' is the configuration itself, too"),
        ('[store]\npath = "a"\n[record]\npath = "a"\n', "record.path: 'a' is store.path, too"),
        ('[store]\nmap = "a\\u0000"\n', "store.map: 'a\\x00' can't be the name of a file"),
        (
            '[store]\nmap = "~nobody-of-this-name/a"\n',
            "store.map: '~nobody-of-this-name/a' can't be the name of a file",
        ),
    ],
)
def test_a_file_that_is_written_is_no_other_one(more: str, told: str, tmp_path: Path) -> None:
    """The map's file would take the store's place, or the configuration's: nothing of that sort begins."""
    (tmp_path / "robot.toml").write_text(DEMO + "\n" + more)
    (tmp_path / "tracks.dbc").write_text("")
    with pytest.raises(ConfigurationError) as caught:
        load_for_ports(tmp_path / "robot.toml")
    assert told in str(caught.value)


def test_files_of_their_own_are_taken(tmp_path: Path) -> None:
    """As in the shipped examples."""
    (tmp_path / "robot.toml").write_text(DEMO + '\n[store]\npath = "map.db"\nmap = "map.npz"\n[record]\npath = "%Y"\n')
    assert load_for_ports(tmp_path / "robot.toml").config.store.map == "map.npz"


def test_a_dbc_file_of_any_encoding_is_read(tmp_path: Path) -> None:
    """Comments in UTF-8, or in nothing at all, are left alone; a name that is none is told with its key."""
    dbc = shipped_config("tracks.dbc").read_bytes() + 'CM_ "Ábra";\n'.encode() + b'CM_ "\x81\x8d";\n'
    (tmp_path / "tracks.dbc").write_bytes(dbc)
    assert "SG_ LEFT" in parse(DEMO, tmp_path, "robot.toml").dbc_text()
    with pytest.raises(ConfigurationError, match=r"devices\.encoders\.dbc: .*cannot be read"):
        parse(DEMO.replace('"tracks.dbc"', '"tracks\\u0000.dbc"'), tmp_path, "robot.toml").dbc_text()


def test_a_window_that_no_scan_comes_inside_of_is_refused() -> None:
    """On a slow line a telegram alone takes longer: the mistake names the key, why, and what would do."""
    text = shipped_config("demo.toml").read_text().replace("baud = 500000", "baud = 38400", 1)
    text = text.replace("resolution_deg = 1.0", "resolution_deg = 0.5")
    with pytest.raises(ConfigurationError, match=r"reordering_window_ms: 100 should be 222 or more: a scan is 191 ms"):
        parse(text, Path(), "robot.toml")
    wide = parse(text.replace("reordering_window_ms = 100.0", "reordering_window_ms = 222.0"), Path(), "robot.toml")
    assert wide.config.filter.reordering_window_ms == 222.0
