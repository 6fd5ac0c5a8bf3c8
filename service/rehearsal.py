"""Once through everything that is compiled, before the first port is opened.

Compiling holds the interpreter for seconds. A read that waits for it comes late, later than the declared latency, and
its stamp would be a lie: so all machine code must be there (compiled once, then cached) before bytes arrive.
"""

from math import nan

import numpy as np

from drivers.samples import ABSENT3, Fix, InertialSample, Sample, Scan, Stamp, WheelTicks
from service.config import Config
from service.pipeline import Pipeline
from service.sample_queue import Arrival

MS = 1_000_000
BEGIN_NS = 10_000 * MS
DRIVE_MS = 500
LOST_MS = range(300, 340)
"""Into the drive, the inertial board is silent, so that a gap is bridged once."""


def rehearse(config: Config) -> None:
    """Put a few seconds of made-up samples through a pipeline that is thrown away."""
    pipeline = Pipeline(config)
    # Long enough for the bias to be seen at standstill, which takes `standstill_s` before and after.
    still_ms = 300 + 10 * round(200.0 * (config.filter.standstill_s or 0.0))
    for at_ms in (*range(0, still_ms, 20), *range(still_ms, still_ms + DRIVE_MS, 5)):
        for device, sample in _samples(at_ms, max(at_ms - still_ms, 0)):
            pipeline.step(Arrival(device, sample, 0))
    pipeline.finish()
    # What is asked of a map beside inserting.
    pipeline.map.take_dirty()
    pipeline.map.evict(map(tuple, pipeline.map.places()[:1].tolist()))
    assert pipeline.map.cells_seen
    assert pipeline.map.mean_width_m > 0.0


def _samples(at_ms: int, driven_ms: int) -> list[tuple[str, Sample]]:
    """What a robot would hear at that time: it stands, then drives slowly ahead, turning a little."""
    now_ns = BEGIN_NS + at_ms * MS
    stamp = Stamp(now_ns - MS, now_ns)
    out: list[tuple[str, Sample]] = []
    if driven_ms not in LOST_MS:
        gyro = (0.0, 0.0, 0.01 if driven_ms else 0.0)
        out.append(("imu", InertialSample(stamp, "HIGHRES_IMU", 0, at_ms * 1000, gyro_rps=gyro)))
    if at_ms % 10:
        return out
    for sensor in (1, 2):
        force = (0.0, 0.0, nan)
        out.append(("imu", InertialSample(stamp, "HIGHRES_IMU", sensor, at_ms * 1000, accel_mps2=force)))
    tilt = InertialSample(stamp, "ATTITUDE", 0, at_ms * 1000, accel_mps2=ABSENT3, tilt_rad=(0.001, 0.001))
    out.append(("imu", tilt))
    epoch = int(driven_ms > LOST_MS.stop)
    out.append(("encoders", WheelTicks(stamp, driven_ms // 2, driven_ms // 2, epoch)))
    if at_ms % 100 == 0:
        out.append(("gps", Fix(stamp, None, 48.0, 11.0 + driven_ms * 1e-9, 500.0, 4, 1.0, (0.02, 0.02, 0.04))))
        ranges = np.full(181, 2.0)
        ranges[:10] = np.inf
        ranges[10:20] = nan
        offsets = np.arange(181, dtype=np.int64) * 37_000
        out.append(("laser", Scan(stamp, offsets, -np.pi / 2, np.radians(1.0), ranges, 16)))
    return out
