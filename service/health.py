"""How the robot's devices, queues and guarantee are doing: for `.../health`, for people, for the watchdog.

Every thread reports here, one short lock at a time; a snapshot is a plain dict, ready for JSON. Device states:

    CONNECTING --port_opened--> STALE --bytes--> DEGRADED --samples--> STREAMING
                                  ^                 |                      |
                                  +---- silent for longer than allowed ----+
    any --port_failed--> LOST (CONNECTING while the port has never been open)

DEGRADED: bytes come, but no samples, or dirt among them. State is worked out when somebody asks; nothing runs.
"""

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from enum import StrEnum
from typing import Any

from estimator.bounded_pose import INTACT, Guarantee
from service.messages import guarantee_message

RATE_WINDOW_NS = 2_000_000_000
"""Rates are means over at least this long (and dirt this recent degrades a device)."""
LIFE_TIMEOUT_NS = 8_000_000_000
"""A reader looks up twice a second, and every 2 s while its port is away; who parses, every 50 ms."""
FLOW_TIMEOUT_NS = 2_000_000_000
"""How long samples may lie before the pipeline takes one."""
DIRT = ("bad_", "skipped_", "short_", "unknown_", "garbage", "framing_", "overrun", "rejected", "stuck")
"""Beginnings of the counts that tell of dirt on a line."""


class DeviceState(StrEnum):
    """What a device does."""

    CONNECTING = "CONNECTING"
    STREAMING = "STREAMING"
    DEGRADED = "DEGRADED"
    STALE = "STALE"
    LOST = "LOST"


class _Device:
    """What is remembered of one device."""

    def __init__(self, stale_after_ns: int, counts: Mapping[str, int], findings: Callable[[], Sequence[str]]) -> None:
        self.stale_after_ns = stale_after_ns
        self.counts = counts
        self.findings = findings
        self.open = False
        self.failure: str | None = None
        self.openings = 0
        self.bytes = 0
        self.samples = 0
        self.byte_ns: int | None = None
        self.sample_ns: int | None = None
        self.dirt = _dirt(counts)
        self.dirt_ns: int | None = None
        self.history: deque[tuple[int, int, int]] = deque()
        """(time, bytes, samples) so far, a few a second, reaching back at least RATE_WINDOW_NS."""

    def received(self, byte_count: int, sample_count: int, now_ns: int) -> None:
        self.bytes += byte_count
        self.samples += sample_count
        if byte_count:
            self.byte_ns = now_ns
        if sample_count:
            self.sample_ns = now_ns
        if not self.history or now_ns - self.history[-1][0] >= RATE_WINDOW_NS // 8:
            self._look_for_dirt(now_ns)
            self.history.append((now_ns, self.bytes, self.samples))
            while len(self.history) > 2 and now_ns - self.history[1][0] > RATE_WINDOW_NS:
                self.history.popleft()

    def _look_for_dirt(self, now_ns: int) -> None:
        dirt = _dirt(self.counts)
        if dirt > self.dirt:
            self.dirt_ns = now_ns
        self.dirt = dirt

    def state(self, now_ns: int) -> DeviceState:
        if not self.open:
            return DeviceState.LOST if self.openings else DeviceState.CONNECTING
        if self.byte_ns is None or now_ns - self.byte_ns > self.stale_after_ns:
            return DeviceState.STALE
        self._look_for_dirt(now_ns)
        dirty = self.dirt_ns is not None and now_ns - self.dirt_ns <= RATE_WINDOW_NS
        if dirty or self.sample_ns is None or now_ns - self.sample_ns > self.stale_after_ns:
            return DeviceState.DEGRADED
        return DeviceState.STREAMING

    def rates(self, now_ns: int) -> tuple[float, float]:
        """(bytes, samples) per second over the last seconds."""
        if not self.history or now_ns <= self.history[0][0]:
            return 0.0, 0.0
        began_ns, byte_count, sample_count = self.history[0]
        seconds = (now_ns - began_ns) * 1e-9
        return (self.bytes - byte_count) / seconds, (self.samples - sample_count) / seconds


def _dirt(counts: Mapping[str, int]) -> int:
    """How much dirt a protocol has counted."""
    # A copy first: the reader's thread may add a name meanwhile.
    return sum(count for name, count in dict(counts).items() if name.startswith(DIRT))


