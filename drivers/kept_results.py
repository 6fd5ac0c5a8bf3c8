"""What a library was loaded for, kept on disk beside the machine code: who finds it there need not load the library.

A start of the service takes a tenth of a second less for each of two libraries that would tell it what they told the
last (docs/decisions/0030). What is kept depends on the library's version, on our own sources (code_folder.py) and on
what it was made of, and is not believed unless its checksum is right.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from drivers.code_folder import code_folder


def kept_result(module: str, library: str, made_of: object, make: Callable[[], Any]) -> Any:
    """What `make` gives: plain values, as JSON knows them. It is called where they are not kept, and may raise.

    module: the `__file__` of whoever makes it. made_of: plain values that it depends on, beside the library.
    """
    about = json.dumps([library, version(library), made_of])
    path = Path(
        code_folder(Path(module).resolve()), f"{library}-{hashlib.sha256(about.encode()).hexdigest()[:32]}.json"
    )
    with contextlib.suppress(OSError, ValueError):
        digest, _, text = path.read_text(encoding="utf-8").partition("\n")
        if digest == _digest(text):
            return json.loads(text)
    text = json.dumps(make())
    draft = path.with_name(f"{path.name}.{os.getpid()}")
    with contextlib.suppress(OSError):
        draft.write_text(f"{_digest(text)}\n{text}", encoding="utf-8")
        draft.replace(path)
    return json.loads(text)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
