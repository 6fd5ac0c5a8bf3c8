"""The emulated GPS receiver: GGA, RMC and GST at each epoch."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta

from drivers.gps_nmea.codec import (
    ErrorEstimate,
    Minimum,
    Position,
    serialise_gga,
    serialise_gst,
    serialise_rmc,
)
from drivers.gps_nmea.fields import Angle, TimeOfDay


class GpsEmulator:
    """Sends one epoch at each whole multiple of its period."""

    def __init__(
        self,
        position: Callable[[int], tuple[float, float, float]],
        *,
        start_ns: int = 0,
        period_ns: int = 100_000_000,
        latency_ns: int = 40_000_000,
        quality: int = 4,
        hdop: float = 0.7,
        sigma_m: tuple[float, float, float] = (0.01, 0.01, 0.02),
        separation_m: float = 40.0,
        utc_start: datetime = datetime(2024, 5, 1, 12, tzinfo=UTC),
        baud: int = 115200,
        velocity: Callable[[int], tuple[float, float] | None] | None = None,
    ) -> None:
        """`position(t_ns)` is the antenna's latitude and longitude in degrees and its height above the ellipsoid.

        The first epoch is `start_ns`, when UTC is `utc_start` (so periods of whole hundredths of a second); its
        sentences are on the wire `latency_ns` later. `sigma_m`: what GST says of east, north and up. `velocity(t_ns)`:
        east and north in m/s, for RMC; None leaves speed and course empty.
        """
        self._position = position
        self._start_ns = start_ns
        self._next_ns = start_ns
        self._period_ns = period_ns
        self.latency_ns = latency_ns
        """From acquisition to the wire."""
        self.quality = quality
        """GGA quality from now on; 0 sends epochs without a fix."""
        self._hdop = hdop
        self._sigma_m = sigma_m
        self._separation_m = separation_m
        self._utc_start = utc_start
        self._baud = baud
        self._velocity = velocity

    @property
    def baud(self) -> int | None:
        """The line rate."""
        return self._baud

    def receive_data(self, data: bytes, now_ns: int) -> None:
        """The receiver takes no commands."""

    def data_to_send(self, now_ns: int) -> bytes:
        """The sentences of all epochs due by `now_ns`."""
        data = bytearray()
        while self._next_ns + self.latency_ns <= now_ns:
            data += self._sentences(self._next_ns)
            self._next_ns += self._period_ns
        return bytes(data)

    def _sentences(self, t_ns: int) -> bytes:
        utc = self._utc_start + timedelta(microseconds=(t_ns - self._start_ns) // 1000)
        time = TimeOfDay(utc.hour, utc.minute, utc.second, utc.microsecond * 1000)
        if self.quality == 0:
            nowhere = Position(time, None, None, 0, satellites=0)
            return serialise_gga(nowhere) + serialise_rmc(Minimum(nowhere, utc.date()))
        lat_deg, lon_deg, height_m = self._position(t_ns)
        at = Position(
            time,
            Angle(lat_deg),
            Angle(lon_deg),
            self.quality,
            self._hdop,
            height_m - self._separation_m,
            self._separation_m,
            satellites=12,
        )
        velocity_mps = self._velocity(t_ns) if self._velocity is not None else None
        east_m, north_m, up_m = self._sigma_m
        return (
            serialise_gga(at)
            + serialise_rmc(Minimum(at, utc.date(), velocity_mps))
            + serialise_gst(ErrorEstimate(time, east_m, north_m, up_m))
        )
