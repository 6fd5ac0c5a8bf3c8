"""Inertial board over MAVLink: packets in, inertial samples out."""

from collections import Counter
from dataclasses import dataclass
from math import isfinite, pi, radians

from drivers.config import ImuConfig, latency_ns
from drivers.imu.board_clock import BoardClock, SensorKey
from drivers.imu.codec import MavlinkFrame, MavlinkStream
from drivers.imu.messages import Reading, read
from drivers.samples import InertialSample, Stamp

_ACCEL_LIMIT_MPS2 = 1000.0
_GYRO_LIMIT_RPS = 100.0
_TILT_LIMIT_RAD = pi * 1.000001
"""Beyond these no sensor of a ground vehicle measures anything: the number is wrong."""
_STUCK_NS = 500_000_000
"""A sensor that repeats itself for so long is told to be stuck."""
_SILENT_NS = 1_000_000_000
"""Another part of the vehicle is listened to once the first has been silent for so long."""

_REFUSED = -1

_Source = tuple[int, int]
"""System and component."""
_MOST_OTHERS = 8
"""So many are named."""


@dataclass(frozen=True, slots=True)
class BoardIdentity:
    """Who speaks, for people."""

    source: str
    sensors: str


class ImuProtocol:
    """The host's end of the wire to the inertial board; see drivers/protocol.py for the contract.

    counts: `samples` delivered, `frames` intact, `bad_crc`, `skipped_bytes`, `lost` by sequence number, in all and as
    `lost_SYSTEM_COMPONENT`, `repeated` sequence numbers, `other_messages`, `other_source` (another component than the
    one listened to), `other_clock` (delivered, without a device time), `nothing_new`, `not_finite`, `out_of_range`,
    `out_of_temperature` (beyond the declared range), `beyond_declared` (the board itself vouches for less than the
    owner), `dead` (no axis feels anything), `stuck` (the same reading for half a second and more; used only where the
    owner doesn't declare that sensors are always noisy), `unchanged` (the same for less, and not used), `reboots`.
    """

    def __init__(self, config: ImuConfig) -> None:
        """Nothing received yet."""
        self.counts: Counter[str] = Counter()
        self._config = config
        self._least_ns, self._most_ns = latency_ns(config.latency_ms)
        self._stream = MavlinkStream(self.counts)
        self._clock = BoardClock((self._least_ns, self._most_ns), config.clock_drift_ppm * 1e-6)
        self._epoch = 0
        self._source: _Source | None = None
        self._source_ns = 0
        self._others: dict[_Source, None] = {}
        """Who else has sent inertial messages."""
        self._sequences: dict[_Source, int] = {}
        self._alive: dict[SensorKey, tuple[tuple[float, ...], int]] = {}
        """Of each sensor: its last reading, and the read that brought it first."""
        self._unwell: dict[SensorKey, str] = {}
        self._losses = 0
        """Gaps in the sequence numbers of the board that is listened to."""
        self._losses_before: dict[SensorKey, int] = {}
        """As they were at each sensor's last packet; _REFUSED where that one was not delivered."""

    @property
    def baud(self) -> int | None:
        """The configured rate."""
        return self._config.baud

    @property
    def deadline_ns(self) -> int | None:
        """The board speaks by itself."""
        return None

    @property
    def identity(self) -> BoardIdentity | None:
        """Who speaks, and what of it is listened to; None before the first reading."""
        if self._source is None:
            return None
        sensors = dict.fromkeys([*self._alive, *self._unwell])
        words = [f"{message} {number}" + self._unwell.get((message, number), "") for message, number in sensors]
        return BoardIdentity("system {} component {}:".format(*self._source), ", ".join(words))

    @property
    def findings(self) -> tuple[str, ...]:
        """Who else speaks, for people: a gimbal's attitude is not the robot's."""
        others = [source for source in list(self._others) if source != self._source]
        declared = self._config.system is not None and self._config.component is not None
        if not others or declared:
            return ()
        named = ", ".join("system {} component {}".format(*source) for source in others)
        listened = "nobody" if self._source is None else "system {} component {}".format(*self._source)
        return (
            f"inertial messages come from {named}, too, and are left out; {listened} is listened to: set "
            "devices.imu.system and .component to the board's",
        )

    def connection_made(self, now_ns: int) -> None:
        """Begin a new epoch: the board may have restarted meanwhile, and other parts of it may speak first."""
        self._stream.clear()
        self._sequences.clear()
        self._others.clear()
        self._source = None
        self._begin_epoch()

    def advance(self, now_ns: int) -> None:
        """Nothing is ever due."""

    def data_to_send(self) -> bytes:
        """Nothing: the board needs no asking."""
        return b""

    def receive_data(self, data: bytes, stamp_ns: int) -> list[InertialSample]:
        """Take bytes; the samples of all inertial messages that they complete."""
        return self._samples(self._stream.receive(data, stamp_ns))

    def finish(self) -> list[InertialSample]:
        """The stream has ended: what was still waited for."""
        return self._samples(self._stream.finish())

    def _samples(self, frames: list[tuple[MavlinkFrame, int]]) -> list[InertialSample]:
        samples = []
        for frame, read_ns in frames:
            self._count_losses(frame)
            reading = read(frame)
            if reading is None:
                self.counts["other_messages"] += 1
                continue
            if not self._is_of_the_board((frame.system, frame.component), read_ns):
                self.counts["other_source"] += 1
                continue
            sensor = frame.message, reading.sensor_id
            fault = self._fault(reading) or self._repetition(sensor, reading, read_ns)
            if fault is not None:
                self.counts[fault] += 1
                self._losses_before[sensor] = _REFUSED
                if fault == "dead":
                    self._unwell[sensor] = " (dead)"
                continue
            samples.append(self._sample(sensor, reading, read_ns))
        self.counts["samples"] += len(samples)
        return samples

    def _sample(self, sensor: SensorKey, reading: Reading, read_ns: int) -> InertialSample:
        """In time; where the board has restarted, in a new epoch."""
        device_us, latest_ns, restarted = self._clock.place(
            sensor, reading.device_time_us, reading.resolution_us, reading.wraps, read_ns
        )
        if restarted:
            self.counts["reboots"] += 1
            self._epoch += 1
        if device_us is None:
            self.counts["other_clock"] += 1
        stamp = Stamp(read_ns - self._most_ns, latest_ns)
        accel, gyro, tilt = reading.accel_mps2, reading.gyro_rps, reading.tilt_rad
        after_loss = self._losses_before.get(sensor, self._losses) != self._losses
        self._losses_before[sensor] = self._losses
        return InertialSample(stamp, *sensor, device_us, accel, gyro, tilt, self._epoch, after_loss)

    def _begin_epoch(self) -> None:
        if self._clock.known:
            self._epoch += 1
        self._clock.clear()
        self._alive.clear()

    def _is_of_the_board(self, source: _Source, read_ns: int) -> bool:
        """Samples of two clocks are never mixed: the first to speak is listened to until it has been silent a while."""
        if source != self._source:
            if not self._may_be_the_board(source) or self._is_heard(read_ns):
                if len(self._others) < _MOST_OTHERS:
                    self._others[source] = None
                return False
            self._source = source
            self._begin_epoch()
        self._source_ns = read_ns
        return True

    def _may_be_the_board(self, source: _Source) -> bool:
        """Has it the numbers that the owner declares?"""
        return self._config.system in (None, source[0]) and self._config.component in (None, source[1])

    def _is_heard(self, now_ns: int) -> bool:
        """Has the one that is listened to spoken lately?"""
        return self._source is not None and now_ns - self._source_ns <= _SILENT_NS

    def _count_losses(self, frame: MavlinkFrame) -> None:
        source = (frame.system, frame.component)
        last = self._sequences.get(source)
        self._sequences[source] = frame.sequence
        if last is None:
            return
        gap = (frame.sequence - last - 1) % 256
        if gap == 255:
            self.counts["repeated"] += 1
        elif gap:
            self._losses += source == self._source
            self.counts["lost"] += gap
            self.counts[f"lost_{frame.system}_{frame.component}"] += gap

    def _repetition(self, sensor: SensorKey, reading: Reading, read_ns: int) -> str | None:
        """`unchanged` or `stuck` where a sensor that is always noisy says again what it said last."""
        last = self._alive.get(sensor)
        if last is None or last[0] != reading.present:
            self._alive[sensor] = reading.present, read_ns
            self._unwell.pop(sensor, None)
            return None
        stuck = read_ns - last[1] >= _STUCK_NS
        if stuck:
            self._unwell[sensor] = " (stuck)"
        if self._config.always_noisy:
            return "stuck" if stuck else "unchanged"
        self.counts["stuck"] += stuck
        return None

    def _fault(self, reading: Reading) -> str | None:
        """Why a reading must not be used; None where nothing is wrong with it."""
        present = reading.present
        if not present:
            return "nothing_new"
        if not isfinite(sum(present)):
            return "not_finite"
        # Absent axes are NaN, which no limit refuses. Most readings are small enough for any axis.
        largest = max(max(present), -min(present))
        if largest > _TILT_LIMIT_RAD and (
            _beyond(reading.accel_mps2, _ACCEL_LIMIT_MPS2)
            or _beyond(reading.gyro_rps, _GYRO_LIMIT_RPS)
            or _beyond(reading.tilt_rad, _TILT_LIMIT_RAD)
        ):
            return "out_of_range"
        if largest == 0.0 and (isfinite(sum(reading.accel_mps2)) or (self._config.always_noisy and len(present) > 1)):
            return "dead"  # not even gravity; or two axes that are exactly zero at once
        within = self._config.temperature_range_degc
        if within is not None and (reading.temperature_degc < within[0] or reading.temperature_degc > within[1]):
            return "out_of_temperature"
        if reading.told_bound and not reading.told_bound <= self._declared_bound(reading):
            return "beyond_declared"
        return None

    def _declared_bound(self, reading: Reading) -> float:
        """What the owner declares of such a reading, in its unit."""
        of_tilt = not isfinite(reading.accel_mps2[0])
        return radians(self._config.tilt_bound_deg) if of_tilt else self._config.accel_bound_mps2


def _beyond(values: tuple[float, ...], limit: float) -> bool:
    """Is any of them farther from zero? NaN is not."""
    for value in values:  # noqa: SIM110  a generator takes twice as long
        if value > limit or value < -limit:
            return True
    return False
