"""What is installed on the robot beside the program."""

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from service.config import load
from service.shipped import shipped_config

FOLDER = Path(__file__).resolve().parents[2] / "systemd"
ANALYZE = shutil.which("systemd-analyze")
needs_analyze = pytest.mark.skipif(ANALYZE is None, reason="systemd-analyze is not installed")


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """The unit with a program that exists here, as the real one stands under /opt."""
    text = (FOLDER / "terrabound.service").read_text()
    copy = tmp_path / "terrabound.service"
    changed, count = re.subn(
        r"^ExecStart=/opt/terrabound/bin/terrabound (.*)$", r"ExecStart=/bin/true \1", text, flags=re.M
    )
    assert count == 1
    copy.write_text(changed)
    return copy


@needs_analyze
def test_systemd_understands_every_key_of_the_unit(unit: Path) -> None:
    """A misspelt key only warns, so any word about our unit is a failure."""
    done = subprocess.run([str(ANALYZE), "verify", "--man=no", str(unit)], capture_output=True, text=True, timeout=60)
    about_ours = [line for line in (done.stdout + done.stderr).splitlines() if "terrabound" in line]
    assert (done.returncode, about_ours) == (0, [])


@needs_analyze
def test_a_misspelt_key_would_be_noticed(unit: Path) -> None:
    """The check above can fail: systemd's warning names our unit."""
    unit.write_text(unit.read_text().replace("WatchdogSec=", "WatchdogSecs="))
    done = subprocess.run([str(ANALYZE), "verify", "--man=no", str(unit)], capture_output=True, text=True, timeout=60)
    assert "WatchdogSecs" in done.stdout + done.stderr


@needs_analyze
def test_the_service_is_hardened(unit: Path) -> None:
    """systemd's own measure of exposure stays at or below 2.0 of 10."""
    command = [str(ANALYZE), "security", "--offline=yes", "--threshold=20", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout[-200:]


def test_the_unit_says_what_the_program_relies_on() -> None:
    """Notification, watchdog, exit code 78, precedence, unbuffered output, a cache for numba, memory it may execute."""
    text = (FOLDER / "terrabound.service").read_text()
    settings = [line for line in text.splitlines() if line and not line.startswith(("#", "["))]
    for needed in (
        "Type=notify",
        "NotifyAccess=main",
        "Restart=on-failure",
        "RestartPreventExitStatus=78",
        "Nice=-10",
        "User=terrabound",
        "SupplementaryGroups=dialout",
        "Environment=PYTHONUNBUFFERED=1",
        "Environment=NUMBA_CACHE_DIR=/var/cache/terrabound/numba",
        "ExecStart=/opt/terrabound/bin/terrabound run --config /etc/terrabound/robot.toml",
    ):
        assert needed in settings
    assert any(line.startswith("WatchdogSec=") for line in settings)
    assert not any(line.startswith("MemoryDenyWriteExecute=y") for line in settings)


def test_the_service_may_write_where_the_example_keeps_its_map() -> None:
    """ProtectSystem=strict leaves only the state directory: the store and the saved map are in it."""
    settings = (FOLDER / "terrabound.service").read_text().splitlines()
    assert "StateDirectory=terrabound" in settings
    store = load(shipped_config("paper-robot.toml")).config.store
    for path in (store.path, store.map):
        assert path is not None
        assert Path(path).parent == Path("/var/lib/terrabound")


def test_the_service_user_is_made(tmp_path: Path) -> None:
    """systemd-sysusers makes the user and puts it into dialout."""
    tool = shutil.which("systemd-sysusers")
    if tool is None:
        pytest.skip("systemd-sysusers is not installed")
    (tmp_path / "etc").mkdir()
    command = [tool, f"--root={tmp_path}", str(FOLDER / "terrabound.sysusers")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if done.returncode != 0 and re.search("permission|not permitted", done.stderr, re.I):
        pytest.skip(f"systemd-sysusers may not write here: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    passwd = (tmp_path / "etc" / "passwd").read_text()
    assert re.search(r"^terrabound:.*:/var/lib/terrabound:\S*nologin$", passwd, re.M)
    assert re.search(r"^dialout:.*terrabound", (tmp_path / "etc" / "group").read_text(), re.M)


def test_udev_understands_the_device_rules() -> None:
    """udevadm verify finds nothing to say."""
    tool = shutil.which("udevadm", path="/usr/bin:/usr/sbin:/bin:/sbin")
    if tool is None:
        pytest.skip("udevadm is not installed")
    done = subprocess.run(
        [tool, "verify", str(FOLDER / "99-terrabound.rules")], capture_output=True, text=True, timeout=60
    )
    if "Unknown command" in done.stderr or "unrecognized" in done.stderr:
        pytest.skip("this udevadm has no verify")
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_device_rules_are_well_formed_and_give_every_stable_name() -> None:
    """Each line is KEY{attribute}OPERATOR"value", ...; laser, imu and gps get links, FTDI its short latency."""
    clause = r'[A-Z]+(\{[\w/]+\})?(==|!=|\+=|:=|=)"[^"]*"'
    text = (FOLDER / "99-terrabound.rules").read_text()
    rules = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert [rule for rule in rules if not re.fullmatch(rf"{clause}(, {clause})*", rule)] == []
    for name in ("laser", "imu", "gps"):
        assert sum(f'SYMLINK+="terrabound/{name}"' in rule and "idVendor" in rule for rule in rules) == 1
    assert any('ATTR{latency_timer}="1"' in rule for rule in rules)
    labels = set(re.findall(r'LABEL="(\w+)"', text))
    assert set(re.findall(r'GOTO="(\w+)"', text)) <= labels


def test_the_can_interface_comes_up_and_recovers_from_bus_off() -> None:
    """can0 runs at the example configuration's rate and restarts by itself."""
    network = configparser.ConfigParser()
    network.optionxform = str  # type: ignore[assignment,method-assign]
    network.read(FOLDER / "80-terrabound-can0.network")
    assert dict(network["Match"]) == {"Name": "can0"}
    assert dict(network["CAN"]) == {"BitRate": "500000", "RestartSec": "100ms"}
