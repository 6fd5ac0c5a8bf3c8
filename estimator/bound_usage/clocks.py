"""Latency and clock drift: the time from a device's own stamp to the read wanders no further than declared.

read - device = offset + latency: the offset of two clocks is unknown but drifts slowly, so the spread of the difference
shows how much of the declared interval of latency is used; the interval's place is not seen.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.config import GpsConfig, ImuConfig
from estimator.bound_usage.at_rest import largest_change
from estimator.bound_usage.ledger import Ledger
from estimator.bound_usage.recording import Array, Recording, Stamps, Whole

IMU_LATENCY, IMU_DRIFT = "devices.imu.latency_ms", "devices.imu.clock_drift_ppm"
GPS_LATENCY = "devices.gps.latency_ms"
RESOLUTION_MS = 1.0
"""Some messages count whole milliseconds."""
HOST_DRIFT_PPM = 200.0
"""A computer's clock against UTC: worse than any that works."""
PIECE_S = 10.0
LONG_S = 60.0


def weigh_clocks(ledger: Ledger, recording: Recording, imu: ImuConfig, gps: GpsConfig | None) -> None:
    """The inertial board's clock and latency, and the receiver's latency."""
    packets = recording.packets
    for epoch in np.unique(packets.epoch):
        chosen = (packets.epoch == epoch) & np.isfinite(packets.device_us)
        if np.count_nonzero(chosen) > 1:
            offset = _offset(packets.stamps[chosen], packets.device_us[chosen] * 1e-3)
            _latency(ledger, IMU_LATENCY, offset, imu.clock_drift_ppm, RESOLUTION_MS)
            _clock_drift(ledger, offset)
    chosen = np.isfinite(recording.utc_s)
    if gps is not None and np.count_nonzero(chosen) > 1:
        offset = _offset(recording.fix_stamps[chosen], recording.utc_s[chosen] * 1e3)
        _latency(ledger, GPS_LATENCY, offset, HOST_DRIFT_PPM, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Offset:
    """Host time less device time, as each reading's stamp bounds it. [n] each."""

    when_ns: Whole
    seconds: Array
    low_ms: Array
    """A reading that came late because the host slept has a stamp that opens backward: no latency is blamed for it."""
    high_ms: Array

    def __getitem__(self, chosen: NDArray[np.bool_]) -> "Offset":
        return Offset(self.when_ns[chosen], self.seconds[chosen], self.low_ms[chosen], self.high_ms[chosen])


def _offset(stamps: Stamps, device_ms: Array) -> Offset:
    begin_ns = stamps.latest_ns[0]
    device = device_ms - device_ms[0]
    return Offset(
        stamps.latest_ns,
        (stamps.latest_ns - begin_ns) * 1e-9,
        (stamps.earliest_ns - begin_ns) * 1e-6 - device,
        (stamps.latest_ns - begin_ns) * 1e-6 - device,
    )


def _latency(ledger: Ledger, key: str, offset: Offset, drift_ppm: float, resolution: float) -> None:
    """The constant offset must be in all intervals of a short piece of time; what lacks is lacking in the latency."""
    width = ledger.accounts[key].declared
    for piece in range(int(offset.seconds[-1] / PIECE_S) + 1):
        inside = offset[(offset.seconds >= piece * PIECE_S) & (offset.seconds < (piece + 1) * PIECE_S)]
        if len(inside.seconds) > 1:
            lacking = largest_change(inside.low_ms, inside.seconds, drift_ppm * 1e-3, inside.high_ms)
            spread = np.maximum(width + lacking, 0.0)
            ledger.charge(
                key, needed=np.maximum(spread - resolution, 0.0), seen=spread, when_ns=inside.when_ns,
                values=spread, worst="{} ms later, or sooner, than another one", given=(IMU_DRIFT,),
            )  # fmt: skip


def _clock_drift(ledger: Ledger, offset: Offset) -> None:
    """Between two pieces of time the offset changed by more than their stamps allow."""
    seconds = offset.seconds
    block = np.flatnonzero(np.diff((seconds / PIECE_S).astype(int), prepend=-1))
    low, high = np.maximum.reduceat(offset.low_ms, block), np.minimum.reduceat(offset.high_ms, block)
    begin, end = seconds[block], seconds[np.append(block[1:], len(seconds)) - 1]
    for j in range(1, len(block)):
        apart = end[j] - begin[:j]
        change = np.maximum(low[j] - high[:j], low[:j] - high[j]) - RESOLUTION_MS
        far = apart > LONG_S
        drift_ppm = np.abs(high[j] - high[:j]) / np.maximum(begin[j] - begin[:j], 1.0) * 1e3
        ledger.charge(
            IMU_DRIFT, needed=np.where(far, np.maximum(change, 0.0) / apart * 1e3, np.nan),
            seen=np.where(far, drift_ppm, np.nan), when_ns=np.full(j, offset.when_ns[block[j]]), values=apart,
            worst="the board's clock against the host's over {} s", given=(IMU_LATENCY,),
        )  # fmt: skip
