"""One device's bytes from a file: nobody answers them, and a file seldom tells when they came.

What `decode` and `listen` must declare of a device is for looking only: where the caller says nothing, latencies are
zero and bounds are placeholders. Guaranteed samples come from a configuration, through service/devices.py.
"""

import re
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias, TypeVar

from pydantic import ValidationError

from drivers.config import EncodersConfig, GpsConfig, ImuConfig, LaserConfig
from drivers.errors import ConfigurationError
from drivers.gps_nmea.protocol import GpsProtocol
from drivers.imu.protocol import ImuProtocol
from drivers.samples import Sample
from drivers.sick_lms.stream import LmsStreamDecoder
from drivers.sick_lms.telegrams import Variant
from drivers.track_encoders.codec import CANDUMP_FD, parse_candump_line
from drivers.track_encoders.protocol import TrackEncoderProtocol

Timed: TypeAlias = tuple[int, Sample]
"""A sample, and the nanoseconds that its line shall tell."""

NO_LINE = "understood, but nothing in it makes a line; the counts tell why"
_INTACT = ("telegrams", "frames", "sentences")
_BROKEN = ("bad_crc", "bad_checksum", "bad_frames", "bad_lines")

_CANDUMP_LINE_BYTES = 256
_CANDUMP = re.compile(rb"\(\d{1,10}\.\d{6,9}\) \S{1,32} [0-9A-Fa-f]{3,8}#|\S{1,32} +[0-9A-Fa-f]{3,8} +\[\d{1,2}\] ")
_LINE_END = re.compile(rb"[\r\n]")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
C = TypeVar("C")


def understood(counts: Mapping[str, int]) -> bool:
    """Was more intact than chance would make? Not all of it makes a line: a receiver without satellites speaks, too."""
    intact, broken = (sum(counts.get(name, 0) for name in names) for names in (_INTACT, _BROKEN))
    return 10 * intact > broken  # in noise one "sentence" in 256 has its checksum


def why_nothing(counts: Mapping[str, int]) -> str | None:
    """What is known of bytes in which nothing is intact."""
    if counts.get("bad_unsummed"):
        return "its sentences have no checksum, so nobody knows whether they arrived as sent: have the receiver add it"
    if counts.get("fd_frames"):
        return "its frames are CAN FD, which is not read: the counters are to come in classic frames"
    return None


class PassiveDecoder(Protocol):
    """Bytes of a file in, samples out; see drivers/protocol.py for the names of the counts."""

    counts: Counter[str]

    def receive_data(self, data: bytes) -> Sequence[Timed]:
        """The samples that `data` completes."""

    def finish(self) -> Sequence[Timed]:
        """The file has ended: what was still waited for."""


class LmsFile:
    """Scans; a file doesn't tell when they were shot."""

    def __init__(self, measuring_mode: int | None = None, variant: Variant | None = None) -> None:
        self._stream = LmsStreamDecoder(measuring_mode, variant)
        self.counts = self._stream.counts

    def receive_data(self, data: bytes) -> list[Timed]:
        """Scans, at time 0."""
        return [(0, scan) for scan in self._stream.receive_data(data)]

    def finish(self) -> list[Timed]:
        """Scans that waited for bytes that never came."""
        return [(0, scan) for scan in self._stream.finish()]


class EncodersFile:
    """Track counters, from slcan bytes (time 0) or a candump log (the times of its lines), whichever comes first."""

    def __init__(self, config: EncodersConfig, dbc: str) -> None:
        self._protocol = TrackEncoderProtocol(config, dbc)
        self.counts = self._protocol.counts
        self._is_candump: bool | None = None
        self._partial = b""

    def receive_data(self, data: bytes) -> list[Timed]:
        """Ticks that `data` completes."""
        if self._is_candump is None:
            data, self._partial = self._partial + data, b""
            if len(data) < _CANDUMP_LINE_BYTES and not _LINE_END.search(data.lstrip()):
                self._partial = data  # too little to tell
                return []
            data = self._told_apart(data)
        if not self._is_candump:
            return [(0, ticks) for ticks in self._protocol.receive_data(data, 0)]
        *lines, self._partial = (self._partial + data).replace(b"\r", b"\n").split(b"\n")
        if len(self._partial) > _CANDUMP_LINE_BYTES:  # no line of a log any more
            self.counts["skipped_bytes"] += len(self._partial) - _CANDUMP_LINE_BYTES
            self._partial = self._partial[-_CANDUMP_LINE_BYTES:]
        return [timed for line in lines for timed in self._receive_line(line)]

    def finish(self) -> list[Timed]:
        """The last line, if its end is missing, and a count that was doubted."""
        line, self._partial = self._partial, b""
        if self._is_candump is None:
            line = self._told_apart(line)
        rest: list[Timed] = []
        if self._is_candump:
            rest += self._receive_line(line)
        else:
            rest += [(0, ticks) for ticks in self._protocol.receive_data(line, 0)]
        return rest + [(ticks.stamp.mid_ns if self._is_candump else 0, ticks) for ticks in self._protocol.finish()]

    def _told_apart(self, begin: bytes) -> bytes:
        """Which of the two is it? From the first bytes, which come back without an editor's mark."""
        begin = begin.removeprefix(BOM_UTF8)
        self._is_candump = begin.lstrip().startswith(b"(") or _CANDUMP.search(begin) is not None
        return begin

    def _receive_line(self, line: bytes) -> Iterator[Timed]:
        if not line.strip():
            return
        text = line.decode("ascii", "replace").strip()
        logged = parse_candump_line(text)
        if logged is None:
            self.counts["fd_frames" if CANDUMP_FD.fullmatch(text) else "bad_lines"] += 1
            return
        for ticks in self._protocol.receive_frame(logged.frame, logged.stamp_ns):
            yield ticks.stamp.mid_ns, ticks


