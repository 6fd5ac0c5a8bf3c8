"""The emulated robot in a process of its own, as the demo and the tests use it."""

import json
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

from drivers.errors import TerraboundError
from service.lifecycle import interrupted_later
from simulator.truth import Truth

START_TIMEOUT_S = 120.0
"""The first start compiles."""
LOOK_UP_S = 0.5
"""`follow` says something at least this often."""


class EmulatedRobot:
    """`terrabound emulate robot`, on a lockstep clock or in real time, start to truth. A context manager."""

    def __init__(
        self,
        config: Path,
        folder: Path,
        *,
        scene: str = "stairs",
        duration_s: float = 30.0,
        speed: float | Literal["max"] = "max",
        seed: int = 1,
        errors: str = "uniform",
        lockstep: bool = True,
    ) -> None:
        """Devices come up as folder/ports/laser and so on; `config` declares the bounds that their errors keep."""
        self.clock_path = folder / "clock"
        self.truth_path = folder / "truth.npz"
        arguments = {
            "--config": config,
            "--links": folder / "ports",
            "--scene": scene,
            "--duration": duration_s,
            "--speed": speed,
            "--seed": seed,
            "--errors": errors,
            **({"--clock": self.clock_path} if lockstep else {}),
            "--truth": self.truth_path,
        }
        options = [str(word) for pair in arguments.items() for word in pair]
        self._command = [sys.executable, "-m", "service.cli", "emulate", "robot", *options, "--json-progress"]
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  closed by __exit__

    def __enter__(self) -> "EmulatedRobot":
        """Start it, and wait until its ports are there."""
        deadline = time.monotonic() + START_TIMEOUT_S
        with ExitStack() as undone:  # also by Ctrl-C: nobody calls __exit__ then
            with interrupted_later():
                self._process = subprocess.Popen(self._command, stdout=subprocess.PIPE, stderr=self._errors, bufsize=0)
                undone.callback(self.__exit__)
            assert self._process.stdout is not None
            line = self._process.stdout.readline()  # "waiting": ports and clock stand
            if not line or time.monotonic() > deadline:
                self._process.kill()
                raise self._failed()
            undone.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self._errors.close()

    def follow(self) -> Iterator[float | None]:
        """Seconds driven so far, now and then; None while hosts still talk to their devices. Ends with the drive."""
        assert self._process.stdout is not None
        driven_s: float | None = None
        while True:
            readable, _, _ = select.select([self._process.stdout], [], [], LOOK_UP_S)
            if readable:
                line = self._process.stdout.readline()
                if not line:
                    break
                progress = json.loads(line)
                driven_s = progress["driven_s"] if progress["state"] in ("driving", "done") else None
            yield driven_s
        if self._process.wait() != 0:
            raise self._failed()

    def truth(self) -> Truth:
        """What was true, once `follow` has ended."""
        return Truth.load(self.truth_path)

    def _failed(self) -> TerraboundError:
        self._process.wait()
        self._errors.seek(0)
        text = self._errors.read().decode(errors="replace").strip()
        return TerraboundError(f"the emulated robot failed: {text or 'it said nothing'}")
