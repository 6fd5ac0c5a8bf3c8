"""The emulated inertial board: gyroscope, two dual-axis accelerometers and tilt sensor, in MAVLink 2 packets.

Like those of real sensors its readings are never quite still: the last bit of each jitters, far inside the margin that
the simulated world leaves for rounding to float32.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import nan

from drivers.imu.codec import MavlinkFrame, serialise
from drivers.imu.messages import attitude, dual_axis_acceleration, dual_axis_tilt, highres_imu
from drivers.samples import Vector3

GYRO_ID = 0
ACCEL_IDS = (1, 2)
_JITTER_GYRO_RPS, _JITTER_ACCEL_MPS2, _JITTER_TILT_RAD = 2.0**-25, 2.0**-20, 2.0**-26


@dataclass(slots=True)
class _Stream:
    """One sensor's packets: when the next is due, and how it is made from its acquisition time."""

    next_ns: int
    period_ns: int
    make: Callable[[int], MavlinkFrame]


class ImuEmulator:
    """Sends each sensor's packets at whole multiples of its period, all with one clock, that of the board."""

    def __init__(
        self,
        gyro: Callable[[int, int], Vector3],
        accel: Callable[[int, int], tuple[float, float]],
        tilt: Callable[[int], tuple[float, float]],
        *,
        start_ns: int = 0,
        gyro_period_ns: int = 5_000_000,
        accel_period_ns: int = 10_000_000,
        tilt_period_ns: int = 10_000_000,
        latency_ns: int = 0,
        clock_ppm: float = 0.0,
        boot_ns: int | None = None,
        baud: int = 115200,
        own_messages: bool = False,
    ) -> None:
        """The world, in base_link: `gyro(t0_ns, t1_ns)` mean body rate in rad/s, `accel(t_ns, sensor_id)` specific
        force (x, y) in m/s^2, `tilt(t_ns)` roll and pitch in rad.

        Accelerometers and tilt are first acquired at `start_ns`, the gyroscope's first mean ends one period later.
        A packet is on the wire `latency_ns` after its acquisition. The board's clock starts at `boot_ns`
        (`start_ns` if not given) and runs `clock_ppm` fast. At 200 Hz and 100 Hz the packets need 34 kB/s: a board on
        USB, or a line of at least 460800 baud; the transfer itself takes no time here. `own_messages`: accelerometers
        and tilt sensor in the messages of drivers/imu/terrabound.xml instead of HIGHRES_IMU and ATTITUDE.
        """
        self._gyro, self._accel, self._tilt = gyro, accel, tilt
        self._gyro_period_ns = gyro_period_ns
        self.latency_ns = latency_ns
        """From acquisition to the wire."""
        self._rate = 1.0 + clock_ppm * 1e-6
        self._boot_ns = start_ns if boot_ns is None else boot_ns
        self._baud = baud
        self._own_messages = own_messages
        self._sequence = 0
        self.stuck = False
        """Do all sensors repeat their last readings?"""
        self._last: dict[str, tuple[float, ...]] = {}
        self._jitter: dict[str, float] = {}
        self._streams = [
            _Stream(start_ns + gyro_period_ns, gyro_period_ns, self._gyro_packet),
            _Stream(start_ns, accel_period_ns, lambda t_ns: self._accel_packet(t_ns, ACCEL_IDS[0])),
            _Stream(start_ns, accel_period_ns, lambda t_ns: self._accel_packet(t_ns, ACCEL_IDS[1])),
            _Stream(start_ns, tilt_period_ns, self._tilt_packet),
        ]

    @property
    def baud(self) -> int | None:
        """The line rate."""
        return self._baud

    def receive_data(self, data: bytes, now_ns: int) -> None:
        """The board takes no commands."""

    def data_to_send(self, now_ns: int) -> bytes:
        """All packets due by `now_ns`, in the order of their acquisition."""
        data = bytearray()
        while (stream := min(self._streams, key=lambda s: s.next_ns)).next_ns + self.latency_ns <= now_ns:
            data += serialise(stream.make(stream.next_ns))
            self._sequence = (self._sequence + 1) % 256
            stream.next_ns += stream.period_ns
        return bytes(data)

    def reboot(self, now_ns: int) -> None:
        """Restart the board's clock and its sequence numbers."""
        self._boot_ns = now_ns
        self._sequence = 0

    def _device_us(self, t_ns: int) -> int:
        return max(0, round((t_ns - self._boot_ns) * self._rate) // 1000)

    def _gyro_packet(self, t_ns: int) -> MavlinkFrame:
        x, y, z = self._felt("gyro", _JITTER_GYRO_RPS, lambda: self._gyro(t_ns - self._gyro_period_ns, t_ns))
        return highres_imu(self._sequence, self._device_us(t_ns), GYRO_ID, gyro_rps=(x, y, z))

    def _accel_packet(self, t_ns: int, sensor_id: int) -> MavlinkFrame:
        x, y = self._felt(f"accel {sensor_id}", _JITTER_ACCEL_MPS2, lambda: self._accel(t_ns, sensor_id))
        if self._own_messages:
            return dual_axis_acceleration(self._sequence, self._device_us(t_ns), sensor_id, (x, y))
        return highres_imu(self._sequence, self._device_us(t_ns), sensor_id, accel_mps2=(x, y, nan))

    def _tilt_packet(self, t_ns: int) -> MavlinkFrame:
        roll, pitch = self._felt("tilt", _JITTER_TILT_RAD, lambda: self._tilt(t_ns))
        if self._own_messages:
            return dual_axis_tilt(self._sequence, self._device_us(t_ns), 0, (roll, pitch))
        return attitude(self._sequence, self._device_us(t_ns) // 1000, roll, pitch)

    def _felt(self, sensor: str, jitter: float, measure: Callable[[], tuple[float, ...]]) -> tuple[float, ...]:
        """What a sensor says of what it should."""
        if self.stuck and sensor in self._last:
            return self._last[sensor]
        moved = self._jitter[sensor] = -self._jitter.get(sensor, jitter)
        self._last[sensor] = felt = tuple(value + moved for value in measure())
        return felt
