"""How a long command is getting on, as one line on a terminal that is rewritten while the data goes elsewhere."""

import sys
import time
from typing import TextIO

_PERIOD_S = 0.2


class LiveLine:
    """Standard error's line. Where that is no terminal, or the data itself goes to the terminal, nothing is shown."""

    def __init__(self) -> None:
        self._shown = _is_terminal(sys.stderr) and not _is_terminal(sys.stdout)
        self._next_s = 0.0

    def show(self, text: str) -> None:
        """Now and then, in place of what was there."""
        if self._shown and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _PERIOD_S
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Leave the line empty."""
        if self._shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def _is_terminal(stream: TextIO | None) -> bool:
    """None: closed by `>&-`."""
    return stream is not None and stream.isatty()
