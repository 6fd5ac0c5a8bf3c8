"""A scanner whose conversation with somebody else was recorded: its scans, with the declared times and unit.

Our own driver's recordings hold a conversation that it can follow once more. Those of an earlier version of it, of
another program, or of a scanner that was streaming already do not; then the telegrams alone must tell (stream.py).
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drivers.config import LaserConfig
from drivers.samples import Scan, Stamp
from drivers.sick_lms.findings import IMPLAUSIBLE
from drivers.sick_lms.framing import Frame
from drivers.sick_lms.measurements import CM, MM
from drivers.sick_lms.sent_times import SentTimes
from drivers.sick_lms.stream import LmsStreamDecoder


class OverheardScanner:
    """A device protocol that never asks: every scan of the declared unit, whatever its angles."""

    deadline_ns = None

    def __init__(self, config: LaserConfig) -> None:
        self.counts: Counter[str] = Counter()
        """Also `undecoded_unit`: in another than the declared unit, for which no range bound is declared; and
        `scans_of_inferred_width`: nothing in the recording told how wide their distances are coded."""
        self.baud = config.baud
        self._config = config
        self._sent_times = SentTimes(config, self.counts)
        self._stream = self._listening()

    def connection_made(self, now_ns: int) -> None:
        """The port was opened: nothing of the old stream goes on."""
        self._sent_times.restart()
        self._stream = self._listening()

    def receive_data(self, data: bytes, stamp_ns: int) -> Sequence[Scan]:
        """Scans that can be told now; some wait for a telegram that says what theirs do not."""
        return self._plausible(self._stream.receive_data(data, stamp_ns))

    def finish(self) -> Sequence[Scan]:
        """The recording has ended: the scans that still waited."""
        return self._plausible(self._stream.finish())

    def advance(self, now_ns: int) -> None:
        """Nothing is waited for."""

    def data_to_send(self) -> bytes:
        """Nothing is asked."""
        return b""

    def _plausible(self, scans: Sequence[Scan]) -> Sequence[Scan]:
        """A scan that the scanner itself calls implausible has no distances."""
        return [
            replace(scan, ranges_m=np.full_like(scan.ranges_m, np.nan)) if scan.status & IMPLAUSIBLE else scan
            for scan in scans
        ]

    def _listening(self) -> LmsStreamDecoder:
        return LmsStreamDecoder(unit=MM if self._config.unit == "mm" else CM, sent=self._sent, counts=self.counts)

    def _sent(self, frame: Frame) -> Stamp:
        return self._sent_times.of(frame, 10_000_000_000 // self.baud)
