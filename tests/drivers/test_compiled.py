"""Machine code is kept, and is never older than the sources it was made of."""

import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.errors import NumbaError
from numpy.typing import NDArray

from drivers import compiled
from drivers.code_cache import CacheFile
from drivers.code_folder import code_folder, sources
from mapper import kernel


def test_machine_code_is_keyed_by_the_module_and_by_all_that_it_imports() -> None:
    """A callee or a constant edited in another file makes the caller's machine code anew."""
    found = {str(path.relative_to(Path(kernel.__file__).parents[1])) for path in sources(Path(kernel.__file__))}
    assert {"mapper/kernel.py", "mapper/grid.py", "mapper/projection.py", "drivers/compiled.py"} <= found
    assert "mapper/elevation_map.py" not in found, "an edit above the kernel must not cost a compilation"


def test_each_module_has_a_folder_of_its_own() -> None:
    """... so that an edit on one floor leaves the machine code of the others in place."""
    folders = {code_folder(Path(str(module.__file__))) for module in (kernel, compiled)}
    assert len(folders) == 2


def test_two_who_keep_code_at_once_never_find_each_others(tmp_path: Path) -> None:
    """Each pair of signatures kept at the same moment is there afterwards, or not; never one under the other's name."""
    cache_file: Callable[..., Any] = CacheFile
    for number in range(60):
        folder = tmp_path / str(number)
        folder.mkdir()
        ready = threading.Barrier(4)

        def keep(name: str, folder: Path = folder, ready: threading.Barrier = ready) -> None:
            mine = cache_file(str(folder), "function-1", ("stamp", 1))
            ready.wait()
            mine.save(name, name * 1000)

        threads = [threading.Thread(target=keep, args=(name,)) for name in "abcd"]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        kept = cache_file(str(folder), "function-1", ("stamp", 1))
        assert [kept.load(name) for name in "abcd"] == [name * 1000 for name in "abcd"]


@compiled.plain_or_compiled
def halves(array: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Parts of the array itself."""
    n = len(array) // 2
    return array[:n], array[n:]


def clear_half(array: NDArray[np.float64]) -> int:
    """Clear the second; how long it is."""
    halves(array)[1][:] = 0.0
    return len(halves(array)[1])


@compiled.compiled_bare
def allocates(n: int) -> float:
    """A sum over an array of its own."""
    return float(np.ones(n).sum())


@pytest.mark.parametrize("how", [compiled.compiled, compiled.compiled_bare, lambda function: function])
def test_a_part_of_an_array_is_the_same_memory_in_python_and_in_machine_code(how: Any) -> None:
    """What is written there is in the array, which keeps its owners: none more after a thousand calls, none less."""
    array, clear = np.arange(6.0), how(clear_half)
    before = sys.getrefcount(array)
    for _ in range(1000):
        assert clear(array) == 3
    assert array.tolist() == [0.0, 1.0, 2.0, 0.0, 0.0, 0.0]
    assert sys.getrefcount(array) == before


def test_what_is_compiled_bare_cannot_allocate() -> None:
    """It doesn't even compile."""
    with pytest.raises(NumbaError):
        allocates(3)
