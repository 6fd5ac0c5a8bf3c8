"""Samples as JSON Lines, in the fields that `decode` and `listen` promise."""

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

from drivers.samples import Fix, InertialSample, Sample, Scan, WheelTicks


def print_samples(samples: Iterable[tuple[int, Sample]]) -> int:
    """Print samples with their times, at once; returns how many."""
    lines = [sample_line(sample, stamp_ns) for stamp_ns, sample in samples]
    if lines:
        print("\n".join(lines), flush=True)
    return len(lines)


def counts_line(byte_count: int, sample_count: int, counts: Mapping[str, int]) -> str:
    """What happened, as one line."""
    told = {
        "bytes": byte_count,
        "lines": sample_count,
        **{name: counts[name] for name in sorted(counts) if counts[name]},
    }
    return "counts: " + " ".join(f"{name}={count}" for name, count in told.items())


def sample_line(sample: Sample, stamp_ns: int | None = None) -> str:
    """One sample as one line; absent values are null. The time is the middle of its stamp, unless given."""
    stamp_ns = sample.stamp.mid_ns if stamp_ns is None else stamp_ns
    return json.dumps(_fields(sample, stamp_ns), allow_nan=False, separators=(",", ":"))


def _fields(sample: Sample, stamp_ns: int) -> dict[str, Any]:
    match sample:
        case Scan():
            return {
                "kind": "scan",
                "stamp_ns": stamp_ns,
                "angle_min_rad": sample.angle_min_rad,
                "angle_increment_rad": sample.angle_increment_rad,
                "ranges_m": [_finite(value) for value in sample.ranges_m.tolist()],
                "status": sample.status,
            }
        case WheelTicks():
            return {"kind": "ticks", "stamp_ns": stamp_ns, "left": sample.left, "right": sample.right}
        case InertialSample():
            return {
                "kind": "inertial",
                "stamp_ns": stamp_ns,
                "message": sample.message,
                "id": sample.sensor_id,
                "accel_mps2": [_finite(value) for value in sample.accel_mps2],
                "gyro_rps": [_finite(value) for value in sample.gyro_rps],
                "tilt_rad": [_finite(value) for value in sample.tilt_rad],
            }
        case Fix():
            return {
                "kind": "fix",
                "stamp_ns": stamp_ns,
                "utc": sample.utc,
                "lat_deg": sample.lat_deg,
                "lon_deg": sample.lon_deg,
                "alt_m": _finite(sample.alt_m),
                "quality": sample.quality,
                "hdop": _finite(sample.hdop),
                "bound_m": [_finite(value) for value in sample.bound_m],
            }


def _finite(value: float) -> float | None:
    """JSON knows no NaN and no infinity; zero needs no sign."""
    return round(value, 9) + 0.0 if math.isfinite(value) else None
