"""What a command is to write, looked at before it begins: hours of work are not thrown away at their end."""

import os
from collections.abc import Iterable
from pathlib import Path

from drivers.errors import TerraboundError


class OutputError(TerraboundError):
    """A file can't be written there, or must not be."""


def refuse_unwritable(outputs: Iterable[Path | None], inputs: Iterable[Path | None] = ()) -> None:
    """Raise OutputError where an output is an input, a folder, or in a folder that isn't there or can't be written.

    What is a device or a pipe (`/dev/stdout`) is left alone. None stands for what nobody asked for.
    """
    sources = [path for path in inputs if path is not None]
    for path in (path for path in outputs if path is not None):
        if any(_same(path, source) for source in sources):
            raise OutputError(f"{path}: is read by this command and would be overwritten; name another file")
        if path.is_dir():
            raise OutputError(f"{path}: can't be written: is a folder; name a file")
        folder = path.resolve().parent
        if path.exists() and not path.is_file():
            continue
        if not folder.is_dir():
            raise OutputError(f"{path}: can't be written: there is no folder {folder}; make it, or name another")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise OutputError(f"{path}: can't be written: the folder {folder} can't be written to; name another")


def _same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:  # one of them isn't there
        return False
