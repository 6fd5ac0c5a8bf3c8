"""Measurements that contradict their bounds: said aloud, kept, and never used."""

from collections import Counter

from estimator.bounded_pose import INTACT, Guarantee


class Contradictions:
    """The first contradiction voids the guarantee for good; every one is counted by its sensor.

    An empty intersection proves that some declared bound was broken (not always the named sensor's own: the others
    that made the set count too). That none was empty proves nothing.
    """

    def __init__(self, counts: Counter[str]) -> None:
        self.guarantee: Guarantee = INTACT
        self._counts = counts

    def report(self, sensor: str, time_ns: int) -> None:
        """`sensor` contradicts the set at host time `time_ns`."""
        self._counts[f"contradiction_{sensor}"] += 1
        if self.guarantee.intact:
            self.guarantee = Guarantee(void_since_ns=time_ns, sensor=sensor)
