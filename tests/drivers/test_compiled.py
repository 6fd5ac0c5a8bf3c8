"""Machine code is kept, and is never older than the sources it was made of."""

from pathlib import Path

from drivers import compiled
from mapper import kernel


def test_machine_code_is_keyed_by_the_module_and_by_all_that_it_imports() -> None:
    """A callee or a constant edited in another file makes the caller's machine code anew."""
    sources = {
        str(path.relative_to(Path(kernel.__file__).parents[1])) for path in compiled._sources(Path(kernel.__file__))
    }
    assert {"mapper/kernel.py", "mapper/grid.py", "mapper/projection.py", "drivers/compiled.py"} <= sources
    assert "mapper/elevation_map.py" not in sources, "an edit above the kernel must not cost a compilation"


def test_each_module_has_a_folder_of_its_own() -> None:
    """... so that an edit on one floor leaves the machine code of the others in place."""
    folders = {compiled._cache_folder(Path(str(module.__file__))) for module in (kernel, compiled)}
    assert len(folders) == 2
