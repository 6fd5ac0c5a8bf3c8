"""What every emulated device is: the far end of a wire, sans I/O, driven by the robot's true time.

An emulator asks the simulated world for readings through a callback given to its constructor, so that it knows
nothing about terrain or motion.
"""

from typing import Protocol


class Emulator(Protocol):
    """The device end of one wire. Times are true nanoseconds on the host's clock; calls never go back in time."""

    @property
    def baud(self) -> int | None:
        """Rate the device speaks and listens at now; a host at another rate sends and gets garbage. None: no rate."""

    def receive_data(self, data: bytes, now_ns: int) -> None:
        """Take what the host wrote, at time `now_ns`."""

    def data_to_send(self, now_ns: int) -> bytes:
        """All bytes whose last bit has left the device by `now_ns` and that were not handed out yet."""
