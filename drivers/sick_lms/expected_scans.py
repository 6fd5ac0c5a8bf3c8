"""The scans that stream once the scanner is set up: which telegrams can be real, and what they mean."""

from collections import Counter
from math import nan

from drivers.samples import Scan, Stamp
from drivers.sick_lms.findings import IMPLAUSIBLE, POLLUTED, SEVERITY, WARNING
from drivers.sick_lms.indices import IndexGaps
from drivers.sick_lms.measurements import TURN_NS, ValueFormat, full_sweep, partial_sweep, scan_of
from drivers.sick_lms.range_telegrams import RangeTelegram, count_word
from drivers.sick_lms.startup import Goal
from drivers.sick_lms.telegrams import OVERHEAD, Configuration


class ExpectedScans:
    """What a scanner streams that reached its `goal` with this `configuration`, which measures distances."""

    def __init__(self, goal: Goal, configuration: Configuration, counts: Counter[str]) -> None:
        value_format = ValueFormat.of(configuration.measuring_mode, configuration.unit)
        assert value_format is not None  # any other configuration was judged unfit
        self._format = value_format
        self._counts = counts
        self._gaps = IndexGaps(counts)
        self._sweeps = (
            [partial_sweep(quarter) for quarter in range(4)] if goal.interlaced else [full_sweep(goal.variant)]
        )
        beside_values = 6 if configuration.appends_indices else 4
        self.headers = frozenset(
            (
                beside_values + 2 * sweep.count,
                count_word(sweep.count, configuration.unit, goal.interlaced, quarter),
            )
            for quarter, sweep in enumerate(self._sweeps)
        )
        """(LEN, count word) of all telegrams that can come."""
        self.status = 0
        """Status byte of the last one."""

    def scan(self, payload: bytes, sent: Stamp) -> Scan:
        """The scan of a B0h telegram with one of `headers` whose first byte was sent within `sent`."""
        telegram = RangeTelegram.parse(payload)
        self._gaps.take(telegram.indices)
        self._note(telegram.status)
        ranges_m = self._format.decode(telegram.codes)
        if telegram.status & IMPLAUSIBLE:
            ranges_m[:] = nan
        return scan_of(telegram, self._sweeps[telegram.quarter], ranges_m, sent)

    def period_ns(self, baud: int) -> int:
        """At least as long as from one scan to the next: a slow line sends only every n-th scan."""
        sweep = self._sweeps[0]
        return (2 * sweep.count + 6 + OVERHEAD) * 10_000_000_000 // baud + sweep.turns * TURN_NS

    def _note(self, status: int) -> None:
        if status & POLLUTED:
            self._counts["polluted_scans"] += 1
        if status & IMPLAUSIBLE:
            self._counts["implausible_scans"] += 1
        if status & SEVERITY >= WARNING:
            self._counts["warned_scans"] += 1
        self.status = status
