"""What the mixture and the Kalman map are fed: mean and covariance of the pose at each beam's time, by an EKF.

It gets the same samples as the set filter (ticks, gyroscope, tilt, accelerometers; standing still it learns the
gyroscope's bias too) and starts as the map frame does: x, y, z and yaw are zero by definition.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan, nan, radians

import numpy as np
from numpy.typing import NDArray

from bench.baselines.ekf import STATES, ExtendedKalmanFilter
from drivers.samples import InertialSample, Sample, WheelTicks
from service.config import Config

Array = NDArray[np.float64]
Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class GaussianPoses:
    """The EKF's poses of a drive, a row a step."""

    time_ns: Times
    """[n] rising."""
    mean: Array
    """[n, 6] as estimator.bounded_pose.AXES."""
    covariance: Array
    """[n, 6, 6]"""

    def at(self, time_ns: Times) -> tuple[Array, Array]:
        """Means [m, 6], linear between steps, and covariances [m, 6, 6], the later step's."""
        after = np.clip(np.searchsorted(self.time_ns, time_ns), 1, len(self.time_ns) - 1)
        before = after - 1
        span = self.time_ns[after] - self.time_ns[before]
        part = np.clip((time_ns - self.time_ns[before]) / span, 0.0, 1.0)[:, None]
        return self.mean[before] * (1.0 - part) + self.mean[after] * part, self.covariance[after]


def middle_ns(sample: InertialSample | WheelTicks) -> int:
    """Of the sample's stamp."""
    return (sample.stamp.earliest_ns + sample.stamp.latest_ns) // 2


def gaussian_poses(config: Config, samples: Sequence[Sample], bound_sigmas: float) -> GaussianPoses:
    """Run the EKF over a drive's samples; a declared bound is `bound_sigmas` standard deviations."""
    imu, encoders, settings = config.devices.imu, config.devices.encoders, config.filter
    readings = sorted((s for s in samples if isinstance(s, InertialSample | WheelTicks)), key=middle_ns)
    tilt = next(s.tilt_rad for s in readings if isinstance(s, InertialSample) and not isnan(s.tilt_rad[0]))
    state, covariance = np.zeros(STATES), np.zeros((STATES, STATES))
    state[3:5] = tilt
    covariance[3, 3] = covariance[4, 4] = (radians(imu.tilt_bound_deg) / bound_sigmas) ** 2
    ekf = ExtendedKalmanFilter(config.robot, imu, state, covariance, encoders.left_metres_per_tick, bound_sigmas)
    last: tuple[int, WheelTicks] | None = None
    rates: list[tuple[float, float, float]] = []
    rate, moved_ns = (nan, nan, nan), 0
    times, means, covariances = [], [], []
    for reading in readings:
        now_ns = middle_ns(reading)
        if isinstance(reading, InertialSample):
            ekf.correct_tilt(*reading.tilt_rad)
            if not isnan(reading.accel_mps2[0]):
                ekf.correct_accelerometers(*reading.accel_mps2[:2])
            if not isnan(reading.gyro_rps[0]):
                rates.append(reading.gyro_rps)
                resting = settings.standstill_s is not None and now_ns - moved_ns > settings.standstill_s * 1e9
                if last is not None and resting:
                    ekf.correct_rest(reading.gyro_rps, radians(settings.standstill_rate_dps or 0.0))
            continue
        if last is None:
            last, moved_ns = (now_ns, reading), now_ns
        then_ns, ticks = last
        if rates:
            x, y, z = np.mean(rates, axis=0)
            rate, rates = (float(x), float(y), float(z)), []
        if now_ns > then_ns and not isnan(rate[0]):
            left = (reading.left - ticks.left) * encoders.left_metres_per_tick
            right = (reading.right - ticks.right) * encoders.right_metres_per_tick
            ekf.predict(left, right, rate, (now_ns - then_ns) * 1e-9)
        if (reading.left, reading.right) != (ticks.left, ticks.right):
            moved_ns = now_ns
        last = now_ns, reading
        times.append(now_ns)
        means.append(ekf.state[:6].copy())
        covariances.append(ekf.covariance[:6, :6].copy())
    return GaussianPoses(np.array(times), np.array(means), np.array(covariances))
