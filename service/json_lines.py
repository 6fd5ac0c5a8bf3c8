"""Samples as JSON Lines, in the fields that `decode` and `listen` promise."""

import json
import math
from typing import Any

from drivers.samples import Fix, InertialSample, Sample, Scan, WheelTicks


def sample_line(sample: Sample) -> str:
    """One sample as one line; absent values are null."""
    return json.dumps(_fields(sample), allow_nan=False, separators=(",", ":"))


def _fields(sample: Sample) -> dict[str, Any]:
    stamp_ns = sample.stamp.mid_ns
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
    """JSON knows no NaN and no infinity."""
    return round(value, 9) if math.isfinite(value) else None
