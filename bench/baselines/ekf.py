"""The filter that everybody knows: an extended Kalman filter on the same readings.

State (x, y, z, roll, pitch, yaw, the gyroscope's three biases) on Earth. The declared bounds are taken for uniform
distributions, so a standard deviation is bound / sqrt 3: the usual reading of a data sheet (`bound_sigmas` changes
it). Its three-sigma box is no bound, only what people take for one.
"""

from dataclasses import dataclass, field
from math import cos, isnan, radians, sin, sqrt, tan

import numpy as np
from numpy.typing import NDArray

from drivers.config import ImuConfig
from estimator.config import RobotConfig

Array = NDArray[np.float64]
GRAVITY = 9.80665
SQRT3 = sqrt(3.0)
STATES = 9


@dataclass(slots=True, eq=False)
class ExtendedKalmanFilter:
    """Predict with the tracks and the gyroscope, correct with tilt, accelerometers and positions."""

    robot: RobotConfig
    imu: ImuConfig
    state: Array
    """[9] started near the truth: unlike the set filter, it can't start with an unknown yaw."""
    covariance: Array
    quantum_m: float
    """Of one track's count."""
    bound_sigmas: float = SQRT3
    """So many standard deviations is a declared bound."""
    _gyro_variance: float = field(init=False)

    def __post_init__(self) -> None:
        self._gyro_variance = (radians(self.imu.gyro_noise_bound_dps) / self.bound_sigmas) ** 2
        bias = radians(self.imu.gyro_bias_bound_dps) / self.bound_sigmas
        self.covariance[6:, 6:] = np.eye(3) * bias**2

    def predict(self, left_m: float, right_m: float, gyro_rps: tuple[float, float, float], seconds: float) -> None:
        """One step of SMF equation 1, the midpoint's attitude; lateral and normal slip are white noise."""
        robot, x = self.robot, self.state
        d = 0.5 * (left_m + right_m)
        wx, wy, wz = ((rate - bias) * seconds for rate, bias in zip(gyro_rps, x[6:9], strict=True))
        sf, cf = sin(x[3]), cos(x[3])
        ct, tt = cos(x[4]), tan(x[4])
        p, q = wy * sf + wz * cf, wy * cf - wz * sf
        half = (x[3] + 0.5 * (wx + tt * p), x[4] + 0.5 * q, x[5] + 0.5 * p / ct)
        r1, r2, r3 = _axes(*half)
        sp, cp, st = sin(half[2]), cos(half[2]), sin(half[1])
        cth = cos(half[1])

        a = np.eye(STATES)
        a[:3, 4] = -d * cp * st, -d * sp * st, -d * cth
        a[:3, 5] = -d * sp * cth, d * cp * cth, 0.0
        a[3, 3:5] = 1.0 + tt * q, p / ct**2
        a[4, 3] = -p
        a[5, 3:5] = q / ct, p * tt / ct
        to_angles = np.array([[1.0, tt * sf, tt * cf], [0.0, cf, -sf], [0.0, sf / ct, cf / ct]])
        a[3:6, 6:9] = -seconds * to_angles

        slip = 0.5 * robot.slip_ratio * np.hypot(left_m, right_m) + self.quantum_m
        lateral = robot.lateral_slip_ratio * abs(d) + robot.turning_centre_m * abs(wz)
        along = np.outer(r1, r1) * slip**2
        across = np.outer(r2, r2) * lateral**2 + np.outer(r3, r3) * (robot.normal_slip_ratio * d) ** 2
        noise = np.zeros((STATES, STATES))
        noise[:3, :3] = (along + across) / self.bound_sigmas**2
        scale = (self.imu.gyro_scale_bound / self.bound_sigmas) ** 2 * np.array([wx, wy, wz]) ** 2
        rates = np.diag(self._gyro_variance * seconds**2 + scale)
        noise[3:6, 3:6] = to_angles @ rates @ to_angles.T
        noise[6:, 6:] = np.eye(3) * (radians(self.imu.gyro_bias_drift_dps2) / self.bound_sigmas * seconds) ** 2

        x[:3] += d * r1
        x[3:6] += wx + tt * p, q, p / ct
        self.covariance = a @ self.covariance @ a.T + noise

    def correct_tilt(self, roll: float, pitch: float) -> None:
        """Roll and pitch, both directly."""
        if not isnan(roll):
            sigma = radians(self.imu.tilt_bound_deg) / self.bound_sigmas
            self._scalar(roll - self.state[3], np.eye(STATES)[3], sigma)
            self._scalar(pitch - self.state[4], np.eye(STATES)[4], sigma)

    def correct_accelerometers(self, ahead: float, left: float) -> None:
        """f_x = -g sin(pitch), f_y = g cos(pitch) sin(roll), the robot's own acceleration taken for noise."""
        sigma = (self.imu.accel_bound_mps2 + self.robot.max_acceleration_mps2) / self.bound_sigmas
        h = np.zeros(STATES)
        h[4] = -GRAVITY * cos(self.state[4])
        self._scalar(ahead + GRAVITY * sin(self.state[4]), h, sigma)
        h = np.zeros(STATES)
        roll, pitch = self.state[3:5]
        h[3], h[4] = GRAVITY * cos(pitch) * cos(roll), -GRAVITY * sin(pitch) * sin(roll)
        self._scalar(left - GRAVITY * cos(pitch) * sin(roll), h, sigma)

    def correct_rest(self, gyro_rps: tuple[float, float, float], rate_bound_rps: float) -> None:
        """The robot stands still: what the gyroscope says is its bias, up to noise and `rate_bound_rps`."""
        sigma = (radians(self.imu.gyro_noise_bound_dps) + rate_bound_rps) / self.bound_sigmas
        for axis, rate in enumerate(gyro_rps):
            self._scalar(rate - self.state[6 + axis], np.eye(STATES)[6 + axis], sigma)

    def correct_position(self, enu: Array, bound: tuple[float, float, float]) -> None:
        """A fix of base_link itself."""
        for axis in range(3):
            self._scalar(enu[axis] - self.state[axis], np.eye(STATES)[axis], bound[axis] / self.bound_sigmas)

    def three_sigma(self) -> Array:
        """[6] of the pose."""
        return np.asarray(3.0 * np.sqrt(np.diag(self.covariance)[:6]))

    def _scalar(self, innovation: float, h: Array, sigma: float) -> None:
        """The Kalman update by one number, in Joseph's form."""
        ph = self.covariance @ h
        gain = ph / (h @ ph + sigma**2)
        self.state += gain * innovation
        keep = np.eye(STATES) - np.outer(gain, h)
        self.covariance = keep @ self.covariance @ keep.T + np.outer(gain, gain) * sigma**2


def _axes(roll: float, pitch: float, yaw: float) -> tuple[Array, Array, Array]:
    """The columns of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    sf, cf, st, ct, sp, cp = sin(roll), cos(roll), sin(pitch), cos(pitch), sin(yaw), cos(yaw)
    return (
        np.array([cp * ct, sp * ct, -st]),
        np.array([cp * st * sf - sp * cf, sp * st * sf + cp * cf, ct * sf]),
        np.array([cp * st * cf + sp * sf, sp * st * cf - cp * sf, ct * cf]),
    )
