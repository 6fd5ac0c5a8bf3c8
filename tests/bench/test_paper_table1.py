"""`terrabound reproduce table1`, short, as a user runs it: a process of its own, from an empty folder."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from bench.paper.table1_reference import HULL, KALMAN, MIXTURE, UNCUT, UNIFORM, WIDE_KALMAN
from service.cli import EXIT_INTERRUPTED, run_command


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], str]:
    """The output folder, the numbers, and what was printed."""
    folder = tmp_path_factory.mktemp("reproduce")
    command = [sys.executable, "-m", "service.cli", "reproduce", "table1", "--short", "--output", "results"]
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=250, check=False)
    assert run.returncode == 0, run.stderr
    return folder / "results", json.loads((folder / "results/table1.json").read_text()), run.stdout


def test_it_leaves_tables_numbers_and_pictures(done: tuple[Path, dict[str, Any], str]) -> None:
    """Every picture that the page shows is there, and the page is what was printed."""
    folder, _, printed = done
    page = (folder / "table1.md").read_text()
    pictures = sorted(path.name for path in folder.glob("*.png"))
    assert len(pictures) == 6
    for picture in pictures:
        assert f"({picture})" in page
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")
    assert "## Errors that keep their bounds" in printed
    assert "\x1b" not in printed


def test_ours_never_fails_where_the_errors_keep_their_bounds(done: tuple[Path, dict[str, Any], str]) -> None:
    """No true hit outside, no cell wrongly certified, under each law; and with broken bounds it is seen to fail."""
    laws = done[1]["laws"]
    keeping = [law for law in laws if "declared" not in law and "beyond" not in law and "sigma" not in law]
    assert len(keeping) == 6
    for law in keeping:
        ours = laws[law]["ours"]
        assert ours["contained_hit"] == 1.0
        assert ours["total_hits_outside"] == ours["total_hits_unseen"] == 0
        assert ours["total_certified_false"] == ours["total_certified_not_hit"] == 0
        assert ours["total_certified"] > 1000
        assert laws[law]["ours, in space"]["total_hits_outside"] == 0
    assert laws["uniform, drifting, 0.67 of the bound declared"]["ours"]["total_hits_outside"] > 0
    assert laws["constant bias"][KALMAN]["contained_hit"] < 0.1


def test_it_repeats_an_earlier_programs_numbers(done: tuple[Path, dict[str, Any], str]) -> None:
    """Eight runs instead of a hundred: the maps of the paper's comparison still come out as they did there."""
    told = {(check["errors" if "errors" in check else "law"], check["method"], check["score"]): check
            for check in done[1]["reference"]}  # fmt: skip
    for law, method in ((UNIFORM, MIXTURE), (UNIFORM, HULL), (UNCUT, MIXTURE), (UNCUT, HULL), (UNCUT, KALMAN)):
        for score in ("rmse_all", "rmse_flat", "roughness", "width_flat", "contained_all"):
            assert told[law, method, score]["met"], told[law, method, score]
    assert told[UNIFORM, WIDE_KALMAN, "width_flat"]["met"]
    assert sum(check["met"] for check in told.values()) > 0.9 * len(told)


def test_order_and_repetition_change_no_bound_of_ours(done: tuple[Path, dict[str, Any], str]) -> None:
    """Bit for bit; the mixture's estimates move when readings are fed twice."""
    joins = done[1]["order_and_repetition"]
    assert set(joins["ours"].values()) == {0}
    assert joins[MIXTURE]["moved_by_repetition"] > 10


def test_ctrl_c_ends_it_at_once_and_leaves_nobody(tmp_path: Path) -> None:
    """Pressed twice, as people do, while its worker processes run: no traceback, no worker left."""
    command = [sys.executable, "-m", "service.cli", "reproduce", "table1"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True) as run:
        children, deadline = Path(f"/proc/{run.pid}/task/{run.pid}/children"), time.monotonic() + 100
        expected = len(os.sched_getaffinity(0)) + 1  # one that tends the workers' semaphores
        while len(workers := children.read_text().split()) < expected and time.monotonic() < deadline:
            time.sleep(0.01)
        os.killpg(run.pid, signal.SIGINT)
        os.killpg(run.pid, signal.SIGINT)
        _, said = run.communicate(timeout=60)
    assert run.returncode == EXIT_INTERRUPTED
    assert "Traceback" not in said
    for worker in workers:
        while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert not Path(f"/proc/{worker}").exists()


def test_without_matplotlib_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Before anything is run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("service.commands.reproduce.find_spec", lambda name: None)
    assert run_command(["reproduce", "table1"]) == 1
    assert "pip install 'terrabound[plots]'" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())
