"""What a person sees who makes a mistake: one clear line, the right exit code, never a traceback.

Through the real entry point, from an empty folder.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.transports import open_serial
from service.cli import COMMANDS, run_command
from service.shipped import shipped_config
from simulator.ports import PseudoPort

DEMO = shipped_config("demo.toml").read_text(encoding="utf-8")
DBC = shipped_config("tracks.dbc").read_text(encoding="utf-8")

Told = tuple[int, str]


def terrabound(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command as a process of its own."""
    command = [sys.executable, "-m", "service.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=100, check=False)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the user is: a folder with the demo's configuration, whose ports are not there."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.toml").write_text(DEMO)
    (tmp_path / "tracks.dbc").write_text(DBC)
    return tmp_path


def complaint(capfd: pytest.CaptureFixture[str], *arguments: object) -> Told:
    """Exit code and what was said, of a command that must not fail with a traceback."""
    code = run_command([str(argument) for argument in arguments])
    said = capfd.readouterr()
    return code, said.err + said.out


def test_the_page_of_all_commands_says_what_each_is_for(tmp_path: Path) -> None:
    """From an empty folder, without importing any of them."""
    done = terrabound(tmp_path, "--help")
    assert done.returncode == 0
    for name, (_, line) in COMMANDS.items():
        assert name in done.stdout
        assert line.split()[0] in done.stdout


@pytest.mark.parametrize("name", [*COMMANDS, "decode lms", "listen encoders", "emulate robot", "emulate gps"])
def test_every_command_explains_itself(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    """Usage, a sentence, and every option with what it does."""
    assert run_command([*name.split(), "--help"]) == 0
    page = capfd.readouterr().out
    assert f"Usage: terrabound {name}" in page
    assert len(page.splitlines()) > 8


@pytest.mark.parametrize(
    "arguments",
    ["frobnicate", "check", "check --frob", "check --config demo.toml --report x --seconds 0",
     "decode", "decode sonar x", "decode gps", "listen gps x --seconds 0",
     "emulate robot --duration 1", "emulate robot --speed 0",
     "demo --speed nan", "demo --speed -1", "decode encoders x --dbc y", "decode lms x --measuring-mode 9"],
)  # fmt: skip
def test_wrong_usage_is_2(arguments: str, folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Unknown commands and options, missing and impossible values; a group without a command shows its page."""
    code, text = complaint(capfd, *arguments.split())
    assert code == (0 if arguments == "decode" else 2)
    assert text.strip()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("max_speed_mps = 0.8", "max_sped_mps = 0.8", "robot.max_sped_mps: unknown key; did you mean max_speed_mps?"),
        ("gyro_bias_bound_dps", "gyro_bias_bound", "devices.imu.gyro_bias_bound: unknown key; did you mean"),
        ("resolution_m = 0.05", "resolution_m = -1.0", "map.resolution_m: -1.0"),
        ('dbc = "tracks.dbc"', 'dbc = "none.dbc"', "none.dbc: cannot be read"),
        ("TRACKS.LEFT", "TRACKS.LEFTY", "devices.encoders: 'TRACKS.LEFTY': TRACKS has no signal"),
        ("[robot]", "[robot", "robot.toml: not valid TOML"),
        ('"ports/imu"', '"ports/laser"', "robot.toml: devices.laser.port and devices.imu.port: both are 'ports/laser'"),
        ('"ports/imu"', '""', "robot.toml: devices.imu.port: is empty"),
        ("[robot]", "robot = 3\n[other]", "robot: 3 should be an object"),
    ],
)
@pytest.mark.parametrize("command", ["check", "run"])
def test_a_wrong_configuration_is_78_and_names_the_place(
    command: str, old: str, new: str, told: str, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """One line for each mistake, with its path."""
    assert old in DEMO
    (folder / "robot.toml").write_text(DEMO.replace(old, new))
    code, text = complaint(capfd, command, "--config", "robot.toml")
    assert code == 78
    assert told in text


@pytest.mark.parametrize(
    ("arguments", "expected", "told"),
    [
        ("check --config none.toml", 78, "none.toml: no such file"),
        ("run --config .", 78, "cannot be read"),
        ("decode gps none.log", 1, "none.log: cannot be read: No such file"),
        ("decode imu .", 1, "cannot be read: Is a directory"),
        ("decode gps tracks.dbc --gst-factor nan", 78, "gst_factor"),
        ("decode encoders x --dbc none.dbc --left A.B --right A.C", 78, "--dbc none.dbc: cannot be read"),
        ("decode encoders x --dbc robot.toml --left A.B --right A.C", 78, "give a Vector DBC file"),
        ("decode encoders x --dbc tracks.dbc --left A --right A.C", 78, "choose one of TRACKS"),
        ("listen gps none", 1, "none: no such port"),
        ("listen lms robot.toml", 1, "robot.toml: can't be used as a serial port"),
        ("export none.npz x.ply", 1, "none.npz: no such file"),
        ("export robot.toml x.ply", 1, "robot.toml: no terrain map"),
        ("export robot.toml x.ply --submap 2", 1, "--submap is for a store"),
        ("replay none.mcap", 1, "none.mcap"),
        ("replay robot.toml", 1, "robot.toml: not an MCAP recording"),
        ("emulate robot --scene dem", 2, "needs --terrain"),
        ("emulate robot --terrain robot.toml", 2, "goes with --scene dem"),
        ("emulate robot --scene dem --terrain robot.toml", 78, "robot.toml: is no elevation model"),
        ("emulate robot --scene dem --terrain none.asc", 78, "none.asc"),
        ("emulate gps --link robot.toml", 78, "robot.toml: exists and is no link"),
        ("emulate robot --speed 2", 2, "--clock"),
        ("check --config robot.toml --seconds 0.5", 1, "ports/gps: no such port"),
    ],
)
def test_what_is_not_there_is_named(
    arguments: str, expected: int, told: str, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Which file or port, and what to do; nothing is changed."""
    code, text = complaint(capfd, *arguments.split())
    assert (code, told in text) == (expected, True), text
    assert (folder / "robot.toml").read_text() == DEMO


def test_a_port_that_another_process_holds_is_named(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """listen refuses it, check tells it; both say what to do."""
    port = PseudoPort(folder / "busy")
    holder = "import sys; from drivers.transports import open_serial; held = open_serial(sys.argv[1], 115200);"
    command = [sys.executable, "-c", f"{holder} print(flush=True); sys.stdin.read()", str(folder / "busy")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()  # it has the port now
        code, text = complaint(capfd, "listen", "imu", "busy", "--seconds", 5)
        assert (code, "busy: another process has this port open" in text) == (1, True), text
        (folder / "robot.toml").write_text(DEMO.replace("ports/imu", "busy"))
        code, text = complaint(capfd, "check", "--config", "robot.toml", "--seconds", 0.5)
        assert (code, "busy: another process has this port open" in text) == (1, True), text
        process.communicate()
    open_serial(str(folder / "busy"), 115200).close()  # it is free again
    port.close()


def test_a_full_disk_is_one_line(recordings: Path, tmp_path: Path) -> None:
    """What can't be written ends the command without a traceback, also at the interpreter's end."""
    log = recordings / "nmea" / "ublox-8.log"
    with Path(os.devnull).with_name("full").open("wb") as full:
        command = [sys.executable, "-m", "service.cli", "decode", "gps", str(log)]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "No space left" in done.stderr
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr


@pytest.mark.parametrize("name", ["", "decode", "run", "emulate robot"])
def test_a_reader_that_leaves_a_page_of_help_ends_it_quietly(name: str, tmp_path: Path) -> None:
    """`| head -1` of any page, and a reader that takes nothing at all: 0, and not a word."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-m", "service.cli", *name.split(), "--help"]
    with os.fdopen(write_end, "wb") as nobody:
        done = subprocess.run(command, stdout=nobody, stderr=subprocess.PIPE, text=True, timeout=100, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_ctrl_c_while_the_command_loads_is_one_line(tmp_path: Path) -> None:
    """The moment when the command line itself is still being loaded is no exception: 130, and no traceback."""
    library = tmp_path / "cyclopts.py"  # stands before the real one: Ctrl-C comes just as it is loaded
    library.write_text(
        "import os, signal\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's background jobs ignore it
        "os.kill(os.getpid(), signal.SIGINT)\nwhile True: pass\n"
    )
    command = [sys.executable, "-c", "from service.cli import main; main()", "--help"]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (130, "terrabound: interrupted\n")
