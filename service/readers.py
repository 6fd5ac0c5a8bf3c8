"""All devices' readers, the thread that parses what they read, the queue that it fills, the recording that is kept.

A reader's thread hardly ever needs the interpreter; what all of them have read is parsed by one thread, a few
milliseconds' worth at a time. So threads change places rarely, and no stamp waits for it (docs/decisions/0037).

They need no machine code to begin, and nothing of filter and map: the service starts them first. A scanner is found and
set up while numba is loaded; what is read before it can be read punctually would be used with late stamps, so it isn't
used.
"""

import threading
import time
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from drivers.clock import Clock
from drivers.errors import CaptureError
from drivers.port_read import read_in_machine_code
from drivers.record_pipe import Record, RecordPipe
from service.config import LoadedConfig
from service.conversation import Conversation
from service.devices import Device, can_frames, unchecked_wiring
from service.health import Health
from service.reader import Reader
from service.sample_queue import Arrival, SampleQueue

if TYPE_CHECKING:
    from drivers.capture import CaptureWriter


GATHER_S = 0.004
"""In real time what has come is parsed this often."""
LONGEST_ANSWER_S = 1.0
"""So long a lockstep waits for a port to take what its protocol answers."""
LONGEST_WAIT_S = 0.05
"""The thread looks up at least this often."""


class Awaited(NamedTuple):
    """What is waited for: something that one of these devices gave."""

    devices: Collection[str]
    since_ns: int
    """... and that was read no earlier (system monotonic)."""


