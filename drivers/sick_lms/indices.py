"""Scans that got lost, told by the index that each telegram may carry."""

from collections import Counter


class IndexGaps:
    """Counts `lost_telegrams` and `repeated_telegrams`."""

    def __init__(self, counts: Counter[str]) -> None:
        self._counts = counts
        self._last: int | None = None

    def restart(self) -> None:
        """The next telegram is the first one: its index says nothing."""
        self._last = None

    def take(self, indices: tuple[int, int] | None) -> None:
        """Scan and telegram index of the next telegram; the latter rises by one, modulo 256."""
        if indices is None:
            return
        index = indices[1]
        if self._last is not None:
            steps = (index - self._last) % 256
            if steps == 0:
                self._counts["repeated_telegrams"] += 1
            elif steps > 1:
                self._counts["lost_telegrams"] += steps - 1
        self._last = index
