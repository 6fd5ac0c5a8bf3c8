"""Where a module's machine code is kept: in a folder named by a hash of the module and of all that it imports.

numba's cache looks only at the file that defines a function: a callee edited in another file would leave old machine
code in place. NUMBA_CACHE_DIR, where set (the systemd unit sets it), is the parent folder.
"""

import contextlib
import hashlib
import os
import re
import tempfile
from functools import cache
from pathlib import Path

_HOUSE = Path(__file__).resolve().parent.parent
_IMPORT = re.compile(rb"^from ((?:drivers|estimator|mapper|simulator|bench)[\w.]*) import (.*)$", re.MULTILINE)


@cache
def _imports(module: Path) -> tuple[bytes, tuple[Path, ...]]:
    """Hash of a file, and the files of this house that it imports itself."""
    text = module.read_bytes()
    found: list[Path] = []
    for name, members in _IMPORT.findall(text):
        folder = _HOUSE / name.decode().replace(".", "/")
        named = [
            folder.with_suffix(".py"),
            *(folder / f"{member}.py" for member in re.findall(r"\w+", members.decode())),
        ]
        found += [path for path in (named[:1] if named[0].is_file() else named[1:]) if path.is_file()]
    return hashlib.sha256(text).digest(), tuple(found)


def sources(module: Path) -> list[Path]:
    """`module` and every file of this house that it imports, however indirectly: constants are compiled in."""
    waiting, found = [module], set[Path]()
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _imports(path)[1]
    return sorted(found)


@cache
def code_folder(module: Path) -> str:
    """Where `module` keeps its machine code: in NUMBA_CACHE_DIR, else the user's cache folder, else a temporary one.

    Where nothing at all can be written (a full disk) it is the first of them, and what is written there fails.
    """
    digest = hashlib.sha256(b"".join(_imports(path)[0] for path in sources(module)))
    named = os.environ.get("NUMBA_CACHE_DIR")
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    parents = [Path(named)] if named else [Path(home) / "terrabound"]
    with contextlib.suppress(OSError):
        parents.append(Path(tempfile.gettempdir()) / f"terrabound-{os.getuid()}")
    folders = [parent / digest.hexdigest()[:16] for parent in parents]
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                return str(folder)
    with contextlib.suppress(OSError):
        return tempfile.mkdtemp(prefix="terrabound-")
    return str(folders[0])