class Readers:
    """The sensors' side of the service, between `start` and `stop`."""

    def __init__(
        self,
        loaded: LoadedConfig,
        clock: Clock,
        *,
        devices: tuple[Device, ...] | None = None,
        capture: Path | None = None,
    ) -> None:
        """`devices` None: as configured; their mistakes are found by `start`. `capture`: record all bytes there."""
        self.clock = clock
        self.devices = unchecked_wiring(loaded) if devices is None else devices
        self.queue = SampleQueue()
        self.queue.keeps_from_ns = None
        self.health = Health()
        self._loaded = loaded
        self._capture_path = capture
        self._capture: CaptureWriter | None = None
        self._recording_is_ours = False
        self._pipe = RecordPipe()
        self._readers: list[Reader] = []
        self._conversations: list[Conversation] = []
        """Of the ports in the order of their numbers."""
        self._names: list[str] = []
        self._gather_s = 0.0
        self._stopped = False
        self._left_to_taker = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._converse, name="conversations", daemon=True)

    def __iter__(self) -> Iterator[Conversation]:
        """Those that were started, in the devices' order."""
        begun = dict(zip(self._names, self._conversations, strict=True))
        return (begun[device.name] for device in self.devices if device.name in begun)

    @property
    def started(self) -> bool:
        """Do they read?"""
        return bool(self._readers)

    @property
    def failure(self) -> BaseException | None:
        """What ended one of them early, if anything did."""
        return next((reader.failure for reader in self._readers if reader.failure is not None), self._failure)

    def open_recording(self) -> None:
        """Create the capture's file. CaptureError where that can't be."""
        if self._capture_path is not None:
            from drivers.capture import CaptureWriter  # most drives are not recorded

            framed = can_frames(self.devices)
            self._capture = CaptureWriter(self._capture_path, self._loaded.text, self._loaded.dbc_text(), framed)
            self._recording_is_ours = True

    def forget_recording(self) -> None:
        """After `close`: remove the capture's file, if there is one."""
        if self._capture_path is not None and self._recording_is_ours:
            self._capture_path.unlink(missing_ok=True)

    def start(self, acknowledge: Callable[[str, int], None] | None = None) -> None:
        """Open the ports and begin; ports may come and go later.

        Until `read_punctually` they converse with their devices, and keep no sample. Raises ConfigurationError where
        what the configuration names can't be used; those that read already are then to be stopped.

        `acknowledge`: see Conversation. Where there is one, nothing is gathered: a lockstep waits for each answer.
        """
        self._gather_s = GATHER_S if acknowledge is None else 0.0
        # The scanner first: it may have to be set up, which takes a second.
        for device in sorted(self.devices, key=lambda device: device.name != "laser"):
            reader = Reader(device, len(self._readers), self._pipe, self.health)
            answered = None if acknowledge is None else partial(self._answered, reader, acknowledge)
            conversation = Conversation(
                device, self.clock, self.queue, self.health, reader.ask, self._capture, answered
            )
            self._names.append(device.name)
            self._conversations.append(conversation)
            self._readers.append(reader)
            reader.start()
            if len(self._readers) == 1:
                # From the beginning: it may hang on the very first bytes.
                self.health.alive("conversations", time.monotonic_ns())
                self._thread.start()

    @staticmethod
    def _answered(reader: Reader, acknowledge: Callable[[str, int], None], device: str, total_bytes: int) -> None:
        """In lockstep time goes on once a protocol's answer to what it heard is on the line."""
        reader.settle(LONGEST_ANSWER_S)
        acknowledge(device, total_bytes)

    def read_punctually(self) -> None:
        """From now on bytes are stamped as they come, and samples are kept."""
        read_in_machine_code()
        for reader in self._readers:
            reader.wake()
        self.queue.keeps_from_ns = time.monotonic_ns() if self.started else 0

    def leave_to_taker(self) -> None:
        """The thread that parses ends: from now on whoever calls `take` does it."""
        self._left_to_taker.set()
        if self._thread.is_alive():
            self._thread.join()

    def take(self, timeout_s: float, rest_s: float = 0.0, awaited: Awaited | None = None) -> list[Arrival]:
        """What the sensors have given since the last call, parsed now. One after `stop` gives all that is left.

        It is waited for `rest_s` in any case, and then, for at most `timeout_s`, until something is there: what is
        `awaited`, if anything is named. No protocol's deadline is missed.
        """
        if self._stopped:
            while self._parse(self._pipe.take(0)):
                pass
        else:
            self._parse(self._gathered(min(rest_s + timeout_s, self._patience_s()), rest_s, awaited))
        return self.queue.take(0)

    def stop(self) -> None:
        """Close the ports; what was read stays in the queue, or can be taken."""
        if self._stopped:
            return
        for reader in self._readers:
            reader.stop()
        self._stopped = True
        if self._thread.is_alive():
            self._thread.join()

    def close(self) -> None:
        """After `stop`, when nothing is taken any more.

        Where the disk refuses the capture's index, the recording replays without it.
        """
        for reader in self._readers:
            reader.close()
        self._pipe.close()
        capture, self._capture = self._capture, None
        try:
            if capture is not None:
                capture.close()
        except CaptureError as error:
            self.health.trouble("recording", str(error))

    def _converse(self) -> None:
        """The thread: whatever ends it early is kept for whoever watches over the service."""
        try:
            while not (self._stopped or self._left_to_taker.is_set()):
                self._parse(self._gathered(self._patience_s(), self._gather_s))
            while self._stopped and self._parse(self._pipe.take(0)):  # closed ports' last records
                pass
        except BaseException as error:
            self._failure = error

    def _gathered(self, patience_s: float, rest_s: float, awaited: Awaited | None = None) -> list[Record]:
        """What ports gave; see `take`."""
        if rest_s > 0:
            time.sleep(min(rest_s, patience_s))
        left_s = patience_s - rest_s
        if awaited is None:
            return self._pipe.take(left_s)
        ports = (port for port, name in enumerate(self._names) if name in awaited.devices)
        return self._pipe.take(left_s, ports, awaited.since_ns)

    def _parse(self, records: list[Record]) -> bool:
        """Make samples of what ports gave, and let deadlines pass; was there anything?"""
        now_ns = self.clock.now_ns()
        for record in records:
            self._conversations[record.port].take(record)
        for conversation in self._conversations:
            conversation.look_up(now_ns)
        self.health.alive("conversations", time.monotonic_ns())
        return bool(records)

    def _patience_s(self) -> float:
        """How long to wait for bytes: until a deadline, and never too long."""
        now_ns = self.clock.now_ns()
        return min([LONGEST_WAIT_S, *(conversation.patience_s(now_ns) for conversation in self._conversations)])
