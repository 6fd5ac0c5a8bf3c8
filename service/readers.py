"""All devices' readers, the queue that they fill, the health that they report to, and the recording that they keep.

They need no machine code, and nothing of filter and map: the service starts them first. A scanner is found and set up
while numba is loaded; what they read before they can read punctually would be used with late stamps, so it isn't used.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.clock import Clock
from drivers.errors import CaptureError
from drivers.port_read import read_in_machine_code
from service.config import LoadedConfig
from service.devices import Device, can_frames, unchecked_wiring
from service.health import Health
from service.reader import Reader
from service.sample_queue import SampleQueue

if TYPE_CHECKING:
    from drivers.capture import CaptureWriter


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
        self.queue.keeps = False
        self.health = Health()
        self._loaded = loaded
        self._capture_path = capture
        self._capture: CaptureWriter | None = None
        self._readers: dict[str, Reader] = {}

    def __iter__(self) -> Iterator[Reader]:
        """Those that were started, in the devices' order."""
        return (self._readers[device.name] for device in self.devices if device.name in self._readers)

    @property
    def started(self) -> bool:
        """Do they read?"""
        return bool(self._readers)

    @property
    def failure(self) -> BaseException | None:
        """What ended one of them early, if anything did."""
        return next((reader.failure for reader in self if reader.failure is not None), None)

    def open_recording(self) -> None:
        """Create the capture's file. CaptureError where that can't be."""
        if self._capture_path is not None:
            from drivers.capture import CaptureWriter  # most drives are not recorded

            framed = can_frames(self.devices)
            self._capture = CaptureWriter(self._capture_path, self._loaded.text, self._loaded.dbc_text(), framed)

    def start(self, acknowledge: Callable[[str, int], None] | None = None) -> None:
        """Open the ports and begin; ports may come and go later. `acknowledge`: see Reader.

        Until `read_punctually` they converse with their devices, and keep no sample. Raises ConfigurationError where
        what the configuration names can't be used; those that read already are then to be stopped.
        """
        # The scanner first: it may have to be set up, which takes a second.
        for device in sorted(self.devices, key=lambda device: device.name != "laser"):
            reader = Reader(device, self.clock, self.queue, self.health, self._capture, acknowledge)
            self._readers[device.name] = reader
            reader.start()

    def read_punctually(self) -> None:
        """From now on bytes are stamped as they come, and samples are kept."""
        read_in_machine_code()
        self.queue.keeps = True

    def stop(self) -> None:
        """Close the ports; what was read stays in the queue."""
        for reader in self:
            reader.stop()

    def end_recording(self) -> None:
        """Close the capture; where the disk refuses its index, the recording replays without it."""
        capture, self._capture = self._capture, None
        try:
            if capture is not None:
                capture.close()
        except CaptureError as error:
            self.health.trouble("recording", str(error))
