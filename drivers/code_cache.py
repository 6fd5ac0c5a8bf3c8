"""Machine code on disk: never older than its sources, whole or not believed, and quickly back in memory.

numba's cache is slow to read: it first makes ready to compile (0.3 s), and parses each function's bitcode, which only a
compilation of its callers needs (5 ms a function). Here both wait until something is compiled, which a start of the
service with a warm cache never does (docs/decisions/0030).

What a power cut or a disk has damaged is compiled again, and so is what a full disk had no room for: no start fails by
it, and no damaged code runs.
"""

import contextlib
import fcntl
import pickle
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numba
from llvmlite.binding import parse_bitcode
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.runtime.nrt import rtsys

from drivers.code_folder import code_folder

KNOWN_NUMBA = ((0, 68),)
"""Versions whose loading of code is known to be what `_LinkedLater` and `_QuickCache` take the place of. Another one
reads its cache in its own way: slower, and just as right."""
_CRC_BYTES = 4


def kept_on_disk(dispatcher: Any) -> Any:
    """The dispatcher, which from now on finds its machine code on disk, and keeps there what it compiles."""
    known = numba.version_info.short in KNOWN_NUMBA
    dispatcher._cache = (_QuickCache if known else _Cache)(dispatcher.py_func)
    return dispatcher


class CacheFile(IndexDataCacheFile):
    """A function's index and code files, each with a checksum; written while no other process writes any in the folder.

    numba names a file in its index before it writes the file: of two processes that compile a function for different
    types at the same time, one would find the other's code under its own types.
    """

    def save(self, key: Any, data: Any) -> None:
        """Keep `data` under `key`."""
        with Path(self._cache_path, ".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            super().save(key, data)

    def _save_index(self, overloads: Any) -> None:
        self._write(self._index_path, (self._version, overloads))

    def _load_index(self) -> Any:
        version, overloads = self._read(self._index_path) or (None, {})
        return overloads if version == self._version else {}

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._data_path(name), data)

    def _load_data(self, name: str) -> Any:
        return self._read(self._data_path(name))

    def _write(self, path: str, content: Any) -> None:
        pickled = self._dump(content)
        with self._open_for_write(path) as file:
            file.write(zlib.crc32(pickled).to_bytes(_CRC_BYTES, "little") + pickled)

    @staticmethod
    def _read(path: str) -> Any:
        """What `_write` wrote; None where it is not there, or no longer whole."""
        try:
            stored = memoryview(Path(path).read_bytes())
        except OSError:
            return None
        crc, pickled = stored[:_CRC_BYTES], stored[_CRC_BYTES:]
        return pickle.loads(pickled) if zlib.crc32(pickled) == int.from_bytes(crc, "little") and pickled else None


class _ByItsSources(_CacheLocator):
    """Finds a function's folder; its name tells the sources, so files need no stamp of their own."""

    def __init__(self, function: Callable[..., Any], path: str) -> None:
        self._py_file = path
        self._line = function.__code__.co_firstlineno
        self._folder = code_folder(Path(path))

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "_ByItsSources":
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return ""

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Code(CompileResultCacheImpl):
    _locator_classes = [_ByItsSources]  # noqa: RUF012  # as numba declares it


class _Cache(FunctionCache):
    """A function's machine code on disk, read in numba's way."""

    _impl_class: Any = _Code

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = CacheFile(self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp())

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a function's code for these types, if the disk takes it."""
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)


_LINKED_LATER = "object, linked later"
"""Kind of a stored library, beside numba's own kinds "object" and "bitcode"."""


class _LinkedLater(JITCodeLibrary):
    """Machine code read back, whose bitcode is parsed once a caller is compiled that links to it."""

    _bitcode: bytes | None = None

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        name, kind, data = state
        if kind != _LINKED_LATER:
            return super()._unserialize(codegen, state)
        object_code, bitcode, defined = data
        library = codegen.create_library(name)
        library.enable_object_caching()
        library._set_compiled_object(object_code)
        library._bitcode = bitcode
        library._finalize_final_module()
        codegen._engine._defined_symbols.update(defined)
        return library

    def _get_module_for_linking(self) -> Any:
        if self._bitcode is not None:
            self._shared_module, self._bitcode = parse_bitcode(self._bitcode), None
        return super()._get_module_for_linking()


class _QuickCode(_Code):
    """Stores beside a function's code the names that it defines, so that its bitcode need not be parsed for them."""

    def reduce(self, data: Any) -> Any:
        (name, kind, stored), *others = super().reduce(data)
        if kind != "object":
            return ((name, kind, stored), *others)
        module = data.library._get_module_for_linking()
        symbols = (symbol for group in (module.functions, module.global_variables) for symbol in group)
        defined = [symbol.name for symbol in symbols if not symbol.is_declaration]
        return ((name, _LINKED_LATER, (*stored, defined)), *others)


class _QuickCache(_Cache):
    """The same, read back without making ready to compile: a compilation does that itself before it begins."""

    _impl_class = _QuickCode

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The function's code for these types, or None."""
        rtsys.initialize(target_context)
        return self._load_overload(sig, target_context)


if numba.version_info.short in KNOWN_NUMBA:
    JITCPUCodegen._library_class = cast(Any, _LinkedLater)
