"""What a command is to write, looked at before it begins: hours of work are not thrown away at their end."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from drivers.errors import TerraboundError


class OutputError(TerraboundError):
    """A file can't be written there, or must not be."""


def refuse_unwritable(outputs: Iterable[Path | None], inputs: Iterable[Path | None] = ()) -> None:
    """Raise OutputError where an output is an input, another output, or can't be written: a folder, or in none such.

    What is a device or a pipe (`/dev/stdout`) is left alone. None stands for what nobody asked for.
    """
    sources = [path for path in inputs if path is not None]
    taken: set[Path] = set()
    for path in (path for path in outputs if path is not None):
        if any(_same(path, source) for source in sources):
            raise OutputError(f"{path}: is read by this command and would be overwritten; name another file")
        if path.is_dir():
            raise OutputError(f"{path}: can't be written: is a folder; name a file")
        folder = path.resolve().parent
        if path.exists() and not path.is_file():
            continue
        if path.resolve() in taken:
            raise OutputError(f"{path}: is to be written twice, with different things; name two files")
        taken.add(path.resolve())
        if not folder.is_dir():
            raise OutputError(f"{path}: can't be written: there is no folder {folder}; make it, or name another")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise OutputError(f"{path}: can't be written: the folder {folder} can't be written to; name another")


def make_folder(path: Path) -> None:
    """Make the folder that a command leaves things in, if it isn't there. Raises OutputError where it can't be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: can't be made a folder: {error.strerror}; name another") from None


@contextmanager
def named_in_errors(path: Path) -> Iterator[None]:
    """A full disk is told with the file that it has no room for. Raises OutputError."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        raise OutputError(f"{path}: can't be written: {error.strerror or error}") from error


def write_text(path: Path, text: str) -> None:
    """Write a file whole. Raises OutputError or OSError, which name it."""
    with named_in_errors(path):
        path.write_text(text, encoding="utf-8")


def _same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:  # one of them isn't there
        return False
