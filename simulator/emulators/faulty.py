"""A device behind a faulty line: what it sends is struck, what it hears is not."""

from simulator.emulators.emulator import Emulator
from simulator.line_faults import LineFaults, LineFormat


class FaultyEmulator:
    """Another device, with faults on its line. A frame goes out when its last byte has left the device."""

    def __init__(self, device: Emulator, line: LineFormat, faults: LineFaults) -> None:
        self._device, self._line, self._faults = device, line, faults
        self._rest = b""
        self.frames_sent = self.frames_intact = 0
        """By the device; and those of them that the host gets whole."""

    @property
    def baud(self) -> int | None:
        """The device's rate."""
        return self._device.baud

    def receive_data(self, data: bytes, now_ns: int) -> None:
        """To the device, as it is."""
        self._device.receive_data(data, now_ns)

    def data_to_send(self, now_ns: int) -> bytes:
        """What has become of the frames that the device has finished by `now_ns`."""
        frames, self._rest = self._line.cut(self._rest + self._device.data_to_send(now_ns))
        arrivals = [self._faults.send(frame) for frame in frames]
        self.frames_sent += len(frames)
        self.frames_intact += sum(arrival.copies > 0 for arrival in arrivals)
        return b"".join(chunk for arrival in arrivals for chunk in arrival.chunks)
