"""Start, watchdog and end of the process: what systemd is told and how signals arrive.

systemd gives a datagram socket in NOTIFY_SOCKET and the watchdog's period in WATCHDOG_USEC (sd_notify(3),
sd_watchdog_enabled(3)). Without them every word is silently dropped: the service runs from a shell as well.
"""

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path


class ServiceNotifier:
    """Tells systemd `READY=1`, `STATUS=...`, `WATCHDOG=1`, `STOPPING=1`."""

    def __init__(self, environment: Mapping[str, str] = os.environ, pid: int | None = None) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # "@name" is a socket of the abstract namespace, whose address begins with a zero byte.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) if address else None
        self._watchdog_ns = _watchdog_ns(environment, os.getpid() if pid is None else pid)
        self._fed_ns: int | None = None
        self._status = ""

    @property
    def watchdog_period_ns(self) -> int | None:
        """How often to feed the watchdog: half of what systemd allows; None where there is no watchdog."""
        return None if self._watchdog_ns is None else self._watchdog_ns // 2

    def ready(self) -> None:
        """The service works: devices are open and the pipeline runs."""
        self._send("READY=1")

    def stopping(self) -> None:
        """An orderly end has begun."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """One line for people (`systemctl status`); sent only when it changed."""
        text = " ".join(text.split())
        if text != self._status:
            self._status = text
            self._send(f"STATUS={text}")

    def feed(self, now_ns: int, flowing: bool) -> bool:
        """Feed the watchdog when half its time has passed, but only while samples flow; was it fed?

        A service that hangs, or whose pipeline stands still, isn't fed: systemd restarts it.
        """
        period = self.watchdog_period_ns
        if period is None or not flowing:
            return False
        if self._fed_ns is not None and now_ns - self._fed_ns < period:
            return False
        self._fed_ns = now_ns
        self._send("WATCHDOG=1")
        return True

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError:
            # A full or vanished socket must never stop mapping; the watchdog notices if it matters.
            return


def process_age_s() -> float:
    """Seconds since this process was started, interpreter and all; the kernel tells it in hundredths."""
    started_ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - started_ticks / os.sysconf("SC_CLK_TCK")


def _watchdog_ns(environment: Mapping[str, str], pid: int) -> int | None:
    """systemd's watchdog timeout, if it is meant for this process."""
    text = environment.get("WATCHDOG_USEC", "")
    meant_for = environment.get("WATCHDOG_PID", str(pid))
    if not (text.isascii() and text.isdigit()) or int(text) == 0 or meant_for != str(pid):
        return None
    return int(text) * 1000


def _hangup() -> tuple[signal.Signals, ...]:
    """SIGHUP, unless whoever started the process has it ignored (`nohup`)."""
    return () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)


@contextmanager
def terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM and SIGHUP do what Ctrl-C does (KeyboardInterrupt): processes and temporary folders are cleared away.

    For commands that have no orderly end but their own. Main thread only.
    """
    numbers = (signal.SIGTERM, *_hangup())
    before = {number: signal.signal(number, signal.default_int_handler) for number in numbers}
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, before[number])


@contextmanager
def interrupted_later() -> Iterator[None]:
    """SIGINT, SIGTERM and SIGHUP wait until the block is over: a process that has just begun must not be lost sight of.

    For a moment. In another thread than the main one, which signals don't reach, nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM, *_hangup())
    before = {number: signal.signal(number, lambda number, frame: came.append(number)) for number in numbers}
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, before[number])
        if came:
            signal.raise_signal(came[0])


@contextmanager
def stop_on_signals(
    event: threading.Event | None = None, tell: Callable[[str], None] | None = None
) -> Iterator[threading.Event]:
    """SIGTERM, SIGINT and SIGHUP (the terminal is gone) set the event that is handed out: an orderly end, exit code 0.

    A second signal falls through to what was installed before: an end that hangs can still be interrupted. But not a
    second SIGHUP: a terminal that goes away sends it, and so does its shell.
    Works in the main thread only, as signals do.
    """
    event = threading.Event() if event is None else event
    numbers = (signal.SIGTERM, signal.SIGINT, *_hangup())
    before = {number: signal.getsignal(number) for number in numbers}
    # The event's lock isn't reentrant, and a signal may arrive while the main thread holds it (inside wait): so the
    # signal only writes a byte, and a thread of its own sets the event.
    hearing, speaking = os.pipe()

    def restore() -> None:
        for number in numbers:
            signal.signal(number, before[number])

    def stop(number: int, frame: object) -> None:
        restore()
        if signal.SIGHUP in numbers:
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        os.write(speaking, bytes([number]))

    def listen() -> None:
        for number in os.read(hearing, 1):  # nothing at all when the block was left without a signal
            event.set()
            if tell is not None:
                tell(signal.Signals(number).name)

    listener = threading.Thread(target=listen, name="signals", daemon=True)
    listener.start()
    for number in numbers:
        signal.signal(number, stop)
    try:
        yield event
    finally:
        restore()
        os.close(speaking)
        listener.join()
        os.close(hearing)
