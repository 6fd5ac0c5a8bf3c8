"""Compile a numeric function to machine code, and keep that code fresh.

numba's cache looks only at the file that defines a function: a callee edited in another file would leave old
machine code in place. So each module's cache folder is keyed by a hash of the module and of all that it imports.
NUMBA_CACHE_DIR, where set (the systemd unit sets it), is the parent folder.
"""

import fcntl
import hashlib
import os
import re
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import IndexDataCacheFile

F = TypeVar("F", bound=Callable[..., Any])

_HOUSE = Path(__file__).resolve().parent.parent
_IMPORT = re.compile(rb"^from ((?:drivers|estimator|mapper|simulator|bench)[\w.]*) import (.*)$", re.MULTILINE)


def _sources(module: Path) -> list[Path]:
    """`module` and every file of this house that it imports, however indirectly: constants are compiled in."""
    waiting, found = [module], set[Path]()
    while waiting:
        path = waiting.pop()
        if path in found or not path.is_file():
            continue
        found.add(path)
        for name, members in _IMPORT.findall(path.read_bytes()):
            folder = _HOUSE / name.decode().replace(".", "/")
            waiting.append(folder.with_suffix(".py"))
            waiting += [folder / f"{member}.py" for member in re.findall(r"\w+", members.decode())]
    return sorted(found)


@cache
def _cache_folder(module: Path) -> str:
    """Where `module` keeps its machine code: in NUMBA_CACHE_DIR, else the user's cache folder, else a temporary one."""
    digest = hashlib.sha256()
    for path in _sources(module):
        digest.update(path.read_bytes())
    named = os.environ.get("NUMBA_CACHE_DIR")
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    parents = [Path(named)] if named else [Path(home) / "terrabound"]
    for parent in [*parents, Path(tempfile.gettempdir()) / f"terrabound-{os.getuid()}"]:
        folder = parent / digest.hexdigest()[:16]
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return str(folder)
    return tempfile.mkdtemp(prefix="terrabound-")


def _keep_beside(function: Callable[..., Any]) -> None:
    """Have numba keep what it compiles next in the cache folder of the function's module."""
    numba.config.CACHE_DIR = _cache_folder(Path(function.__code__.co_filename))  # type: ignore[attr-defined]


_save: Callable[..., None] = IndexDataCacheFile.save


def _save_alone(self: Any, key: Any, data: Any) -> None:
    """Keep machine code while no other process keeps any in this folder.

    numba names a file in its index before it writes the file: of two processes that compile a function for different
    types at the same time, one would find the other's code under its own types.
    """
    with Path(self._cache_path, ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        _save(self, key, data)


IndexDataCacheFile.save = _save_alone  # type: ignore[method-assign]  # there is no hook for it


def compiled(function: F) -> F:
    """Machine code for `function`: cached on disk, no fastmath.

    Division by zero gives an infinity or NaN, as in numpy, instead of raising.
    """
    _keep_beside(function)
    return cast(F, numba.njit(cache=True, error_model="numpy")(function))


def compiled_unlocked(function: F) -> F:
    """The same for work of tens of microseconds: other threads run meanwhile, as it releases the interpreter lock.

    Shorter work should keep the lock: each release invites a waiting thread to take it, and costs more than it gives.
    """
    _keep_beside(function)
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


_BARE: dict[str, Any] = {"_nrt": False}
"""No part of numba's own runtime: what allocates doesn't compile, and no array's references are counted, which costs an
atomic addition for each array of each call: a tenth of the mapping kernel's time."""


def compiled_without_heap(function: F) -> F:
    """The same for a hot path, in which nothing may allocate."""
    _keep_beside(function)
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", **_BARE)(function))


def compiled_into_callers(function: F) -> F:
    """The same for a small step of a hot path: its machine code becomes part of each caller's."""
    _keep_beside(function)
    return cast(F, numba.njit(cache=True, forceinline=True, error_model="numpy", **_BARE)(function))
