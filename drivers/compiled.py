"""Compile a numeric function to machine code, and keep that code fresh.

numba's cache looks only at the file that defines a function: a callee edited in another file would leave old
machine code in place. So the cache folder is keyed by a hash of all sources that hold compiled functions.
NUMBA_CACHE_DIR, where set (the systemd unit sets it), is the parent folder.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_HOUSE = Path(__file__).resolve().parent.parent
_FLOORS = ("drivers", "estimator", "mapper", "simulator")


def _source_hash() -> str:
    """Hash of every source file that may hold a compiled function."""
    digest = hashlib.sha256()
    for floor in _FLOORS:
        for path in sorted((_HOUSE / floor).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """First writable choice of: NUMBA_CACHE_DIR, the user's cache folder, a temporary one."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    parents = [Path(named)] if named else [Path(home) / "terrabound"]
    for parent in [*parents, Path(tempfile.gettempdir()) / f"terrabound-{os.getuid()}"]:
        folder = parent / _source_hash()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix="terrabound-"))


numba.config.CACHE_DIR = str(_cache_folder())  # type: ignore[attr-defined]


def compiled(function: F) -> F:
    """Machine code for `function`: cached on disk, no fastmath.

    Division by zero gives an infinity or NaN, as in numpy, instead of raising.
    """
    return cast(F, numba.njit(cache=True, error_model="numpy")(function))


def compiled_unlocked(function: F) -> F:
    """The same for work of tens of microseconds: other threads run meanwhile, as it releases the interpreter lock.

    Shorter work should keep the lock: each release invites a waiting thread to take it, and costs more than it gives.
    """
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
