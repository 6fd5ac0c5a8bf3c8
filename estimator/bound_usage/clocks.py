"""Latency and clock drift: the time from a device's own stamp to the read wanders no further than declared.

read - device = offset + latency: the offset of two clocks is unknown but drifts slowly, so the spread of the difference
shows how much of the declared interval of latency is used; the interval's place is not seen.
"""

import numpy as np

from drivers.config import GpsConfig, ImuConfig
from estimator.bound_usage.at_rest import largest_change
from estimator.bound_usage.ledger import Ledger
from estimator.bound_usage.recording import Array, Recording, Whole

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
    read_ns = packets.stamps.latest_ns + round(imu.latency_ms[0] * 1e6)
    for epoch in np.unique(packets.epoch):
        chosen = (packets.epoch == epoch) & np.isfinite(packets.device_us)
        if np.count_nonzero(chosen) > 1:
            behind = _behind(read_ns[chosen], packets.device_us[chosen] * 1e-3)
            _latency(ledger, IMU_LATENCY, read_ns[chosen], behind, imu.clock_drift_ppm, RESOLUTION_MS)
            _clock_drift(ledger, read_ns[chosen], behind)
    if gps is not None:
        read_ns = recording.fix_stamps.latest_ns + round(gps.latency_ms[0] * 1e6)
        chosen = np.isfinite(recording.utc_s)
        if np.count_nonzero(chosen) > 1:
            utc_ms = (recording.utc_s[chosen] - recording.utc_s[chosen][0]) * 1e3
            _latency(ledger, GPS_LATENCY, read_ns[chosen], _behind(read_ns[chosen], utc_ms), HOST_DRIFT_PPM, 0.0)


def _behind(read_ns: Whole, device_ms: Array) -> Array:
    """[n] ms from the device's stamp to the read, up to a constant."""
    return np.asarray((read_ns - read_ns[0]) * 1e-6 - (device_ms - device_ms[0]))


def _latency(ledger: Ledger, key: str, read_ns: Whole, behind_ms: Array, drift_ppm: float, resolution: float) -> None:
    """Inside short pieces of time, so that drift hardly counts."""
    seconds = (read_ns - read_ns[0]) * 1e-9
    for piece in range(int(seconds[-1] / PIECE_S) + 1):
        inside = (seconds >= piece * PIECE_S) & (seconds < (piece + 1) * PIECE_S)
        if np.count_nonzero(inside) > 1:
            spread = largest_change(behind_ms[inside], seconds[inside], drift_ppm * 1e-3)
            ledger.charge(
                key, needed=np.maximum(spread - resolution, 0.0), seen=spread, when_ns=read_ns[inside],
                values=spread, worst="{} ms later, or sooner, than another one", given=(IMU_DRIFT,),
            )  # fmt: skip


def _clock_drift(ledger: Ledger, read_ns: Whole, behind_ms: Array) -> None:
    """What latency can't explain of a change over a long time."""
    seconds = (read_ns - read_ns[0]) * 1e-9
    block = np.flatnonzero(np.diff((seconds / PIECE_S).astype(int), prepend=-1))
    low = np.minimum.reduceat(behind_ms, block)
    high = np.maximum.reduceat(behind_ms, block)
    begin, end = seconds[block], seconds[np.append(block[1:], len(seconds)) - 1]
    latency = ledger.trusted(IMU_LATENCY) + RESOLUTION_MS
    for j in range(1, len(block)):
        apart = end[j] - begin[:j]
        change = np.maximum(high[j] - low[:j], high[:j] - low[j]) - latency
        far = apart > LONG_S
        drift_ppm = np.abs(low[j] - low[:j]) / np.maximum(begin[j] - begin[:j], 1.0) * 1e3
        ledger.charge(
            IMU_DRIFT, needed=np.where(far, np.maximum(change, 0.0) / apart * 1e3, np.nan),
            seen=np.where(far, drift_ppm, np.nan), when_ns=np.full(j, read_ns[block[j]]), values=apart,
            worst="the board's clock against the host's over {} s", given=(IMU_LATENCY,),
        )  # fmt: skip
