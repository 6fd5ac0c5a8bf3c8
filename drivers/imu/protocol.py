"""Inertial board over MAVLink: packets in, inertial samples out."""

from collections import Counter
from math import isfinite, pi

from drivers.config import ImuConfig, latency_ns
from drivers.imu.codec import MavlinkFrame, MavlinkStream
from drivers.imu.messages import READINGS, Reading
from drivers.samples import InertialSample, Stamp

_ACCEL_LIMIT_MPS2 = 1000.0
_GYRO_LIMIT_RPS = 100.0
_TILT_LIMIT_RAD = pi * 1.000001
"""Beyond these no sensor of a ground vehicle measures anything: the number is wrong."""
_CLOCK_JUMP_NS = 1_000_000_000

_Sensor = tuple[str, int]


class ImuProtocol:
    """The host's end of the wire to the inertial board; see drivers/protocol.py for the contract.

    counts: `samples` delivered, `frames` intact, `bad_crc`, `skipped_bytes`, `lost` by sequence number, `repeated`,
    `other_messages`, `other_source` (another component than the first), `nothing_new`, `not_finite`, `out_of_range`,
    `dead` (all axes exactly zero), `reboots`.
    """

    def __init__(self, config: ImuConfig) -> None:
        """Nothing received yet."""
        self.counts: Counter[str] = Counter()
        self._baud = config.baud
        self._least_ns, self._most_ns = latency_ns(config.latency_ms)
        self._drift = config.clock_drift_ppm * 1e-6
        self._stream = MavlinkStream(self.counts)
        self._source: tuple[int, int] | None = None
        self._sequences: dict[tuple[int, int], int] = {}
        self._clocks: dict[_Sensor, tuple[int, int]] = {}
        """Of each sensor: device time in us and host time in ns of its last packet."""
        self._epoch = 0

    @property
    def baud(self) -> int | None:
        """The configured rate."""
        return self._baud

    @property
    def deadline_ns(self) -> int | None:
        """The board speaks by itself."""
        return None

    def connection_made(self, now_ns: int) -> None:
        """Begin a new epoch: the board may have restarted meanwhile, and other parts of it may speak first."""
        self._stream.clear()
        self._sequences.clear()
        self._source = None
        self._new_epoch()

    def advance(self, now_ns: int) -> None:
        """Nothing is ever due."""

    def data_to_send(self) -> bytes:
        """Nothing: the board needs no asking."""
        return b""

    def receive_data(self, data: bytes, stamp_ns: int) -> list[InertialSample]:
        """Take bytes; the samples of all inertial messages that they complete."""
        samples = []
        for frame, read_ns in self._stream.receive(data, stamp_ns):
            self._count_losses(frame)
            reader = READINGS.get(frame.message)
            if reader is None:
                self.counts["other_messages"] += 1
                continue
            source = (frame.system, frame.component)
            if self._source is None:
                self._source = source
            if source != self._source:  # another part of the vehicle, with a clock of its own
                self.counts["other_source"] += 1
                continue
            reading = reader(frame.fields())
            if (fault := _fault(frame.message, reading)) is not None:
                self.counts[fault] += 1
                continue
            self._watch_clock((frame.message, reading.sensor_id), reading.device_time_us, read_ns)
            samples.append(self._sample(frame.message, reading, read_ns))
        return samples

    def _sample(self, message: str, reading: Reading, read_ns: int) -> InertialSample:
        self.counts["samples"] += 1
        return InertialSample(
            stamp=Stamp(read_ns - self._most_ns, read_ns - self._least_ns),
            message=message,
            sensor_id=reading.sensor_id,
            device_time_us=reading.device_time_us,
            accel_mps2=reading.accel_mps2,
            gyro_rps=reading.gyro_rps,
            tilt_rad=reading.tilt_rad,
            epoch=self._epoch,
        )

    def _count_losses(self, frame: MavlinkFrame) -> None:
        source = (frame.system, frame.component)
        last = self._sequences.get(source)
        self._sequences[source] = frame.sequence
        if last is None:
            return
        gap = (frame.sequence - last - 1) % 256
        if gap == 255:
            self.counts["repeated"] += 1
        else:
            self.counts["lost"] += gap

    def _watch_clock(self, sensor: _Sensor, device_us: int, read_ns: int) -> None:
        """A board whose clock went back, or away from the host's, has restarted: a new epoch begins."""
        last = self._clocks.get(sensor)
        if last is not None:
            device_ns, host_ns = (device_us - last[0]) * 1000, read_ns - last[1]
            apart_ns = abs(device_ns - host_ns)
            if device_ns < 0 or apart_ns > _CLOCK_JUMP_NS + self._most_ns + self._drift * host_ns:
                self.counts["reboots"] += 1
                self._new_epoch()
        self._clocks[sensor] = (device_us, read_ns)

    def _new_epoch(self) -> None:
        if self._clocks:
            self._epoch += 1
        self._clocks.clear()


def _fault(message: str, reading: Reading) -> str | None:
    """Why a reading must not be used; None where nothing is wrong with it."""
    if not reading.present:
        return "nothing_new"
    if not all(map(isfinite, reading.present)):
        return "not_finite"
    # Absent axes are NaN, which no limit refuses.
    if (
        _beyond(reading.accel_mps2, _ACCEL_LIMIT_MPS2)
        or _beyond(reading.gyro_rps, _GYRO_LIMIT_RPS)
        or _beyond(reading.tilt_rad, _TILT_LIMIT_RAD)
    ):
        return "out_of_range"
    if message != "HIGHRES_IMU" and len(reading.present) == 6 and not any(reading.present):
        return "dead"
    return None


def _beyond(values: tuple[float, ...], limit: float) -> bool:
    """Is any of them farther from zero? NaN is not."""
    for value in values:  # noqa: SIM110  a generator takes twice as long
        if value > limit or value < -limit:
            return True
    return False
