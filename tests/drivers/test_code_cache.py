"""Machine code comes back from disk quickly, and is as good as what was just compiled."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest

from drivers import code_cache

MODULE = """
import numpy as np
from drivers.compiled import compiled, compiled_into_callers, compiled_without_heap

@compiled_into_callers
def halved(x: float) -> float:
    return 0.5 * x

@compiled
def total(values):
    whole = 0.0
    for value in values:
        whole += halved(value)
    return whole

@compiled_without_heap
def scale(values, factor):
    for i in range(values.size):
        values[i] *= factor

@compiled
def checked(values):
    if values[0] < 0.0:
        raise ValueError("negative")
    return np.sqrt(values[-1])
"""

PROGRAM = """
import json, sys
import numpy as np
{patch}
from kept import checked, halved, scale, total

values = np.arange(5.0)
scale(values, 3.0)
out = {{"total": total(values), "root": checked(values), "scaled": values.tolist(), "half": halved(7.0)}}
try:
    checked(np.full(2, -1.0))
except ValueError as error:
    out["raised"] = str(error)
out["hits"] = [sum(f.stats.cache_hits.values()) for f in (halved, scale, total, checked)]
out["misses"] = [sum(f.stats.cache_misses.values()) for f in (halved, scale, total, checked)]
out["ready_to_compile"] = "numba.np.linalg" in sys.modules
{after}
print(json.dumps(out))
"""

COMPILE_A_CALLER = """
from drivers.compiled import compiled
import numba

@numba.njit
def caller(values):
    scale(values, 2.0)
    return total(values) + halved(1.0) + checked(values)

out["called"] = caller(np.ones(4))
out["again"] = [total(np.ones(4)), total(np.ones(4, np.float32))]  # of a type that is not on disk
"""
NO_ROOM = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))"
IN_NUMBAS_WAY = "from drivers import code_cache; code_cache.KNOWN_NUMBA = ()"


def _run(folder: Path, patch: str = "", after: str = "") -> Any:
    (folder / "kept.py").write_text(MODULE)
    program = folder / "program.py"
    program.write_text(PROGRAM.format(patch=patch, after=after))
    house = str(Path(code_cache.__file__).parents[1])
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "code"), "PYTHONPATH": house}
    done = subprocess.run(
        [sys.executable, program], env=environment, capture_output=True, text=True, timeout=200, check=True
    )
    return json.loads(done.stdout)


WANTED = {"total": 15.0, "scaled": [0.0, 3.0, 6.0, 9.0, 12.0], "half": 3.5, "raised": "negative"}


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """A folder with code on disk, and what the process said that compiled it."""
    folder = tmp_path_factory.mktemp("kept")
    return folder, _run(folder)


def test_the_installed_numba_is_one_whose_code_is_known_to_come_back_quickly() -> None:
    """With another version the service starts a second later: look at its loading of code, then name the version."""
    assert numba.version_info.short in code_cache.KNOWN_NUMBA


def test_code_comes_back_as_it_was_without_making_ready_to_compile(kept: tuple[Path, Any]) -> None:
    """A second process compiles nothing, computes the same, raises the same."""
    folder, first = kept
    second = _run(folder)
    assert first["misses"] == [1, 1, 1, 1]
    assert first["ready_to_compile"]
    assert (second["hits"], second["misses"]) == ([1, 1, 1, 1], [0, 0, 0, 0])
    assert not second["ready_to_compile"]
    for run in (first, second):
        assert WANTED.items() <= run.items()
    assert first["root"] == second["root"]


def test_what_came_back_is_linked_into_callers_compiled_later(kept: tuple[Path, Any]) -> None:
    """A caller that is new, and a type that is new, are compiled against code that was read back."""
    second = _run(kept[0], after=COMPILE_A_CALLER)
    assert second["hits"] == [1, 1, 1, 1]
    assert second["called"] == pytest.approx(4.0 + 0.5 + 2.0**0.5)
    assert second["again"] == [2.0, 2.0]


def test_with_another_numba_its_own_way_is_taken(tmp_path: Path) -> None:
    """An unknown version reads its cache as it always does, and computes the same."""
    first, second = _run(tmp_path, patch=IN_NUMBAS_WAY), _run(tmp_path, patch=IN_NUMBAS_WAY)
    assert first["misses"] == second["hits"] == [1, 1, 1, 1]
    assert second["ready_to_compile"]
    assert WANTED.items() <= second.items()


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "kept.halved*.nbi": lambda data: b"",
    "kept.scale*.nbi": lambda data: data[:-9] + bytes((data[-9] ^ 1,)) + data[-8:],
    "kept.total*.nbc": lambda data: data[:-20],
    "kept.checked*.nbc": lambda data: data[:2000] + bytes((data[2000] ^ 1,)) + data[2001:],
}


def test_what_is_damaged_on_disk_is_compiled_again(kept: tuple[Path, Any], tmp_path: Path) -> None:
    """After a power cut files may be empty or cut short, or a bit has turned: none of it runs or ends the program."""
    folder = tmp_path / "kept"
    shutil.copytree(kept[0], folder)
    for files, damage in DAMAGE.items():
        damaged = list(folder.rglob(files))
        assert damaged
        for path in damaged:
            path.write_bytes(damage(path.read_bytes()))
    again, after = _run(folder), _run(folder)
    assert again["misses"] == after["hits"] == [1, 1, 1, 1]
    assert WANTED.items() <= again.items()


def test_a_full_disk_keeps_nothing_and_ends_nothing(tmp_path: Path) -> None:
    """What can't be kept is compiled at each start."""
    full = _run(tmp_path, patch=NO_ROOM)
    assert full["misses"] == [1, 1, 1, 1]
    assert WANTED.items() <= full.items()
    assert not list(tmp_path.rglob("*.nb?"))
