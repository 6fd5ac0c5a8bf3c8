"""Compile a numeric function to machine code, and keep that code on disk (drivers/code_cache.py)."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.extending import register_jitable

from drivers.code_cache import kept_on_disk

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Machine code for `function`: cached on disk, no fastmath.

    Division by zero gives an infinity or NaN, as in numpy, instead of raising.
    """
    return cast(F, kept_on_disk(numba.njit(error_model="numpy")(function)))


def compiled_unlocked(function: F) -> F:
    """The same for work of tens of microseconds: other threads run meanwhile, as it releases the interpreter lock.

    Shorter work should keep the lock: each release invites a waiting thread to take it, and costs more than it gives.
    """
    return cast(F, kept_on_disk(numba.njit(nogil=True, error_model="numpy")(function)))


_BARE: dict[str, Any] = {"_nrt": False}
"""No part of numba's own runtime: what allocates doesn't compile, and no array's references are counted, which costs an
atomic addition for each array of each call: a tenth of the mapping kernel's time."""


def compiled_without_heap(function: F) -> F:
    """The same for a hot path, in which nothing may allocate."""
    return cast(F, kept_on_disk(numba.njit(nogil=True, error_model="numpy", **_BARE)(function)))


def compiled_bare(function: F) -> F:
    """The same for a step of a few microseconds, which keeps the lock: Python hands an array over in two thirds of the
    time. None may return an array to Python, which would get another one.
    """
    return cast(F, kept_on_disk(numba.njit(error_model="numpy", **_BARE)(function)))


def compiled_into_callers(function: F) -> F:
    """The same for a small step of a hot path: its machine code becomes part of each caller's."""
    return cast(F, kept_on_disk(numba.njit(forceinline=True, error_model="numpy", **_BARE)(function)))


def plain_or_compiled(function: F) -> F:
    """Plain Python to Python, written into the code of compiled callers: for what gives parts of an array."""
    return register_jitable(inline="always")(function)


def only_as_compiled(function: Callable[..., Any]) -> None:
    """Have `function` raise TypeError for types it was not compiled for: to compile anew would take a second, live."""
    cast(Any, function).disable_compile()