class Health:
    """What is known of the robot's state; any thread may report and ask."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._devices: dict[str, _Device] = {}
        self._pipeline: dict[str, int] = {}
        self._drops: Counter[str] = Counter()
        self._guarantee = INTACT
        self._faults: Sequence[Mapping[str, Any]] = ()
        self._unanswered_ns: int | None = None
        """When the first sample came that the pipeline has not answered; None where it owes nothing."""
        self._answered_ns: int | None = None
        self._troubles: dict[str, str] = {}
        self._alive_ns: dict[str, int] = {}
        """When each thread last looked up."""

    def watch(
        self,
        name: str,
        stale_after_s: float,
        counts: Mapping[str, int] | None = None,
        findings: Callable[[], Sequence[str]] = tuple,
    ) -> None:
        """Keep an eye on a device: silence longer than `stale_after_s` is a fault.

        `counts` are its protocol's own; `findings()` gives sentences about what the device says of itself.
        """
        with self._lock:
            self._devices[name] = _Device(round(stale_after_s * 1e9), {} if counts is None else counts, findings)

    def trouble(self, what: str, text: str | None) -> None:
        """Something beside the devices fails (`recording`, `saving`), and the service goes on; None: it works again."""
        with self._lock:
            if text is None:
                self._troubles.pop(what, None)
            else:
                self._troubles[what] = text

    @property
    def failures(self) -> dict[str, str]:
        """Ports that can't be used now and what else fails, each with its reason."""
        with self._lock:
            ports = {name: device.failure for name, device in self._devices.items() if device.failure is not None}
            return ports | self._troubles

    @property
    def troubles(self) -> dict[str, str]:
        """What fails beside the devices, and why."""
        with self._lock:
            return dict(self._troubles)

    def alive(self, name: str, now_ns: int) -> None:
        """The device's reader is at work: it reads, waits for bytes, or tries to open its port."""
        self._alive_ns[name] = now_ns

    def port_opened(self, name: str) -> None:
        """The device's port is open."""
        with self._lock:
            device = self._devices[name]
            device.open, device.failure = True, None
            device.openings += 1

    def port_failed(self, name: str, failure: str) -> None:
        """The device's port could not be opened, or went away."""
        with self._lock:
            device = self._devices[name]
            device.open, device.failure = False, failure

    def received(self, name: str, byte_count: int, sample_count: int, now_ns: int) -> None:
        """A read gave bytes, and they completed samples."""
        with self._lock:
            self._devices[name].received(byte_count, sample_count, now_ns)
            if sample_count and self._unanswered_ns is None:
                self._unanswered_ns = now_ns

    def dropped(self, name: str, total: int) -> None:
        """So many samples of a device were dropped by the full queue, in all."""
        with self._lock:
            self._drops[name] = total

    def processed(
        self,
        now_ns: int,
        counts: Mapping[str, int] | None = None,
        guarantee: Guarantee = INTACT,
        faults: Sequence[Mapping[str, Any]] | None = None,
    ) -> None:
        """The pipeline took all samples that had come.

        `counts` and `faults` (the newest last, as plain values) are its own, where it has brought them together.
        """
        with self._lock:
            self._unanswered_ns = None
            self._answered_ns = now_ns
            if counts is not None:
                self._pipeline = dict(counts)
            if faults is not None:
                self._faults = faults
            self._guarantee = guarantee

    def flowing(self, now_ns: int) -> bool:
        """Do samples that arrive flow through the pipeline? Only then is the watchdog fed.

        Where no samples arrive (sensors unplugged or without power) nothing is owed: a restart would not bring
        them back, and would cost the map. But every thread must be at work: one that hangs starves the flow.
        """
        with self._lock:
            return self._flowing(now_ns)

    def hung(self, now_ns: int) -> list[str]:
        """Threads that have not looked up for too long: devices' readers, and `conversations`, which parses for all."""
        with self._lock:
            return self._hung(now_ns)

    def state(self, name: str, now_ns: int) -> DeviceState:
        """What a device does."""
        with self._lock:
            return self._devices[name].state(now_ns)

    def status_line(self, now_ns: int) -> str:
        """One line for `systemctl status`."""
        with self._lock:
            states = ", ".join(f"{name} {device.state(now_ns).lower()}" for name, device in self._devices.items())
            guarantee, troubles, hung = self._guarantee, list(self._troubles), self._hung(now_ns)
        failing = "".join([*(f"{what} hangs; " for what in hung), *(f"{what} fails; " for what in troubles)])
        return failing + (states if guarantee.intact else f"bounds contradicted by {guarantee.sensor}; {states}")

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """Everything, as plain values for JSON."""
        with self._lock:
            return {
                "time_ns": now_ns,
                "flowing": self._flowing(now_ns),
                "processed_ns": self._answered_ns,
                "guarantee": asdict(guarantee_message(self._guarantee)),
                "faults": list(self._faults),
                "devices": {name: self._device(name, device, now_ns) for name, device in self._devices.items()},
                "pipeline": dict(self._pipeline),
                "troubles": dict(self._troubles),
            }

    def _flowing(self, now_ns: int) -> bool:
        if self._unanswered_ns is not None and now_ns - self._unanswered_ns > FLOW_TIMEOUT_NS:
            return False
        return not self._hung(now_ns)

    def _hung(self, now_ns: int) -> list[str]:
        # A copy first: a reader whose thread starts late adds its name meanwhile.
        return [name for name, alive_ns in self._alive_ns.copy().items() if now_ns - alive_ns > LIFE_TIMEOUT_NS]

    def _device(self, name: str, device: _Device, now_ns: int) -> dict[str, Any]:
        """One device's row of the snapshot."""
        bytes_per_s, samples_per_s = device.rates(now_ns)
        return {
            "state": device.state(now_ns).value,
            "failure": device.failure,
            "openings": device.openings,
            "bytes": device.bytes,
            "samples": device.samples,
            "bytes_per_s": round(bytes_per_s, 1),
            "samples_per_s": round(samples_per_s, 2),
            "dropped": self._drops[name],
            "counts": dict(device.counts),
            "findings": list(device.findings()),
        }
