"""What each experiment of the paper is given and gives back, and how its runs are spread over processes.

An experiment is a module bench/paper/<name>.py with one entry function:

    def run(output: Path, short: bool, progress: Progress) -> Outcome

`output` exists. Pictures go there as `<name>_*.png`; the command writes the outcome beside them as `<name>.json` and
`<name>.md`. `short` asks for the same in some seconds: fewer seeds, shorter drives.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.pool import Pool
from pathlib import Path
from typing import Any, Protocol, TypeVar

from drivers.errors import TerraboundError

Task = TypeVar("Task")
Done = TypeVar("Done")

PATIENCE_S = 900


class Progress(Protocol):
    """Where the experiment stands: the share of its work that is done, from 0 to 1, and what comes next."""

    def __call__(self, share: float, doing: str) -> None: ...


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of an experiment."""

    title: str
    report: str
    """Markdown: tables, each with a sentence of what it shows."""
    numbers: dict[str, Any]
    """The same and more for machines: written as JSON."""
    pictures: tuple[Path, ...]
    broken: tuple[str, ...] = ()
    """Promises of ours that did not hold, a sentence each. None, or the command fails."""


def in_processes(function: Callable[[Task], Done], tasks: Iterable[Task]) -> Iterator[Done]:
    """function(task) for each task, in order, in a process for each core. Ctrl-C ends them all at once.

    `function` stands at the top of a module, and tasks and results can be pickled. Raises TerraboundError if a result
    does not come for PATIENCE_S.
    """
    with _interrupted_once() as heed_interrupts, _pool() as pool:
        heed_interrupts()
        results = pool.imap(function, tasks)
        while True:
            try:
                yield results.next(PATIENCE_S)
            except StopIteration:
                return
            except multiprocessing.TimeoutError:
                raise TerraboundError(
                    f"a worker process has given no result for {PATIENCE_S} s; was one killed for want of memory?"
                ) from None


@contextmanager
def _interrupted_once() -> Iterator[Callable[[], None]]:
    """Ctrl-C interrupts from the call of what is given on, or then; a second one leaves in peace the end that began.

    Interrupted between a worker's birth and its first orders, the parent would leave an orphan that complains.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    heeded = came = False

    def interrupt(number: int, frame: object) -> None:
        nonlocal came
        came = True
        if heeded:
            signal.signal(number, signal.SIG_IGN)
            raise KeyboardInterrupt

    def heed() -> None:
        nonlocal heeded
        heeded = True
        if came:
            interrupt(signal.SIGINT, None)

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield heed
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _pool() -> Iterator[Pool]:
    """Workers that never hear Ctrl-C, which is the parent's matter, and end with the block."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        pool = multiprocessing.get_context("spawn").Pool(len(os.sched_getaffinity(0)), _end_with_parent)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield pool
    finally:
        pool.terminate()
        pool.join()


def _end_with_parent() -> None:
    """When the parent is gone, however it went, so are we."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (wait([parent.sentinel]), os._exit(1)), daemon=True).start()