class ImuFile:
    """Inertial samples, at the board's own time."""

    def __init__(self) -> None:
        # Only a board whose clock goes back has restarted: there is no host's clock beside it.
        self._protocol = ImuProtocol(imu_config(latency_ms=(0.0, 1e13)))
        self.counts = self._protocol.counts

    def receive_data(self, data: bytes) -> list[Timed]:
        """Samples that `data` completes."""
        return [(1000 * (sample.device_time_us or 0), sample) for sample in self._protocol.receive_data(data, 0)]

    def finish(self) -> list[Timed]:
        """What stands behind a beginning that never ended."""
        return [(1000 * (sample.device_time_us or 0), sample) for sample in self._protocol.finish()]


class GpsFile:
    """Fixes, at their UTC in nanoseconds since 1970 (0 while the receiver has told no date)."""

    def __init__(self, config: GpsConfig) -> None:
        self._protocol = GpsProtocol(config)
        self.counts = self._protocol.counts

    def receive_data(self, data: bytes) -> list[Timed]:
        """Fixes that `data` completes."""
        return [(_utc_ns(fix.utc), fix) for fix in self._protocol.receive_data(data, 0)]

    def finish(self) -> list[Timed]:
        """The last epoch's fix."""
        return [(_utc_ns(fix.utc), fix) for fix in self._protocol.finish()]


def laser_config(
    baud: int, scan_angle_deg: int, resolution_deg: float, unit: Literal["mm", "cm"], write_configuration: bool
) -> LaserConfig:
    """A scanner somewhere, not mounted on anything."""
    return declared(
        LaserConfig,
        port="",
        baud=baud,
        scan_angle_deg=scan_angle_deg,
        resolution_deg=resolution_deg,
        unit=unit,
        write_configuration=write_configuration,
        latency_ms=(0.0, 0.0),
        range_bound_m=1.0,
        angle_bound_deg=1.0,
        mount_x_m=0.0,
        mount_y_m=0.0,
        mount_z_m=0.0,
        mount_pitch_deg=0.0,
        mount_position_bound_m=0.0,
        mount_angle_bound_deg=0.0,
    )


def encoders_config(
    left: str, right: str, interface: Literal["slcan", "socketcan"] = "slcan", bitrate: int = 500000
) -> EncodersConfig:
    """Two counters, in ticks."""
    return declared(
        EncodersConfig,
        port="",
        interface=interface,
        bitrate=bitrate,
        dbc="",
        left=left,
        right=right,
        left_metres_per_tick=1.0,
        right_metres_per_tick=1.0,
        latency_ms=(0.0, 0.0),
        restart_ms=1e9,  # of a unit that nobody knows a pause says nothing
    )


def imu_config(baud: int = 115200, latency_ms: tuple[float, float] = (0.0, 0.0)) -> ImuConfig:
    """An inertial board of unknown quality."""
    return declared(
        ImuConfig,
        port="",
        baud=baud,
        latency_ms=latency_ms,
        clock_drift_ppm=1000.0,
        gyro_bias_bound_dps=1.0,
        gyro_bias_drift_dps2=1.0,
        gyro_noise_bound_dps=1.0,
        gyro_scale_bound=0.5,
        tilt_bound_deg=1e6,  # what a board vouches for is no reason to leave a reading out
        accel_bound_mps2=1e6,
    )


def gps_config(gst_factor: float, range_error_m: float, baud: int = 115200) -> GpsConfig:
    """A receiver whose bounds are two factors."""
    return declared(
        GpsConfig,
        port="",
        baud=baud,
        latency_ms=(0.0, 0.0),
        gst_factor=gst_factor,
        range_error_m=range_error_m,
        floor_horizontal_m=0.0,
        floor_vertical_m=0.0,
    )


def declared(kind: Callable[..., C], **fields: Any) -> C:
    """A device's declaration from what the command line gave. Raises ConfigurationError that names what is wrong."""
    try:
        return kind(**fields)
    except ValidationError as error:
        entries = error.errors(include_url=False)
        # Without a place it is about several keys, and names them itself.
        raise ConfigurationError("; ".join(": ".join([*map(str, e["loc"][:1]), e["msg"]]) for e in entries)) from None


def read_dbc(path: Path) -> str:
    """The text of a DBC file. Raises ConfigurationError."""
    try:
        return path.read_text(encoding="cp1252", errors="replace")
    except OSError as error:
        raise ConfigurationError(f"--dbc {path}: cannot be read: {error.strerror}; name a Vector DBC file") from None


def _utc_ns(utc: str | None) -> int:
    """ISO 8601 with milliseconds; second 60, a leap second, is the next minute's first, as in Unix time."""
    if utc is None:
        return 0
    minute, second = utc.removesuffix("Z").rsplit(":", 1)
    begin = datetime.fromisoformat(minute).replace(tzinfo=UTC)
    return (begin - _EPOCH) // timedelta(microseconds=1) * 1000 + round(float(second) * 1000) * 1_000_000
