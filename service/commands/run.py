"""`terrabound run`: the service on the robot."""

import gc
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.clock import SystemClock
from drivers.errors import CaptureError, ConfigurationError
from service.config import LoadedConfig, load_for_ports
from service.health import Health
from service.lifecycle import ServiceNotifier, stop_on_signals
from service.readers import Readers
from service.session import NotAnAddress
from service.session_ahead import SessionAhead

if TYPE_CHECKING:
    from service.onboard import Onboard

TICK_S = 0.5
SLOW_START_S = 6.0
STILL_LOADING = (
    "still loading: this machine is busy, or it is a first start, which makes machine code for this computer (a minute "
    "or more, once); Ctrl-C ends it"
)
SWITCH_S = 0.001
"""So long a thread that wants the interpreter waits for one that is busy; 5 ms would be half of a tile's time."""


def run(*, config: Path) -> int:
    """Read the sensors, keep the pose set and the map, and stream tiles, until told to stop (SIGTERM, Ctrl-C, a
    terminal that goes away).

    A device that is missing, busy or unplugged is named once, tried again until it is there, and mapping goes on with
    what the others give as far as that goes. So it does where the address is in use, or nothing can be recorded.

    Parameters
    ----------
    config
        The robot's TOML file; docs/config/ holds examples.
    """
    loaded = load_for_ports(config)
    record = loaded.config.record.path
    notifier, loading = ServiceNotifier(), _Loading()
    with stop_on_signals(tell=loading.leave) as ended:
        ahead = SessionAhead(loaded.config.publish)
        capture = None if record is None else unused_path(loaded.path(record), datetime.now(UTC))
        loading.readers = readers = Readers(loaded, SystemClock(), capture=capture)
        try:
            readers.open_recording()
        except CaptureError as error:  # the map is worth more than the recording
            readers.health.trouble("recording", f"record.path: {error}; nothing is recorded until the next start")
        with _told_if_slow(notifier):
            onboard = _onboard(loaded, readers, ahead)
        loading.over = True
        notifier.ready()
        console = _Console(onboard.health)
        saved_ns = time.monotonic_ns()
        while not ended.wait(TICK_S) and onboard.failure is None:
            now_ns = time.monotonic_ns()
            line = onboard.status_line()
            notifier.status(line)
            notifier.feed(now_ns, onboard.health.flowing(now_ns))
            console.show(line)
            if now_ns - saved_ns > loaded.config.store.period_s * 1e9:
                saved_ns = now_ns
                onboard.request_save()
        notifier.stopping()
        onboard.stop()
        console.close()
    if onboard.failure is not None:
        raise onboard.failure
    return 0


def _onboard(loaded: LoadedConfig, readers: Readers, ahead: SessionAhead) -> "Onboard":
    """Filter, map and publisher, started. Their code is loaded now: meanwhile the sensors are read already."""
    gc.disable()  # what loading makes, stays
    try:
        readers.start()
        readers.read_punctually()
        from service.onboard import Onboard

        sys.setswitchinterval(SWITCH_S)
        onboard = Onboard(loaded, readers.clock, readers=readers, ahead=ahead)
        onboard.start()
    except BaseException as error:
        readers.stop()
        readers.close()
        readers.forget_recording()  # of a service that never was
        if isinstance(error, NotAnAddress):
            raise ConfigurationError(f"{loaded.source}: publish: {error}") from None
        raise
    finally:
        gc.enable()
    return onboard


def unused_path(pattern: Path, now: datetime) -> Path:
    """The recording's path: `%Y`, `%H` and so on stand for the time (UTC); a number is added where the file exists."""
    path = pattern.with_name(now.strftime(pattern.name))
    number = 1
    while os.path.lexists(path):  # False in a folder that may not be looked into: opening the file will say so
        number += 1
        path = path.with_name(f"{Path(now.strftime(pattern.name)).stem}-{number}{pattern.suffix}")
    return path


class _Loading:
    """Until the service works it has no map to save: who tells it to stop does not wait for a minute of compiling."""

    def __init__(self) -> None:
        self.readers: Readers | None = None
        self.over = False

    def leave(self, signal_name: str) -> None:
        """End the process, on the thread that hears of signals; what was recorded stays."""
        if self.over:
            return
        try:
            if self.readers is not None:
                self.readers.stop()
                self.readers.close()
        finally:
            os._exit(0)


@contextmanager
def _told_if_slow(notifier: ServiceNotifier) -> Iterator[None]:
    """Who looks at a start that takes long is told why."""

    def tell() -> None:
        notifier.status(STILL_LOADING)
        with suppress(OSError):
            print(f"terrabound: {STILL_LOADING}", file=sys.stderr, flush=True)

    timer = threading.Timer(SLOW_START_S, tell)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


class _Console:
    """What a person sees: the state as a line that is rewritten, and each new failure as a line of its own."""

    def __init__(self, health: Health) -> None:
        self._health = health
        self._told: dict[str, str] = {}
        self._on_terminal = sys.stderr.isatty()

    def show(self, line: str) -> None:
        """Tell what has changed."""
        failures = self._health.failures
        for name, failure in failures.items():
            if self._told.get(name) != failure:
                self._say(f"terrabound: {name}: {failure}")
        for name in self._told.keys() - failures.keys():
            self._say(f"terrabound: {name}: works again")
        self._told = failures
        if self._on_terminal:
            self._print(f"\r\x1b[K{line}")

    def close(self) -> None:
        """Leave the line as it is."""
        if self._on_terminal:
            self._print("\n")

    def _say(self, text: str) -> None:
        self._print(f"\r\x1b[K{text}\n" if self._on_terminal else f"{text}\n")

    @staticmethod
    def _print(text: str) -> None:
        # A log on a full disk, a pipe whose reader has left: no reason to end a drive.
        with suppress(OSError):
            print(text, end="", file=sys.stderr, flush=True)
