"""A demo that is ended from outside leaves nothing behind: no process, no temporary folder."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

WAIT_S = 100.0


def processes_that_name(folder: Path) -> list[str]:
    """Command lines of running processes in which the folder stands."""
    lines = []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = process.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:  # it has ended
            continue
        if str(folder) in line:
            lines.append(line)
    return lines


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_demo_that_is_ended_takes_its_robot_and_its_folder_along(number: signal.Signals, tmp_path: Path) -> None:
    """While its emulated robot is still starting, the worst moment: 130, no traceback, and nothing is left."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    # A shell's background jobs ignore Ctrl-C; as a person's foreground job it is heard.
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [sys.executable, "-c", f"{heard}; from service.cli import main; main()", "demo", "--output", "out"]
    environment = os.environ | {"TMPDIR": str(temporary)}
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True) as demo:
        deadline = time.monotonic() + WAIT_S
        while not processes_that_name(temporary) and time.monotonic() < deadline and demo.poll() is None:
            time.sleep(0.01)
        demo.send_signal(number)
        _, said = demo.communicate(timeout=WAIT_S)
    assert demo.returncode == 130, said
    assert "Traceback" not in said
    assert list(temporary.iterdir()) == []
    assert processes_that_name(temporary) == []
